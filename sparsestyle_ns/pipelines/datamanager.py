"""Photos and rays for training on a few views, whatever nerfstudio dataparser reads them."""

import copy
import functools
import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Dict, Optional, Tuple, Type, Union

import torch
import tyro
from jaxtyping import Float, Int
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.utils.dataloaders import RandIndicesEvalDataloader
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sparsestyle_ns.data.photos import SMALLEST_SIDE, PhotoDataset, at_size, check_one_size, open_photo
from sparsestyle_ns.data.transforms import read_transforms
from sparsestyle_ns.data.view_selection import BLENDER_VIEWS, DEFAULT_NUM_VIEWS, select_views
from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.effects.matched_depth import MatchedRays
from sparsestyle_ns.effects.registry import ALL_AUTO, EffectSettings, decide
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.utils.distributed import num_processes
from sparsestyle_ns.utils.errors import InputError


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
    max_image_side: Annotated[Optional[int], tyro.conf.arg(aliases=("--max-image-side",))] = 1008
    """Photos whose longer side is over this many pixels are reduced to it."""
    matched_share: float = 0.25
    """Rays to matched points in a batch, over its other rays; none where `matched_depth` is off (see Effects)."""
    seed: int = 42
    """Seed of the choice of pixels; a step's batch depends on it and the step alone, so a resumed run sees the same."""
    effects: tyro.conf.Suppress[EffectSettings] = ALL_AUTO
    """The pipeline's, which hands them on."""
    decided: tyro.conf.Suppress[Optional[Decisions]] = None
    """What was decided before; None: the scene is measured."""


@dataclass
class TrainingPixels:
    """All pixels of the training views with their rays; view i's are rows `starts[i]` to `starts[i + 1]`, row by row.

    Attributes:
        origins, directions: world rays, directions of unit length.
        colors: in [0, 1], alpha composited on the background colour.
        views: index of the training view.
        starts: first row of each view, and the number of rows last.
        sizes: (height, width) of each view.
        trusted: rows that a mask, where there is one, leaves in.
    """

    origins: Float[Tensor, "pixels 3"]
    directions: Float[Tensor, "pixels 3"]
    colors: Float[Tensor, "pixels 3"]
    views: Int[Tensor, "pixels"]
    starts: Tuple[int, ...]
    sizes: Tuple[Tuple[int, int], ...]
    trusted: Int[Tensor, "trusted"]


