"""Photos and rays for training on a few views, whatever nerfstudio dataparser reads them."""

import functools
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Callable, Dict, Literal, Optional, Tuple, Type, Union

import torch
import tyro
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import (
    DataManager,
    VanillaDataManager,
    VanillaDataManagerConfig,
    variable_res_collate,
)
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.utils.dataloaders import RandIndicesEvalDataloader
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sparsestyle_ns.core.triangulation import distances_to_meeting
from sparsestyle_ns.data.photos import SMALLEST_SIDE, PhotoDataset, at_scale, at_size, check_one_size, reduced
from sparsestyle_ns.data.reading import read_scene
from sparsestyle_ns.data.scene_info import scene_info, select_outputs
from sparsestyle_ns.data.view_selection import select_views
from sparsestyle_ns.effects.decisions import Decisions
from sparsestyle_ns.effects.matched_depth import MatchedRays, matched_rays
from sparsestyle_ns.effects.pose_refinement import CameraRefinement, carried_along
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.runs.scene_record import ExpectedScene, SceneRecord, in_words, record_scene
from sparsestyle_ns.utils.distributed import num_processes
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import say


@dataclass
class FewShotDataManagerConfig(VanillaDataManagerConfig):
    """Settings of the few-shot data manager."""

    _target: Type = field(default_factory=lambda: FewShotDataManager)
    num_views: Annotated[Optional[int], tyro.conf.arg(aliases=("--num-views",))] = None
    """How many photos to train on, by the standard split: 3 for LLFF (RegNeRF's), 8 otherwise (for Blender's hundred,
    DietNeRF's). Fewer are used where a scene has fewer."""
    view_ids: Annotated[Optional[Tuple[int, ...]], tyro.conf.arg(aliases=("--view-ids",))] = None
    """The photos to train on, by number, instead: an image's place in its sorted folder for LLFF, a frame's in
    transforms_train.json for Blender."""
    max_image_side: Annotated[Optional[int], tyro.conf.arg(aliases=("--max-image-side",))] = 504
    """Photos whose longer side is over this many pixels are reduced to it."""
    matched_share: float = 0.25
    """Rays to matched points in a batch, over its other rays; none where `matched_depth` is off (see Effects)."""
    seed: int = 42
    """Seed of the choice of pixels; a step's batch depends on it and the step alone, so a resumed run sees the same."""
    expected: tyro.conf.Suppress[Optional[ExpectedScene]] = None
    """What the scene has to be, where a run of it is opened or gone on with; not in config.yml."""


@dataclass
class TrainingPixels:
    """All pixels of the training views, view by view and row by row, with their world rays by the given cameras."""

    origins: Float[Tensor, "pixels 3"]
    directions: Float[Tensor, "pixels 3"]
    """Of unit length."""
    colors: Float[Tensor, "pixels 3"]
    """In [0, 1], alpha composited on the background colour."""
    views: Int[Tensor, "pixels"]
    """Indices of training views."""
    starts: Tuple[int, ...]
    """The first pixel of each view, and the number of all pixels last."""
    sizes: Tuple[Tuple[int, int], ...]
    """(height, width) of each view."""
    trusted: Int[Tensor, "trusted"]
    """Pixels that a mask, where there is one, leaves in."""

    def rows(self, view: int) -> slice:
        """Where the pixels of a view are."""
        return slice(self.starts[view], self.starts[view + 1])


@dataclass
class PixelSampler:
    """By which `ns-export pointcloud` and `poisson` ask for random pixels, each time others: how many at once."""

    num_rays_per_batch: Optional[int] = None
    """None: nobody asked, and batches are those of training."""


