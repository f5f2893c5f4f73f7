"""What is off isn't there: no module, no parameter, no operation."""

import functools
import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import decided
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from torch.nn.functional import normalize
from torch.utils._python_dispatch import TorchDispatchMode

from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.data.scene_info import NDC
from sparsestyle_ns.effects.background import background_color
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.effects.matched_colors import build_exposure
from sparsestyle_ns.effects.matched_depth import matched_rays
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.fields.coarse import CoarseFieldConfig
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModelConfig
from sparsestyle_ns.models.hier_style import HierStyleModelConfig
from sparsestyle_ns.pipelines import scene_pipeline as pipelines
from sparsestyle_ns.pipelines.coarse_fewshot import CoarseFewShotPipelineConfig
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig

BOX = SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]))
TO_NDC = NDC((1.5, 2.0), near=0.7, depth_range=(1.0, 9.0))
FIELD = {"num_levels": 2, "num_layers": 2, "layer_width": 16, "feature_dim": 4}
ORANGE = {"color": [1.0, 0.5, 0.0]}


class Operations(TorchDispatchMode):
    """Counts the operators that torch runs."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter = Counter()

    def __torch_dispatch__(self, function, types, arguments=(), keywords=None):
        self.counts[str(function)] += 1
        return function(*arguments, **(keywords or {}))


def coarse_model(*on: str):
    config = CoarseFewShotModelConfig(
        coarse_field=CoarseFieldConfig(**FIELD), num_samples=6, grid_resolution=8, precision="float32"
    )
    return config.setup(scene_box=BOX, num_train_data=3, effects=decided(*on, background=ORANGE), ndc=TO_NDC)


def style_model(*on: str):
    config = HierStyleModelConfig(
        coarse_field=CoarseFieldConfig(**FIELD),
        **{"hash_levels": 2, "min_resolution": 4, "max_resolution": 8, "log2_table_size": 8, "layer_width": 16},
        # With few samples, thin ones are left out where residual density can't add to them: that is work saved.
        **{"num_steps": 8, "num_samples": None, "occupancy_resolution": 4, "precision": "float32"},
    )
    return config.setup(scene_box=BOX, num_train_data=3, effects=decided(*on, background=ORANGE), ndc=TO_NDC)


def rays(count: int = 20) -> RayBundle:
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor([0.0, 0.0, 3.0]) + 0.1 * torch.randn(count, 3, generator=generator)
    aim = 0.5 * torch.rand(count, 3, generator=generator)
    cameras = torch.arange(count)[:, None] % 3
    return RayBundle(origins, normalize(aim - origins, dim=-1), torch.ones(count, 1), cameras)


def training_operations(model) -> Counter:
    """What an iteration of stage 1 runs, forwards and backwards."""
    model.train()
    with Operations() as operations:
        outputs = model.get_outputs(rays())
        losses = model.get_loss_dict(outputs, {"image": torch.full((20, 3), 0.5)})
        sum(losses.values()).backward()
    return operations.counts


def stylised_operations(model) -> Counter:
    """What rendering and learning a stylised view runs."""
    bundle = rays()
    with Operations() as operations:
        model.stylised(model.freeze(bundle.origins, bundle.directions)).rgb.sum().backward()
    return operations.counts


def names(model) -> set:
    return {name for name, _ in [*model.named_modules(), *model.named_parameters(), *model.named_buffers()] if name}


@pytest.mark.parametrize(
    "effect, part",
    [
        ("view_color", "field.direction_encoding"),
        ("exposure", "exposure"),
        ("background", "background"),
        ("empty_space", "grid"),
    ],
)
def test_in_stage_1_an_effect_that_is_off_has_no_module_no_parameter_and_no_operation(effect, part):
    on, off = coarse_model("box", effect), coarse_model("box")
    assert any(name.startswith(part) for name in names(on)) and not any(name.startswith(part) for name in names(off))
    groups = [itertools.chain(*model.get_param_groups().values()) for model in (on, off)]
    learned = [sum(parameter.numel() for parameter in group) for group in groups]
    assert (learned[0] > learned[1]) == (effect in ("view_color", "exposure"))
    with_it, without = training_operations(on), training_operations(off)
    assert without.total() < with_it.total()
    assert not without - with_it  # and nothing else is run in its place


@pytest.mark.parametrize("effect, part", [("residual_density", "residual.density_head"), ("empty_space", "occupancy")])
def test_in_stage_2_an_effect_that_is_off_has_no_module_no_parameter_and_no_operation(effect, part):
    on, off = style_model("box", effect), style_model("box")
    assert any(name.startswith(part) for name in names(on)) and not any(name.startswith(part) for name in names(off))
    with_it, without = stylised_operations(on), stylised_operations(off)
    assert without.total() < with_it.total()
    assert not without - with_it


def test_photos_exposures_are_frozen_in_stage_2():
    model = style_model("box", "exposure")
    assert not model.exposure.log_gain.requires_grad
    assert not style_model("box").state_dict().keys() & {"exposure.log_gain"}


@pytest.mark.parametrize(
    "layout, kind", [("ndc", ForwardFacingSpace), ("box", BoxSpace), ("contraction", ContractedSpace)]
)
def test_the_layout_that_is_on_is_the_only_one_built(layout, kind):
    model = coarse_model(layout)
    spaces = [
        module for module in model.modules() if isinstance(module, ForwardFacingSpace | BoxSpace | ContractedSpace)
    ]
    assert [type(space) for space in spaces] == [kind]
    assert torch.isfinite(model.get_outputs(rays())["rgb"]).all()


def test_contraction_costs_operations_that_a_box_doesnt():
    assert training_operations(coarse_model("box")).total() < training_operations(coarse_model("contraction")).total()


def test_ndc_is_built_with_the_dataparsers_numbers():
    space = coarse_model("ndc").space
    assert (space.focal_over_half_size, space.near) == ((1.5, 2.0), 0.7)


def test_without_lens_distortion_no_ray_is_undistorted(tmp_path: Path):
    import make_sample_scene

    options = ["--layout", "nerfstudio", "--width", "16", "--num-views", "9", "--supersample", "1"]
    make_sample_scene.main([str(tmp_path / "bent"), *options, "--distortion", "0.1"])
    make_sample_scene.main([str(tmp_path / "straight"), *options])

    def operations(name: str, choice: str) -> Counter:
        config = FewShotDataManagerConfig(data=tmp_path / name / "nerfstudio", dataparser=NerfstudioDataParserConfig())
        manager = config.setup(device="cpu", test_mode="inference")
        manager.set_effects(decide(manager.scene, EffectSettings(lens_distortion=choice)))
        for dataset in (manager.train_dataset, manager.eval_dataset):
            assert (dataset.cameras.distortion_params is None) == (choice == "off")
        with Operations() as counted:
            manager.train_dataset.cameras.generate_rays(camera_indices=0, keep_shape=True)
        return counted.counts

    bent, off = operations("bent", "on"), operations("bent", "off")
    assert off == operations("straight", "off")
    assert off.total() < bent.total()


def test_rays_of_a_bent_lens_are_those_that_the_photos_show(tmp_path: Path):
    import make_sample_scene
    from sample_scene.cameras import rays_of_rows

    k1, width, height = 0.4, 40, 30
    options = ["--layout", "nerfstudio", "--num-views", "9", "--supersample", "1", "--distortion", str(k1)]
    make_sample_scene.main([str(tmp_path), "--width", str(width), *options])
    rows = np.arange(height)
    # The script renders along these rays; on a camera that looks along −z, a ray's place in the picture is x/−z, y/−z.
    config = FewShotDataManagerConfig(data=tmp_path / "nerfstudio", dataparser=NerfstudioDataParserConfig())
    for choice, largest, smallest in (("on", 1e-3, 0.0), ("off", 4.0, 2.0)):
        manager = config.setup(device="cpu", test_mode="inference")
        manager.set_effects(decide(manager.scene, EffectSettings(lens_distortion=choice)))
        cameras = manager.train_dataset.cameras
        focal = float(cameras.fx[0])
        true, _ = rays_of_rows(np.eye(3, 4), focal, height, width, rows, 1, k1)
        rays = cameras.generate_rays(camera_indices=0, keep_shape=True)
        local = (rays.directions @ cameras.camera_to_worlds[0, :, :3]).reshape(-1, 3).numpy()
        errors = focal * np.linalg.norm(local[:, :2] / local[:, 2:] - true[:2].T / true[2:].T, axis=-1)
        assert smallest <= errors.max() < largest


def test_without_matched_depth_no_ray_is_trained_on_that_has_no_colour(tmp_path: Path):
    import make_sample_scene

    sizes = ["--width", "126", "--num-views", "3", "--supersample", "1"]
    make_sample_scene.main([str(tmp_path), "--layout", "llff", *sizes])

    def batch(choice: str):
        config = FewShotDataManagerConfig(
            data=tmp_path / "llff", dataparser=LLFFDataParserConfig(), train_num_rays_per_batch=20
        )
        manager = config.setup(device="cpu", test_mode="val")
        manager.set_effects(decide(manager.scene, EffectSettings(matched_depth=choice)))
        return manager.next_train(0)

    (more_rays, same_photos), (rays, photos) = batch("on"), batch("off")
    assert (len(rays), rays.metadata, len(photos["image"])) == (20, {}, 20)
    assert len(more_rays) == 25 and torch.equal(more_rays.origins[:20], rays.origins)
    assert torch.equal(same_photos["image"], photos["image"])
    assert ((more_rays.metadata["matched_distance"] > 0).squeeze(-1) == (torch.arange(25) >= 20)).all()

    def operations(bundle) -> Counter:
        model = coarse_model("ndc")
        model.train()
        with Operations() as counted:
            sum(model.get_loss_dict(model.get_outputs(bundle), photos).values()).backward()
        return counted.counts

    assert operations(rays).total() < operations(more_rays).total()


def test_without_a_semantic_loss_no_network_is_loaded_and_no_operation_is_run(
    llff_scene: Path, monkeypatch: pytest.MonkeyPatch
):
    def trained(weight: float):
        manager = FewShotDataManagerConfig(
            data=llff_scene, dataparser=LLFFDataParserConfig(), train_num_rays_per_batch=20
        )
        model = CoarseFewShotModelConfig(coarse_field=CoarseFieldConfig(**FIELD), num_samples=6)
        config = CoarseFewShotPipelineConfig(
            datamanager=manager, model=model, semantic_weight=weight, semantic_side=16, semantic_every=2
        )
        pipeline = config.setup(device="cpu")
        pipeline.get_training_callbacks(TrainingCallbackAttributes(None, None, pipeline, None))
        pipeline.get_train_loss_dict(1)  # what is found once, when training begins
        counts = []
        for train in (pipeline.get_train_loss_dict, functools.partial(VanillaPipeline.get_train_loss_dict, pipeline)):
            for step in (0, 1):
                pipeline.zero_grad()
                with Operations() as counted:
                    sum(train(step)[1].values()).backward()
                counts.append(counted.counts)
        return pipeline, counts

    on, (with_it, between, plain, _) = trained(0.1)
    assert with_it.total() > between.total() == plain.total()
    monkeypatch.setattr(pipelines, "load_backbone", lambda *_: pytest.fail("the network was loaded"))
    off, (without, *others) = trained(0.0)
    assert off.unseen is None and names(on) == names(off)
    assert all(counts == without for counts in others)


def test_what_is_off_builds_nothing_and_reads_no_photo():
    decisions, unread = decided("box"), Scene(DataparserOutputs([Path("gone.png")], cameras=None))
    assert background_color(decisions) is None
    assert build_exposure(decisions, num_photos=3) is None
    assert matched_rays(decisions, unread) is None
    assert CoarseFieldConfig(**FIELD).setup(decisions.on("view_color")).direction_encoding is None
