"""What benchmarks run on: a scene, a coarse run of it, and the plain way to do the same."""

import copy
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional, Tuple

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.field_components.encodings import HashEncoding
from nerfstudio.field_components.mlp import MLP
from nerfstudio.models.base_model import ModelConfig
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from benchmarks._measure import CACHE, ROOT, Options
from sparsestyle_ns.core.occupancy import interval_lengths
from sparsestyle_ns.core.sampling import even_edges
from sparsestyle_ns.core.spaces import Space
from sparsestyle_ns.core.volrend import dense_weights, optical_depth
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField, fine_density
from sparsestyle_ns.losses.stylization import Losses
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager
from sparsestyle_ns.pipelines.hier_style import HierStylePipeline
from sparsestyle_ns.rendering.render import over_background
from sparsestyle_ns.runs.coarse_run import CoarseRun, find_coarse_run
from sparsestyle_ns.utils.errors import InputError

BACKBONE = "vgg16-shift-tolerant"
"""The feature network of all benchmarks: its weights are on every machine, so that figures can be compared."""
COARSE_METHOD = "coarse-fewshot-draft"
QUICK_COARSE = ["--pipeline.datamanager.max-image-side", "32", "--pipeline.model.coarse-field.layer-width", "32"]
"""A coarse run for --quick."""
PLAIN_SAMPLES = 64
"""Even samples a ray of the plain way."""
PLAIN_RAYS_PER_CHUNK = ModelConfig().eval_num_rays_per_chunk
"""Rays that the plain way renders at once: as many as nerfstudio does, unless told otherwise."""
PLAIN_NOTE = (
    f"The plain way: the coarse field at {PLAIN_SAMPLES} even samples on every ray in every step, nerfstudio's torch "
    f"HashEncoding and an MLP as in our residual field on all of them, dense compositing, {PLAIN_RAYS_PER_CHUNK} rays "
    "at a time; with gradients each chunk is checkpointed, so that it is rendered again in the backward pass. It runs "
    "as nerfstudio would: in float32 on a CPU, under autocast (float16) on a GPU, with Adam that isn't fused. Ours "
    "runs with the project's defaults (bfloat16 matrix products where the device has them)."
)

# -------------------------------------------------------------------------------------------------------------- scenes


@dataclass(frozen=True)
class Scene:
    """Photos and a painting: an LLFF folder and an image file."""

    name: str
    folder: Path
    style_image: Path


def find_scene(options: Options) -> Scene:
    """The scene that the command line asks for.

    Raises:
        InputError: it isn't there.
    """
    if options.sample:
        return _sample_scene(options.quick)
    data = options.data or Path(os.environ.get("SPARSESTYLE_DATA") or ROOT.parent / "shared" / "data")
    scene = Scene("fern", data / "llff" / "fern", data / "styles" / "woman_with_hat_matisse.jpg")
    for path in (scene.folder, scene.style_image):
        if not path.exists():
            raise InputError(f"There is no {path}: name the folder of the data with --data, or give --sample.")
    return scene


def _sample_scene(small: bool) -> Scene:
    width = "126" if small else "504"
    folder = CACHE / f"sample-{width}"
    scene = Scene("sample", folder / "llff", folder / "painting.png")
    scripts = {
        scene.folder: ["make_sample_scene.py", folder, "--layout", "llff", "--width", width],
        scene.style_image: ["make_style_image.py", scene.style_image],
    }
    for product, (script, *arguments) in scripts.items():
        if not product.exists():
            command = [sys.executable, ROOT / "data_scripts" / script, *arguments]
            if subprocess.run(list(map(str, command))).returncode != 0:
                raise InputError(f"The sample {product} couldn't be made; see the lines above.")
    return scene


def at_size(config: TrainerConfig, scene: Scene, longer_side: Optional[int]) -> Any:
    """A copy of a method's config, for a scene whose photos are brought to a size, enlarged where they are smaller.

    Args:
        longer_side: in pixels; None for what the method says.
    """
    config = copy.deepcopy(config)
    manager = config.pipeline.datamanager
    manager.data, manager.dataparser = scene.folder, LLFFDataParserConfig()
    if longer_side is not None:
        # The size is the smaller one of scale and side, and no photo is that large.
        manager.max_image_side, manager.camera_res_scale_factor = longer_side, math.inf
    return config


