"""Forward-facing scenes in LLFF folders: `poses_bounds.npy` and photos, for a scene in normalised device coordinates.

A row of `poses_bounds.npy` has 17 numbers: a 3x5 matrix in row-major order, then the near and far bound of the scene
seen from that camera. The matrix's columns are the camera's down, right and back vectors, its position, and (height,
width, focal length) in pixels at full size. Rows are in the order of the sorted image names.

Cameras come out as nerfstudio has them, with columns right, up, back and position, in the world of the recentred
average camera: it sits at the origin and looks along -z. One unit is `bound_scale` times the smallest near bound of the
file, so that with the default an average camera sees nothing nearer than 4/3, beyond NDC's near plane z = -1 (the
convention of RegNeRF and FreeNeRF).
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import List, NamedTuple, Optional, Tuple, Type

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn import functional as F

from sparsestyle_ns.core.ndc import ndc_rays
from sparsestyle_ns.data.estimated import estimated_distortion
from sparsestyle_ns.data.parser_choice import advice
from sparsestyle_ns.data.photos import check_one_size, images_in, open_photo, photo_size
from sparsestyle_ns.data.scene_info import NDC, SCENE_INFO, SceneInfo
from sparsestyle_ns.utils.errors import InputError

NDC_NEAR = 1.0
"""Distance of NDC's near plane in the scaled world."""
DEPTH_MARGIN = 0.1
"""Share by which the bounds of depth are widened: LLFF's are percentiles of sparse points."""
USUAL_NUM_VIEWS = 3
"""Views to train on by default (RegNeRF's); a folder with no more of them than `eval_interval` is trained on whole."""
BOX_MARGIN = 0.05
"""How far the scene box reaches beyond what the cameras see, on each side, as a part of its width."""


@dataclass
class LLFFDataParserConfig(DataParserConfig):
    """Forward-facing photos in an LLFF folder, for a scene in NDC."""

    _target: Type = field(default_factory=lambda: LLFFDataParser)
    """target class to instantiate"""
    data: Path = Path("data/llff/fern")
    """LLFF folder: it holds poses_bounds.npy and one of images_8, images_4, images."""
    downscale_factor: Optional[int] = None
    """Which size of image to read: N for the folder images_N, 1 for images; left out, the first of images_8, images_4,
    images that is there."""
    eval_interval: int = 8
    """Every how many of the sorted images one is held out for evaluation, from the first on (at least 2). A folder with
    no more images than this has none to spare: all are trained on, and evaluated on."""
    bound_scale: float = 0.75
    """The length that becomes 1, as a part of the smallest near bound (above 0): at 0.75, NDC's near plane is a quarter
    nearer than the nearest thing seen."""


class LLFFCameras(NamedTuple):
    """What `poses_bounds.npy` says of each view, in its own world and units: poses have the columns right, up, back and
    position, sizes are (width, height) in pixels at full size, as focal lengths, and bounds are depths."""

    camera_to_worlds: Float[Tensor, "num_views 3 4"]
    full_sizes: Float[Tensor, "num_views 2"]
    focals: Float[Tensor, " num_views"]
    bounds: Float[Tensor, "num_views 2"]


