"""A pinhole camera's rays, against nerfstudio's."""

import math

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from sparsestyle_ns.core.pinhole import pinhole_rays
from sparsestyle_ns.core.rotations import rotation_matrix


def camera(**settings) -> Cameras:
    turn = rotation_matrix(torch.tensor([[0.3, -0.5, 0.2]]))
    pose = torch.cat([turn, torch.tensor([[[1.0], [-2.0], [0.5]]])], dim=-1)
    lens = {"fx": 30.0, "fy": 31.0, "cx": 15.0, "cy": 12.5, "width": 32, "height": 24, "times": torch.tensor([[0.25]])}
    return Cameras(pose, **{**lens, **settings})


def test_rays_are_nerfstudios() -> None:
    one = camera()
    ours, theirs = pinhole_rays(one), one.generate_rays(camera_indices=0, keep_shape=True)
    for name in ("origins", "directions", "times", "camera_indices"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), atol=1e-6, rtol=0)
    torch.testing.assert_close(ours.metadata["directions_norm"], theirs.metadata["directions_norm"])
    assert ours.shape == theirs.shape == (24, 32)


def test_pixels_areas_add_up_to_the_solid_angle_that_the_picture_covers() -> None:
    # A side of a cube seen from its middle: a sixth of all directions.
    side = pinhole_rays(camera(fx=50.0, fy=50.0, cx=50.0, cy=50.0, width=100, height=100))
    assert abs(side.pixel_area.sum().item() - 4 * math.pi / 6) < 1e-3


def test_other_cameras_are_left_to_nerfstudio() -> None:
    assert pinhole_rays(camera(camera_type=CameraType.FISHEYE)) is None
    assert pinhole_rays(camera(distortion_params=torch.tensor([0.1, 0, 0, 0, 0, 0]))) is None
    assert pinhole_rays(camera(distortion_params=torch.zeros(6))) is not None
    two = camera()[torch.tensor([0, 0])]
    assert pinhole_rays(two) is None
