"""The last line of this package's commands: what was made, and what to type next."""

import shlex
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, List, Optional, Sequence, Union

from nerfstudio.engine.trainer import TrainerConfig

from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.runs.coarse_run import read_coarse_run
from sparsestyle_ns.runs.run_folder import COARSE_METHOD, STYLE_METHOD
from sparsestyle_ns.runs.scene_record import SceneRecord
from sparsestyle_ns.utils.files import free_path
from sparsestyle_ns.utils.progress import say

PAINTING = "PAINTING.jpg"
"""Stands for a painting that the person at the keyboard has to name."""
RESUMING = ("--load-dir", "--load-checkpoint", "--load-step")


def finish(made: Union[Path, str, None], command: Sequence[object]) -> None:
    """Prints a command's last line: the file or folder that it made, with a word on it, and what to type next."""
    say(f"{'Nothing was saved' if made is None else f'Made {made}'} – next: {shlex.join(map(str, command))}")


def ns_train_style(coarse_run: Path, config: TrainerConfig) -> List[str]:
    """The command that stylises a coarse run, given by its folder and what is in its config.yml."""
    method = config.method_name.replace(COARSE_METHOD, STYLE_METHOD)
    start = ["ns-train", method, "--style-image", PAINTING, "--coarse-run", str(coarse_run)]
    return [*start, *scene_arguments(config)]


def after_evaluation(run: Path, stylised: bool) -> List[str]:
    """What follows on the measuring of a run, stylised or coarse, given by its folder."""
    if stylised:
        return ["sparsestyle", "gallery", str(run)]
    config = read_coarse_run(run).config
    config.pipeline.datamanager.data = SceneRecord.load(run).find_data(run.resolve())  # wherever that is by now
    if config.get_base_dir().resolve() != run.resolve():  # the run has moved
        config.output_dir = Path("outputs")
    return ns_train_style(run, config)


def after_export(run: Path, output_path: Path, format: str) -> List[object]:
    """What follows on an export: a look at a page; of a file of points or triangles, that page."""
    if format == "html":
        return ["python", "-m", "webbrowser", output_path.resolve().as_uri()]
    page = free_path(output_path.with_suffix(".html"))
    return ["sparsestyle", "export", run, "--format", "html", "--output-path", page]


def scene_arguments(config: TrainerConfig) -> List[str]:
    """The end of an ns-train command on the same scene as a run, with the same views, size and effects."""
    manager = config.pipeline.datamanager
    arguments = flags_of("--num-views", manager.num_views) + flags_of("--view-ids", manager.view_ids)
    arguments += flags_of("--max-image-side", manager.max_image_side)  # methods differ in what they do without it
    arguments += _changed_flags(config.pipeline.effects, EffectSettings(), "pipeline.effects.")
    arguments += flags_of("--output-dir", config.output_dir, Path("outputs"))
    arguments += flags_of("--vis", config.vis, "viewer+tensorboard")
    return [*arguments, "--data", str(manager.data or manager.dataparser.data), *parser_arguments(manager.dataparser)]


def parser_arguments(config: Any) -> List[str]:
    """A dataparser's name and those of its settings that aren't its defaults."""
    from nerfstudio.configs.dataparser_configs import all_dataparsers

    name = next(name for name, known in all_dataparsers.items() if type(known) is type(config))
    return [name, *_changed_flags(config, all_dataparsers[name])]


def _changed_flags(config: Any, default: Any, prefix: str = "") -> List[str]:
    """The flags by which a config differs from a default of the same class; its `data` is named elsewhere."""
    flags: List[str] = []
    for each in fields(config):
        value, usual = getattr(config, each.name), getattr(default, each.name)
        if each.name not in ("data", "_target") and not is_dataclass(value):
            flags += flags_of(f"--{prefix}{each.name}", value, usual)
    return flags


def flags_of(name: str, value: Any, usual: Any = None) -> List[str]:
    """A flag with its value or values; nothing where that is what it usually is."""
    if value == usual:
        return []
    values = value if isinstance(value, (tuple, list)) else (value,)
    return [name.replace("_", "-"), *map(str, values)]


def resume_command(method: str, checkpoints: Path, typed: Optional[Sequence[str]] = None) -> List[str]:
    """The command that trains a method on from a folder of checkpoints, otherwise as it was `typed` (None: here)."""
    typed = sys.argv[1:] if typed is None else list(typed)
    if any(part.split("=")[0].replace("_", "-") == "--load-config" for part in typed):  # with which no flag counts
        return ["ns-train", method, "--load-config", str(checkpoints.parent / "config.yml")]
    if method not in typed:  # training was begun by something else than ns-train
        return ["ns-train", method, "--load-dir", str(checkpoints)]
    before, after = typed[: typed.index(method)], typed[typed.index(method) + 1 :]
    kept, skip = [], False
    for argument in after:
        is_resuming = argument.split("=")[0].replace("_", "-") in RESUMING
        if not skip and not is_resuming:
            kept.append(argument)
        skip = is_resuming and "=" not in argument
    return ["ns-train", *before, method, "--load-dir", str(checkpoints), *kept]