class LLFFDataParser(DataParser):
    """Reads an LLFF folder; a view's id is its place among the sorted images."""

    config: LLFFDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        """One split of the folder: "train", or "val" and "test", which are the held-out views."""
        self._check_settings()
        folder, interval = self.config.data, self.config.eval_interval
        read = read_poses_bounds(folder)
        filenames = _find_images(folder, self.config.downscale_factor, num_poses=len(read.focals))
        width, height = _read_image_size(filenames, read.full_sizes)

        # All views take part in recentring and scaling, so that the world does not depend on the split.
        transform = _recentring_transform(read.camera_to_worlds)
        scale = 1.0 / (self.config.bound_scale * read.bounds.min().item())
        camera_to_worlds = transform[:, :3] @ read.camera_to_worlds
        camera_to_worlds[..., 3] = scale * (camera_to_worlds[..., 3] + transform[:, 3])

        focals = read.focals * width / read.full_sizes[:, 0]
        # NDC is one space for all views, and the focal length is only its unit of x and y.
        focal = focals.mean().item()
        nearest, farthest = scale * read.bounds[:, 0].min().item(), scale * read.bounds[:, 1].max().item()
        depth_range = (1 - DEPTH_MARGIN) * nearest, (1 + DEPTH_MARGIN) * farthest
        ndc = NDC((2 * focal / width, 2 * focal / height), NDC_NEAR, depth_range)
        view_ids = self._view_ids(split, len(filenames))
        poses, fx = camera_to_worlds[view_ids].float(), focals[view_ids, None].float()
        num_views = len(view_ids) if len(view_ids) <= interval else USUAL_NUM_VIEWS
        lenses = estimated_distortion(folder, [filenames[i].name for i in view_ids])
        return DataparserOutputs(
            image_filenames=[filenames[i] for i in view_ids],
            cameras=Cameras(
                poses, fx, fx, cx=width / 2, cy=height / 2, width=width, height=height, distortion_params=lenses
            ),
            scene_box=_ndc_scene_box(camera_to_worlds, focals, (width, height), ndc.focal_over_half_size, filenames),
            dataparser_scale=scale,
            dataparser_transform=transform.float(),
            metadata={SCENE_INFO: SceneInfo(tuple(view_ids), ndc, default_num_views=num_views)},
        )

    def _check_settings(self) -> None:
        interval, scale, factor = self.config.eval_interval, self.config.bound_scale, self.config.downscale_factor
        if interval < 2:
            raise InputError(f"--eval-interval {interval} would leave no image to train on: give 2 or more.")
        if not 0 < scale < math.inf:
            raise InputError(f"--bound-scale {scale} is no scale: give a number above 0, such as 0.75.")
        if factor is not None and (factor < 1 or factor != int(factor)):  # ns-render has it as 2.0
            raise InputError(f"--downscale-factor {factor} names no folder: give N for images_N, 1 for images.")

    def _view_ids(self, split: str, num_views: int) -> List[int]:
        if split not in ("train", "val", "test"):
            raise ValueError(f"Unknown split {split!r}: it is train, val or test.")
        interval = self.config.eval_interval
        if num_views <= interval:
            if split != "train":
                CONSOLE.log(
                    f"{self.config.data} has {num_views} images, too few to hold one of {interval} out: "
                    "evaluation is on the training images."
                )
            return list(range(num_views))
        return [i for i in range(num_views) if (i % interval != 0) == (split == "train")]


def read_poses_bounds(folder: Path) -> LLFFCameras:
    """The cameras in `poses_bounds.npy` of an LLFF folder, in float64 and in the order of the rows.

    Raises:
        InputError: if the file is missing, is not an array of N rows of 17 numbers, or a row describes no camera.
    """
    if not folder.is_dir():
        raise InputError(f"There is no folder {folder}", "give an LLFF folder with --data")
    path = folder / "poses_bounds.npy"
    if not path.exists():
        raise InputError(
            f"{folder} has no poses_bounds.npy: an LLFF folder needs that file (LLFF's imgs2poses.py writes it) "
            "and one of images_8, images_4, images",
            advice(folder, path.name),
        )
    rows = _load_rows(path)
    down, right, back, position, size = rows[:, :15].reshape(-1, 3, 5).unbind(-1)
    cameras = LLFFCameras(
        camera_to_worlds=torch.stack([right, -down, back, position], dim=-1),
        full_sizes=size[:, [1, 0]],
        focals=size[:, 2],
        bounds=rows[:, 15:],
    )
    _check_cameras(cameras, path)
    return cameras


