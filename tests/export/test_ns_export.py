"""nerfstudio's own exporters take these runs, and write all of their files or none, and never over others."""

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import run_entrypoint
from interrupted import finish
from plyfile import PlyData

from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.pipelines.command_output import claim_output
from sparsestyle_ns.pipelines.export_command import check_box, check_export
from sparsestyle_ns.utils.errors import InputError

pytest.importorskip("open3d", exc_type=ImportError)  # which names the library that it lacks


@pytest.mark.parametrize("what", ["pointcloud", "poisson"])
def test_ns_export_writes_points_and_a_mesh_of_a_stylised_run(what, patterned_run, tmp_path):
    from nerfstudio.scripts import exporter

    where = ["--load-config", str(patterned_run / "config.yml"), "--output-dir", str(tmp_path)]
    counts = ["--num-points", "3000", "--num-rays-per-batch", "1500", "--normal-method", "open3d"]
    texture = ["--texture-method", "point_cloud"] if what == "poisson" else []
    run_entrypoint(exporter.entrypoint, [what, *where, *counts, *texture])
    name = {"pointcloud": "point_cloud.ply", "poisson": "poisson_mesh.ply"}[what]
    vertices = PlyData.read(tmp_path / name)["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], axis=-1)
    assert len(points) > 500
    # Of the photos' 2,304 pixels one batch of 1,500, drawn with replacement, has 1,100, and two have 1,700.
    assert what == "poisson" or len(np.unique(points, axis=0)) > 1400


@pytest.mark.parametrize(
    ("kind", "settings", "name"),
    [
        ("ExportPointCloud", {}, "point_cloud.ply"),
        ("ExportTSDFMesh", {"texture_method": "tsdf"}, "tsdf_mesh.ply"),
        ("ExportTSDFMesh", {}, "mesh.obj"),
        ("ExportTSDFMesh", {}, "material_0.png"),
        ("ExportPoissonMesh", {}, "poisson_mesh.ply"),
        ("ExportPoissonMesh", {"save_point_cloud": True}, "point_cloud.ply"),
        ("ExportCameraPoses", {}, "transforms_eval.json"),
    ],
)
def test_an_export_never_takes_the_place_of_a_file(kind, settings, name, tmp_path, monkeypatch):
    from nerfstudio.scripts import exporter

    def claim(folder):
        claim_output(getattr(exporter, kind)(load_config=None, output_dir=folder, **settings), "exporter")

    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "notes.txt").touch()
    claim(tmp_path / "made")  # a folder may have other files
    (tmp_path / "made" / name).touch()
    sentence = rf"Something is at --output-dir .*made already \({name}\); take {tmp_path / 'made-2'} or another place"
    with pytest.raises(InputError, match=sentence):
        claim(tmp_path / "made")
    monkeypatch.chdir(tmp_path / "made")
    with pytest.raises(InputError, match=f"Something is at --output-dir [.] already .* take {tmp_path / 'made-2'} or"):
        claim(".")
    claim(tmp_path / "made-2")
    with pytest.raises(
        InputError, match=r"can't be written to .*Not a directory.* name another place with --output-dir"
    ):
        claim(tmp_path / "made" / "notes.txt")


@pytest.mark.parametrize(
    ("kind", "settings", "sentence"),
    [
        ("ExportGaussianSplat", {}, "sparsestyle export RUN --format splat"),
        ("ExportMarchingCubesMesh", {}, "ns-export poisson --normal-method open3d"),
        ("ExportPointCloud", {}, "no normals of its own; add --normal-method open3d"),
        ("ExportPoissonMesh", {"normal_method": "open3d", "num_points": 0}, "--num-points is 0; give 1 or more"),
        (
            "ExportPointCloud",
            {"normal_method": "open3d", "num_points": 9, "num_rays_per_batch": 9},
            "--num-points is 9; give 100 or more",
        ),
        ("ExportTSDFMesh", {"downscale_factor": 0}, "--downscale-factor is 0; give 1 or more"),
        (
            "ExportTSDFMesh",
            {"resolution": 1},
            "--resolution is 1 1 1; give one number of cells, or three, each 2 or more",
        ),
        ("ExportTSDFMesh", {"resolution": [8, 9]}, "--resolution is 8 9; give one number of cells, or three"),
        (
            "ExportTSDFMesh",
            {"bounding_box_max": (-1, 1, 1)},
            "--bounding-box-min isn't below --bounding-box-max in x, y",
        ),
        ("ExportTSDFMesh", {"target_num_faces": 0}, "--target-num-faces is 0; give 4 or more"),
        ("ExportTSDFMesh", {"num_pixels_per_side": 0}, "--num-pixels-per-side is 0; give 8 or more"),
        ("ExportTSDFMesh", {"refinement_epsilon": -1.0}, "--refinement-epsilon is -1.0; give 0.0 or more"),
        ("ExportTSDFMesh", {"use_bounding_box": False, "bounding_box_max": (-1, 1, 1), "target_num_faces": None}, None),
        ("ExportPointCloud", {"normal_method": "open3d", "std_ratio": 0.0}, "--std-ratio is 0.0; give 0.001 or more"),
        ("ExportCameraPoses", {}, None),
    ],
)
def test_an_export_that_cant_be_done_is_refused_before_any_work(kind, settings, sentence, tmp_path):
    from nerfstudio.scripts import exporter

    command = getattr(exporter, kind)(load_config=None, output_dir=tmp_path, **settings)
    if sentence is None:
        check_export(command)
        return
    with pytest.raises(InputError, match=sentence):
        check_export(command)


