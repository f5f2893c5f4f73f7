"""Deciding about a scene's effects without training: `sparsestyle effects`."""

import copy
from pathlib import Path
from typing import Optional, Tuple

from nerfstudio.configs.dataparser_configs import all_dataparsers

from sparsestyle_ns.data.parser_choice import check_parser
from sparsestyle_ns.effects.base import Decisions
from sparsestyle_ns.effects.registry import ALL_AUTO, decide
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.runs.coarse_run import check_scene, read_coarse_run
from sparsestyle_ns.runs.scene_record import record_scene
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError


def measure_scene(
    dataparser: str,
    data: Path,
    num_views: Optional[int] = None,
    view_ids: Optional[Tuple[int, ...]] = None,
    coarse_run: Optional[Path] = None,
    style_image: Optional[Path] = None,
) -> Decisions:
    """What ns-train would decide with everything on auto.

    Args:
        dataparser: its name on the command line, with its default settings.
        data: the scene.
        num_views, view_ids: see `FewShotDataManagerConfig`.
        coarse_run: a run of the scene to measure the effects of stage 2 on; without one they are assumed.
        style_image: the painting; without one its palette counts as another than the photos'.

    Raises:
        InputError: there is no such dataparser or scene, or something can't be read.
    """
    check_parser(dataparser)
    if not data.exists():
        raise InputError(f"There is no {data}; name a scene's folder with --data.")
    config = FewShotDataManagerConfig(
        data=data, dataparser=copy.deepcopy(all_dataparsers[dataparser]), num_views=num_views, view_ids=view_ids
    )
    manager = config.setup(device="cpu", test_mode="inference")
    scene = manager.scene
    if coarse_run is not None:
        run = read_coarse_run(coarse_run)
        check_scene(run, record_scene(manager))
        scene.coarse_density = run.density(manager.effects)
    if style_image is not None:
        scene.style_image = Painting.read(style_image).pixels
    return decide(scene, ALL_AUTO, manager.effects)
