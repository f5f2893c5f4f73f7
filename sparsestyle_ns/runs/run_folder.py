"""Runs on disk: finding the config of one, and loading it wherever it lies now."""

import re
from pathlib import Path
from typing import Any, Tuple

from sparsestyle_ns.utils.errors import InputError

COARSE_METHOD = "coarse-fewshot"
"""What the names of stage 1's methods start with."""
STYLE_METHOD = "hier-style"
"""What the names of stage 2's methods start with."""


REPORT_FILE = "evaluation.json"
"""What was measured of a run, in its folder."""


def find_config(run: Path, method: str = "") -> Path:
    """The config.yml of a run, given by its folder or by that file; reads no more than its method's name.

    Args:
        run: the folder or the file.
        method: what the name of the run's method starts with; empty for either method of this package.

    Raises:
        InputError: it isn't there, or is a run of another method.
    """
    path = run if run.name == "config.yml" else run / "config.yml"
    if not path.is_file():
        what = "There is no run at" if not run.exists() else "There is no config.yml in"
        example = f"outputs/fern/{method or STYLE_METHOD}/2026-01-31_120000"
        raise InputError(f"{what} {run}; name a run's folder, such as {example}.")
    try:
        name = re.search(r"^method_name: *(\S+)", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} can't be read; name the folder of a run that ns-train made.") from error
    if name is None:
        raise InputError(f"{path} is no config of a nerfstudio run; name the folder of a run that ns-train made.")
    if not name[1].startswith((method,) if method else (COARSE_METHOD, STYLE_METHOD)):
        raise InputError(
            f"{run} is a run of {name[1]}; name a run of {method or COARSE_METHOD + ' or ' + STYLE_METHOD}."
        )
    return path


def load_run(config_path: Path) -> Tuple[Any, Any, int]:
    """A run's config, its pipeline with the newest checkpoint loaded, ready to evaluate, and that one's iteration.

    The run may have been moved since it was made, and its photos' path may be relative to another folder.

    Raises:
        InputError: the run has no checkpoint.
    """
    from nerfstudio.utils.eval_utils import eval_setup

    folder = config_path.resolve().parent

    def where_it_is_now(config: Any) -> Any:
        from sparsestyle_ns.runs.coarse_run import checkpoint_step, newest_checkpoint
        from sparsestyle_ns.runs.scene_record import SceneRecord

        newest = newest_checkpoint(folder / config.relative_model_dir)
        if newest is None:
            raise InputError(f"{folder} has no checkpoint yet; train it, or name another run.")
        config.load_step = checkpoint_step(newest)
        # nerfstudio joins these four to find the checkpoints, from the folder that the command was started in.
        config.output_dir, config.experiment_name = folder.parents[2], folder.parents[1].name
        config.method_name, config.timestamp = folder.parent.name, folder.name
        data = config.pipeline.datamanager.data
        if data is not None and not data.exists():
            config.pipeline.datamanager.data = Path(SceneRecord.load(folder).data)
        return config

    config, pipeline, _, step = eval_setup(config_path, test_mode="test", update_config_callback=where_it_is_now)
    return config, pipeline, step
