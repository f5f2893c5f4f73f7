"""The three ways to lay out space. Exactly one is on: the first, in the order of the table, that the scene needs."""

from typing import Optional

from nerfstudio.data.scene_box import SceneBox

from sparsestyle_ns.core.camera_paths import MAX_SPREAD, is_forward_facing, meeting_point, viewing_spread
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace, Space
from sparsestyle_ns.data.scene_info import NDC
from sparsestyle_ns.effects.decisions import Decisions, Measurement
from sparsestyle_ns.effects.scene import Scene

MIN_EMPTY_BORDER = 0.5
"""Share of the photos' border that shows nothing, from which on a scene is an object with nothing behind it."""


def measure_forward_facing(scene: Scene) -> Measurement:
    """The largest angle between a camera and the mean viewing direction, in degrees."""
    poses = scene.cameras.camera_to_worlds
    on, words = False, "degrees; but the dataparser gives no bounds of depth, as llff-data does"
    if scene.ndc is not None:
        on = is_forward_facing(poses)
        words = "degrees from the mean direction: "
        words += "all cameras face one way" if on else "the cameras face different ways"
    return Measurement(on, words, viewing_spread(poses), MAX_SPREAD, possible=scene.ndc is not None)


def measure_box(scene: Scene) -> Measurement:
    """The share of the photos' border that shows nothing; and whether the cameras look into the scene box."""
    on, words = False, "of the photos' border is empty: an object with nothing behind it"
    if scene.ndc is not None:
        words = "the dataparser gives a box in NDC only"
    elif scene.empty_border < MIN_EMPTY_BORDER:
        words = "of the photos' border is empty: there is something behind the subject"
    elif not _looks_into_box(scene):
        words = "of the photos' border is empty, but the cameras don't look into the scene box"
    else:
        on = True
    return Measurement(on, words, scene.empty_border, MIN_EMPTY_BORDER, possible=scene.ndc is None)


def _looks_into_box(scene: Scene) -> bool:
    low, high = scene.outputs.scene_box.aabb
    point = meeting_point(scene.cameras.camera_to_worlds)
    return bool(((low < point) & (point < high)).all())


def measure_contraction(scene: Scene) -> Measurement:
    """The share of the photos' border that shows something."""
    value, threshold = 1.0 - scene.empty_border, 1.0 - MIN_EMPTY_BORDER
    words = "of the photos' border shows a background" + "; no other layout fits" * (value <= threshold)
    return Measurement(True, words, value, threshold)


def build_space(effects: Decisions, scene_box: SceneBox, ndc: Optional[NDC]) -> Space:
    """The space of the layout that is on, for the dataparser's scene box, which is in NDC if there is a map to NDC."""
    if effects.on("ndc"):
        assert ndc is not None
        return ForwardFacingSpace(scene_box, ndc.focal_over_half_size, ndc.near, ndc.depth_range)
    if effects.on("box"):
        return BoxSpace(scene_box)
    # nerfstudio's dataparsers make the box for the extent of the cameras; coordinates within it aren't bent.
    low, high = scene_box.aabb
    return ContractedSpace(unit=0.5 * (high - low).amax().item())
