"""The three ways to lay space out; exactly one is on, the first in this order that a scene calls for."""

from typing import Any, Dict, List, Tuple

import numpy as np
from jaxtyping import Float

from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace, Space
from sparsestyle_ns.effects.base import Effect, Measurement
from sparsestyle_ns.effects.scene import Scene

MAX_SPREAD = 45.0
"""Degrees by which a camera may look aside from the mean viewing direction of a forward-facing capture."""
MIN_EMPTY_BORDER = 0.5
"""Share of the photos' border pixels that show nothing, from which on a scene is an object by itself."""


def viewing_spread(camera_to_worlds: Float[np.ndarray, "views 3 4"]) -> float:
    """Largest angle, in degrees, between a camera's viewing direction and the mean of all; 180 where they cancel."""
    directions = -camera_to_worlds[:, :, 2] / np.linalg.norm(camera_to_worlds[:, :, 2], axis=-1, keepdims=True)
    mean = directions.mean(axis=0)
    if np.linalg.norm(mean) < 1e-6:
        return 180.0
    return float(np.degrees(np.arccos(np.clip(directions @ (mean / np.linalg.norm(mean)), -1.0, 1.0)).max()))


def meeting_point(camera_to_worlds: Float[np.ndarray, "views 3 4"]) -> Float[np.ndarray, "3"]:
    """The point nearest to all viewing axes, by least squares; of parallel axes, the one nearest to the origin."""
    back = camera_to_worlds[:, :, 2] / np.linalg.norm(camera_to_worlds[:, :, 2], axis=-1, keepdims=True)
    aside = np.eye(3) - back[:, :, None] * back[:, None, :]
    return np.linalg.pinv(aside.sum(axis=0)) @ np.einsum("nij,nj->i", aside, camera_to_worlds[:, :, 3])


class ForwardFacing(Effect):
    """Normalised device coordinates, for cameras that look one way at things of any depth."""

    name = "ndc"
    help = "Forward-facing warp: cameras look one way, at things of any depth."
    layout = True

    def measure(self, scene: Scene) -> Measurement:
        """See `Effect.measure`; the angle between the cameras, in degrees."""
        spread = viewing_spread(scene.camera_to_worlds)
        found = {"value": spread, "threshold": MAX_SPREAD}
        if "ndc_near" not in scene.metadata:
            words = "degrees; but the dataparser gives no bounds of depth, as llff-data does"
            return Measurement(False, words, **found, possible=False)
        if spread > MAX_SPREAD:
            return Measurement(False, "degrees: the cameras look in many directions", **found)
        return Measurement(True, "degrees: the cameras look one way, and depth has no end", **found)

    def build(self, parameters: Dict[str, List[float]], **needs: Any) -> Space:
        """See `Effect.build`; needs the scene box in NDC and the dataparser's metadata."""
        scene_box, metadata = needs["scene_box"], needs["metadata"]
        focal: Tuple[float, float] = tuple(metadata["ndc_focal_over_half_size"])
        return ForwardFacingSpace(scene_box, focal, metadata["ndc_near"], tuple(metadata["ndc_depth_range"]))


class BoundedBox(Effect):
    """A box around an object that cameras stand around."""

    name = "box"
    help = "Bounded box: an object inside a ring of cameras, with nothing behind it."
    layout = True

    def measure(self, scene: Scene) -> Measurement:
        """See `Effect.measure`; the share of the photos' border that shows nothing."""
        found = {"value": scene.empty_border, "threshold": MIN_EMPTY_BORDER}
        if scene.metadata.get("space") == "ndc":
            return Measurement(False, "the dataparser gives no box in the world", **found, possible=False)
        if scene.empty_border < MIN_EMPTY_BORDER:
            return Measurement(False, "of the border is empty: something lies behind what is looked at", **found)
        low, high = scene.box
        point = meeting_point(scene.camera_to_worlds)
        if not ((low < point) & (point < high)).all():
            return Measurement(False, "of the border is empty, but the cameras don't look into the box", **found)
        return Measurement(True, "of the border is empty: an object by itself", **found)

    def build(self, parameters: Dict[str, List[float]], **needs: Any) -> Space:
        """See `Effect.build`; needs the scene box in the world."""
        return BoxSpace(needs["scene_box"])


class Contraction(Effect):
    """All of space, bent into a cube (`rendering.space.contract`)."""

    name = "contraction"
    help = "Unbounded contraction: cameras all around, background beyond them."
    layout = True

    def measure(self, scene: Scene) -> Measurement:
        """See `Effect.measure`; the share of the photos' border that shows something."""
        value = 1.0 - scene.empty_border
        if value > 1.0 - MIN_EMPTY_BORDER:
            return Measurement(True, "of the border shows a background", value, 1.0 - MIN_EMPTY_BORDER)
        return Measurement(True, "of the border shows a background; the other layouts don't fit", value, 0.5)

    def build(self, parameters: Dict[str, List[float]], **needs: Any) -> Space:
        """See `Effect.build`; needs the scene box, which nerfstudio's dataparsers make for the cameras' size."""
        corners = needs["scene_box"].aabb
        # Coordinates within the box aren't bent.
        return ContractedSpace(unit=0.5 * (corners[1] - corners[0]).amax().item())
