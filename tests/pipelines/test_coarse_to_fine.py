"""Stage 2's training: views from small to large, and what counts at which of their sizes."""

import copy
import math
import shutil
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.nn.functional import interpolate

from sparsestyle_ns.core.schedules import Level
from sparsestyle_ns.engine.loading import load_run
from sparsestyle_ns.engine.restyling import Restyling, Workshop
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.pipelines.hier_style import HierStylePipelineConfig, StyleLevel, StyleTask
from sparsestyle_ns.runs.coarse_run import read_coarse_run
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError

SETTINGS = {"view_scales": (0.45, 1.0), "scale_shares": (0.6, 0.4), "novel_views": 1, "warm_start_steps": 0}
"""Of photos of 32 × 24 pixels 0.45 makes 14.4 × 10.8, and so 14 × 11."""


@pytest.fixture(scope="module")
def training(runs: SimpleNamespace) -> Training:
    """Ten iterations, of which none is made yet."""
    config = copy.deepcopy(load_run(runs.style / "config.yml").config)
    config.max_num_iterations = 10
    for name, value in SETTINGS.items():
        setattr(config.pipeline, name, value)
    return Training(config, torch.device("cpu"), read_coarse_run(runs.coarse).model_state())


# --- the content loss's weight ---------------------------------------------------------------------------------------


def content_weights(iterations, **settings):
    config = HierStylePipelineConfig(**settings)
    return [
        [config.weights_at(level.first + step, level)["content"] for step in range(level.length)]
        for level in config.levels(iterations)
    ]


def test_the_content_losses_weight_falls_at_each_size_and_ends_at_one_value():
    first, second, third = content_weights(
        1000,
        view_scales=(0.25, 0.5, 1.0),
        scale_shares=(0.5, 0.3, 0.2),
        content_share=0.6,
        content_restart=0.3,
        loss_weights={"content": 10.0},
    )
    assert first[0] == pytest.approx(10.0) and second[0] == third[0] == pytest.approx(3.0)
    for weights in (first, second, third):
        end = round(0.6 * len(weights))
        assert weights[end:] == [pytest.approx(10 * 0.01)] * (len(weights) - end)
        assert weights[: end + 1] == sorted(weights[: end + 1], reverse=True) and weights[end - 1] > weights[end]
    # Half way down it is the geometric mean of both ends (Eq. 6).
    assert first[150] == pytest.approx(1.0) and second[90] == pytest.approx((3.0 * 0.1) ** 0.5)


def test_at_one_size_it_is_equation_6():
    (weights,) = content_weights(
        200, view_scales=(1.0,), scale_shares=(1.0,), content_share=0.5, loss_weights={"content": 10.0}
    )
    assert weights[:101] == pytest.approx([10 * 0.01 ** (step / 100) for step in range(101)])
    assert weights[100:] == pytest.approx([0.1] * 100)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_restart_from_nothing_is_refused(value):
    with pytest.raises(InputError, match=r"content-restart is .*; give a number above 0"):
        HierStylePipelineConfig(content_restart=value).levels(100)


# --- sizes -----------------------------------------------------------------------------------------------------------


def test_an_iteration_belongs_to_the_last_level_that_has_begun():
    levels = [StyleLevel(level, None, []) for level in (Level(0.25, 0, 3), Level(0.5, 3, 2), Level(1.0, 5, 0))]
    task = StyleTask(None, levels)
    assert [task.level(step).schedule.scale for step in range(5)] == [0.25] * 3 + [0.5] * 2
    assert task.level(99) is levels[-1]


def test_ten_iterations_are_six_small_ones_and_four_of_the_photos_size(training):
    task = training.pipeline.task
    assert [level.schedule for level in task.levels] == [Level(0.45, 0, 6), Level(1.0, 6, 4)]
    shapes = [training.pipeline.losses(task, step)[0].shape for step in (0, 5, 6, 9)]
    assert shapes == [(11, 14, 3)] * 2 + [(24, 32, 3)] * 2


def test_views_are_no_larger_than_they_are_asked_for(runs):
    config = copy.deepcopy(load_run(runs.style / "config.yml").config)
    config.pipeline.view_side = 16
    config.pipeline.view_scales, config.pipeline.scale_shares, config.pipeline.warm_start_steps = (1.0,), (1.0,), 0
    training = Training(config, torch.device("cpu"), read_coarse_run(runs.coarse).model_state())
    assert all(view.picture.shape == (12, 16, 3) for view in training.pipeline.scene_views.views)


def test_each_size_has_all_views_photos_first_and_those_between_them_too(training):
    scene = training.pipeline.scene_views
    assert list(scene.by_scale) == [0.45, 1.0] and scene.num_photos == 3
    for size, views in zip(((11, 14), (24, 32)), scene.by_scale.values(), strict=True):
        assert len(views) == 4
        assert all(view.picture.shape == (*size, 3) and view.accumulation.shape == size for view in views)
    assert len(scene.views) == 8


