"""A crop box, by which ns-render and the viewer cut a scene out: pictures show what is in it, before its background."""

from pathlib import Path
from types import SimpleNamespace
from typing import Dict, Sequence

import pytest
import torch
from conftest import coarse_pipeline
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.model_components.renderers import background_color_override_context
from torch import Tensor

from sparsestyle_ns.engine.loading import load_run

MAGENTA = torch.tensor([1.0, 0.0, 1.0])
EVERYWHERE = (0.0, 0.0, 0.0), (1e6, 1e6, 1e6)
NOWHERE = (0.0, 0.0, 1e3), (1.0, 1.0, 1.0)
SLAB = (0.0, 0.0, -3.0), (1e3, 1e3, 2.0)
"""All that is 2 to 4 before the average camera, which looks along −z."""


def cropped(model, camera: Cameras, box: Sequence, **settings) -> Dict[str, Tensor]:
    """The outputs as ns-render and the viewer ask for them."""
    box = OrientedBox.from_params(box[0], (0.0, 0.0, 0.0), box[1])
    with background_color_override_context(MAGENTA), torch.no_grad():
        return model.get_outputs_for_camera(camera, obb_box=box, **settings)


@pytest.fixture(scope="module")
def pipelines(llff_scene: Path, patterned_run: Path) -> Dict[str, SimpleNamespace]:
    coarse, style = coarse_pipeline(llff_scene), load_run(patterned_run / "config.yml").pipeline
    coarse.model.finish_learning()
    return {"coarse": coarse.eval(), "exact": style, "baked": style}


@pytest.mark.parametrize("kind", ["coarse", "learning", "exact", "baked"])
def test_pictures_show_what_is_in_the_box_before_its_background(pipelines, kind) -> None:
    pipeline = pipelines["coarse" if kind == "learning" else kind]
    model, camera = pipeline.model, pipeline.datamanager.train_dataset.cameras[1:2]
    if kind == "learning":
        model.learns = True
    if kind in ("exact", "baked"):
        model.display.own = type(model.display.own)(kind, model.display.own.mix)
    whole = model.get_outputs_for_camera(camera)
    nothing, part = (cropped(model, camera, box) for box in (NOWHERE, SLAB))
    everything = cropped(model, camera, EVERYWHERE)
    assert torch.equal(nothing["rgb"], MAGENTA.expand_as(nothing["rgb"]))
    assert nothing["accumulation"].max() == 0
    known = whole["accumulation"] < 1 - 1e-3  # where the last step, which is endless without a box, makes no difference
    difference = (everything["accumulation"] - whole["accumulation"]).abs()
    assert difference[~known].mean() < 0.1
    assert 0.01 < part["accumulation"].mean() < everything["accumulation"].mean() + 1e-3
    seen = part["accumulation"] > 1e-3
    z = part["depth"] * camera.generate_rays(camera_indices=0).directions.reshape(*part["depth"].shape[:2], 3)[..., 2:]
    z = z + camera.camera_to_worlds[0, 2, 3]
    assert ((z[seen] < -2 + 0.05) & (z[seen] > -4 - 0.05)).all()
    empty = (~seen).expand_as(part["rgb"])
    torch.testing.assert_close(part["rgb"][empty], MAGENTA.expand_as(part["rgb"])[empty], atol=2e-3, rtol=0)
    assert torch.equal(model.get_outputs_for_camera(camera)["rgb"], whole["rgb"])
    if kind == "learning":
        model.learns = False


def test_a_coarse_picture_has_an_opacity(pipelines) -> None:
    model = pipelines["coarse"].model
    outputs = model.get_outputs_for_camera(pipelines["coarse"].datamanager.train_dataset.cameras[1:2])
    assert model.get_rgba_image(outputs).shape == (*outputs["rgb"].shape[:2], 4)
