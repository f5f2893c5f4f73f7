"""Focal lengths by EXIF, worked out by hand, and which photos one lens took."""

import math

import pytest
from PIL import ExifTags, Image

from sparsestyle_ns.prepare.lenses import USUAL_FOCAL, Lens, exif_focals, shared_lenses

TAGS = ExifTags.Base


def exif_of(model: str = "", **tags: float) -> Image.Exif:
    exif = Image.Exif()
    if model:
        exif[TAGS.Model] = model
    for name, value in tags.items():
        exif.get_ifd(ExifTags.IFD.Exif)[getattr(TAGS, name)] = value
    return exif


@pytest.mark.parametrize("size", [(4000, 3000), (3000, 4000)])
def test_equivalents_of_35_mm_keep_the_angle_of_the_diagonal_or_of_the_longer_side(size):
    # The film's diagonal is 43.27 mm, and of a 4:3 photo the diagonal is 5/4 of the longer side.
    found = exif_focals(exif_of(FocalLengthIn35mmFilm=26), size)
    assert found == pytest.approx((26 / 43.27 * 1.25, 26 / 36))


def test_the_nearer_of_what_exif_may_mean_counts():
    lens = Lens((0.75, 0.72), 0.025, known=True)
    assert lens.improbability(0.75) == lens.improbability(0.72) == 0.0
    assert lens.improbability(0.70) == pytest.approx(0.5 * (math.log(0.72 / 0.70) / 0.025) ** 2)


def test_millimetres_count_where_the_sensor_is_known():
    tags = {"FocalLength": 50.0, "FocalPlaneXResolution": 4000.0, "FocalPlaneResolutionUnit": 2}
    # 6000 pixels at 4000 an inch are 38.1 mm across; the photo may have been made smaller since.
    found = exif_focals(exif_of(**tags, ExifImageWidth=6000, ExifImageHeight=4000), (1500, 1000))
    assert found == pytest.approx((50 / 38.1,))
    assert exif_focals(exif_of(**tags), (6000, 4000)) == pytest.approx((50 / 38.1,))


@pytest.mark.parametrize(
    "tags",
    [{}, {"FocalLength": 4.2}, {"FocalLengthIn35mmFilm": 0}, {"FocalLengthIn35mmFilm": 65535}, {"FocalLength": 0.0}],
)
def test_what_says_nothing_of_the_angle_is_no_focal_length(tags):
    assert exif_focals(exif_of(**tags), (4000, 3000)) == ()


def test_without_exif_one_lens_took_all_and_its_focal_length_is_a_usual_one():
    lenses, lens_of = shared_lenses([(Image.Exif(), (4, 3))] * 3)
    assert (len(lenses), lens_of) == (1, [0, 0, 0])
    assert (lenses[0].focals, lenses[0].known) == ((USUAL_FOCAL,), False)


def test_one_lens_took_all_unless_exif_says_otherwise():
    wide, tele = exif_of("A", FocalLengthIn35mmFilm=26), exif_of("A", FocalLengthIn35mmFilm=52)
    lenses, lens_of = shared_lenses([(exif, (4, 3)) for exif in (wide, tele, wide)])
    assert lens_of == [0, 1, 0]
    assert lenses[1].focals == pytest.approx(tuple(2 * focal for focal in lenses[0].focals))
    # A photo that lost its EXIF was taken with the others' lens, if they have only one.
    assert shared_lenses([(exif, (4, 3)) for exif in (wide, Image.Exif(), wide)])[1] == [0, 0, 0]
    lenses, lens_of = shared_lenses([(exif, (4, 3)) for exif in (wide, Image.Exif(), tele)])
    assert lens_of == [0, 2, 1] and not lenses[2].known


def test_two_cameras_have_two_lenses():
    photos = [(exif_of(model, FocalLengthIn35mmFilm=26), (4, 3)) for model in ("A", "B", "A")]
    assert shared_lenses(photos)[1] == [0, 1, 0]
