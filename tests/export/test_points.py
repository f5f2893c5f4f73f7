"""Points and meshes lie on what the cameras see, with its colours, and files say so to other programs."""

import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from plyfile import PlyData

from sparsestyle_ns.cli import main
from sparsestyle_ns.export import points as points_module
from sparsestyle_ns.export.points import (
    Points,
    at_edge,
    cross_likeness,
    encode_points,
    export_points,
    joined,
    likeness,
    splat,
    surface_points,
    surfaces,
)
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.render import over_background
from sparsestyle_ns.utils.errors import InputError

try:
    from sparsestyle_ns.export.mesh import open3d, picture_of_mesh, poisson_mesh
except InputError as error:
    MISSING = str(error)  # it names the library, and what to install
else:
    MISSING = ""
needs_open3d = pytest.mark.skipif(bool(MISSING), reason=MISSING)

WIDTH, HEIGHT = 96, 72


def cameras():
    """Three cameras in a row, 0.3 apart, that look along −z."""
    poses = torch.eye(4)[:3].repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([-0.3, 0.0, 0.3])
    return Cameras(poses, fx=80.0, fy=80.0, cx=48.0, cy=36.0, width=WIDTH, height=HEIGHT)


def look_at_ball(camera):
    """What a camera sees of a ball of radius 1 at (0, 0, −3), coloured by where one looks; nothing else is there."""
    bundle = camera.generate_rays(camera_indices=0, keep_shape=True)
    offset = bundle.origins - torch.tensor([0.0, 0.0, -3.0])
    along = (offset * bundle.directions).sum(dim=-1, keepdim=True)
    root = along.square() - offset.square().sum(dim=-1, keepdim=True) + 1.0
    hit = root > 0
    depth = torch.where(hit, -along - root.clamp(min=0).sqrt(), 20.0)
    rgb = torch.where(hit, 0.5 + 0.4 * torch.sin(2.0 * (bundle.origins + depth * bundle.directions)), 0.0)
    return {"rgb": rgb, "accumulation": hit.float(), "depth": depth}


@pytest.fixture(scope="module")
def ball():
    """Pictures of the ball and the points of each."""
    views = cameras()
    pictures = [look_at_ball(views[index : index + 1]) for index in range(3)]
    return pictures, [surface_points(views[index : index + 1], picture) for index, picture in enumerate(pictures)]


def test_points_lie_on_the_surface_with_its_colours(ball):
    points = joined(ball[1])
    assert len(points.positions) > 3000
    radius = (points.positions - torch.tensor([0.0, 0.0, -3.0])).norm(dim=-1)
    torch.testing.assert_close(radius, torch.ones_like(radius), atol=1e-4, rtol=0)
    torch.testing.assert_close(points.colors, 0.5 + 0.4 * torch.sin(2.0 * points.positions), atol=1e-4, rtol=0)


def test_pixels_at_the_edge_of_something_nearer_make_no_points():
    depth = torch.tensor([[1.0, 1.02, 3.0, 3.0], [1.0, 1.02, 3.0, 3.0]])
    assert at_edge(depth).tolist() == [[False, True, True, False]] * 2
    assert at_edge(depth.T).T.tolist() == [[False, True, True, False]] * 2


def test_far_background_and_what_is_hardly_there_make_no_points():
    camera = cameras()[:1]
    picture = {
        "rgb": torch.ones(HEIGHT, WIDTH, 3),
        "accumulation": torch.ones(HEIGHT, WIDTH, 1),
        "depth": torch.full((HEIGHT, WIDTH, 1), 2.0),
    }
    picture["depth"][:10] = 100.0
    picture["accumulation"][-10:] = 0.3
    assert len(surface_points(camera, picture).positions) == (HEIGHT - 21) * WIDTH  # ten, ten, and the edge of the far
    picture["accumulation"].zero_()
    assert len(surface_points(camera, picture).positions) == 0


def test_the_background_is_taken_off_colours(ball, monkeypatch):
    picture, points = ball[0][0], ball[1][0]
    accumulation, background = 0.8 * picture["accumulation"], torch.tensor([1.0, 1.0, 1.0])
    rgb = over_background(accumulation * picture["rgb"], accumulation, background)
    seen = {**picture, "accumulation": accumulation, "rgb": rgb}
    monkeypatch.setattr(points_module, "exact_pictures", lambda scene: [seen])
    pictures, parts = surfaces(SimpleNamespace(model=SimpleNamespace(background=background), cameras=cameras()))
    torch.testing.assert_close(pictures[0]["rgb"], picture["rgb"])
    torch.testing.assert_close(parts[0].colors, points.colors)


