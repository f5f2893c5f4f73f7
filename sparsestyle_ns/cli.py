"""`sparsestyle ...`: what has no ns-* command of its own.

A subcommand is a class of options, whose docstrings are its help, and a function, imported when it runs: help is fast.
"""

import errno
import importlib
import sys
from dataclasses import fields
from typing import Dict, List, Optional, Sequence, Set, Tuple, Type

import tyro

from sparsestyle_ns.engine.evaluate_options import EvaluateOptions
from sparsestyle_ns.export.export_options import ExportOptions
from sparsestyle_ns.gallery.gallery_options import GalleryOptions
from sparsestyle_ns.prepare.prepare_options import EffectsOptions, PrepareOptions
from sparsestyle_ns.studies.study_options import AblateOptions, CompareOptions, TradeoffOptions
from sparsestyle_ns.stylise.stylise_options import StyliseOptions
from sparsestyle_ns.utils.errors import CommandOptions, InputError, exit_on_input_error
from sparsestyle_ns.utils.interrupts import end_on_ctrl_c, ended_by_ctrl_c

SUBCOMMANDS: Dict[str, Tuple[Type[CommandOptions], str]] = {
    "ablate": (AblateOptions, "studies.paper_studies:ablate"),
    "compare": (CompareOptions, "studies.paper_studies:compare"),
    "effects": (EffectsOptions, "prepare.measure_effects:print_effects"),
    "evaluate": (EvaluateOptions, "engine.loading:evaluate"),
    "export": (ExportOptions, "export.export_run:export_run"),
    "gallery": (GalleryOptions, "gallery.make_gallery:make_gallery"),
    "prepare": (PrepareOptions, "prepare.prepare_scene:prepare"),
    "stylise": (StyliseOptions, "stylise.stylise:stylise"),
    "tradeoff": (TradeoffOptions, "studies.tradeoff:tradeoff"),
}
"""Each subcommand's options, and the function that takes them."""

DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.EFBIG, errno.ENAMETOOLONG)
"""Errors that a disk, or one's rights on it, may lead to wherever a command reads or writes."""


def with_dashes(arguments: List[str]) -> List[str]:
    """The command line with the two dashes behind which a dataparser's own options come, where they were left out."""
    options, _ = SUBCOMMANDS.get(arguments[0] if arguments else "", (None, ""))
    if options is None or "--" in arguments or not hasattr(options, "dataparser"):
        return arguments
    own = {f"--{each.name.replace('_', '-')}" for each in fields(options)}
    for place, (before, word, after) in enumerate(zip(arguments, arguments[1:], arguments[2:], strict=False), start=1):
        is_of_parser = after.startswith("--") and after.split("=")[0].replace("_", "-") not in own
        if is_of_parser and not before.startswith("-") and word in dataparser_names():
            return [*arguments[:place], "--", *arguments[place:]]
    return arguments


def dataparser_names() -> Set[str]:
    """Those that nerfstudio knows."""
    from nerfstudio.configs.dataparser_configs import all_dataparsers  # takes seconds, and is rarely needed

    return set(all_dataparsers)


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
            args=with_dashes(sys.argv[1:] if arguments is None else list(arguments)),
        )
        options.expand_paths()
        options.check()
        module, name = dict(SUBCOMMANDS.values())[type(options)].split(":")
        try:
            getattr(importlib.import_module(f"sparsestyle_ns.{module}"), name)(options)
        except OSError as error:
            if error.errno not in DISK:
                raise
            where = "A file" if error.filename is None else error.filename
            raise InputError(
                f"{where} can't be read or written ({error.strerror}); see to the disk and its rights, and try again."
            ) from error