class FewShotDataManager(VanillaDataManager[PhotoDataset]):
    """Keeps the few training views, and all their rays, in memory.

    It chooses the views (`select_views`), reduces large photos, has the effects decided, and adds to the datasets'
    metadata what the models need to know of the scene: `effects` and `view_ids`.
    """

    config: FewShotDataManagerConfig
    effects: Decisions

    @property
    def dataparser(self) -> DataParser:
        """nerfstudio's reader of the scene."""
        return self._dataparser

    @dataparser.setter
    def dataparser(self, parser: DataParser) -> None:
        parser.get_dataparser_outputs = functools.partial(read_scene, parser)
        self._dataparser = parser

    def create_train_dataset(self) -> PhotoDataset:
        """The dataset of the selected views only."""
        self._check_settings()
        outputs = self.train_dataparser_outputs
        ids = outputs.metadata.get("view_ids", list(range(len(outputs.image_filenames))))
        forward_facing = outputs.metadata.get("space") == "ndc"
        standard = BLENDER_VIEWS if isinstance(self.config.dataparser, BlenderDataParserConfig) else None
        default = DEFAULT_NUM_VIEWS["llff" if forward_facing else "other"]
        if forward_facing and self.dataparser.config.eval_interval >= len(ids):
            default = len(ids)
        chosen = select_views(ids, self.config.num_views, self.config.view_ids, default, standard)
        self.view_ids = tuple(ids[position] for position in chosen)
        self.train_dataparser_outputs = select_outputs(outputs, chosen)
        if len(outputs.cameras.width.unique()) == len(outputs.cameras.height.unique()) == 1:
            # Blender's cameras have the size of the first photo, also where that isn't trained on.
            check_one_size([outputs.image_filenames[0], *self.train_dataparser_outputs.image_filenames])
        if self.test_mode == "val":
            names = ", ".join(path.name for path in self.train_dataparser_outputs.image_filenames)
            CONSOLE.print(
                f"Training on {len(chosen)} of {len(ids)} views: {', '.join(map(str, self.view_ids))} ({names})."
            )
        self.effects = self.config.decided or decide(self.scene, self.config.effects)
        return self._dataset(self.train_dataparser_outputs)

    def _check_settings(self) -> None:
        side, rays = self.config.max_image_side, self.config.train_num_rays_per_batch
        if side is not None and side < SMALLEST_SIDE:
            raise InputError(f"--max-image-side is {side}; give {SMALLEST_SIDE} pixels or more.")
        if rays < 1:
            raise InputError(f"--pipeline.datamanager.train-num-rays-per-batch is {rays}; give 1 or more.")

    @property
    def scene(self) -> Scene:
        """The training views, for measuring."""
        return Scene.of(self.train_dataparser_outputs)

    def create_eval_dataset(self) -> PhotoDataset:
        """The dataparser's whole held-out split; the training views where it holds out none, as of very few photos."""
        outputs = self.dataparser.get_dataparser_outputs(split=self.test_split)
        if not outputs.image_filenames:
            CONSOLE.print("No view is held out; evaluating on the training views.")
            outputs = self.train_dataparser_outputs
        return self._dataset(outputs)

    def _dataset(self, outputs: DataparserOutputs) -> PhotoDataset:
        limit = self.config.max_image_side
        longest = int(max(outputs.cameras.width.max(), outputs.cameras.height.max()))
        scale = self.config.camera_res_scale_factor
        if limit is not None and longest * scale > limit:
            # A little more, as nerfstudio cuts sides off to whole pixels, photos' and masks' in different precision.
            scale = (1.0 + 1e-6) * limit / longest
        dataset = self.dataset_type(dataparser_outputs=outputs, scale_factor=scale)
        dataset.cameras = at_size(outputs.cameras, dataset.cameras.width, dataset.cameras.height)
        dataset.cameras.distortion_params = self.effects.build("lens_distortion", cameras=dataset.cameras)
        dataset.metadata.update(effects=self.effects, view_ids=self.view_ids)
        return dataset

    def setup_train(self) -> None:
        """Loads the photos and generates all their rays once."""
        self.pixels = gather_pixels(self.train_dataset, self.device)

    def setup_eval(self) -> None:
        """Sees to it that held-out photos can be used.

        nerfstudio would keep all of them in memory, for batches of their pixels that few ask for (`next_eval`).
        """
        if self.test_mode == "val":
            for index in range(len(self.eval_dataset)):
                self.eval_dataset.get_data(index, "uint8")
        self.eval_dataloader = RandIndicesEvalDataloader(self.eval_dataset, self.device)

    def next_eval(self, step: int) -> Tuple[RayBundle, Dict[str, Any]]:
        """A batch of random pixels of held-out views; from the first one on all of their photos are in memory."""
        if not hasattr(self, "eval_image_dataloader"):
            super().setup_eval()
        return super().next_eval(step)

    @functools.cached_property
    def matched(self) -> Optional[MatchedRays]:
        """Rays to points of known depth; None where the effect is off. Found when training begins."""
        rays = self.effects.build("matched_depth", scene=self.scene)
        return None if rays is None else MatchedRays(**{key: part.to(self.device) for key, part in vars(rays).items()})

    def next_train(self, step: int) -> Tuple[RayBundle, Dict[str, Any]]:
        """A batch of random pixels of all training views; the same for the same seed and step.

        Where points are matched, rays to some of them come last. They have no colour, but their distance is in the
        bundle's metadata as `matched_distance`, which is 0 for the others.
        """
        self.train_count += 1
        generator = torch.Generator(device=self.device).manual_seed(self.config.seed * 1_000_003 + step)
        count = self.config.train_num_rays_per_batch
        pick = torch.randint(len(self.pixels.trusted), (count,), generator=generator, device=self.device)
        pixels, matched, metadata = self.pixels, self.matched, {}
        chosen = pixels.trusted[pick]
        rays = pixels.origins[chosen], pixels.directions[chosen], pixels.views[chosen]
        if matched is not None:
            extra = math.ceil(self.config.matched_share * count)
            pick = torch.randint(len(matched), (extra,), generator=generator, device=self.device)
            known = matched.origins[pick], matched.directions[pick], matched.views[pick]
            rays = tuple(map(torch.cat, zip(rays, known, strict=True)))
            distances = matched.distances[pick]
            metadata["matched_distance"] = torch.cat([distances.new_zeros(count, 1), distances])
        return bundle_rays(*rays, metadata), {"image": pixels.colors[chosen]}

    def get_train_rays_per_batch(self) -> int:
        """Rays of a batch that this process renders."""
        return self.config.train_num_rays_per_batch // num_processes()


