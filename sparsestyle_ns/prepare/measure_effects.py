"""Deciding about a scene's effects without training: `sparsestyle effects`."""

import copy
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import List

from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig

from sparsestyle_ns.data.parser_choice import parse_dataparser
from sparsestyle_ns.effects.decisions import Decisions, EffectSettings
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.hints import PAINTING, finish, flags_of, parser_arguments
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.prepare.prepare_options import EffectsOptions
from sparsestyle_ns.runs.coarse_run import check_scene, read_coarse_run
from sparsestyle_ns.runs.run_folder import COARSE_METHOD, STYLE_METHOD, find_config, read_config
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError


def print_effects(options: EffectsOptions) -> None:
    """Prints the decisions, and what to type next; beside JSON, that goes to stderr."""
    parser = parse_dataparser(options.dataparser, options.data)
    with redirect_stdout(sys.stderr):  # what dataparsers print must not get into the JSON
        decisions = measure_scene(parser, options)
    print(decisions.json() if options.json else decisions.text(), flush=True)
    with redirect_stdout(sys.stderr if options.json else sys.stdout):
        finish(None, next_command(parser, options))


def next_command(dataparser: DataParserConfig, options: EffectsOptions) -> List[str]:
    """Training on the scene, with the painting where there is a coarse run."""
    command = ["ns-train", COARSE_METHOD]
    if options.coarse_run is not None:
        command = ["ns-train", *_style_method(options.coarse_run)]
        command += ["--style-image", str(options.style_image or PAINTING)]
    command += flags_of("--coarse-run", options.coarse_run)
    command += flags_of("--num-views", options.num_views) + flags_of("--view-ids", options.view_ids)
    return [*command, "--data", str(options.data), *parser_arguments(dataparser)]


def _style_method(coarse_run: Path) -> List[str]:
    """The method that stylises a coarse run as it was made: a draft as a draft, and at its size."""
    try:
        config = read_config(find_config(coarse_run, COARSE_METHOD).parent)
    except InputError:
        return [STYLE_METHOD]
    size = flags_of("--max-image-side", config.pipeline.datamanager.max_image_side)
    return [config.method_name.replace(COARSE_METHOD, STYLE_METHOD), *size]


def measure_scene(dataparser: DataParserConfig, options: EffectsOptions) -> Decisions:
    """What ns-train would decide with everything on auto.

    Raises:
        InputError: something can't be read, or the run is of another scene.
    """
    config = FewShotDataManagerConfig(
        data=options.data, dataparser=copy.deepcopy(dataparser), num_views=options.num_views, view_ids=options.view_ids
    )
    manager = config.setup(device="cpu", test_mode="inference")
    scene = manager.scene
    effects = decide(scene, EffectSettings())
    if options.coarse_run is not None:
        run = read_coarse_run(options.coarse_run)
        check_scene(run, manager.record(effects))
        scene.coarse_density = run.density(effects)
    if options.style_image is not None:
        scene.style_image = Painting.read(options.style_image).pixels
    return decide(scene, EffectSettings(), effects)
