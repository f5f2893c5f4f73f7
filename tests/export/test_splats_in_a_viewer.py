"""A viewer of splats that others wrote shows what the command says that it does."""

import json
import subprocess

import pytest
import torch
from small_scenes import psnr, scene
from splat_viewers import install, needs_viewers, open_playcanvas
from test_gaussians import seen

from sparsestyle_ns.export.fit_gaussians import fit_gaussians
from sparsestyle_ns.export.gaussians import DRAWINGS, picture_of_gaussians
from sparsestyle_ns.export.gltf import encode_gltf
from sparsestyle_ns.export.place_gaussians import place_gaussians
from sparsestyle_ns.export.splat_file import encode_splats

pytestmark = pytest.mark.slow

VALIDATE = """
const fs = require("fs");
require("gltf-validator").validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])))
  .then((report) => console.log(JSON.stringify(report.issues)));
"""


@pytest.fixture(scope="module")
def viewers(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewers")
    install(folder)
    return folder


@pytest.fixture(scope="module", params=["ndc", "box"])
def splats(request):
    """A small scene with its Gaussians, and views that have their centre in the middle, as the viewer's have."""
    small = scene(request.param)
    small.cameras.cx[:], small.cameras.cy[:] = 32.0, 24.0
    small.cameras.fy[:] = small.cameras.fx
    views = [seen(small, index) for index in range(3)]
    gaussians = fit_gaussians(place_gaussians(small.model.space, views, 4000), views, small.model.background, 60)
    return small, views, gaussians


@needs_viewers
@pytest.mark.parametrize("form", ["full", "small"])
def test_playcanvas_shows_a_file_as_the_command_says(form, splats, viewers, tmp_path):
    small, views, gaussians = splats
    (viewers / f"{form}.ply").write_bytes(encode_splats(gaussians, form == "small"))
    with open_playcanvas(viewers, tmp_path / "profile", f"{form}.ply") as viewer:
        for view in views[:2]:
            shown = viewer.picture(view.camera, small.model.background)
            background = small.model.background
            own = picture_of_gaussians(gaussians, view.camera, background, DRAWINGS["PlayCanvas"]).clamp(0.0, 1.0)
            assert psnr(shown, own) > 32  # it keeps numbers in 16 bits and blends in 8
            assert psnr(shown, view.picture) == pytest.approx(psnr(own, view.picture), abs=1.0)


@needs_viewers
def test_khronos_validator_finds_no_error_in_splats_as_gltf(splats, viewers):
    small, _, gaussians = splats
    path = viewers / "scene.glb"
    path.write_bytes(encode_gltf(gaussians, small.model.space))
    (viewers / "validate.cjs").write_text(VALIDATE)
    done = subprocess.run(["node", "validate.cjs", path], cwd=viewers, capture_output=True, text=True, check=True)
    issues = json.loads(done.stdout)
    assert issues["numErrors"] == 0, issues["messages"]
    assert torch.isfinite(gaussians.rows).all()
