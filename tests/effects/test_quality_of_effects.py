"""An effect that a scene calls for makes views better that weren't trained on."""

import functools
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, List, Optional, Tuple

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from scipy.spatial.transform import Rotation
from torch import Tensor

from sparsestyle_ns.core.rotations import similarity_between
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.loading import known_views
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.metrics.image import psnr
from sparsestyle_ns.style.color import color_moments, gaussian_distance
from sparsestyle_ns.style.painting import Painting

SEEDS = (0, 1, 2)
"""Short trainings of one scene with different seeds differ by up to a decibel, so means over some are compared."""
BENT = ("--distortion", "0.5", "--wander", "1", "--num-views", "32", "--num-train", "28")
PARSERS = {"llff": LLFFDataParserConfig, "blender": BlenderDataParserConfig, "nerfstudio": NerfstudioDataParserConfig}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory):
    """Makes a scene of small pictures, once for the same options."""
    import make_sample_scene

    @functools.cache
    def make(layout: str, *options: str) -> Path:
        folder = tmp_path_factory.mktemp("scene")
        sizes = ["--num-views", "16", "--num-train", "12", "--num-val", "1", "--num-test", "3", "--width", "40"]
        make_sample_scene.main([str(folder), "--layout", layout, *sizes, *options])
        return folder / layout

    return make


@pytest.fixture(scope="module")
def painting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import make_style_image

    path = tmp_path_factory.mktemp("painting") / "painting.png"
    make_style_image.main([str(path)])
    return path


def small_config(method: str, folder: Path, layout: str, steps: int, effects: Dict[str, str]) -> Any:
    """A draft's config with a small coarse field, for all of a scene's training views."""
    config = method_config(method)
    pipeline = config.pipeline
    pipeline.effects = EffectSettings(**effects)
    manager, field = pipeline.datamanager, pipeline.model.coarse_field
    manager.data, manager.dataparser = folder, PARSERS[layout]()
    parser = PARSERS[layout](data=folder).setup()
    manager.num_views = len(parser.get_dataparser_outputs("train").image_filenames)
    field.layer_width, field.num_layers, field.feature_dim = 64, 3, 32
    config.max_num_iterations = steps
    return config


def trained(config: Any, coarse_state: Optional[Dict[str, Tensor]] = None, seed: int = 0) -> Any:
    """The pipeline after all iterations of its config."""
    torch.manual_seed(seed)
    config.pipeline.datamanager.seed += seed
    training = Training(config, torch.device("cpu"), coarse_state)
    for _ in range(config.max_num_iterations):
        training.step()
    training.pipeline.eval()
    return training.pipeline


def trained_coarse(
    folder: Path, layout: str, steps: int, effects: Dict[str, str], num_views: Optional[int] = None, seed: int = 0
) -> Any:
    """Stage 1, shortened."""
    config = small_config("coarse-fewshot-draft", folder, layout, steps, effects)
    if num_views is not None:
        config.pipeline.datamanager.num_views = num_views
    model = config.pipeline.model
    model.num_samples, model.num_eval_samples, model.grid_resolution = 16, 32, 32
    model.seed += seed
    config.optimizers["fields"]["optimizer"].lr, config.optimizers["fields"]["scheduler"] = 5e-3, None
    return trained(config, seed=seed)


def trained_style(
    folder: Path, layout: str, painting: Path, coarse_state: Dict[str, Tensor], steps: int, effects: Dict[str, str]
) -> Any:
    """Stage 2, shortened and in small."""
    config = small_config("hier-style-draft", folder, layout, steps, effects)
    pipeline, model = config.pipeline, config.pipeline.model
    pipeline.style_image, pipeline.backbone, pipeline.feature_side = painting, "vgg16-shift-tolerant", 80
    model.num_steps, model.occupancy_resolution, model.min_resolution, model.max_resolution = 32, 32, 8, 32
    return trained(config, coarse_state)


@torch.no_grad()
def held_out_views(pipeline: Any) -> List[Tuple[Tensor, Tensor]]:
    """(render, photo) of each held-out view, [H, W, 3]."""
    dataset, views = pipeline.datamanager.eval_dataset, []
    for index in range(len(dataset)):
        render = pipeline.model.get_outputs_for_camera(dataset.cameras[index : index + 1])["rgb"]
        views.append((render, dataset[index]["image"][..., :3]))
    return views


def held_out_psnr(
    folder: Path, layout: str, steps: int, effects: Dict[str, str], num_views: Optional[int] = None
) -> float:
    """Mean PSNR, in dB, of the held-out views after short trainings on others; on all, if not told how many."""
    runs = [trained_coarse(folder, layout, steps, effects, num_views, seed) for seed in SEEDS]
    values = [psnr(*view) for run in runs for view in held_out_views(run)]
    return sum(values) / len(values)