def load_photos(scene: Scene, longer_side: Optional[int] = None) -> FewShotDataManager:
    """The photos of a scene, in a size."""
    config = at_size(method_config(COARSE_METHOD), scene, longer_side)
    return config.pipeline.datamanager.setup(device="cpu", test_mode="inference")


def find_or_train_coarse(scene: Scene, options: Options) -> CoarseRun:
    """A run of coarse-fewshot-draft on the scene: an earlier one from .bench, else a new one.

    Raises:
        InputError: training failed.
    """
    device = options.set_up().type
    usual = 20 if options.quick else method_config(COARSE_METHOD).max_num_iterations
    iterations = str(options.coarse_iterations or usual)
    folder = CACHE / "coarse" / ("-".join([scene.name, iterations] + ["quick"] * options.quick))
    manager = load_photos(scene)
    effects = decide(manager.scene, EffectSettings())
    record = manager.record(effects)
    found = find_coarse_run(folder, [COARSE_METHOD], record)
    if found is None:
        print(f"Training a coarse run of {iterations} iterations, once; it is kept in {folder}", flush=True)
        command = ["-m", "nerfstudio.scripts.train", COARSE_METHOD, "--data", scene.folder, "--output-dir", folder]
        command += ["--max-num-iterations", iterations]
        command += ["--machine.device-type", device, "--vis", "tensorboard", "--viewer.quit-on-train-completion"]
        command += ["True", *(QUICK_COARSE if options.quick else [])]
        command += ["llff-data"]
        environment = os.environ | {"OMP_NUM_THREADS": str(options.num_threads), "PYTHONWARNINGS": "ignore"}
        subprocess.run([sys.executable, *map(str, command)], env=environment, stdout=subprocess.DEVNULL)
        found = find_coarse_run(folder, [COARSE_METHOD], record)
    if found is None:
        raise InputError("The coarse run couldn't be trained; see the lines above.")
    return found


def style_config(scene: Scene, coarse: CoarseRun, longer_side: int, options: Options, only_whole: bool = False) -> Any:
    """The config of hier-style for a scene in a size; with --quick everything is small.

    Args:
        only_whole: all iterations are at the size of the photos, none at smaller ones.
    """
    config = at_size(method_config("hier-style"), scene, max(32, longer_side // 8) if options.quick else longer_side)
    pipeline = config.pipeline
    pipeline.style_image, pipeline.backbone = scene.style_image, BACKBONE
    pipeline.model.fine_encoding = "hash"  # the plain way gets the same tables
    pipeline.model.coarse_field = copy.deepcopy(coarse.config.pipeline.model.coarse_field)
    if only_whole:
        pipeline.view_side, pipeline.view_scales, pipeline.scale_shares = "photos", (1.0,), (1.0,)
    if options.quick:
        pipeline.feature_side, pipeline.warm_start_steps = 64, 1
        pipeline.model.log2_table_size, pipeline.model.occupancy_resolution = 12, 16
    return config


# ------------------------------------------------------------------------------------------------------- the plain way


class PlainField(nn.Module):
    """The stylised field from nerfstudio's parts, with the weights of our residual field, rendered without a trick.

    Args:
        coarse: the frozen coarse field.
        residual: our residual field; its weights are copied.
        space: lays rays into the fields' cube.
        background: colour behind the scene, or None.
    """

    def __init__(
        self, coarse: CoarseField, residual: ResidualField, space: Space, background: Optional[Float[Tensor, "3"]]
    ) -> None:
        super().__init__()
        self.coarse, self.space = coarse, space
        self.background = background
        self.encoding = hash_encoding_like(residual.grid)
        self.mlp: MLP = copy.deepcopy(residual.mlp)
        self.color_head = copy.deepcopy(residual.color_head)
        self.density_head = copy.deepcopy(residual.density_head)
        self.density_scale = residual.density_scale

    def density_and_color(self, positions: Float[Tensor, "*batch 3"]) -> Tuple[Tensor, Tensor]:
        """σ_f and c_f at field coordinates in [−1, 1] (Eq. 1 to 3)."""
        with torch.no_grad():
            density, feature = self.coarse.density_and_feature(positions)
        hidden = self.mlp(torch.cat([self.encoding(0.5 * (positions + 1.0)), feature], dim=-1))
        if self.density_head is not None:
            density = fine_density(self.density_scale * self.density_head(hidden).squeeze(-1), density)
        return density, torch.sigmoid(self.color_head(hidden))

    def render_chunk(self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]) -> Tensor:
        """Colours of rays, [rays, 3]."""
        with torch.autocast(origins.device.type, enabled=origins.device.type == "cuda"):
            segments = self.space.segments(origins, directions)
            edges = even_edges(len(origins), PLAIN_SAMPLES, origins.device)
            positions = segments.positions(0.5 * (edges[:, 1:] + edges[:, :-1]))
            density, color = self.density_and_color(positions)
            lengths = interval_lengths(segments, edges, self.space.unbounded)
            weights = dense_weights(optical_depth(density, lengths))
            rgb = (weights[..., None] * color).sum(dim=-2)
            return over_background(rgb, weights.sum(dim=-1, keepdim=True), self.background).float()

    def render(self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]) -> Tensor:
        """Colours of any number of rays, [rays, 3], in bounded memory."""
        chunks = zip(origins.split(PLAIN_RAYS_PER_CHUNK), directions.split(PLAIN_RAYS_PER_CHUNK), strict=True)
        if not torch.is_grad_enabled():
            return torch.cat([self.render_chunk(*rays) for rays in chunks])
        return torch.cat([checkpoint(self.render_chunk, *rays, use_reentrant=False) for rays in chunks])

    @torch.no_grad()
    def picture(self, camera: Cameras) -> Float[Tensor, "H W 3"]:
        """What a camera sees."""
        rays = camera.generate_rays(camera_indices=0, keep_shape=True)
        return self.render(rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3)).view(*rays.shape, 3)


