"""What EXIF says of a photo's lens, and which photos were taken with one and the same."""

from dataclasses import dataclass
from typing import Any, List, Optional, Sequence, Tuple

import numpy as np
from PIL import ExifTags, Image

DIAGONAL_35MM = 43.27
"""Millimetres across a picture of 35 mm film, 36 × 24 mm; equivalent focal lengths keep the diagonal's angle."""
MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0}
"""Of the unit that resolution in the focal plane is given in: inch, centimetre, millimetre."""
SHORTEST, LONGEST = 0.2, 20.0
"""Focal lengths, in longer sides of the photo, that EXIF may give; others are slips."""
EXIF_SPREAD = 0.05
"""Standard deviation of a focal length by EXIF, in logarithms: it is rounded, and of a picture cut to another shape."""
USUAL_FOCAL, USUAL_SPREAD = 0.9, 0.35
"""Focal length where EXIF says nothing: the mean and standard deviation of logarithms. A telephone's main camera has
0.7 to 0.85 longer sides, its wide one half of that; other cameras mostly have 0.8 to 2."""


@dataclass(frozen=True)
class Lens:
    """A lens at one zoom.

    Attributes:
        focal: its focal length, in longer sides of a whole photo.
        spread: how far off that may be, as a standard deviation of its logarithm.
        known: whether EXIF gives it.
    """

    focal: float = USUAL_FOCAL
    spread: float = USUAL_SPREAD
    known: bool = False


def shared_lenses(photos: Sequence[Tuple[Image.Exif, Tuple[int, int]]]) -> Tuple[List[Lens], List[int]]:
    """The lenses that photos were taken with, by their EXIF and size in pixels; and of each photo, which it is.

    One lens took all photos unless EXIF says that camera, focal length or zoom differ; photos that it says nothing of
    were taken with the one that the others were, if that is only one.
    """
    marks = [_marks(exif) for exif, _ in photos]
    kinds = sorted({mark for mark in marks if any(mark)}, key=marks.index)
    if len(kinds) != 1 and not all(any(mark) for mark in marks):
        kinds.append(_marks(Image.Exif()))
    which = [kinds.index(mark) if mark in kinds else 0 for mark in marks]
    return [
        _lens([photo for photo, kind in zip(photos, which, strict=True) if kind == one]) for one in set(which)
    ], which


def _lens(photos: Sequence[Tuple[Image.Exif, Tuple[int, int]]]) -> Lens:
    focals = [focal for exif, size in photos if (focal := exif_focal(exif, size)) is not None]
    return Lens(float(np.median(focals)), EXIF_SPREAD, known=True) if focals else Lens()


def exif_focal(exif: Image.Exif, size: Tuple[int, int]) -> Optional[float]:
    """The focal length in longer sides: of 35 mm film, else from that in millimetres and the sensor's size; None where
    EXIF has neither."""
    more, longer = exif.get_ifd(ExifTags.IFD.Exif), max(size)
    equivalent = _number(more, ExifTags.Base.FocalLengthIn35mmFilm)
    if equivalent:
        focal = equivalent / DIAGONAL_35MM * float(np.hypot(*size)) / longer
    else:
        millimetres = _number(more, ExifTags.Base.FocalLength)
        resolution = _number(more, ExifTags.Base.FocalPlaneXResolution)
        unit = MILLIMETRES.get(int(_number(more, ExifTags.Base.FocalPlaneResolutionUnit) or 2), 25.4)
        whole = [_number(more, side) for side in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
        focal = millimetres * resolution / unit / max(*(side or 0.0 for side in whole), 0.0 if all(whole) else longer)
    return focal if SHORTEST < focal < LONGEST else None


def _marks(exif: Image.Exif) -> Tuple[Any, ...]:
    """By what EXIF tells one camera, lens and zoom from another."""
    more = exif.get_ifd(ExifTags.IFD.Exif)
    camera = [str(exif.get(tag, "")).strip(" \0") for tag in (ExifTags.Base.Make, ExifTags.Base.Model)]
    numbers = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.DigitalZoomRatio)
    lengths = [_number(more, tag) for tag in numbers]
    # No zoom is written as 0, as 1, or not at all.
    return (*camera, *lengths[:2], 0.0 if lengths[2] == 1.0 else lengths[2])


def _number(values: Any, tag: int) -> float:
    """What a tag says, if that is a number above 0, else 0."""
    try:
        number = float(values.get(tag, 0.0))
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if 0.0 < number < 1e6 else 0.0
