"""The three ways to lay out space. Exactly one is on: the first, in the order of the table, that the scene needs."""

from typing import Optional

from nerfstudio.data.scene_box import SceneBox

from sparsestyle_ns.core.camera_paths import MAX_SPREAD, is_forward_facing, meeting_point, viewing_spread
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace, Space
from sparsestyle_ns.data.scene_info import NDC
from sparsestyle_ns.effects.base import Decisions, Effect, Measurement
from sparsestyle_ns.effects.scene import Scene

MIN_EMPTY_BORDER = 0.5
"""Share of the photos' border that shows nothing, from which on a scene is an object with nothing behind it."""


def measure_forward_facing(scene: Scene) -> Measurement:
    """The largest angle between a camera and the mean viewing direction, in degrees."""
    poses = scene.cameras.camera_to_worlds
    found = {"value": viewing_spread(poses), "threshold": MAX_SPREAD}
    if scene.ndc is None:
        words = "degrees; but the dataparser gives no bounds of depth, as llff-data does"
        return Measurement(False, words, **found, possible=False)
    if not is_forward_facing(poses):
        return Measurement(False, "degrees from the mean direction: the cameras face different ways", **found)
    return Measurement(True, "degrees from the mean direction: all cameras face one way", **found)


def measure_box(scene: Scene) -> Measurement:
    """The share of the photos' border that shows nothing; and whether the cameras look into the scene box."""
    found = {"value": scene.empty_border, "threshold": MIN_EMPTY_BORDER}
    if scene.ndc is not None:
        return Measurement(False, "the dataparser gives a box in NDC only", **found, possible=False)
    if scene.empty_border < MIN_EMPTY_BORDER:
        return Measurement(False, "of the photos' border is empty: there is something behind the subject", **found)
    low, high = scene.outputs.scene_box.aabb
    point = meeting_point(scene.cameras.camera_to_worlds)
    if not ((low < point) & (point < high)).all():
        words = "of the photos' border is empty, but the cameras don't look into the scene box"
        return Measurement(False, words, **found)
    return Measurement(True, "of the photos' border is empty: an object with nothing behind it", **found)


def measure_contraction(scene: Scene) -> Measurement:
    """The share of the photos' border that shows something."""
    value, threshold = 1.0 - scene.empty_border, 1.0 - MIN_EMPTY_BORDER
    words = "of the photos' border shows a background" + "; no other layout fits" * (value <= threshold)
    return Measurement(True, words, value, threshold)


LAYOUTS = (
    Effect("ndc", measure_forward_facing, layout=True),
    Effect("box", measure_box, layout=True),
    Effect("contraction", measure_contraction, layout=True),
)


def build_space(effects: Decisions, scene_box: SceneBox, ndc: Optional[NDC]) -> Space:
    """The space of the layout that is on.

    Args:
        effects: what was decided.
        scene_box: the dataparser's: in NDC if it gives the map to NDC, else in the world.
        ndc: that map, without which there is no layout in NDC.
    """
    if effects.on("ndc"):
        assert ndc is not None
        return ForwardFacingSpace(scene_box, ndc.focal_over_half_size, ndc.near, ndc.depth_range)
    if effects.on("box"):
        return BoxSpace(scene_box)
    # nerfstudio's dataparsers make the box for the extent of the cameras; coordinates within it aren't bent.
    low, high = scene_box.aabb
    return ContractedSpace(unit=0.5 * (high - low).amax().item())
