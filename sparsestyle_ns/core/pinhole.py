"""The rays of one pinhole camera, in one pass over its pixels."""

from typing import Optional

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle


def is_pinhole(cameras: Cameras) -> bool:
    """Whether these are one camera, in perspective, without distortion."""
    if cameras.shape != (1,) or int(cameras.camera_type) != CameraType.PERSPECTIVE.value:
        return False
    return cameras.distortion_params is None or not bool(cameras.distortion_params.any())


def pinhole_rays(camera: Cameras) -> Optional[RayBundle]:
    """The rays through all pixels' centres, [H, W]; None for what is no lone pinhole camera (`is_pinhole`).

    nerfstudio's `generate_rays` finds the same origins and unit directions for any mixture of cameras, by masks and
    three directions a pixel. `pixel_area` is the solid angle of a pixel, cos³ / (f_x f_y) where its ray has that cosine
    to the camera's axis; nerfstudio's is the product of two lengths that is close to it near the axis.

    Example:
        >>> camera = Cameras(torch.eye(4)[None, :3], fx=2.0, fy=2.0, cx=1.0, cy=1.0, width=2, height=2)
        >>> pinhole_rays(camera).directions.shape
        torch.Size([2, 2, 3])
    """
    if not is_pinhole(camera):
        return None
    pose, device = camera.camera_to_worlds[0], camera.device
    height, width = int(camera.height), int(camera.width)
    x = (torch.arange(width, device=device) + 0.5 - camera.cx[0]) / camera.fx[0]
    y = (torch.arange(height, device=device) + 0.5 - camera.cy[0]) / camera.fy[0]
    length = (x.square() + (1.0 + y.square())[:, None]).sqrt()[..., None]
    across = x[:, None] * pose[:, 0] - pose[:, 2]
    directions = (across - (y[:, None] * pose[:, 1])[:, None]) / length
    return RayBundle(
        origins=pose[:, 3].expand_as(directions),
        directions=directions,
        pixel_area=length**-3 / (camera.fx[0] * camera.fy[0]),
        camera_indices=torch.zeros(height, width, 1, dtype=torch.long, device=device),
        times=None if camera.times is None else camera.times[0].expand(height, width, 1),
        metadata={"directions_norm": length},
    )