class FewShotDataManager(VanillaDataManager[PhotoDataset]):
    """Chooses the views to train on (`select_views`), reduces large photos, and keeps all their rays in memory.

    The pipeline tells it by `set_effects` what was decided about the scene; photos and rays are loaded after that.
    InputError where the scene or a setting can't be used.
    """

    config: FewShotDataManagerConfig
    effects: Optional[Decisions] = None
    pixels: TrainingPixels
    """Once they are loaded."""
    _refined_rays: Optional[Callable[[Tensor, Tensor, Tensor], Tuple[Tensor, Tensor]]] = None

    def __init__(
        self,
        config: FewShotDataManagerConfig,
        device: Union[torch.device, str] = "cpu",
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
    ) -> None:
        # In place of VanillaDataManager's, which reads the scene unchecked.
        self.config, self.device, self.test_mode = config, device, test_mode
        self.world_size, self.local_rank = world_size, local_rank
        self.train_pixel_sampler = PixelSampler()
        side, rays = config.max_image_side, config.train_num_rays_per_batch
        if side is not None and side < SMALLEST_SIDE:
            raise InputError(f"--max-image-side is {side}; give {SMALLEST_SIDE} pixels or more.")
        if rays < 1:
            raise InputError(f"--pipeline.datamanager.train-num-rays-per-batch is {rays}; give 1 or more.")
        if config.data is None:
            config.data = config.dataparser.data
        config.dataparser.data = config.data = Path(config.data).expanduser()
        self.dataparser = config.dataparser.setup()
        if test_mode == "inference":
            self.dataparser.downscale_factor = 1  # as in nerfstudio, whose parser then opens no photo
        self.includes_time = self.dataparser.includes_time
        self.test_split = "val" if test_mode == "val" else "test"
        try:
            self.train_dataparser_outputs = self._chosen_views(self.dataparser)
            self.train_dataset = self._dataset(self.train_dataparser_outputs)
            self.eval_dataset = self.create_eval_dataset()
        except InputError as error:
            if config.expected is None:
                raise
            raise config.expected.refusal(str(config.data), error.fault) from error
        if config.expected is not None:
            held_out = self._held_out if self.test_split == "test" else None
            # For mere inference photos needn't be there, and those that the parser names may be of another size.
            with_photos = test_mode != "inference"
            config.expected.check(record_scene(config.data, self.train_dataparser_outputs, None, held_out, with_photos))
        self.exclude_batch_keys_from_device = self.train_dataset.exclude_batch_keys_from_device
        if config.masks_on_gpu and "mask" in self.exclude_batch_keys_from_device:
            self.exclude_batch_keys_from_device.remove("mask")
        if not has_one_size(self.train_dataset.cameras):
            config.collate_fn = variable_res_collate  # what nerfstudio does for photos of several sizes
        DataManager.__init__(self)

    def _chosen_views(self, parser: DataParser) -> DataparserOutputs:
        outputs = read_scene(parser)
        info, asked, expected = scene_info(outputs), (self.config.num_views, self.config.view_ids), self.config.expected
        gone = [] if expected is None else [view for view in expected.record.view_ids if view not in info.view_ids]
        if gone:
            raise InputError(f"it was trained on views {', '.join(map(str, gone))}, too, which aren't there any more")
        chosen = select_views(info.view_ids, *asked, info.default_num_views, info.standard_views)
        selected = select_outputs(outputs, chosen)
        if has_one_size(outputs.cameras):
            # Blender's cameras have the size of the first photo, also where that isn't trained on.
            check_one_size([outputs.image_filenames[0], *selected.image_filenames])
        if self.test_mode == "val":
            names = ", ".join(path.name for path in selected.image_filenames)
            ids = ", ".join(str(info.view_ids[position]) for position in chosen)
            CONSOLE.print(f"Training on {len(chosen)} of {len(info.view_ids)} views: {ids} ({names}).")
        return selected

    def create_eval_dataset(self) -> PhotoDataset:
        """The dataparser's whole held-out split; the training views where it holds out none, as of very few photos."""
        outputs = self._held_out = read_scene(self.dataparser, self.test_split)
        if not outputs.image_filenames:
            CONSOLE.print("No view is held out; evaluating on the training views.")
            outputs = self.train_dataparser_outputs
        else:
            trained = set(self.train_dataparser_outputs.image_filenames)
            shared = [path.name for path in outputs.image_filenames if path in trained]
            if shared:
                say(f"Held out, but trained on as well, so that figures say less: {in_words(shared)}.")
        return self._dataset(outputs)

    def _dataset(self, outputs: DataparserOutputs) -> PhotoDataset:
        limit = self.config.max_image_side
        longest = int(max(outputs.cameras.width.max(), outputs.cameras.height.max()))
        scale = self.config.camera_res_scale_factor
        if limit is not None and longest * scale > limit:
            # A little more, as nerfstudio cuts sides off to whole pixels, photos' and masks' in different precision.
            scale = (1.0 + 1e-6) * limit / longest
        dataset = PhotoDataset(outputs, scale)
        dataset.cameras = at_size(outputs.cameras, dataset.cameras.width, dataset.cameras.height)
        return dataset

    def record(self, effects: Decisions) -> SceneRecord:
        """What says of a run on these views, with these effects, which scene it is of."""
        outputs = self.train_dataparser_outputs
        if self.test_mode == "inference":  # whose parser names photos of the full size
            outputs = self._chosen_views(self.config.dataparser.setup())
        return record_scene(self.config.data, outputs, effects)

    def measured_views(self) -> Optional[DataparserOutputs]:
        """The held-out views of the split that runs are measured on; None where a scene hasn't that split."""
        if self.test_split == "test":
            return self._held_out
        try:
            return read_scene(self.dataparser, "test")
        except InputError:
            return None

    @property
    def scene(self) -> Scene:
        """The training views, for measuring."""
        return Scene(self.train_dataparser_outputs)

    def set_effects(self, effects: Decisions) -> None:
        """Takes over what was decided, and then loads photos, unless it is for mere inference, which needs none."""
        self.effects = effects
        if not effects.on("lens_distortion"):
            for dataset in (self.train_dataset, self.eval_dataset):
                dataset.given_cameras.distortion_params = None
        if self.test_mode != "inference":
            self.load_pixels()

    def refine_cameras(self, refinement: Optional[CameraRefinement]) -> None:
        """From now on training cameras, and rays of training batches, are as this has refined them by then.

        Held-out cameras go with them, by the similarity that lays the given training cameras over the refined ones.
        """
        if refinement is None:
            return
        self._refined_rays = refinement.forward  # no module, which would be part of the state twice
        self.train_dataset.refine = refinement.cameras
        self.eval_dataset.refine = self._carried_along if self.has_held_out else refinement.cameras

    @property
    def has_held_out(self) -> bool:
        """Whether views are evaluated that aren't those trained on."""
        return self.eval_dataset.image_filenames != self.train_dataset.image_filenames

    def _carried_along(self, cameras: Cameras) -> Cameras:
        given, refined = self.train_dataset.given_cameras, self.train_dataset.cameras
        return carried_along(cameras, given, refined)

    def refined_rays(
        self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], views: Int[Tensor, "rays"]
    ) -> Tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
        """Rays of given training cameras, as they are by the refined ones; differentiable where these are learned."""
        return (origins, directions) if self._refined_rays is None else self._refined_rays(origins, directions, views)

    def load_pixels(self) -> None:
        """Loads the training photos with all their rays, unless that is done already."""
        if not hasattr(self, "pixels"):
            self.pixels = self.pixels_at(1.0)

    def pixels_at(self, scale: float) -> TrainingPixels:
        """The training photos, reduced to a share of their size, with all their rays by the given cameras."""
        loaded = scale == 1.0 and hasattr(self, "pixels")
        return self.pixels if loaded else gather_pixels(self.train_dataset, self.device, scale)

    @property
    def photo_side(self) -> int:
        """The longer side of the largest training photo, in pixels."""
        cameras = self.train_dataset.cameras
        return int(max(cameras.width.max(), cameras.height.max()))

    @functools.cached_property
    def matched(self) -> Optional[MatchedRays]:
        """Rays to points of known depth; None where the effect is off. Found when training begins."""
        rays = None if self.effects is None else matched_rays(self.effects, self.scene)
        return None if rays is None else MatchedRays(**{key: part.to(self.device) for key, part in vars(rays).items()})

    def get_datapath(self) -> Path:
        """Where a viewer keeps camera paths: as nerfstudio's do, with the scene, else where the command was started."""
        return self.config.data if os.access(self.config.data, os.W_OK) else Path.cwd()

    def setup_train(self) -> None:
        """Nothing yet: rays are generated once it is decided whether lenses bend them (`set_effects`)."""

    def setup_eval(self) -> None:
        """Makes sure that held-out photos can be used; nerfstudio would keep all in memory for `next_eval`."""
        if self.test_mode == "val":
            for index in range(len(self.eval_dataset)):
                self.eval_dataset.get_data(index, "uint8")
        self.eval_dataloader = RandIndicesEvalDataloader(self.eval_dataset, self.device)

    def next_eval(self, step: int) -> Tuple[RayBundle, Dict[str, Any]]:
        """A batch of random pixels of held-out views; from the first one on all of their photos are in memory."""
        if not hasattr(self, "eval_image_dataloader"):
            super().setup_eval()
        return super().next_eval(step)

    def next_eval_image(self, step: int) -> Tuple[Cameras, Dict[str, Any]]:
        """A held-out camera, as refined as it is by now, with its photo."""
        self.eval_dataloader.cameras = self.eval_dataset.cameras.to(self.device)
        return super().next_eval_image(step)

    def next_train(self, step: int) -> Tuple[RayBundle, Dict[str, Any]]:
        """A batch of random pixels of all training views; the same for the same seed and step.

        Where points are matched, rays to some of them come last, without colour, but with their distance in the
        bundle's metadata as `matched_distance`, which is 0 for the others.
        """
        self.train_count += 1
        asked = self.train_pixel_sampler.num_rays_per_batch
        seed = step if asked is None else self.train_count  # nerfstudio's exporters ask for step 0 again and again
        generator = torch.Generator(device=self.device).manual_seed(self.config.seed * 1_000_003 + seed)
        count = asked or self.config.train_num_rays_per_batch
        pick = torch.randint(len(self.pixels.trusted), (count,), generator=generator, device=self.device)
        pixels, matched, metadata = self.pixels, self.matched if asked is None else None, {}
        chosen = pixels.trusted[pick]
        rays = pixels.origins[chosen], pixels.directions[chosen], pixels.views[chosen]
        if matched is not None:
            extra = math.ceil(self.config.matched_share * count)
            pick = torch.randint(len(matched), (extra,), generator=generator, device=self.device)
            known = matched.origins[pick], matched.directions[pick], matched.views[pick]
            rays = tuple(map(torch.cat, zip(rays, known, strict=True)))
            distances = matched.distances[pick] if self._refined_rays is None else self._distances_now(pick)
            metadata["matched_distance"] = torch.cat([distances.new_zeros(count, 1), distances])
        *bent, views = rays
        return bundle_rays(*self.refined_rays(*bent, views), views, metadata), {"image": pixels.colors[chosen]}

    def matched_pairs(self, points: Int[Tensor, "points"]) -> Tuple[Float[Tensor, "2 points 3"], ...]:
        """Origins and directions of both photos' rays to some matched points, by the refined cameras."""
        matched, half = self.matched, len(self.matched) // 2
        both = torch.cat([points, points + half])
        rays = self.refined_rays(matched.origins[both], matched.directions[both], matched.views[both])
        return tuple(part.view(2, -1, 3) for part in rays)

    @torch.no_grad()
    def _distances_now(self, pick: Int[Tensor, "rays"]) -> Float[Tensor, "rays 1"]:
        """Distances of matched points along rays, by the cameras as they are refined by now."""
        half = len(self.matched) // 2
        distances = distances_to_meeting(*self.matched_pairs(pick % half))
        return distances[pick // half, torch.arange(len(pick), device=pick.device)][:, None]

    def get_train_rays_per_batch(self) -> int:
        """Rays of a batch that this process renders."""
        return self.config.train_num_rays_per_batch // num_processes()


def has_one_size(cameras: Cameras) -> bool:
    """Whether all of some cameras have photos of one size."""
    return len(cameras.width.unique()) == len(cameras.height.unique()) == 1


def gather_pixels(dataset: PhotoDataset, device: Union[str, torch.device], scale: float = 1.0) -> TrainingPixels:
    """Loads all images of a dataset, at a share of their size in (0, 1], and generates the ray of each pixel."""
    parts, starts, sizes = [], [0], []
    cameras = at_scale(dataset.given_cameras, scale)
    for index in range(len(dataset)):
        data = dataset[index]
        size = int(cameras.height[index]), int(cameras.width[index])
        image = reduced(data["image"][..., :3], size)
        rays = cameras.generate_rays(camera_indices=index, keep_shape=True).flatten()
        count = len(rays)
        mask = torch.ones(count, dtype=torch.bool)
        if "mask" in data:  # a pixel that is made of some that aren't trusted isn't either
            mask = reduced(data["mask"].float().view(*data["image"].shape[:2], 1), size).reshape(-1) > 0.99
        trusted = mask.nonzero().squeeze(-1) + starts[-1]
        parts.append((rays.origins, rays.directions, image.reshape(-1, 3), torch.full((count,), index), trusted))
        starts.append(starts[-1] + count)
        sizes.append(tuple(image.shape[:2]))
    *pixels, trusted = (torch.cat(part).to(device) for part in zip(*parts, strict=True))
    return TrainingPixels(*pixels, tuple(starts), tuple(sizes), trusted)


def bundle_rays(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    views: Int[Tensor, "rays"],
    metadata: Dict[str, Float[Tensor, "rays _"]],
) -> RayBundle:
    """A nerfstudio ray bundle of world rays and the training views that they belong to."""
    area = torch.ones_like(origins[:, :1])
    return RayBundle(origins, directions, area, camera_indices=views[:, None], metadata=metadata)
