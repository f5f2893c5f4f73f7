"""What EXIF says of a photo's lens, and which photos were taken with one and the same."""

import math
from dataclasses import dataclass
from typing import Any, List, Sequence, Tuple

from PIL import ExifTags, Image

DIAGONAL_35MM, WIDTH_35MM = 43.27, 36.0
"""Millimetres of a picture on 35 mm film. Equivalent focal lengths keep the angle of the diagonal by the standard, that
of the longer side as some have it; of 4:3 photos these are 4% apart."""
MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0}
"""Of the unit that resolution in the focal plane is given in: inch, centimetre, millimetre."""
SHORTEST, LONGEST = 0.2, 20.0
"""Focal lengths, in longer sides of the photo, that EXIF may give; others are slips."""
EXIF_SPREAD = 0.025
"""Standard deviation of a focal length by EXIF, in logarithms: it is rounded, and changes a little with focus."""
USUAL_FOCAL, USUAL_SPREAD = 0.9, 0.35
"""Focal length where EXIF says nothing: the mean and standard deviation of logarithms. A telephone's main camera has
0.7 to 0.85 longer sides, its wide one half of that; other cameras mostly have 0.8 to 2."""


@dataclass(frozen=True)
class Lens:
    """A lens at one zoom.

    Attributes:
        focals: what its focal length may be, in longer sides of a whole photo; the likeliest first.
        spread: how far off one of these is, as a standard deviation of its logarithm.
        known: whether EXIF gives it.
    """

    focals: Tuple[float, ...] = (USUAL_FOCAL,)
    spread: float = USUAL_SPREAD
    known: bool = False

    def improbability(self, focal: float) -> float:
        """Of a focal length in longer sides: the negative logarithm of its probability, up to a constant."""
        return min(0.5 * (math.log(focal / one) / self.spread) ** 2 for one in self.focals)


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
    found = [focals for exif, size in photos if (focals := exif_focals(exif, size))]
    return Lens(found[0], EXIF_SPREAD, known=True) if found else Lens()


def exif_focals(exif: Image.Exif, size: Tuple[int, int]) -> Tuple[float, ...]:
    """What EXIF says that the focal length may be, in longer sides; nothing where it doesn't tell.

    From that in millimetres and the sensor's size, else from that of 35 mm film, by the diagonal and by the longer
    side.
    """
    more, longer = exif.get_ifd(ExifTags.IFD.Exif), max(size)
    equivalent = _number(more, ExifTags.Base.FocalLengthIn35mmFilm)
    unit = MILLIMETRES.get(int(_number(more, ExifTags.Base.FocalPlaneResolutionUnit) or 2), 25.4)
    sides = [_number(more, side) for side in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
    pixels = max(sides) if all(sides) else longer
    exact = (
        _number(more, ExifTags.Base.FocalLength) * _number(more, ExifTags.Base.FocalPlaneXResolution) / unit / pixels
    )
    by_diagonal = equivalent / DIAGONAL_35MM * math.hypot(*size) / longer
    focals = (exact,) if exact else (by_diagonal, equivalent / WIDTH_35MM)
    return tuple(focal for focal in focals if SHORTEST < focal < LONGEST)


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
