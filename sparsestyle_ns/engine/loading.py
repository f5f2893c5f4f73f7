"""Runs loaded from disk, wherever they lie now, and measured."""

from pathlib import Path
from typing import NamedTuple, Optional, Tuple

from sparsestyle_ns.data.parser_choice import parse_dataparser
from sparsestyle_ns.data.photos import PhotoDataset
from sparsestyle_ns.effects.pose_refinement import carried_along
from sparsestyle_ns.engine.evaluate_options import EvaluateOptions
from sparsestyle_ns.engine.hints import after_evaluation, finish
from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.evaluation.held_out import HeldOutReport
from sparsestyle_ns.evaluation.tables import report_tables
from sparsestyle_ns.pipelines.datamanager import FewShotDataManager, FewShotDataManagerConfig
from sparsestyle_ns.pipelines.scene_pipeline import CheckedPipeline
from sparsestyle_ns.runs.checkpoints import checkpoint_path
from sparsestyle_ns.runs.run_folder import find_config
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import not_writable


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
    known = None if options.known_scene is None else (options.known_scene, options.known_views)
    how = options.style_image, options.baked, options.vgg_weights
    report = evaluate_run(config, options.output_path, *how, known=known)
    for table in report_tables(report.means, len(report.views)):
        table.print()
    finish(options.output_path, after_evaluation(config.parent, stylised="content_ssim" in report.means))


def evaluate_run(
    config_path: Path,
    output_path: Path,
    style_image: Optional[Path] = None,
    baked: bool = False,
    vgg_weights: Optional[Path] = None,
    known: Optional[Tuple[Path, Tuple[int, ...]]] = None,
) -> HeldOutReport:
    """Loads a run and writes its `CheckedPipeline.held_out_report`; InputError where it has no checkpoint.

    With `known`, a scene and its numbers of the run's photos, of that scene's held-out views (see `known_views`).
    """
    run = load_run(config_path)
    run.pipeline.config.vgg_weights = vgg_weights or run.pipeline.config.vgg_weights
    views = None if known is None else known_views(run.pipeline.datamanager, *known)
    report = run.pipeline.held_out_report(style_image, baked, views=views)
    try:
        run.save_report(report, output_path)
    except OSError as error:
        raise not_writable(output_path, "The report", error.strerror) from error
    return report


def known_views(manager: FewShotDataManager, scene: Path, view_ids: Tuple[int, ...]) -> PhotoDataset:
    """Held-out views of a scene with known poses, placed in the world of a run whose poses were estimated.

    By the similarity that lays the known cameras of the run's photos over the run's own, with its focal length.

    Args:
        manager: the run's.
        scene: folder of the known scene.
        view_ids: its numbers of the run's photos, in the run's order.

    Raises:
        InputError: the scene can't be read, or these aren't as many photos as the run's, or two or more.
    """
    count = len(manager.train_dataset)
    if len(view_ids) != count or count < 2:
        raise InputError(
            f"--known-views names {len(view_ids)} photos, and the run was trained on {count}; name each of these, two "
            "at least."
        )
    known: FewShotDataManager = FewShotDataManagerConfig(
        data=scene, dataparser=parse_dataparser([], scene), view_ids=view_ids, max_image_side=manager.photo_side
    ).setup(device="cpu", test_mode="test")
    views, training = known.eval_dataset, known.train_dataset.cameras
    views.refine = lambda cameras: carried_along(cameras, training, manager.train_dataset.cameras)
    return views
