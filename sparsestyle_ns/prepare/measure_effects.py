"""Deciding about a scene's effects without training: `sparsestyle effects`."""

import copy
from pathlib import Path
from typing import Optional, Tuple

from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig

from sparsestyle_ns.effects.base import Decisions, EffectSettings
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.runs.coarse_run import check_scene, read_coarse_run
from sparsestyle_ns.runs.scene_record import record_scene
from sparsestyle_ns.style.painting import Painting


def measure_scene(
    dataparser: DataParserConfig,
    data: Path,
    num_views: Optional[int] = None,
    view_ids: Optional[Tuple[int, ...]] = None,
    coarse_run: Optional[Path] = None,
    style_image: Optional[Path] = None,
) -> Decisions:
    """What ns-train would decide with everything on auto.

    Args:
        coarse_run: a run of the scene to measure the effects of stage 2 on; without one they are assumed.
        style_image: the painting; without one its palette counts as another than the photos'.

    Raises:
        InputError: something can't be read, or the run is of another scene.
    """
    config = FewShotDataManagerConfig(
        data=data, dataparser=copy.deepcopy(dataparser), num_views=num_views, view_ids=view_ids
    )
    manager = config.setup(device="cpu", test_mode="inference")
    scene = manager.scene
    effects = decide(scene, EffectSettings())
    if coarse_run is not None:
        run = read_coarse_run(coarse_run)
        check_scene(run, record_scene(data, manager.train_dataparser_outputs, effects))
        scene.coarse_density = run.density(effects)
    if style_image is not None:
        scene.style_image = Painting.read(style_image).pixels
    return decide(scene, EffectSettings(), effects)