def test_a_view_is_like_what_the_points_of_the_others_show(ball):
    pictures, parts = ball
    for covered, value in cross_likeness(parts, cameras(), pictures):
        assert covered > 0.85
        assert value > 28


def test_splatting_shows_the_nearest_point():
    points = Points(
        torch.tensor([[0.0, 0.0, -4.0], [0.0, 0.0, -2.0], [0.0, 0.0, 2.0]]), torch.eye(3), torch.zeros(3, 3)
    )
    colors, shown = splat(points, cameras()[1:2])
    assert shown.nonzero().tolist() == [[36, 48]]
    assert colors[36, 48].tolist() == [0.0, 1.0, 0.0]


def test_likeness_counts_surfaces_only():
    picture = {"rgb": torch.full((1, 4, 3), 0.5), "accumulation": torch.tensor([[[1.0], [1.0], [0.0], [1.0]]])}
    shown = torch.tensor([[True, False, True, True]])
    found = likeness(torch.full((1, 4, 3), 0.6), shown, picture)
    assert found.covered == pytest.approx(2 / 3)
    assert found.psnr == pytest.approx(20.0, abs=1e-3)


def test_where_no_surface_is_covered_there_is_no_psnr(ball, capsys):
    pictures, parts = ball
    nowhere = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    assert likeness(torch.zeros(HEIGHT, WIDTH, 3), nowhere, pictures[0]) == (0.0, None)
    nothing = {**pictures[0], "accumulation": torch.zeros(HEIGHT, WIDTH, 1)}
    assert likeness(torch.zeros(HEIGHT, WIDTH, 3), ~nowhere, nothing) == (0.0, None)
    unseen = Points(*torch.empty(3, 0, 3))
    found = cross_likeness([parts[0], unseen, unseen], cameras(), pictures)
    assert [value is None for _, value in found] == [True, False, False]


def test_an_export_says_in_words_that_a_view_is_not_covered(ball, tmp_path, capsys, monkeypatch):
    pictures, parts = ball
    unseen = Points(*torch.empty(3, 0, 3))
    monkeypatch.setattr(points_module, "surfaces", lambda scene: (pictures, [parts[0], unseen, unseen]))
    scene = SimpleNamespace(cameras=cameras(), names=["a.png", "b.png", "c.png"])
    export_points(scene, tmp_path / "points.ply")
    printed = capsys.readouterr().out
    assert "a.png: none of its surfaces is covered, so there is no PSNR\n" in printed
    assert len(re.findall(r"% of its surfaces covered, PSNR there [\d.]+ dB", printed)) == 2
    assert "nan" not in printed


def test_no_points_make_no_file(ball, tmp_path, monkeypatch):
    unseen = Points(*torch.empty(3, 0, 3))
    monkeypatch.setattr(points_module, "surfaces", lambda scene: (ball[0], [unseen] * 3))
    with pytest.raises(InputError, match="The views show no surface point, so there is nothing to write"):
        export_points(SimpleNamespace(cameras=cameras(), names=["a", "b", "c"]), tmp_path / "points.ply")
    assert not (tmp_path / "points.ply").exists()


def test_other_programs_read_the_points(tmp_path, ball):
    points = ball[1][0]
    (tmp_path / "points.ply").write_bytes(encode_points(points))
    vertices = PlyData.read(tmp_path / "points.ply")["vertex"]
    np.testing.assert_allclose(np.stack([vertices[axis] for axis in "xyz"], axis=-1), points.positions.numpy())
    colors = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1)
    np.testing.assert_allclose(colors / 255.0, points.colors.numpy(), atol=0.5 / 255 + 1e-6)