def _load_rows(path: Path) -> Float[Tensor, "num_views 17"]:
    try:
        rows = np.load(path, allow_pickle=False)
    except Exception as error:  # numpy meets a damaged header with errors of its parser's and tokeniser's too
        raise InputError(
            f"{path} cannot be read as an array of numbers ({type(error).__name__}), it may be cut short or be "
            "something else under that name: fetch or make it again."
        ) from error
    if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "fiu":
        raise InputError(f"{path} is not one array of real numbers: make it with LLFF's imgs2poses.py.")
    if rows.ndim != 2 or rows.shape[0] == 0 or rows.shape[1] != 17:
        raise InputError(
            f"{path} has the shape {rows.shape} in place of (number of images, 17), a 3x5 pose and two bounds a row: "
            "make it with LLFF's imgs2poses.py."
        )
    return torch.from_numpy(rows.astype(np.float64))


def _check_cameras(cameras: LLFFCameras, path: Path) -> None:
    """Raises an `InputError` that names the first row (from 0) that describes no camera."""
    rotations = cameras.camera_to_worlds[..., :3]
    near, far = cameras.bounds.unbind(-1)
    numbers = torch.cat([values.reshape(len(rotations), -1) for values in cameras], dim=-1)
    gram_error = (rotations.transpose(1, 2) @ rotations - torch.eye(3, dtype=rotations.dtype)).abs().amax((1, 2))
    faults = (
        (~numbers.isfinite().all(-1), "has a number that is not finite"),
        (cameras.focals <= 0, "has a focal length that is not above 0"),
        ((cameras.full_sizes <= 0).any(-1), "has an image size that is not above 0"),
        (near <= 0, "has a near bound that is not above 0"),
        (near >= far, "has a near bound that is not below its far bound"),
        (
            ((torch.linalg.det(rotations) - 1).abs() > 1e-2) | (gram_error > 1e-2),
            "has [down, right, back] columns that are not a rotation",
        ),
    )
    for wrong, fault in faults:
        if wrong.any():
            row = int(wrong.nonzero()[0])
            raise InputError(
                f"Row {row} (from 0) of {path} {fault}: correct it, or drop the row together with its image."
            )


OTHER_SUFFIXES = (".webp", ".tif", ".tiff", ".heic", ".heif")
"""Of photos that `sparsestyle prepare` takes, too."""


def _find_images(folder: Path, downscale_factor: Optional[int], num_poses: int) -> List[Path]:
    """Sorted image files of the folder that `downscale_factor` names, one for each pose."""
    names = ["images_8", "images_4", "images"]
    if downscale_factor is not None:
        names = ["images" if downscale_factor == 1 else f"images_{int(downscale_factor)}"]
    image_folder = next((folder / name for name in names if (folder / name).is_dir()), None)
    if image_folder is None:
        there = sorted(path.name for path in folder.glob("images*") if path.is_dir())
        advice = f"choose from {', '.join(there)} with --downscale-factor" if there else "put the photos into images"
        raise InputError(f"{folder} has no folder {' or '.join(names)}", advice)
    filenames = images_in(image_folder, (".jpg", ".jpeg", ".png"))
    others = images_in(image_folder, OTHER_SUFFIXES)
    if not filenames and others:
        raise InputError(
            f"{image_folder} has {others[0].name}, and only .jpg, .jpeg and .png are read",
            f"make a scene of it with sparsestyle prepare {folder} --output {folder.name}-scene",
        )
    if not filenames:
        raise InputError(
            f"{image_folder} has no .jpg, .jpeg or .png image",
            "put the photos there, or choose another folder with --downscale-factor",
        )
    if len(filenames) != num_poses:
        raise InputError(
            f"{image_folder} has {len(filenames)} images, but {folder / 'poses_bounds.npy'} has {num_poses} poses: "
            "keep exactly one image for each pose, in the same sorted order."
        )
    return filenames


