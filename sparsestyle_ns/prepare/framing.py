"""Reading photos as cameras and phones store them, and bringing them to one size."""

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import List, Optional, Sequence, Tuple

from PIL import ExifTags, Image, UnidentifiedImageError

from sparsestyle_ns.data.photos import images_in
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.pictures import UnknownPixelsError, as_upright, orientation_of, to_8_bits

HEIC_SUFFIXES = (".heic", ".heif")
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", *HEIC_SUFFIXES)
LOSSLESS_SUFFIXES = (".png", ".tif", ".tiff")
MIN_PHOTOS = 3
JPEG_QUALITY = 95

Size = Tuple[int, int]
"""Width and height in pixels."""


@dataclass
class Photo:
    """A photo.

    Attributes:
        image: RGB, or RGBA where any pixels are transparent.
        orientation: EXIF's, from 1 (upright) to 8; 1 where it says nothing.
        upright: whether `image` was turned by that; else it has the pixels as they are stored.
        exif: all that EXIF says.
        mask: grey, turned as `image` is, and black where that isn't to be trained on; None where it has none.
    """

    path: Path
    image: Image.Image
    orientation: int = 1
    upright: bool = True
    exif: Image.Exif = field(default_factory=Image.Exif)
    mask: Optional[Image.Image] = None


@dataclass(frozen=True)
class Framing:
    """What happens to a photo of the size `original`: it is scaled to `scaled`, then cropped to `size`, that of all,
    from `corner` on, the column and row of the first pixel that is kept."""

    original: Size
    scaled: Size
    corner: Tuple[int, int]
    size: Size

    def apply(self, image: Image.Image, resample: Image.Resampling = Image.Resampling.LANCZOS) -> Image.Image:
        """The photo, or its mask, as it goes into the scene."""
        if image.size != self.scaled:
            image = image.resize(self.scaled, resample)
        left, top = self.corner
        return image.crop((left, top, left + self.size[0], top + self.size[1]))


def find_photos(folder: Path) -> List[Path]:
    """The photos of a folder or, if it has none, of its folder `images`, by name; an `InputError` if fewer than 3."""
    if folder.is_file():
        raise InputError(f"{folder} is a file, and no video; name the folder that the photos are in.")
    if not folder.is_dir():
        raise InputError(f"There is no folder {folder}; name the folder that the photos are in.")
    for place in (folder, folder / "images"):
        photos = images_in(place, SUFFIXES) if place.is_dir() else []
        if photos:
            break
    if len(photos) < MIN_PHOTOS:
        count = {0: "no photo", 1: "only one photo"}.get(len(photos), f"only {len(photos)} photos")
        raise InputError(
            f"{folder} has {count} ({', '.join(SUFFIXES)}); a scene needs at least {MIN_PHOTOS}, each taken from "
            "another place."
        )
    others = sorted(set(images_in(place, tuple(Image.registered_extensions()))) - set(photos))
    if others:
        print(f"Passed over, as they are none of {', '.join(SUFFIXES)}: {', '.join(path.name for path in others)}")
    return photos


def read_photo(path: Path, upright: bool = True) -> Photo:
    """Reads a photo, turned as its EXIF orientation says if it is to be upright.

    Raises:
        InputError: it can't be read, or is HEIC and the package for that is missing.
    """
    if path.suffix.lower() in HEIC_SUFFIXES:
        _register_heic(path)
    try:
        data = path.read_bytes()
        with Image.open(io.BytesIO(data)) as image:
            image.load()  # by which Pillow turns a TIFF upright, and forgets the orientation
            exif = image.getexif()
            exif.get_ifd(ExifTags.IFD.Exif)  # read while the file is open
            orientation, pixels = orientation_of(image), to_8_bits(image, data)
            return Photo(path, as_upright(pixels, orientation) if upright else pixels, orientation, upright, exif)
    except FileNotFoundError as error:
        raise InputError(f"{path} is a link that leads nowhere; put the photo there, or take it out.") from error
    except UnknownPixelsError as error:
        raise InputError(f"{path} has {error}; save it as 8-bit RGB or grey, or take it out.") from error
    except UnidentifiedImageError as error:
        raise InputError(
            f"{path} is no image that can be read; save it again as JPEG or PNG, or take it out."
        ) from error
    # Decoders meet a damaged file with errors of many kinds: OSError, SyntaxError, struct.error, and others.
    except Exception as error:
        raise InputError(f"{path} is damaged ({error}); copy it again from the camera, or take it out.") from error


def _register_heic(path: Path) -> None:
    try:
        import pillow_heif
    except ImportError as error:
        raise InputError(
            f"{path} is HEIC, which needs a package more: pip install pillow-heif, or save the photos as JPEG."
        ) from error
    pillow_heif.register_heif_opener()


def frame_photos(sizes: Sequence[Size]) -> List[Framing]:
    """How photos of any sizes come to one.

    Each is scaled so that its longer side is as long as the shortest longer side of all; then all are cropped, evenly
    on both sides, to the smallest width and the smallest height. So photos by one camera keep one focal length in
    pixels, however they were held, and the middle of the lens stays in the middle. Photos of one size stay as they are.
    """
    longest = min(max(size) for size in sizes)
    scaled = [tuple(max(1, round(side * longest / max(size))) for side in size) for size in sizes]
    width, height = (min(sides) for sides in zip(*scaled, strict=True))
    return [
        Framing(tuple(size), small, ((small[0] - width) // 2, (small[1] - height) // 2), (width, height))
        for size, small in zip(sizes, scaled, strict=True)
    ]


def write_photos(photos: Sequence[Photo], framings: Sequence[Framing], folder: Path) -> List[str]:
    """Writes numbered photos and returns their names; PNG if all were lossless or any has transparency."""
    lossless = all(photo.path.suffix.lower() in LOSSLESS_SUFFIXES for photo in photos)
    transparent = any(photo.image.mode == "RGBA" for photo in photos)
    suffix = ".png" if lossless or transparent else ".jpg"
    names = [f"photo_{number:03d}{suffix}" for number in range(len(photos))]
    folder.mkdir(parents=True)
    for name, photo, framing in zip(names, photos, framings, strict=True):
        framing.apply(photo.image).save(folder / name, quality=JPEG_QUALITY, subsampling=0)
    return names


def mask_name(name: str) -> str:
    """Where a scene has the mask of the photo with a name, seen from its folder."""
    return f"masks/{Path(name).stem}.png"


def write_masks(photos: Sequence[Photo], framings: Sequence[Framing], folder: Path, names: Sequence[str]) -> None:
    """Writes the masks of photos into a scene's folder if any has one; that of a photo without one leaves all of it in.

    `InputError` where a photo's frame has no pixel that its mask leaves in.
    """
    if all(photo.mask is None for photo in photos):
        return
    for name, photo, framing in zip(names, photos, framings, strict=True):
        mask = framing.apply(photo.mask or Image.new("L", photo.image.size, 255), Image.Resampling.NEAREST)
        if mask.getbbox() is None:
            raise InputError(
                f"The mask of {photo.path} leaves nothing in of the {mask.width} × {mask.height} pixels that the scene "
                "has of it; replace it, or take the photo out."
            )
        (folder / mask_name(name)).parent.mkdir(exist_ok=True)
        mask.save(folder / mask_name(name))
