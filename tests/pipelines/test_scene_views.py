"""The semantic loss of views that nobody photographed, on a tiny scene."""

from pathlib import Path

import pytest
import torch
from conftest import TINY, coarse_pipeline, ns_train, only_run
from reference import semantic_loss as slow_semantic_loss
from torch.nn.functional import interpolate

from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipeline
from sparsestyle_ns.pipelines.datamanager import bundle_rays
from sparsestyle_ns.runs.checkpoints import load_checkpoint, newest_checkpoint
from sparsestyle_ns.utils.errors import InputError

ON = {"semantic_weight": 0.5, "semantic_every": 4, "semantic_side": 16}


@pytest.fixture(scope="module")
def pipeline(llff_scene: Path) -> CoarseFewShotPipeline:
    return coarse_pipeline(llff_scene, **ON)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_the_loss_is_that_of_a_rendered_view_and_a_photo_both_drawn_by_the_generator(pipeline, seed: int) -> None:
    unseen, model = pipeline.unseen, pipeline.model
    generator = torch.Generator().manual_seed(seed)
    place, photo = (int(torch.randint(len(them), (), generator=generator)) for them in (unseen.places, unseen.photos))
    rays = unseen.places.generate_rays(camera_indices=torch.tensor([place]), keep_shape=True)
    assert rays.shape[:2] == (12, 16)
    origins, directions = rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3)
    render = model(bundle_rays(origins, directions, torch.zeros(len(origins), dtype=torch.long), {}))["rgb"]
    pixels, (height, width) = pipeline.datamanager.pixels, pipeline.datamanager.pixels.sizes[photo]
    picture = pixels.colors[pixels.starts[photo] : pixels.starts[photo + 1]].view(height, width, 3)
    small = interpolate(picture.permute(2, 0, 1)[None], size=(12, 16), mode="bilinear", antialias=True)
    maps = [unseen.backbone(image)[0].tolist() for image in (render.view(12, 16, 3).permute(2, 0, 1)[None], small)]
    found = unseen.loss(model, torch.Generator().manual_seed(seed)).item()
    assert found == pytest.approx(slow_semantic_loss(*maps), rel=1e-4)
    assert 0 < found < 1


def test_its_gradient_reaches_the_field(pipeline) -> None:
    pipeline.model.zero_grad()
    pipeline.unseen.loss(pipeline.model, torch.Generator().manual_seed(0)).backward()
    for name, parameter in pipeline.model.field.named_parameters():
        assert parameter.grad.isfinite().all() and parameter.grad.abs().sum() > 0, name


def test_it_is_weighted_and_comes_every_few_iterations(pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline.unseen, "loss", lambda model, generator: torch.tensor(6.0))
    losses = [pipeline.get_train_loss_dict(step)[1].get("semantic_loss") for step in range(9)]
    assert [step for step, loss in enumerate(losses) if loss is not None] == [0, 4, 8]
    assert losses[4] == 3.0


def test_what_is_drawn_depends_on_the_step_alone(pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    def draw(model: object, generator: torch.Generator) -> torch.Tensor:
        return torch.rand((), generator=generator)

    monkeypatch.setattr(pipeline.unseen, "loss", draw)
    there, back = (
        [pipeline.get_train_loss_dict(step)[1]["semantic_loss"].item() for step in steps]
        for steps in (range(0, 40, 4), range(36, -1, -4))
    )
    assert there == back[::-1] and len(set(there)) == 10


def test_a_view_is_rendered_at_the_exposure_of_the_photo_that_it_is_held_against(llff_scene: Path) -> None:
    pipeline = coarse_pipeline(llff_scene, **ON, exposure="on")
    generator = torch.Generator().manual_seed(7)
    photo = [int(torch.randint(len(them), (), generator=generator)) for them in (pipeline.unseen.places, range(3))][1]
    pipeline.unseen.loss(pipeline.model, torch.Generator().manual_seed(7)).backward()
    gradient = pipeline.model.exposure.log_gain.grad.abs().sum(dim=-1)
    assert gradient.argmax() == photo  # the others' come from the mean that is taken off all


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"semantic_weight": -1.0}, "semantic-weight is -1.0"),
        ({"semantic_weight": float("nan")}, "semantic-weight is nan"),
        ({"semantic_weight": 0.1, "semantic_every": 0}, "semantic-every is 0"),
        ({"semantic_weight": 0.1, "semantic_side": 7}, "semantic-side is 7"),
        ({"semantic_weight": 0.1, "views": 1}, "there is one; train on more"),
        ({"semantic_weight": 0.1, "vgg_weights": Path("gone.pth")}, "no VGG weight file gone.pth"),
    ],
)
def test_settings_that_can_not_be_used_are_named(settings: dict, sentence: str, llff_scene: Path) -> None:
    with pytest.raises(InputError, match=sentence):
        coarse_pipeline(llff_scene, **settings)


def test_a_checkpoint_says_which_network_took_part_and_does_not_hold_it(runs, llff_scene: Path, tmp_path: Path) -> None:
    flags = ["--pipeline.semantic-weight", "0.1", "--pipeline.semantic-side", "16", "--max-num-iterations", "2"]
    ns_train("coarse-fewshot", llff_scene, tmp_path, *TINY, *flags)
    found = load_checkpoint(newest_checkpoint(only_run(tmp_path, "coarse-fewshot") / "nerfstudio_models"))
    without = load_checkpoint(newest_checkpoint(runs.coarse / "nerfstudio_models"))
    assert found["pipeline"].keys() == without["pipeline"].keys()
    assert found["backbone"]["name"].startswith("vgg16") and "backbone" not in without
