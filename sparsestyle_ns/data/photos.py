"""Photos of a scene: one that can't be trained on is found when it is read, and named."""

import copy
from collections import Counter
from pathlib import Path
from typing import Any, Callable, Dict, List, Literal, Optional, Sequence, Tuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from torch import Tensor

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import digest
from sparsestyle_ns.utils.pictures import read_mask

IMAGE_MODES = ("L", "RGB", "RGBA")
"""Pillow's names of the pixel formats that are read as they are meant."""
SMALLEST_SIDE = 8
"""Pixels a side below which a photo shows nothing."""
DARKEST = 3
"""Of 255: a photo with nothing brighter is black, but for the noise of its compression."""


def images_in(folder: Path, suffixes: Sequence[str]) -> List[Path]:
    """The files in a folder with one of these suffixes, sorted by name; hidden files are passed over.

    Links that lead nowhere are among them, to be found when they are read.
    """
    files = (path for path in folder.iterdir() if path.is_file() or (path.is_symlink() and not path.exists()))
    return sorted(path for path in files if path.suffix.lower() in suffixes and not path.name.startswith("."))


def open_photo(path: Path, draft: bool = False) -> Image.Image:
    """Reads a photo whole.

    Args:
        draft: whether a JPEG may come at its smallest size, which is fast and still finds that it is cut short.

    Raises:
        InputError: there is no such file, it can't be decoded, or its pixels aren't 8-bit grey, RGB or RGBA.
    """
    try:
        with Image.open(path) as image:
            if draft:
                image.draft(None, (1, 1))
            image.load()
    except FileNotFoundError as error:
        raise InputError(f"There is no photo {path}: put it there, or take it out of the scene.") from error
    # Decoders meet a damaged file with errors of many kinds: OSError, SyntaxError, struct.error, and others.
    except Exception as error:
        raise InputError(f"{path} cannot be read as an image, it may be cut short: replace it.") from error
    if image.mode not in IMAGE_MODES:
        broken = int((~np.isfinite(np.asarray(image))).sum()) if image.mode == "F" else 0
        also = f", {broken} of which are not finite" * (broken > 0)
        raise InputError(f"{path} has pixels of the kind {image.mode}{also}: save it as 8-bit RGB or RGBA.")
    return image


def photo_digests(outputs: DataparserOutputs) -> List[Optional[str]]:
    """The `digest` of each view's photo, with its mask where it has one; None where that can't be read."""

    def of_files(*paths: Optional[Path]) -> Optional[str]:
        try:
            return digest(*(path.read_bytes() for path in paths if path is not None))
        except OSError:
            return None

    masks = outputs.mask_filenames or [None] * len(outputs.image_filenames)
    return list(map(of_files, outputs.image_filenames, masks))


def photo_size(path: Path) -> Tuple[int, int]:
    """Width and height in pixels, from the file's header alone; an `InputError` if there is none."""
    try:
        with Image.open(path) as image:
            return image.size
    except Exception:
        return open_photo(path).size  # says what is wrong with it


def has_opacity(path: Path) -> bool:
    """Whether a photo's pixels have an opacity, by its header alone; False where there is none."""
    try:
        with Image.open(path) as image:
            return image.mode == "RGBA"
    except Exception:
        return False


def is_transparent(path: Path) -> bool:
    """Whether any pixel of a photo isn't opaque."""
    return has_opacity(path) and open_photo(path).getchannel("A").getextrema()[0] < 255


def check_one_size(filenames: Sequence[Path]) -> None:
    """Raises an `InputError` that names the first photo that isn't of the size that most are of."""
    sizes = {filename: photo_size(filename) for filename in filenames}
    usual = Counter(sizes.values()).most_common(1)[0][0]
    for filename, size in sizes.items():
        if size != usual:
            raise InputError(
                f"{filename} is {size[0]}x{size[1]} pixels, but the other images are {usual[0]}x{usual[1]}: bring all "
                "of them to one size."
            )


def at_size(cameras: Cameras, width: Int[Tensor, "views 1"], height: Int[Tensor, "views 1"]) -> Cameras:
    """The same cameras for images of another size: each pixel's ray goes to what that pixel shows.

    nerfstudio multiplies focal lengths and centres by the scale that was asked for, also where whole pixels make the
    image's own another one: of 378 rows times 1/4, 94 are left, whose last ones then are half a pixel off.
    """
    resized = copy.deepcopy(cameras)
    across, down = width / cameras.width, height / cameras.height
    resized.fx, resized.cx, resized.width = cameras.fx * across, cameras.cx * across, width
    resized.fy, resized.cy, resized.height = cameras.fy * down, cameras.cy * down, height
    return resized