def test_a_small_photo_is_the_mean_of_a_large_ones_areas_and_its_rays_go_to_the_same_corners(training):
    manager = training.pipeline.datamanager
    small, large = manager.pixels_at(0.45), manager.pixels
    assert manager.pixels_at(1.0) is large and manager.photo_side == 32
    assert list(small.sizes) == [(11, 14)] * 3
    assert list(small.starts) == [0, 154, 308, 462]
    for photo in range(3):
        whole = large.colors[large.starts[photo] : large.starts[photo + 1]].view(1, 24, 32, 3).permute(0, 3, 1, 2)
        found = small.colors[small.starts[photo] : small.starts[photo + 1]].view(11, 14, 3)
        torch.testing.assert_close(found, interpolate(whole, (11, 14), mode="area")[0].permute(1, 2, 0))
        middles = [part.directions[part.starts[photo] : part.starts[photo + 1]].mean(dim=0) for part in (small, large)]
        torch.testing.assert_close(*middles, atol=2e-3, rtol=0)


def test_half_of_an_even_size_is_exactly_the_mean_of_four_pixels(training):
    half, whole = training.pipeline.datamanager.pixels_at(0.5), training.pipeline.datamanager.pixels
    means = whole.colors.view(3, 12, 2, 16, 2, 3).mean(dim=(2, 4))
    torch.testing.assert_close(half.colors.view(3, 12, 16, 3), means)


def test_the_painting_and_the_views_are_seen_at_sizes_that_belong_together(training):
    small, large = training.pipeline.task.levels
    side = training.pipeline.config.feature_side
    assert side == 48
    for level, expected in ((small, round(0.45 * side)), (large, side)):
        for view in level.views:
            features = level.targets.features(view.picture)
            torch.testing.assert_close(view.features, features)
            maps = level.targets.backbone(torch.rand(1, 3, expected, expected))
            assert max(view.features.shape[-2:]) == maps[0].shape[-1]
    assert len(small.targets.style_rows()) < len(large.targets.style_rows()) / 3
    assert training.pipeline.targets is large.targets


@pytest.mark.parametrize("size, side", [(0.5, 252), (1.0, 126), (2.0, 63)])
def test_wider_strokes_come_of_smaller_pictures_for_the_network(size, side):
    config = HierStylePipelineConfig(stroke_size=size)
    assert config.side_at(0.5, 252) == side
    assert config.side_at(1.0, 252) == 2 * side


@pytest.mark.parametrize("size", [0.0, 0.49, 2.1, math.nan])
def test_strokes_beyond_half_and_twice_are_refused(size, painting):
    with pytest.raises(InputError, match=r"--stroke-size is .*; give a number from 0.5 to 2\."):
        HierStylePipelineConfig(stroke_size=size, style_image=painting).load_style()


def test_the_style_counts_more_for_an_object_on_a_background(training, monkeypatch):
    pipeline = training.pipeline
    _, everywhere = pipeline.losses(pipeline.task, 0)
    monkeypatch.setitem(pipeline.model._buffers, "background", torch.ones(3))
    _, of_object = pipeline.losses(pipeline.task, 0)
    assert of_object.weights == {**everywhere.weights, "style": 4.0 * everywhere.weights["style"]}


def test_restyling_goes_through_the_same_sizes(training, runs, painting, monkeypatch):
    pipeline = training.pipeline
    seen, losses = [], type(pipeline).losses

    def watched(self, task, step):
        image, values = losses(self, task, step)
        seen.append(tuple(image.shape[:2]))
        return image, values

    monkeypatch.setattr(type(pipeline), "losses", watched)
    before = pipeline.scene_views
    restyling = Restyling(Workshop(pipeline, runs.style, nullcontext()), Painting.read(painting), iterations=5)
    assert list(restyling)[-1].done == 1.0
    assert seen == [(11, 14)] * 3 + [(24, 32)] * 2
    assert pipeline.scene_views is before


def test_a_restyling_with_settings_of_its_own_leaves_the_other_styles_features_alone(training, runs, painting):
    pipeline, largest = training.pipeline, training.pipeline.task.levels[-1]
    before = [view.features.clone() for view in largest.views]
    workshop, image = Workshop(pipeline, runs.style, nullcontext()), Painting.read(painting)
    own = {"stroke_size": 2.0, "kept_structure": 0.8}
    restyling = Restyling(workshop, image, iterations=5, own=own)
    settings = replace(pipeline.config, **own)
    new = pipeline.new_task(restyling.field, image, workshop.backbone, pipeline.effects, 5, settings)
    assert new.levels[-1].targets.feature_side == largest.targets.feature_side // 2
    assert (new.levels[-1].targets.kept_structure, largest.targets.kept_structure) == (0.8, 0.65)
    for old, view, features in zip(largest.views, new.levels[-1].views, before, strict=True):
        assert torch.equal(old.features, features)
        assert view.features.shape[-1] < features.shape[-1]
    assert list(restyling)[-1].done == 1.0
    folder = restyling.save()
    try:
        saved = load_run(folder / "config.yml").config.pipeline
        assert (saved.stroke_size, saved.kept_structure) == (2.0, 0.8)
        own = pipeline.config.resolution_for(2.0, pipeline.datamanager.photo_side)
        assert saved.model.max_resolution == own < pipeline.config.model.max_resolution
    finally:
        shutil.rmtree(folder)
