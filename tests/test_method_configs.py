"""What the methods are set to: for people, for a first look, and as the paper has them."""

from dataclasses import replace

import pytest

from sparsestyle_ns.core.schedules import Level, content_weight
from sparsestyle_ns.engine.training import FusedAdamConfig, MuonConfig
from sparsestyle_ns.method_configs import method_config

STAGES = ("coarse-fewshot", "hier-style")
VARIANTS = ("", "-draft", "-paper")


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_variant_of_stage_2_trains_its_own_variant_of_stage_1_where_there_is_no_run(variant):
    coarse = method_config(f"hier-style{variant}").coarse_method()
    assert coarse == method_config(f"coarse-fewshot{variant}")
    assert coarse.method_name == f"coarse-fewshot{variant}"
    coarse.max_num_iterations = 1  # a copy
    assert method_config(f"coarse-fewshot{variant}").max_num_iterations > 1


def test_methods_are_at_full_size_and_drafts_at_half_of_it():
    for stage in STAGES:
        sides = [method_config(stage + variant).pipeline.datamanager.max_image_side for variant in VARIANTS]
        assert sides == [504, 252, 504]


@pytest.mark.parametrize("variant", ["", "-draft"])
def test_stage_1_learns_matrices_with_muon_and_all_else_with_adam_both_slower_and_slower(variant):
    config = method_config(f"coarse-fewshot{variant}")
    kinds = {name: type(group["optimizer"]) for name, group in config.optimizers.items()}
    assert kinds == {"fields": FusedAdamConfig, "hidden_layers": MuonConfig, "cameras": FusedAdamConfig}
    for group in config.optimizers.values():
        assert 0.0 < group["scheduler"].final < 1.0


@pytest.mark.parametrize(("variant", "expected"), [("", [126, 252, 504]), ("-draft", [126, 252])])
def test_stage_2_goes_from_126_pixels_to_what_is_shown(variant, expected):
    config = method_config(f"hier-style{variant}")
    levels = config.pipeline.levels(config.max_num_iterations)
    lengths = [level.length for level in levels]
    assert lengths == sorted(lengths, reverse=True) and sum(lengths) == config.max_num_iterations
    for photo_side in (504, 1008):
        sides = [photo_side * config.pipeline.share_of_photos(level.scale, photo_side) for level in levels]
        seen = [config.pipeline.side_at(level.scale, photo_side) for level in levels]
        assert sides == pytest.approx(expected) and seen == expected
    assert [config.pipeline.side_at(level.scale, 252) for level in levels][-1] == 252


def test_views_are_as_much_larger_as_strokes_are_finer_up_to_the_photos_size_and_smaller_as_they_are_wider():
    for stroke_size, side, seen in ((0.5, 1008, 1008), (0.7, 720, 720), (2.0, 252, 252)):
        config = replace(method_config("hier-style").pipeline, stroke_size=stroke_size)
        assert 1008 * config.share_of_photos(1.0, 1008) == pytest.approx(side)
        assert config.side_at(1.0, 1008) == seen
        assert config.share_of_photos(1.0, 200) == 1.0 / max(1.0, stroke_size)


@pytest.mark.parametrize(
    ("photo_side", "settings", "cells"),
    [
        (504, {}, 512),
        (400, {}, 400),
        (1008, {}, 512),
        (1008, {"stroke_size": 0.5}, 1008),
        (1008, {"view_side": "photos"}, 1008),
        (504, {"stroke_size": 2.0}, 256),
        (10, {}, 16),
    ],
)
def test_the_hash_grid_is_as_fine_as_the_views(photo_side, settings, cells):
    config = replace(method_config("hier-style").pipeline, **settings)
    config.settle_resolution(photo_side)
    assert config.model.max_resolution == cells
    config.settle_resolution(photo_side // 2)
    assert config.model.max_resolution == cells  # settled once
    paper = method_config("hier-style-paper").pipeline
    paper.settle_resolution(photo_side)
    assert paper.model.max_resolution == 512


@pytest.mark.parametrize(
    ("photo_side", "of_run", "of_style", "cells"),
    [(504, 1.0, 1.0, 512), (504, 1.0, 0.5, 512), (504, 1.0, 2.0, 256), (504, 0.5, 1.0, 512), (1008, 0.5, 1.0, 512)],
)
def test_another_style_of_a_run_with_wider_strokes_has_a_coarser_grid(photo_side, of_run, of_style, cells):
    config = replace(method_config("hier-style").pipeline, stroke_size=of_run)
    config.settle_resolution(photo_side)
    assert config.resolution_for(of_style, photo_side) == cells


@pytest.mark.parametrize(("view_side", "side"), [("photos", 1008), (300, 300), (504, 504)])
def test_views_have_the_side_that_is_asked_for(view_side, side):
    config = replace(method_config("hier-style").pipeline, view_side=view_side)
    assert 1008 * config.share_of_photos(1.0, 1008) == pytest.approx(side)
    assert config.side_at(1.0, 1008) == side and config.side_at(0.5, 1008) == side // 2


def test_the_papers_stage_1_has_50_000_iterations_of_adam_at_a_constant_rate():
    config = method_config("coarse-fewshot-paper")
    assert config.max_num_iterations == 50_000
    for name in ("fields", "hidden_layers", "cameras"):
        optimizer, scheduler = (config.optimizers[name][part] for part in ("optimizer", "scheduler"))
        assert type(optimizer) is FusedAdamConfig and scheduler is None
        assert (optimizer.lr, optimizer.betas) == (5e-4, (0.9, 0.999))
    field = config.pipeline.model.coarse_field
    assert (field.num_levels, field.num_layers, field.layer_width) == (7, 6, 256)


def test_the_papers_stage_2_has_200_iterations_on_whole_photos_whose_rate_falls_at_50_and_100():
    config = method_config("hier-style-paper")
    assert config.max_num_iterations == 200
    optimizer, scheduler = (config.optimizers["fields"][part] for part in ("optimizer", "scheduler"))
    assert (optimizer.lr, optimizer.betas) == (5e-3, (0.9, 0.999))
    schedule = replace(scheduler, iterations=200)
    rates = [schedule.factor(step) for step in (0, 49, 50, 99, 100, 199)]
    assert rates == pytest.approx([1, 1, 0.33, 0.33, 0.1089, 0.1089])
    assert config.pipeline.levels(200) == (Level(1.0, 0, 200),)
    assert config.pipeline.warm_start_steps == 0 and config.pipeline.thinning == 0


def test_the_papers_content_weight_falls_from_10_to_a_hundredth_in_100_of_200_iterations():
    settings = method_config("hier-style-paper").pipeline
    assert settings.content_decay == 0.01 and settings.content_share * 200 == 100
    (level,) = settings.levels(200)
    for step in (0, 1, 50, 99, 100, 150, 199):
        expected = {"content": content_weight(step, 10.0, 0.01, 100), "style": 1.0}
        assert settings.weights_at(step, level) == pytest.approx(expected)


def test_the_papers_methods_add_nothing_to_it():
    for stage in STAGES:
        effects = method_config(f"{stage}-paper").pipeline.effects
        assert effects.view_color == "on" and effects.matched_depth == "off"
    assert effects.residual_density == "on" and effects.palette == "off"
    assert method_config("coarse-fewshot-paper").pipeline.model.distortion_weight == 0
    model = method_config("hier-style-paper").pipeline.model
    assert (model.hash_levels, model.min_resolution, model.max_resolution) == (8, 128, 512)
    assert (model.features_per_level, model.log2_table_size) == (4, 19)
    assert (model.hidden_layers, model.layer_width) == (2, 256)