def at_scale(cameras: Cameras, scale: float) -> Cameras:
    """The same cameras for images at a share of their size in (0, 1], rounded to whole pixels."""
    width, height = ((side * scale).round().long().clamp(min=1) for side in (cameras.width, cameras.height))
    return cameras if scale == 1.0 else at_size(cameras, width, height)


def reduced(image: Float[Tensor, "H W channels"], size: Tuple[int, int]) -> Float[Tensor, "h w channels"]:
    """An image at a smaller (height, width), each pixel the mean of those in its place."""
    if tuple(image.shape[:2]) == size:
        return image
    return F.interpolate(image.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)


def _check_content(path: Path, pixels: UInt8[np.ndarray, "H W channels"]) -> None:
    height, width, channels = pixels.shape
    if min(height, width) < SMALLEST_SIDE:
        raise InputError(
            f"{path} is {width}x{height} pixels, but at least {SMALLEST_SIDE} a side are needed: replace it, or take "
            "it and its pose out of the scene."
        )
    opaque = channels == 3 or pixels[..., 3].min() == 255
    nothing = pixels[..., :3].max() <= DARKEST if opaque else pixels[..., 3].max() == 0
    if nothing:
        kind = "black" if opaque else "transparent"
        raise InputError(f"{path} is {kind} all over: replace it, or take it and its pose out of the scene.")


def read_mask_of(photo: Path, mask: Path, *sizes: Tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Which pixels of a photo a mask leaves in, as it is stored; `InputError` where it has none of these sizes."""
    try:
        inside = read_mask(mask.read_bytes())
    except Exception as error:  # decoders meet a damaged file with errors of many kinds
        fault = "can't be read" if mask.exists() else "isn't there"
        raise InputError(f"The mask {mask} doesn't fit {photo}, as it {fault}: replace it.") from error
    height, width = inside.shape
    if (width, height) not in sizes:
        raise InputError(
            f"The mask {mask} doesn't fit {photo}: it is {width}x{height} pixels, and the photo "
            f"{sizes[0][0]}x{sizes[0][1]}; scale it to that size."
        )
    if not inside.any():
        raise InputError(f"The mask {mask} leaves nothing of {photo} in: replace it, or take out both.")
    return inside


class PhotoDataset(InputDataset):
    """nerfstudio's dataset of images, which raises an `InputError` for those that can't be used.

    Its `cameras` are as refined as they are by now, where `refine` is set.
    """

    refine: Optional[Callable[[Cameras], Cameras]] = None
    """What became of the cameras that the dataparser gives."""
    given_cameras: Cameras
    """These, at the photos' size."""

    @property
    def cameras(self) -> Cameras:
        """The photos' cameras."""
        return self.given_cameras if self.refine is None else self.refine(self.given_cameras)

    @cameras.setter
    def cameras(self, cameras: Cameras) -> None:
        self.given_cameras = cameras

    def get_numpy_image(self, image_idx: int) -> UInt8[np.ndarray, "H W channels"]:
        """Pixels of a photo, RGB or RGBA, at the size of its camera."""
        path = self.image_filenames[image_idx]
        image = open_photo(path)
        if image.mode == "L":
            image = image.convert("RGB")
        _check_content(path, np.asarray(image))
        size = int(self.cameras.width[image_idx]), int(self.cameras.height[image_idx])
        # Products of sides and scales may fall to either side of a whole number.
        if any(abs(own * self.scale_factor - side) > 1 for own, side in zip(image.size, size, strict=True)):
            whole = tuple(round(side / self.scale_factor) for side in size)
            raise InputError(
                f"{path} is {image.width}x{image.height} pixels, but its camera is for {whole[0]}x{whole[1]}: scale it "
                "to that size."
            )
        return np.array(image if image.size == size else image.resize(size, resample=Image.Resampling.BILINEAR))

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> Dict[str, Any]:
        """nerfstudio's dictionary of a photo and, where there is one, its mask, which nerfstudio would misread."""
        image = self.get_image_uint8(image_idx) if image_type == "uint8" else self.get_image_float32(image_idx)
        data: Dict[str, Any] = {"image_idx": image_idx, "image": image}
        masks = self._dataparser_outputs.mask_filenames
        if masks is not None:
            data["mask"] = torch.from_numpy(self._read_mask(masks[image_idx], image_idx))[..., None]
            if self.mask_color:
                data["image"] = torch.where(data["mask"], image, image.new_tensor(self.mask_color))
        return data

    def _read_mask(self, mask: Path, image_idx: int) -> Bool[np.ndarray, "H W"]:
        """Which pixels of a photo, at the size of its camera, a mask leaves in."""
        photo = self.image_filenames[image_idx]
        inside = read_mask_of(photo, mask, photo_size(photo))
        size = int(self.cameras.width[image_idx]), int(self.cameras.height[image_idx])
        return np.array(Image.fromarray(inside).resize(size, resample=Image.Resampling.NEAREST))
