"""The colours of a finished style: mapped to the painting's after the last iteration, and only then."""

import copy
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch

from sparsestyle_ns.core.sliced import random_directions, sliced_distance
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.engine.restyling import Restyling, Workshop
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.runs.coarse_run import read_coarse_run
from sparsestyle_ns.style.painting import Painting


def new_training(runs: SimpleNamespace, iterations: int = 4, palette: str = "on", **settings) -> Training:
    config = copy.deepcopy(load_run(runs.style / "config.yml").config)
    config.max_num_iterations = iterations
    for name, value in {"warm_start_steps": 2, **settings}.items():
        setattr(config.pipeline, name, value)
    scene = config.pipeline.datamanager.setup(device="cpu", test_mode="inference").scene
    config.pipeline.decided = decide(scene, EffectSettings(palette=palette, residual_density="off"))
    training = Training(config, torch.device("cpu"), read_coarse_run(runs.coarse).model_state())
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # a few iterations leave a field grey all over
        table = training.pipeline.model.residual.grid.table
        table.copy_(torch.empty_like(table).uniform_(-1, 1, generator=generator))
    return training


@torch.no_grad()
def colors_of(training: Training) -> torch.Tensor:
    """Of all pixels of the largest views."""
    pipeline = training.pipeline
    views, task = pipeline.task.levels[-1].views, pipeline.task
    return torch.cat([pipeline.scene_views.render(view, task.style).reshape(-1, 3) for view in views])


def distance(training: Training) -> float:
    """Of the views' colours from the painting's."""
    target = training.pipeline.task.levels[-1].targets.style_picture.flatten(1).T
    directions = random_directions(3, 64, torch.Generator().manual_seed(0))
    return float(sliced_distance(colors_of(training), target, directions)) ** 0.5


def test_colours_are_mapped_after_the_last_iteration_and_learn_on_as_they_were(runs):
    training = new_training(runs)
    own = training.pipeline.model.residual.recoloring
    for _ in range(3):
        training.step()
        assert own.is_neutral
    training.step()
    assert not own.is_neutral
    mapped = distance(training)
    kept = copy.deepcopy(own)
    own.reset()
    assert mapped < 0.5 * distance(training)
    own.adopt(kept)
    training.num_steps = 2  # a finished run that is gone on with
    training.step()
    assert own.is_neutral


def test_moments_give_the_painting_s_mean_colour(runs):
    training = new_training(runs, 1, palette_transfer="moments")
    training.step()
    assert not training.pipeline.model.residual.recoloring.table.any()
    mean = training.pipeline.task.levels[-1].targets.style_picture.flatten(1).mean(dim=1)
    torch.testing.assert_close(colors_of(training).mean(dim=0), mean, atol=0.03, rtol=0)


def test_without_the_palette_colours_stay_as_they_were_learned(runs):
    training = new_training(runs, 1, palette="off")
    training.step()
    assert training.pipeline.model.residual.recoloring.is_neutral


def test_a_run_keeps_the_map(runs):
    saved = load_run(runs.style / "config.yml").pipeline
    assert saved.effects.on("palette") and not saved.model.residual.recoloring.is_neutral


@pytest.mark.parametrize("stylised_field", ["residual", "coarse"])
def test_what_is_fine_tuned_and_what_is_restyled_have_it_too(runs, painting, stylised_field):
    if stylised_field == "coarse":
        config = copy.deepcopy(load_run(runs.style / "config.yml").config)
        config.pipeline.model.stylised_field, config.max_num_iterations = "coarse", 1
        training = Training(config, torch.device("cpu"), read_coarse_run(runs.coarse).model_state())
        training.step()
        assert not training.pipeline.model.residual.recoloring.is_neutral
        return
    training = new_training(runs, 2)
    restyling = Restyling(Workshop(training.pipeline, runs.style, nullcontext()), Painting.read(painting), iterations=2)
    assert list(restyling)[-1].done == 1.0
    assert not restyling.field.recoloring.is_neutral
