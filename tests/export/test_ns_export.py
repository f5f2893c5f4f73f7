"""nerfstudio's own exporters of points and of a Poisson mesh take these runs."""

import numpy as np
import pytest
from conftest import run_entrypoint
from plyfile import PlyData

pytest.importorskip("open3d", exc_type=ImportError, reason="Open3D can't be loaded on this machine")


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
