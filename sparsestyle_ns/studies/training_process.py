"""A run of a study in a process of its own: what ns-train does once it has read its command line.

Started as `python -m sparsestyle_ns.studies.training_process CONFIG.yml`; how far it is and why it failed is in the
file that `PROGRESS_FILE` names.
"""

import sys
from pathlib import Path

import yaml
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts import train

from sparsestyle_ns.utils.progress import ProgressReport, report


def train_run(config: TrainerConfig) -> None:
    """Trains, and reports why it didn't where it fails."""
    try:
        train.main(config)
    except SystemExit as end:  # so an InputError ends, with its sentence
        if end.code:
            report(ProgressReport(failure=str(end.code)))
        raise
    except Exception as error:
        report(ProgressReport(failure=f"{type(error).__name__}: {error}"))
        raise


if __name__ == "__main__":
    train_run(yaml.load(Path(sys.argv[1]).read_text(encoding="utf-8"), Loader=yaml.Loader))