def read_scene(parser: DataParser, split: str = "train", **kwargs: Any) -> DataparserOutputs:
    """What a dataparser says of one split of a scene, checked; nerfstudio's own parsers check next to nothing.

    Raises:
        InputError: the scene can't be read, or a camera in it is none.
    """
    config = parser.config
    name = type(config).__name__.removesuffix("DataParserConfig").lower()
    if isinstance(config, BlenderDataParserConfig):
        frames = read_transforms(config.data / f"transforms_{split}.json", with_angle=True)["frames"]
        first = frames[0]["file_path"].replace("./", "")
        open_photo(config.data / f"{first}.png")  # gives all cameras of the split their size
    elif isinstance(config, NerfstudioDataParserConfig):
        is_file = config.data.suffix == ".json"
        read_transforms(config.data if is_file else config.data / "transforms.json", with_angle=False)
    try:
        outputs = DataParser.get_dataparser_outputs(parser, split, **kwargs)
    except InputError:
        raise
    except Exception as error:  # a file that isn't as a parser expects it shows itself in any kind of error
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{config.data} can't be read as a scene of the kind {name} ({type(error).__name__}: {reason}); correct "
            "its files, or choose the dataparser that they were made for."
        ) from error
    check_cameras(outputs)
    return outputs


def check_cameras(outputs: DataparserOutputs) -> None:
    """Makes sure that cameras are finite and have an angle of view.

    Raises:
        InputError: one isn't or hasn't; its photo is named.
    """
    cameras = outputs.cameras
    if len(cameras) == 0:  # a split may be empty
        return
    numbers = [cameras.camera_to_worlds.flatten(1), cameras.fx, cameras.fy, cameras.cx, cameras.cy]
    usable = torch.cat([part.reshape(len(cameras), -1) for part in numbers], dim=-1).isfinite().all(dim=-1)
    for part in (cameras.fx, cameras.fy, cameras.width, cameras.height):
        usable &= (part > 0).reshape(len(cameras), -1).all(dim=-1)
    if not usable.all():
        photo = outputs.image_filenames[int((~usable).nonzero()[0])]
        raise InputError(
            f"The camera of {photo} has a pose that is not finite, or a focal length or size that is not above 0: "
            "correct it, or take the photo out of the scene."
        )


def select_outputs(outputs: DataparserOutputs, positions: Tuple[int, ...]) -> DataparserOutputs:
    """The same scene with only the views at these positions."""
    index = torch.tensor(positions)
    metadata = copy.copy(outputs.metadata)
    for key in ("view_ids", "view_names"):
        if key in metadata:
            metadata[key] = [metadata[key][position] for position in positions]
    return replace(
        outputs,
        image_filenames=[outputs.image_filenames[position] for position in positions],
        mask_filenames=outputs.mask_filenames and [outputs.mask_filenames[position] for position in positions],
        cameras=outputs.cameras[index],
        metadata=metadata,
    )


def gather_pixels(dataset: InputDataset, device: Union[str, torch.device]) -> TrainingPixels:
    """Loads all images of a dataset and generates the ray of each pixel."""
    rays, colors, views, starts, sizes, trusted = [], [], [], [0], [], []
    for index in range(len(dataset)):
        data = dataset[index]
        image = data["image"][..., :3]
        bundle = dataset.cameras.generate_rays(camera_indices=index, keep_shape=True)
        height, width = image.shape[:2]
        rays.append(torch.cat([bundle.origins, bundle.directions], dim=-1).reshape(-1, 6))
        colors.append(image.reshape(-1, 3))
        views.append(torch.full((height * width,), index))
        mask = data["mask"].reshape(-1) > 0.5 if "mask" in data else torch.ones(height * width, dtype=torch.bool)
        trusted.append(mask.nonzero().squeeze(-1) + starts[-1])
        starts.append(starts[-1] + height * width)
        sizes.append((height, width))
    origins, directions = torch.cat(rays).to(device).split(3, dim=-1)
    return TrainingPixels(
        origins=origins.contiguous(),
        directions=directions.contiguous(),
        colors=torch.cat(colors).to(device),
        views=torch.cat(views).to(device),
        starts=tuple(starts),
        sizes=tuple(sizes),
        trusted=torch.cat(trusted).to(device),
    )


def bundle_rays(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    views: Int[Tensor, "rays"],
    metadata: Dict[str, Float[Tensor, "rays _"]],
) -> RayBundle:
    """A nerfstudio ray bundle of world rays and the training views that they belong to."""
    return RayBundle(
        origins=origins,
        directions=directions,
        pixel_area=torch.ones_like(origins[:, :1]),
        camera_indices=views[:, None],
        metadata=metadata,
    )
