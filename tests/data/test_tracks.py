"""Tracks are kept with a scene, and are matches of each two of its photos."""

import numpy as np
import pytest

from sparsestyle_ns.data.tracks import TRACKS_FILE, Tracks
from sparsestyle_ns.utils.errors import InputError


def three_photos() -> Tracks:
    """Point 7 is seen in all photos, point 3 in the first and last one."""
    photos, points = np.array([0, 0, 1, 2, 2]), np.array([7, 3, 7, 3, 7])
    positions = np.array([[0.5, 0.5], [0.1, 0.2], [0.6, 0.5], [0.2, 0.2], [0.7, 0.5]])
    return Tracks(("a.png", "b.png", "c.png"), photos, points, positions)


def test_a_point_in_three_photos_is_a_match_of_each_two():
    matches = three_photos().matches(["a.png", "b.png", "c.png"], [(100, 50)] * 3)
    assert {pair: rows.shape[1] for pair, rows in matches.pairs.items()} == {(0, 1): 1, (0, 2): 2, (1, 2): 1}
    # The centre of the first pixel is at (0, 0), half a pixel from the corner.
    assert matches.points[1].tolist() == [[59.5, 24.5]]
    (first, second) = matches.pairs[0, 1][:, 0]
    assert matches.points[0][first].tolist() == [49.5, 24.5] and second == 0


def test_photos_may_be_fewer_and_in_another_order():
    matches = three_photos().matches(["c.png", "a.png", "new.png"], [(10, 10)] * 3)
    assert matches.pairs[0, 1].shape[1] == 2 and matches.pairs[0, 2].shape[1] == 0
    (at_c, at_a) = matches.pairs[0, 1]
    assert (matches.points[0][at_c] - matches.points[1][at_a])[:, 0].tolist() == pytest.approx([1.0, 2.0])


def test_what_is_saved_is_found_again(tmp_path):
    three_photos().save(tmp_path)
    found = Tracks.find(tmp_path)
    assert found.names == three_photos().names
    for name in ("photos", "points", "positions"):
        np.testing.assert_array_equal(getattr(found, name), getattr(three_photos(), name))


def test_a_scene_without_tracks_has_none(tmp_path):
    assert Tracks.find(tmp_path) is None


@pytest.mark.parametrize("content", [b"nothing", b""])
def test_a_damaged_file_is_named(tmp_path, content):
    (tmp_path / TRACKS_FILE).write_bytes(content)
    with pytest.raises(InputError, match=r"tracks\.npz can't be read .*prepare the scene again"):
        Tracks.find(tmp_path)


def test_a_file_whose_parts_do_not_fit_is_refused(tmp_path):
    tracks = three_photos()
    tracks.photos = np.array([0, 0, 1, 2, 3])
    tracks.save(tmp_path)
    with pytest.raises(InputError, match="parts don't fit together"):
        Tracks.find(tmp_path)
