"""Runs loaded from disk, wherever they lie now, and measured."""

from pathlib import Path
from typing import NamedTuple, Optional

from sparsestyle_ns.engine.evaluate_options import EvaluateOptions
from sparsestyle_ns.engine.hints import after_evaluation, finish
from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.evaluation.held_out import HeldOutReport
from sparsestyle_ns.evaluation.tables import report_tables
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline
from sparsestyle_ns.runs.checkpoints import checkpoint_path
from sparsestyle_ns.runs.run_folder import find_config
from sparsestyle_ns.style.painting import Painting


class LoadedRun(NamedTuple):
    """A run, ready to render, with the newest checkpoint, which is of iteration `step`."""

    config: SparseStyleTrainerConfig
    pipeline: CheckedPipeline
    step: int

    def save_report(self, report: HeldOutReport, path: Path) -> None:
        """Writes what was measured of the run; OSError where that can't be."""
        checkpoint = checkpoint_path(self.config.get_checkpoint_dir(), self.step)
        report.save(path, self.config.experiment_name, self.config.method_name, self.step, checkpoint)


def load_run(config_path: Path) -> LoadedRun:
    """Loads a run by its config.yml, wherever it is now; InputError as in `RunConfig.open_in`."""
    from nerfstudio.utils.eval_utils import eval_setup  # nerfstudio's own circle: it imports all methods

    def opened(config: SparseStyleTrainerConfig) -> SparseStyleTrainerConfig:
        config.open_in(config_path.resolve().parent)
        return config

    config, pipeline, _, step = eval_setup(config_path, test_mode="test", update_config_callback=opened)
    return LoadedRun(config, pipeline, step)


def evaluate(options: EvaluateOptions) -> None:
    """Measures a run by checked options, writes the report, and prints its tables; InputError as in `evaluate_run`."""
    if options.style_image is not None:
        Painting.read(options.style_image)
    config = find_config(options.run)
    report = evaluate_run(config, options.output_path, options.style_image, options.baked, options.vgg_weights)
    for table in report_tables(report.means, len(report.views)):
        table.print()
    finish(options.output_path, after_evaluation(config.parent, stylised="content_ssim" in report.means))


def evaluate_run(
    config_path: Path,
    output_path: Path,
    style_image: Optional[Path] = None,
    baked: bool = False,
    vgg_weights: Optional[Path] = None,
) -> HeldOutReport:
    """Loads a run and writes its `CheckedPipeline.held_out_report`; InputError where it has no checkpoint."""
    run = load_run(config_path)
    run.pipeline.config.vgg_weights = vgg_weights or run.pipeline.config.vgg_weights
    report = run.pipeline.held_out_report(style_image, baked)
    run.save_report(report, output_path)
    return report
