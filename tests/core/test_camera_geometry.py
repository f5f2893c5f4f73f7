"""How a scene was captured, by its cameras' poses."""

import numpy as np
import pytest
import torch
from test_camera_paths import ring

from sparsestyle_ns.core.camera_paths import is_forward_facing, meeting_point, viewing_spread


def camera_at(position, back) -> torch.Tensor:
    """A camera, upright, with this vector pointing backwards out of it."""
    back = np.asarray(back, float) / np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    return torch.from_numpy(np.stack([right, np.cross(back, right), back, np.asarray(position, float)], axis=-1))


def turned(*degrees: float) -> torch.Tensor:
    """Cameras in one place, turned to the side by so many degrees."""
    return torch.stack([camera_at((0, 0, 0), (np.sin(a), 0, np.cos(a))) for a in np.radians(degrees)])


def test_the_spread_of_viewing_directions_is_the_largest_angle_from_their_mean():
    pair = turned(-30, 30)
    assert viewing_spread(pair) == pytest.approx(30)
    assert viewing_spread(pair[:1]) == pytest.approx(0, abs=1e-5)
    assert viewing_spread(turned(0, 180)) == 180


def test_a_forward_facing_captures_cameras_look_aside_by_45_degrees_at_most():
    assert is_forward_facing(turned(-44, 44)) and not is_forward_facing(turned(-46, 46))


def test_cameras_around_a_point_meet_there():
    point = np.array([0.3, -0.2, 0.5])
    backs = np.array([[1.0, 0.1, 0.2], [-0.4, 0.3, 1.0], [0.2, -0.5, -1.0]])
    cameras = torch.stack([camera_at(point + 3 * back, back) for back in backs])
    assert meeting_point(cameras).numpy() == pytest.approx(point)
    torch.testing.assert_close(
        meeting_point(ring(6).camera_to_worlds), torch.tensor([0.5, -0.2, 0.0]), atol=1e-4, rtol=0
    )


def test_of_parallel_axes_the_point_nearest_to_the_origin_counts():
    cameras = torch.stack([camera_at((x, 0, 5), (0, 0, 1)) for x in (1, 3)])
    assert meeting_point(cameras).tolist() == pytest.approx([2, 0, 0])
