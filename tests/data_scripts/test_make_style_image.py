"""The style image: a picture of strokes that follow a flow, in the paints of a palette."""

import cv2
import imageio.v2 as imageio
import numpy as np
import pytest
from make_style_image import PALETTES, compose, follow_flow, main, paint

SIZE = 128


@pytest.fixture(scope="module")
def pictures():
    return {palette: paint(SIZE, seed=0, palette=palette) for palette in PALETTES}


def test_there_are_at_least_three_palettes():
    assert len(PALETTES) >= 3


def test_a_picture_has_five_columns_for_every_four_rows(pictures):
    for picture in pictures.values():
        assert picture.shape == (SIZE, 160, 3)
        assert picture.dtype == np.uint8


def test_the_same_seed_paints_the_same_picture_and_another_seed_another(pictures):
    np.testing.assert_array_equal(paint(SIZE, seed=0, palette="night"), pictures["night"])
    assert (paint(SIZE, seed=1, palette="night") != pictures["night"]).mean() > 0.5


def test_palettes_differ_in_mean_colour(pictures):
    means = np.stack([picture.mean(axis=(0, 1)) for picture in pictures.values()])
    distances = np.linalg.norm(means[:, None] - means[None], axis=-1)
    assert distances[~np.eye(len(means), dtype=bool)].min() > 20


def test_colours_are_saturated(pictures):
    for picture in pictures.values():
        assert np.mean(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)[..., 1]) > 0.35 * 255


def test_strokes_run_along_the_flow():
    picture = paint(256, seed=0, palette="night").mean(axis=-1)
    _, flow = compose(256, 320, np.random.default_rng(0), PALETTES["night"])
    gradient = np.stack([cv2.Sobel(picture, cv2.CV_64F, 1, 0), cv2.Sobel(picture, cv2.CV_64F, 0, 1)], axis=-1)
    along = np.abs((gradient * flow).sum(axis=-1)).mean()
    across = np.abs(gradient[..., 0] * -flow[..., 1] + gradient[..., 1] * flow[..., 0]).mean()
    # Without a preferred direction the two would be equal.
    assert across > 1.5 * along


def test_strokes_cover_the_first_coat(pictures):
    for palette, picture in pictures.items():
        ground = np.array([int(PALETTES[palette].ground[i : i + 2], 16) for i in (1, 3, 5)])
        assert (picture == ground).all(axis=-1).mean() < 0.02


def test_a_curve_follows_a_whirl_around_its_centre():
    y, x = np.mgrid[0:101, 0:101] - 50.0
    flow = np.stack([-y, x], axis=-1) / np.maximum(np.hypot(x, y), 1e-6)[..., None]
    path = follow_flow(flow, np.array([[80.0, 50.0]]), np.array([30.0]), steps=15)[0]
    assert path.shape == (31, 2)
    # Straight steps of one pixel stray outwards by about half a pixel over the 15 steps.
    np.testing.assert_allclose(np.hypot(*(path - 50).T), 30, atol=1)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(30)


def test_the_flow_is_of_unit_length():
    _, flow = compose(64, 80, np.random.default_rng(2), PALETTES["garden"])
    np.testing.assert_allclose(np.linalg.norm(flow, axis=-1), 1, rtol=1e-4)


def test_the_command_writes_what_paint_returns(tmp_path, pictures):
    output = tmp_path / "folder" / "style.png"
    assert main([str(output), "--size", str(SIZE), "--palette", "harvest"]) == 0
    np.testing.assert_array_equal(imageio.imread(output), pictures["harvest"])


def test_an_unknown_palette_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="night, harvest"):
        paint(SIZE, palette="mud")


def test_a_canvas_too_small_for_strokes_is_one_sentence_and_status_1(tmp_path, capsys):
    assert main([str(tmp_path / "style.png"), "--size", "10"]) == 1
    assert "at least 64" in capsys.readouterr().err


def test_an_output_that_cannot_be_written_is_one_sentence_and_status_1(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main([str(tmp_path / "file" / "style.png"), "--size", "64"]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_an_output_of_unknown_format_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path / "style.xyz")])
    assert ".png or .jpg" in capsys.readouterr().err
