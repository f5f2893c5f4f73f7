"""`sparsestyle ...`: what has no ns-* command of its own.

A subcommand is a class of options, whose docstrings are its help, and a function, imported when it runs: help is fast.
"""

import importlib
from typing import Dict, Optional, Sequence, Tuple, Type

import tyro

from sparsestyle_ns.engine.evaluate_options import EvaluateOptions
from sparsestyle_ns.export.export_options import ExportOptions
from sparsestyle_ns.gallery.gallery_options import GalleryOptions
from sparsestyle_ns.prepare.prepare_options import EffectsOptions, PrepareOptions
from sparsestyle_ns.studies.study_options import AblateOptions, CompareOptions, TradeoffOptions
from sparsestyle_ns.utils.errors import CommandOptions, exit_on_input_error
from sparsestyle_ns.utils.interrupts import end_on_ctrl_c, ended_by_ctrl_c

SUBCOMMANDS: Dict[str, Tuple[Type[CommandOptions], str]] = {
    "ablate": (AblateOptions, "studies.paper_studies:ablate"),
    "compare": (CompareOptions, "studies.paper_studies:compare"),
    "effects": (EffectsOptions, "prepare.measure_effects:print_effects"),
    "evaluate": (EvaluateOptions, "engine.loading:evaluate"),
    "export": (ExportOptions, "export.export_run:export_run"),
    "gallery": (GalleryOptions, "gallery.make_gallery:make_gallery"),
    "prepare": (PrepareOptions, "prepare.prepare_scene:prepare"),
    "tradeoff": (TradeoffOptions, "studies.tradeoff:tradeoff"),
}
"""Each subcommand's options, and the function that takes them."""


@exit_on_input_error
def main(arguments: Optional[Sequence[str]] = None) -> None:
    """The command line; `arguments` default to the process's own."""
    if arguments is None:
        end_on_ctrl_c()
    with ended_by_ctrl_c():
        options: CommandOptions = tyro.extras.subcommand_cli_from_dict(
            {name: options for name, (options, _) in SUBCOMMANDS.items()},
            prog="sparsestyle",
            description="Tools around stylised scenes. Training, rendering and viewing are nerfstudio's ns-* commands.",
            args=arguments,
        )
        options.check()
        module, function = dict(SUBCOMMANDS.values())[type(options)].split(":")
        getattr(importlib.import_module(f"sparsestyle_ns.{module}"), function)(options)