def _read_image_size(filenames: List[Path], full_sizes: Float[Tensor, "num_views 2"]) -> Tuple[int, int]:
    """Width and height in pixels that all the images share; each is decoded once to see that it can be."""
    for filename in filenames:
        open_photo(filename, draft=True)
    check_one_size(filenames)
    width, height = photo_size(filenames[0])
    for filename, (full_width, full_height) in zip(filenames, full_sizes.tolist(), strict=True):
        # Scaled by one factor and rounded up or down, both sides are less than a pixel off.
        if abs(width * full_height - height * full_width) >= full_width + full_height:
            raise InputError(
                f"{filename} is {width}x{height} pixels, which is no scaled version of the "
                f"{full_width:g}x{full_height:g} that poses_bounds.npy was made for: scale the original photos "
                "without cropping or turning them."
            )
    return width, height


def _recentring_transform(camera_to_worlds: Float[Tensor, "num_views 3 4"]) -> Float[Tensor, "3 4"]:
    """The rigid motion that takes the average camera to the origin, looking along -z with y up.

    The average camera sits at the mean position; its back vector is the normalised mean of the back vectors, and its up
    vector the mean of the up vectors, made orthogonal to it (as in NeRF's and RegNeRF's reader).
    """
    _, up, back, position = camera_to_worlds.mean(0).unbind(-1)
    right = torch.linalg.cross(up, back)
    if right.norm() < 1e-3:
        raise InputError(
            "The cameras in poses_bounds.npy look into opposite directions, but llff-data is for forward-facing photos:"
            " read a scene seen from all around with nerfstudio-data or blender-data."
        )
    right, back = F.normalize(right, dim=0), F.normalize(back, dim=0)
    world_to_average = torch.stack([right, torch.linalg.cross(back, right), back])
    return torch.cat([world_to_average, -world_to_average @ position[:, None]], dim=-1)


def _ndc_scene_box(
    camera_to_worlds: Float[Tensor, "num_views 3 4"],
    focals: Float[Tensor, " num_views"],
    size: Tuple[int, int],
    focal_over_half_size: Tuple[float, float],
    filenames: List[Path],
) -> SceneBox:
    """The axis-aligned box in NDC that holds all that the views see from the near plane to infinity.

    A frustum is a polyhedron in NDC too, so the ends of the rays through the image's four corners bound it. The box is
    wider than they are by `BOX_MARGIN` of its width on each side in x and y, and is [-1, 1] in z.
    Poses are in the recentred, scaled world; focal lengths, width and height in pixels of the images as read. An
    InputError names an image of which a part never reaches the near plane.
    """
    half_size = torch.tensor(size, dtype=focals.dtype) / 2
    corners = torch.tensor([[-1, -1], [-1, 1], [1, -1], [1, 1]], dtype=focals.dtype) * half_size
    directions = F.pad(corners / focals[:, None, None], (0, 1), value=-1.0)
    directions = directions @ camera_to_worlds[..., :3].transpose(1, 2)
    origins = camera_to_worlds[:, None, :, 3].expand_as(directions)
    origins, directions, valid = ndc_rays(origins, directions, focal_over_half_size, NDC_NEAR)
    aside = ~valid.all(1).squeeze(-1)
    if aside.any():
        raise InputError(
            f"{filenames[int(aside.nonzero()[0])]} looks too far aside from the average camera, but llff-data is for "
            "forward-facing photos: drop that image and its pose, or read the scene with nerfstudio-data."
        )
    ends = torch.cat([origins, origins + directions]).flatten(0, 1)
    low, high = ends.amin(0), ends.amax(0)
    margin = BOX_MARGIN * (high - low)
    margin[2] = 0
    return SceneBox(aabb=torch.stack([low - margin, high + margin]).float())


llff_data = DataParserSpecification(
    config=LLFFDataParserConfig(),
    description="Forward-facing photos in an LLFF folder (poses_bounds.npy, images_8), for a scene in NDC.",
)
"""What nerfstudio's commands load to offer `llff-data`, while nerfstudio's own configs are still being imported: this
module and what it imports may import no datamanager, pipeline or `TrainerConfig`."""