def test_a_box_that_isnt_whole_is_named(tmp_path, capsys):
    from nerfstudio.scripts import exporter

    box = {"obb_center": (0.0, 0.0, 0.0), "normal_method": "open3d"}
    check_export(exporter.ExportPointCloud(load_config=None, output_dir=tmp_path, **box))
    assert "have an effect only together" in " ".join(capsys.readouterr().out.split())


def test_options_that_nerfstudio_doesnt_read_are_named(tmp_path, capsys):
    from nerfstudio.scripts import exporter

    options = {"bounding_box_min": (-2.0, -2.0, -2.0), "normal_method": "open3d"}
    check_export(exporter.ExportPoissonMesh(load_config=None, output_dir=tmp_path, **options))
    printed = " ".join(capsys.readouterr().out.split())
    assert "--bounding-box-min has no effect here: ns-export poisson takes points from everywhere, or from" in printed


BOX = "--obb-rotation 0 0 0 --obb-scale 1 1 1"


@pytest.mark.parametrize(
    ("words", "status", "left"),
    [
        ("gaussian-splat --output-dir {tmp}/new/folder", 1, set()),
        ("pointcloud --normal-method open3d --num-points 100 --depth-output-name foo --output-dir {tmp}/new", 1, set()),
        (f"pointcloud --normal-method open3d {BOX} --obb-center 90 90 90 --output-dir {{tmp}}/new", 1, set()),
        ("tsdf --downscale-factor 100 --output-dir {tmp}/new", 1, set()),
        (
            "tsdf --resolution 8 --bounding-box-min 50 50 50 --bounding-box-max 60 60 60 --output-dir {tmp}/new",
            1,
            set(),
        ),
        ("tsdf --resolution 100000 --output-dir {tmp}/new", 1, set()),  # more memory than any machine has
        ("tsdf --rgb-output-name depth --output-dir {tmp}/new", 1, set()),
        ("cameras --output-dir {tmp}/taken/new", 1, set()),
        (
            "tsdf --downscale-factor 1 --resolution 16 --texture-method tsdf --output-dir {tmp}/new",
            0,
            {"new", "tsdf_mesh.ply"},
        ),
        ("cameras --output-dir {tmp}/new", 0, {"new", "transforms_train.json", "transforms_eval.json"}),
    ],
)
def test_an_export_leaves_its_files_or_nothing(words, status, left, runs, tmp_path):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "taken").touch()
    command = ["ns-export", *words.format(tmp=tmp_path / "made").split()]
    ending = finish([*command, "--load-config", runs.style / "config.yml"], tmp_path / "log")
    assert ending.status == status, ending.printed[-3000:]
    assert "Traceback" not in ending.printed
    assert status == 0 or ending.printed.splitlines()[-1].startswith("Error: ")
    assert {path.name for path in (tmp_path / "made").rglob("*")} == {"taken", *left}


@pytest.mark.parametrize("where", [(90.0, 90.0, 90.0), None], ids=["elsewhere", "at the scene"])
def test_a_box_without_a_surface_is_refused(where, patterned_run, tmp_path):
    from nerfstudio.scripts import exporter

    pipeline = load_run(patterned_run / "config.yml").pipeline
    options = {"obb_center": where or (0.0, 0.0, 0.0), "obb_rotation": (0.0, 0.0, 0.0), "obb_scale": (9.0, 9.0, 9.0)}
    command = exporter.ExportPointCloud(load_config=None, output_dir=tmp_path, **options)
    if where is None:
        check_box(command, pipeline)
        return
    with pytest.raises(InputError, match=r"holds no surface: none of \d+ rays .* Most end between \(") as refused:
        check_box(command, pipeline)
    corners = re.findall(r"\(([^)]*)\)", str(refused.value))
    low, high = (np.array([float(each) for each in corner.split(", ")]) for corner in corners)
    assert (low < high).all()
    check_box(replace(command, obb_center=tuple((low + high) / 2), obb_scale=tuple(high - low)), pipeline)