@needs_open3d
def test_a_mesh_follows_the_surface_and_has_its_colours(ball):
    pictures, parts = ball
    mesh = poisson_mesh(joined(parts))
    radius = np.linalg.norm(np.asarray(mesh.vertices) - [0.0, 0.0, -3.0], axis=-1)
    assert np.abs(radius - 1.0).max() < 0.05
    assert np.asarray(mesh.vertices)[:, 2].min() > -3.6  # the back, which no camera saw, isn't made up
    covered, value = likeness(*picture_of_mesh(mesh, cameras()[1:2]), pictures[1])
    assert covered > 0.8
    assert value > 28


@needs_open3d
def test_too_few_points_make_no_mesh():
    with pytest.raises(InputError, match="only 5 surface points"):
        poisson_mesh(Points(*torch.rand(3, 5, 3)))


def test_a_machine_on_which_open3d_can_not_be_loaded_is_told_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "config.yml").write_text("method_name: hier-style\n")
    (tmp_path / "open3d.py").write_text(
        "raise OSError('libusb-1.0.so.0: cannot open shared object file: No such file or directory')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.delitem(sys.modules, "sparsestyle_ns.export.mesh", raising=False)
    with pytest.raises(SystemExit) as ended:
        main(["export", str(tmp_path), "--format", "mesh", "--output-path", str(tmp_path / "scene.ply")])
    message = ended.value.code
    assert message.startswith("Error: Open3D, which makes the mesh, can't be loaded (libusb-1.0.so.0: cannot open")
    assert "apt-get install libusb-1.0-0" in message
    assert "\n" not in message
    assert not (tmp_path / "scene.ply").exists()


@pytest.mark.parametrize("kind", ["ply", pytest.param("mesh", marks=needs_open3d)])
def test_a_run_is_exported_with_its_errors(patterned_run, tmp_path, capsys, kind):
    target = tmp_path / "new" / "scene.ply"
    main(["export", str(patterned_run), "--format", kind, "--output-path", str(target)])
    printed = capsys.readouterr().out
    html = f"sparsestyle export {patterned_run} --format html --output-path {target.with_suffix('.html')}"
    assert printed.splitlines()[-1] == f"Made {target} – next: {html}"
    found = re.findall(r"(image0\d\d).png: (\d+)% of its surfaces covered, PSNR there ([\d.]+) dB", printed)
    assert [name for name, _, _ in found] == ["image001", "image005", "image011"]
    assert all(int(covered) > 20 and float(value) > 15 for _, covered, value in found)
    if kind == "mesh":
        mesh = open3d.io.read_triangle_mesh(str(target))
        assert len(mesh.triangles) > 100
        assert mesh.has_vertex_colors()
    else:
        assert PlyData.read(target)["vertex"].count > 1000


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (["{tmp}/gone", "--output-path", "{tmp}/a.html"], "Error: There is no run at"),
        (["{tmp}/coarse", "--output-path", "{tmp}/a.html"], "Error: {tmp}/coarse is a run of coarse-fewshot"),
        (["{tmp}/run", "--output-path", "{tmp}"], "Error: --output-path {tmp} is a folder"),
        (["{tmp}/run", "--output-path", "{tmp}/run/config.yml/a.ply"], "Error: The scene can't be written to"),
        (["{tmp}/run", "--output-path", "{tmp}/a.html", "--resolution", "5"], "Error: --resolution 5 isn't between"),
    ],
)
def test_what_can_not_be_exported_is_said_in_one_sentence(tmp_path, given, sentence):
    for name, method in (("run", "hier-style"), ("coarse", "coarse-fewshot")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yml").write_text(f"method_name: {method}\n")
    with pytest.raises(SystemExit) as ended:
        main(["export", *(part.format(tmp=tmp_path) for part in given)])
    assert ended.value.code.startswith(sentence.format(tmp=tmp_path))
    assert "\n" not in ended.value.code


def test_ns_export_and_ns_render_get_colour_without_background_and_opacity():
    color, background = torch.rand(4, 3, generator=torch.Generator().manual_seed(0)), torch.ones(3)
    accumulation = torch.tensor([[1.0], [0.5], [0.1], [0.0]])
    outputs = {"rgb": over_background(accumulation * color, accumulation, background), "accumulation": accumulation}
    rgba = HierStyleModel.get_rgba_image(SimpleNamespace(background=background), outputs)
    torch.testing.assert_close(rgba[:3, :3], color[:3])
    assert rgba[3].tolist() == [0.0] * 4
    assert torch.equal(rgba[:, 3:], accumulation)
