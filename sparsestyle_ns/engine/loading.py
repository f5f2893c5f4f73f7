"""Runs loaded from disk, wherever they lie now, and measured."""

from pathlib import Path
from typing import NamedTuple, Optional

from sparsestyle_ns.engine.evaluate_options import EvaluateOptions
from sparsestyle_ns.engine.hints import after_evaluation, finish
from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.evaluation.held_out import HeldOutReport
from sparsestyle_ns.evaluation.tables import report_tables
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline
from sparsestyle_ns.runs.checkpoints import checkpoint_step, newest_checkpoint
from sparsestyle_ns.runs.run_folder import find_config
from sparsestyle_ns.runs.scene_record import SceneRecord
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError


class LoadedRun(NamedTuple):
    """A run, ready to render, with the newest checkpoint, which is of iteration `step`."""

    config: SparseStyleTrainerConfig
    pipeline: CheckedPipeline
    step: int


def load_run(config_path: Path) -> LoadedRun:
    """Loads a run by its config.yml, wherever it is now; InputError where it has no checkpoint."""
    from nerfstudio.utils.eval_utils import eval_setup  # nerfstudio's own circle: it imports all methods

    folder = config_path.resolve().parent

    def where_it_is_now(config: SparseStyleTrainerConfig) -> SparseStyleTrainerConfig:
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
    return LoadedRun(config, pipeline, step)


def evaluate(options: EvaluateOptions) -> None:
    """Measures a run by checked options, writes the report, and prints its tables; InputError as in `evaluate_run`."""
    if options.style_image is not None:
        Painting.read(options.style_image)
    config = find_config(options.run)
    report = evaluate_run(config, options.output_path, options.style_image, options.baked)
    for table in report_tables(report.means, len(report.views)):
        table.print()
    finish(options.output_path, after_evaluation(config.parent, stylised="content_ssim" in report.means))


def evaluate_run(
    config_path: Path, output_path: Path, style_image: Optional[Path] = None, baked: bool = False
) -> HeldOutReport:
    """Loads a run and writes its `CheckedPipeline.held_out_report`; InputError where it has no checkpoint."""
    config, pipeline, step = load_run(config_path)
    report = pipeline.held_out_report(style_image, baked)
    report.save(output_path, config.experiment_name, config.method_name, step)
    return report
