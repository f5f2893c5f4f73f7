"""Lenses that bend straight lines: nerfstudio bends the rays by the cameras' distortion parameters."""

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from sparsestyle_ns.data.matches import undistorted
from sparsestyle_ns.effects.decisions import Measurement
from sparsestyle_ns.effects.scene import Scene

MIN_PIXELS = 0.25
"""Shift of a pixel by the lens, in pixels of the photos as they are, from which on it matters."""


def largest_shift(cameras: Cameras) -> float:
    """How far, in pixels, distortion moves the point of an image's border that it moves most; 0 without any."""
    if cameras.distortion_params is None or not cameras.distortion_params.any():
        return 0.0
    around = np.linspace(-1.0, 1.0, 9)
    sides = [np.stack([around, np.full(9, side)], axis=-1) for side in (-1.0, 1.0)]
    rim = np.concatenate([*sides, *(side[:, ::-1] for side in sides)])
    pairs = ((cameras.fx, cameras.fy), (cameras.cx, cameras.cy), (cameras.width, cameras.height))
    focals, centers, sizes = (torch.cat(pair, dim=-1).double().numpy()[:, None] for pair in pairs)
    points = (0.5 * sizes * (1.0 + rim) - centers) / focals
    moved = np.stack([undistorted(each, cameras, index) for index, each in enumerate(points)])
    return float(np.linalg.norm((moved - points) * focals, axis=-1).max())


def measure_lens_distortion(scene: Scene) -> Measurement:
    """The largest shift of a pixel, in pixels of the photos as they are."""
    if scene.cameras.distortion_params is None:
        return Measurement(False, "the cameras have no distortion parameters", 0.0, MIN_PIXELS, possible=False)
    if (scene.cameras.camera_type == CameraType.FISHEYE624.value).any():
        return Measurement(True, "rays of FISHEYE624 cameras need their distortion parameters", None, MIN_PIXELS)
    shift = largest_shift(scene.cameras)
    return Measurement(shift >= MIN_PIXELS, "pixels at most by which the lens moves a point", shift, MIN_PIXELS)
