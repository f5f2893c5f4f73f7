"""Pictures among a person's photos that are none, or are there twice: they are named and left out."""

from typing import List, Sequence

import numpy as np
from PIL import ExifTags, Image

from sparsestyle_ns.prepare.framing import MIN_PHOTOS, Photo
from sparsestyle_ns.utils.errors import InputError

THUMBNAIL, SAME_PIXELS = 32, 2.0
"""Side at which photos are compared, and the mean difference of grey values, of 255, up to which they are one photo."""
SCREENSHOT_WORDS = ("screenshot", "screen shot", "bildschirmfoto", "capture d")
SCREEN_SHAPE = 1.9
"""Sides' ratio of telephones' screens, from which on a picture without a camera in EXIF is none of the camera's."""


def without_useless(photos: Sequence[Photo]) -> List[Photo]:
    """The photos without screenshots and second copies, which are named; an `InputError` if fewer than 3 are left."""
    kept: List[Photo] = []
    reasons: List[str] = []
    thumbnails: List[np.ndarray] = []
    screenshots = _screenshots(photos)
    for photo in photos:
        thumbnail = np.asarray(photo.image.convert("L").resize((THUMBNAIL, THUMBNAIL), Image.Resampling.BOX), float)
        twin = next((i for i, other in enumerate(thumbnails) if np.abs(other - thumbnail).mean() < SAME_PIXELS), None)
        if photo in screenshots:
            reasons.append(f"{photo.path.name} is left out: it is a screenshot, not a photo.")
        elif twin is not None and _same_shape(kept[twin], photo):
            reasons.append(f"{photo.path.name} is left out: it is the same photo as {kept[twin].path.name}.")
        else:
            kept.append(photo)
            thumbnails.append(thumbnail)
    for reason in reasons:
        print(f"Warning: {reason}", flush=True)
    if len(kept) < MIN_PHOTOS:
        raise InputError(
            f"Only {len(kept)} of the {len(photos)} photos can be used, and a scene needs at least {MIN_PHOTOS}. "
            f"{' '.join(reasons)} Take more, each from another place."
        )
    return kept


def _same_shape(first: Photo, second: Photo) -> bool:
    (width, height), (other_width, other_height) = first.image.size, second.image.size
    return abs(width * other_height - other_width * height) < 0.02 * width * other_height


def _screenshots(photos: Sequence[Photo]) -> List[Photo]:
    by_camera = [photo for photo in photos if photo.exif.get(ExifTags.Base.Model)]
    found = [photo for photo in photos if _says_screenshot(photo)]
    if by_camera:
        others = [photo for photo in photos if photo not in by_camera and photo not in found]
        found += [photo for photo in others if max(photo.image.size) > SCREEN_SHAPE * min(photo.image.size)]
    return found


def _says_screenshot(photo: Photo) -> bool:
    comment = photo.exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.UserComment, b"")
    words = comment.decode("latin-1") if isinstance(comment, bytes) else str(comment)
    text = f"{photo.path.stem} {words}".lower().replace("_", " ")
    return any(word in text for word in SCREENSHOT_WORDS)