@pytest.mark.slow
@pytest.mark.parametrize(
    "layout, options, on, off, steps",
    [
        ("llff", (), {"ndc": "on"}, {"contraction": "on"}, 300),
        ("blender", (), {"box": "on"}, {"contraction": "on"}, 300),
        ("nerfstudio", (), {"contraction": "on"}, {"box": "on"}, 300),
        ("blender", (), {"background": "on"}, {"background": "off"}, 300),
        ("llff", ("--shiny", "0.8"), {"view_color": "on"}, {"view_color": "off"}, 300),
        ("llff", ("--exposure", "0.7"), {"exposure": "on"}, {"exposure": "off"}, 300),
        # Where all cameras look at one point, a wrong lens only bends the scene that is learned, and nobody sees it.
        # Where they look aside, the bend matters once the scene is sharper than the bend.
        ("nerfstudio", BENT, {"lens_distortion": "on"}, {"lens_distortion": "off"}, 1000),
        ("blender", (), {"empty_space": "on"}, {"empty_space": "off"}, 300),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else None,
)
def test_an_effect_that_a_scene_calls_for_makes_held_out_views_better(scenes, layout, options, on, off, steps):
    folder = scenes(layout, *options)
    with_it, without = (held_out_psnr(folder, layout, steps, effects) for effects in (on, off))
    print(f"{layout} {options} {on}: {with_it:.2f} dB, {off}: {without:.2f} dB")  # docs/effects.md's table
    assert with_it > without


@pytest.mark.parametrize(
    "layout, options, steps, has_empty_space, is_haze",
    [
        pytest.param("llff", (), 600, True, False, id="clear"),
        # All photos are grey: what is learned is solid all over, nothing to skip and nothing doubtful.
        pytest.param("llff", ("--haze", "1"), 300, False, False, id="thick mist"),
        pytest.param("blender", (), 60, False, True, id="hardly trained"),
    ],
)
def test_the_coarse_field_of_a_made_scene_calls_for_skipping_and_residual_density_or_not(
    scenes, layout, options, steps, has_empty_space, is_haze
):
    pipeline = trained_coarse(scenes(layout, *options), layout, steps, {})
    field = pipeline.model.field
    scene = replace(pipeline.datamanager.scene, coarse_density=lambda points: field.density_and_feature(points)[0])
    decisions = decide(scene, EffectSettings())
    assert (decisions.on("empty_space"), decisions.on("residual_density")) == (has_empty_space, is_haze)
    assert decisions["empty_space"].measured is not None


@pytest.mark.slow
def test_with_the_depth_of_matched_points_three_photos_say_more_about_other_views(scenes):
    folder = scenes("llff", "--width", "126")
    with_it, without = (
        held_out_psnr(folder, "llff", 300, {"matched_depth": choice}, num_views=3) for choice in ("on", "off")
    )
    assert with_it > without


@pytest.mark.slow
def test_cameras_that_are_off_come_nearer_to_where_they_were_and_views_gain(scenes, tmp_path):
    known = scenes("llff", "--width", "126")
    rows, axes = np.load(known / "poses_bounds.npy"), np.random.default_rng(0).normal(size=(16, 3))
    turns = Rotation.from_rotvec(np.radians(0.5) * axes / np.linalg.norm(axes, axis=-1, keepdims=True)).as_matrix()
    matrices = rows[:, :15].reshape(-1, 3, 5)
    matrices[..., :3] = turns @ matrices[..., :3]
    shutil.copytree(known, tmp_path / "off")
    np.save(tmp_path / "off" / "poses_bounds.npy", np.c_[matrices.reshape(-1, 15), rows[:, 15:]])
    exact = LLFFDataParserConfig(data=known).setup().get_dataparser_outputs("train").cameras.camera_to_worlds
    errors, quality = {}, {}
    for choice in ("on", "off"):
        effects = {"pose_refinement": choice, "matched_depth": "on"}
        pipeline = trained_coarse(tmp_path / "off", "llff", 300, effects)
        manager = pipeline.datamanager
        found = manager.train_dataset.cameras.camera_to_worlds
        moved = similarity_between(exact.double(), found.double()).of_poses(exact.double())
        turned = moved[..., :3].mT @ found[..., :3].double()
        cosine = 0.5 * (turned.diagonal(dim1=-2, dim2=-1).sum(dim=-1) - 1.0)
        errors[choice] = float(cosine.clamp(-1.0, 1.0).acos().rad2deg().mean())
        views = known_views(manager, known, manager.train_dataset.metadata["scene_info"].view_ids)
        quality[choice] = pipeline.held_out_report(views=views).means["psnr"]
    print(f"degrees off: {errors}, held-out PSNR: {quality}")
    assert errors["on"] < 0.7 * errors["off"]
    assert quality["on"] > quality["off"]


@pytest.mark.slow
def test_residual_density_lets_the_style_change_a_hazy_scene(scenes, painting):
    folder = scenes("blender")
    hazy = trained_coarse(folder, "blender", 60, {}).model.state_dict()
    losses = []
    for choice in ("on", "off"):
        pipeline = trained_style(folder, "blender", painting, hazy, 60, {"residual_density": choice})
        losses.append(pipeline.held_out_report().means["style_loss"])
    assert losses[0] < 0.95 * losses[1]


@pytest.mark.slow
def test_palette_transfer_brings_held_out_views_to_the_colours_of_the_painting(scenes, painting):
    folder = scenes("llff")
    coarse = trained_coarse(folder, "llff", 150, {}).model.state_dict()
    aim = color_moments(Painting.read(painting).pixels.flatten(1).T)
    distances = []
    for choice in ("on", "off"):
        pipeline = trained_style(folder, "llff", painting, coarse, 60, {"palette": choice})
        colors = torch.cat([render.reshape(-1, 3) for render, _ in held_out_views(pipeline)])
        distances.append(float(gaussian_distance(*color_moments(colors), *aim)))
    assert distances[0] < distances[1]
