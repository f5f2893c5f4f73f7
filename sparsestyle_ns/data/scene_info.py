"""What training needs to know of a scene beside nerfstudio's `DataparserOutputs`.

A dataparser of a new dataset fills a `SceneInfo` and puts it into its outputs' metadata under `SCENE_INFO`. For
nerfstudio's own dataparsers `data.reading` makes one.
"""

from dataclasses import dataclass, replace
from typing import Optional, Tuple

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from sparsestyle_ns.data.tracks import Tracks

SCENE_INFO = "scene_info"
"""Where a dataparser's metadata has the `SceneInfo`."""


@dataclass(frozen=True)
class NDC:
    """The map of a forward-facing scene, and so of its scene box, to normalised device coordinates (`core.ndc`).

    Attributes:
        focal_over_half_size: (2f/w, 2f/h), f, w and h in pixels.
        near: distance of the near plane, in world units.
        depth_range: depth of the nearest and the farthest thing that any view sees, in world units.
    """

    focal_over_half_size: Tuple[float, float]
    near: float
    depth_range: Tuple[float, float]


@dataclass(frozen=True)
class SceneInfo:
    """One split of a scene.

    Attributes:
        view_ids: the number of each view, by which `--view-ids` chooses it, in the outputs' order.
        ndc: None where the bounds of depth aren't known.
        standard_views: ids of the few views that papers train on, in their order; None: views at even steps.
        default_num_views: how many views to train on unless `--num-views` says otherwise.
        poses_estimated: whether the cameras were estimated from these few photos, and so are not quite right.
        tracks: what the photos show where, if the cameras were estimated from that.
    """

    view_ids: Tuple[int, ...]
    ndc: Optional[NDC] = None
    standard_views: Optional[Tuple[int, ...]] = None
    default_num_views: int = 8
    poses_estimated: bool = False
    tracks: Optional[Tracks] = None


def scene_info(outputs: DataparserOutputs) -> SceneInfo:
    """The `SceneInfo` of a dataparser's outputs, which `data.reading.read_scene` gives to all."""
    return outputs.metadata[SCENE_INFO]


def select_outputs(outputs: DataparserOutputs, positions: Tuple[int, ...]) -> DataparserOutputs:
    """The same scene with only the views at these positions."""
    info = scene_info(outputs)
    chosen = replace(info, view_ids=tuple(info.view_ids[position] for position in positions))
    return replace(
        outputs,
        image_filenames=[outputs.image_filenames[position] for position in positions],
        mask_filenames=outputs.mask_filenames and [outputs.mask_filenames[position] for position in positions],
        cameras=outputs.cameras[torch.tensor(positions)],
        metadata={**outputs.metadata, SCENE_INFO: chosen},
    )
