"""`sparsestyle tradeoff`: measures all axes within a budget and writes the report, also when it is stopped."""

import gc
import tempfile
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Callable, Iterator, List, Sequence

import torch
import tyro
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.progress_bar import ProgressBar

from sparsestyle_ns.data.parser_choice import MARKERS, marker_of
from sparsestyle_ns.engine.hints import after_tradeoff, finish
from sparsestyle_ns.studies.tradeoff.axis import Axis
from sparsestyle_ns.studies.tradeoff.budget import Budget
from sparsestyle_ns.studies.tradeoff.plan import Plan, run_plans
from sparsestyle_ns.studies.tradeoff.precision import PrecisionGroup
from sparsestyle_ns.studies.tradeoff.quadrature import Quadrature
from sparsestyle_ns.studies.tradeoff.rendering import Rendering
from sparsestyle_ns.studies.tradeoff.report import GROUPS, Report, cant_write
from sparsestyle_ns.studies.tradeoff.stage1 import Stage1
from sparsestyle_ns.studies.tradeoff.stage2 import Stage2
from sparsestyle_ns.studies.tradeoff.study import Options, Study, quiet
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.machine import device_name, versions

REPORT_SECONDS = 4.0
REPORT_SHARE = 0.05
"""Time that is kept for writing the report: so many seconds, but no larger part of the budget."""
REFRESHES = 2
"""Of the progress bar in a second; drawing it takes time from what is measured."""


def parse_dataparser(arguments: Sequence[str], data: Path) -> Any:
    """A dataparser's config from its name and options, as after ns-train; without them from what the folder holds.

    Raises:
        InputError: the scene isn't there, or nothing says which dataparser reads it.
    """
    if not data.exists():
        raise InputError(f"There is no {data}; name a scene's folder with --data.")
    if not arguments:
        marker = marker_of(data)
        if marker is None:
            raise InputError(
                f"{data} has none of {', '.join(MARKERS)}, so the dataparser isn't known; name it last, such as colmap."
            )
        arguments = [MARKERS[marker]]
    return tyro.cli(AnnotatedDataParserUnion, args=list(arguments), prog="sparsestyle tradeoff")


def measure(options: Options, budget: Budget, console: Console) -> Report:
    """Measures what fits into the budget.

    Ctrl-C ends it; what has been measured is in the report.

    Raises:
        InputError: the scene, the painting or the coarse run can't be used.
    """
    _check_folder(options.output_dir)
    seconds, stopped = budget.left, []
    with _progress(console, budget) as begin, quiet():
        study = Study(options, budget)
        plans, left_out = all_plans(study)
        reserve = min(REPORT_SECONDS, REPORT_SHARE * seconds)
        try:
            run_plans(plans, budget.part(budget.left - reserve), begin)
        except KeyboardInterrupt:
            stopped = ["Stopped by Ctrl-C; what was measured before is here."]
        finally:
            gc.unfreeze()
    axes = [plan.axis for plan in plans if plan.axis.points or plan.axis.left_out]
    return Report(scene_in_words(study), facts(study, seconds, budget.spent), axes, [*stopped, *left_out])


def all_plans(study: Study) -> tuple[List[Plan], List[str]]:
    """What to measure, in order, and the groups that can't be, with the reason."""
    asked, left_out = study.options.groups or tuple(GROUPS), []
    has_style = study.targets is not None
    for group in ("fine-field", "style"):
        if group in asked and not has_style:
            left_out.append(f"{GROUPS[group]}: there is no painting; name one with --style-image.")
    stage1, stage2, quadrature = Stage1(study), Stage2(study), Quadrature(study)
    fine, style = "fine-field" in asked and has_style, "style" in asked and has_style
    plans: List[Plan] = []
    if "training" in asked or study.options.coarse_run is None:
        plans.append(stage1.long_plan())
    if has_style and set(asked) != {"training"}:
        plans.append(stage2.long_plan())
    if "quadrature" in asked:
        plans += quadrature.plans()
    if "rendering" in asked:
        plans += Rendering(study).plans()
    if "precision" in asked:
        plans += PrecisionGroup(study).plans()
    if "training" in asked:
        plans += stage1.short_plans()
    if fine:
        plans += stage2.fine_plans()
    if style:
        plans += stage2.style_plans(after_fine=fine)
    return plans, left_out


def _check_folder(folder: Path) -> None:
    """Makes the folder of the report before anything is measured."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise cant_write(folder, error) from error


class TimeColumn(ProgressColumn):
    """A bar of the time that has been spent."""

    def __init__(self, budget: Budget) -> None:
        super().__init__()
        self.budget = budget

    def render(self, task: Task) -> ProgressBar:
        """The bar as it is now."""
        total = self.budget.end - self.budget.start
        return ProgressBar(total=total, completed=min(total, self.budget.spent), width=40)


@contextmanager
def _progress(console: Console, budget: Budget) -> Iterator[Callable[[Axis], None]]:
    """Shows how much of the time has passed, and what is being measured."""
    columns = (TimeColumn(budget), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, transient=True, refresh_per_second=REFRESHES) as progress:
        task = progress.add_task("loading the scene", total=None)
        yield lambda axis: progress.update(task, description=f"{axis.group}: {axis.title}")


def scene_in_words(study: Study) -> str:
    """fern, 3 photos, 126 × 94."""
    height, width = study.size
    return f"{study.options.data.resolve().name}, {len(study.manager.train_dataset)} photos, {width} × {height}"


def facts(study: Study, seconds: float, spent: float) -> dict[str, Any]:
    """What figures depend on."""
    options = study.options
    backbone = None if study.targets is None else study.targets.backbone.description
    return {
        "device": device_name(study.device),
        "threads": torch.get_num_threads(),
        "versions": versions(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "budget_seconds": seconds,
        "spent_seconds": spent,
        "presets": [study.coarse_config.method_name, study.style_config.method_name],
        "coarse_run": "trained here" if options.coarse_run is None else str(options.coarse_run),
        "style_image": "none" if options.style_image is None else options.style_image.name,
        "feature_network": "none" if backbone is None else f"{backbone.name}, {backbone.source}",
        "held_out_views": [str(view) for view in study.views],
    }


def run(options: Options, seconds: float) -> None:
    """Measures, writes the report, and prints the recommendation."""
    console = Console()
    try:
        report = measure(options, Budget(seconds), console)
    except KeyboardInterrupt:
        raise SystemExit("Stopped before anything was measured.") from None
    page = report.write(options.output_dir)

    def say(*lines: str) -> None:
        console.print(*lines, sep="\n", markup=False, highlight=False, soft_wrap=True)

    say(*(report.recommendation or ["Nothing could be measured in the time there was; give a larger --budget."]))
    left_out = report.everything_left_out()
    if left_out:
        say(f"Left out, {len(left_out)}:", *(f"  {line}" for line in left_out))
    finish(page.resolve(), after_tradeoff(options))