def hash_encoding_like(grid: HashGrid) -> HashEncoding:
    """nerfstudio's hash encoding in torch, with the same grids and the same values as one of ours.

    Raises:
        ValueError: nerfstudio rounds the grids' resolutions otherwise.
    """
    encoding = HashEncoding(
        num_levels=len(grid.resolutions),
        min_res=grid.resolutions[0],
        max_res=grid.resolutions[-1],
        log2_hashmap_size=int(math.log2(grid.table_size)),
        features_per_level=grid.get_out_dim() // len(grid.resolutions),
        implementation="torch",
    ).to(grid.table.device)
    if tuple(encoding.scalings.int().tolist()) != tuple(grid.resolutions):
        raise ValueError(f"nerfstudio's grids are {encoding.scalings.tolist()}, ours {grid.resolutions}")
    with torch.no_grad():
        encoding.hash_table.copy_(grid.table)
    return encoding


def plain_field_of(model: HierStyleModel) -> PlainField:
    """The plain way to render a stylised model, with its weights."""
    return PlainField(model.field, model.residual, model.space, model.background)


class PlainTraining:
    """The plain way to do the steps of a stylised run: the same views, losses and weights at the start."""

    def __init__(self, ours: Training) -> None:
        self.pipeline: HierStylePipeline = ours.pipeline
        self.field = plain_field_of(self.pipeline.model)
        learning_rate = ours.optimizers.config["fields"]["optimizer"].lr
        learned = [parameter for parameter in self.field.parameters() if parameter.requires_grad]
        self.optimizer = AdamOptimizerConfig(lr=learning_rate).setup(learned)
        self.num_steps = 0

    def step(self) -> None:
        """One iteration: one whole view (Eq. 5)."""
        schedule, targets, views = self.pipeline.task.level(self.num_steps)
        pixels = self.pipeline.datamanager.pixels_at(schedule.scale)
        index = self.num_steps % len(pixels.sizes)
        view, rows = views[index], pixels.rows(index)
        self.optimizer.zero_grad()
        image = self.field.render(pixels.origins[rows], pixels.directions[rows]).view(view.picture.shape)
        values = targets.losses(targets.view(image, view.content, view.accumulation))
        sum(Losses(values, self.pipeline.config.weights_at(self.num_steps, schedule)).terms().values()).backward()
        self.optimizer.step()
        self.num_steps += 1
