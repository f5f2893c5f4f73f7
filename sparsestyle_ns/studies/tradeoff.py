"""`sparsestyle tradeoff`: measures all curves within a budget and writes the report, also when it is stopped."""

import gc
import tempfile
import warnings
from dataclasses import replace
from datetime import datetime, timezone
from typing import Dict, List, Tuple

import rich
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.console import Console

from sparsestyle_ns.data.parser_choice import parse_dataparser
from sparsestyle_ns.engine.hints import finish, scene_arguments
from sparsestyle_ns.studies.measure_rendering import altered, baking_plan, precision_plan, quadrature_plans
from sparsestyle_ns.studies.measure_training import StageRuns
from sparsestyle_ns.studies.study import Study
from sparsestyle_ns.studies.study_options import TradeoffOptions
from sparsestyle_ns.studies.time_budget import Budget, Plan, parse_duration, run_plans
from sparsestyle_ns.studies.tradeoff_report import FILES, GROUPS, Fact, Report, report_folder, writing_to
from sparsestyle_ns.studies.workbench import Workbench
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.files import all_or_nothing
from sparsestyle_ns.utils.interrupts import PRESSES, StoppedByCtrlC, stop
from sparsestyle_ns.utils.machine import device_name, versions

STOPPED = "Stopped by Ctrl-C; what was measured before is here."
REPORT_SECONDS = 4.0
REPORT_SHARE = 0.05
"""Time that is kept for writing the report: so many seconds, but no larger part of the budget."""


def tradeoff(options: TradeoffOptions) -> None:
    """Measures, writes the report, and prints the recommendation; an `InputError` if an option can't be used.

    Where nothing could be measured, too; then nothing is left of the report.
    """
    budget_seconds = parse_duration(options.budget)
    if options.rounds < 1:
        raise InputError(f"--rounds is {options.rounds}, but has to be at least 1.")
    study, options = study_of(options), replace(options, output_dir=report_folder(options.output_dir, options.force))
    files = [options.output_dir / name for name in FILES]
    with all_or_nothing([path for path in files if not path.exists()]):
        with writing_to(options.output_dir):  # known before anything is measured
            options.output_dir.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=options.output_dir).close()
        report = _measured(study, options, Budget(budget_seconds))
        page = report.write(options.output_dir)
    lines, left_out = report.recommendation, report.everything_left_out()
    if left_out:
        lines += [f"Left out, {len(left_out)}:", *(f"  {line}" for line in left_out)]
    Console().print(*lines, sep="\n", markup=False, highlight=False, soft_wrap=True)
    config = study.config("coarse-fewshot")
    finish(page.resolve(), ["ns-train", config.method_name, *scene_arguments(config)])
    if STOPPED in report.left_out:
        raise StoppedByCtrlC


def _measured(study: Study, options: TradeoffOptions, budget: Budget) -> Report:
    """What `measure` finds; ends the process, or raises an InputError, where that is nothing."""
    try:
        report = measure(study, options, budget)
        if STOPPED in report.left_out and not report.measured:
            raise StoppedByCtrlC
    except PRESSES:
        stop("Stopped by Ctrl-C before anything was measured.")
    if not report.measured and len(report.left_out) == len(options.groups or GROUPS):
        raise InputError(f"Nothing could be measured: {report.left_out[0]}")
    if not report.measured:
        raise InputError("Nothing could be measured in the time there was; give a larger --budget.")
    return report


def study_of(options: TradeoffOptions) -> Study:
    """The scene and the presets that the options name."""
    named = ("max_image_side", "num_views", "view_ids", "vgg_weights", "backbone")
    settings = {name: getattr(options, name) for name in named}
    return Study(options.data, parse_dataparser(options.dataparser, options.data), draft=not options.full, **settings)


def measure(study: Study, options: TradeoffOptions, budget: Budget) -> Report:
    """Measures what fits into the budget; Ctrl-C ends it, and what has been measured is in the report."""
    seconds, stopped = budget.left, []
    # The lines and warnings of nerfstudio and of the methods stay away from the terminal.
    quiet = altered(CONSOLE, quiet=True), altered(rich.get_console(), quiet=True)
    with quiet[0], quiet[1], warnings.catch_warnings(), Console().status("Loading the scene") as status:
        warnings.simplefilter("ignore")
        bench = Workbench(study, budget, options.style_image, options.coarse_run, options.rounds)
        plans, left_out = all_plans(bench, options)

        def begin(plan: Plan) -> None:
            titles = ", ".join(curve.title for curve in plan.curves)
            status.update(f"{plan.curves[0].group}: {titles}, {budget.spent:.0f} s of {seconds:.0f} s have passed")

        try:
            run_plans(plans, budget.part(budget.left - min(REPORT_SECONDS, REPORT_SHARE * seconds)), begin)
        except PRESSES:
            stopped = [STOPPED]
        finally:
            gc.unfreeze()
    curves = [curve for plan in plans for curve in plan.curves if curve.points or curve.left_out]
    height, width = bench.size
    scene = f"{study.name}, {len(bench.manager.train_dataset)} photos, {width} × {height}"
    return Report(scene, facts(bench, options, seconds), curves, [*stopped, *left_out])


def all_plans(bench: Workbench, options: TradeoffOptions) -> Tuple[List[Plan], List[str]]:
    """What to measure, in order, and the groups that can't be, with the reason."""
    asked, has_style = options.groups or tuple(GROUPS), bench.targets is not None
    of_style = [group for group in ("fine-field", "style") if group in asked]
    reason = "there is no painting; name one with --style-image."
    left_out = [] if has_style else [f"{GROUPS[group]}: {reason}" for group in of_style]
    coarse, style = StageRuns(bench, is_style=False), StageRuns(bench, is_style=True)
    plans = [coarse.long_plan()] if "training" in asked or bench.trains_coarse else []
    if has_style and set(asked) != {"training"}:
        plans.append(style.long_plan())
    if "quadrature" in asked:
        plans += quadrature_plans(bench)
    if "rendering" in asked:
        plans.append(baking_plan(bench))
    if "precision" in asked:
        plans.append(precision_plan(bench))
    if "training" in asked:
        plans.append(coarse.short_plan(["training"]))
    if has_style and of_style:
        plans.append(style.short_plan(of_style))
    return plans, left_out


def facts(bench: Workbench, options: TradeoffOptions, seconds: float) -> Dict[str, Fact]:
    """What figures depend on."""
    backbone = None if bench.targets is None else bench.targets.backbone.description
    return {
        "device": device_name(bench.device),
        "threads": str(torch.get_num_threads()),
        "versions": versions(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "budget_seconds": seconds,
        "spent_seconds": bench.budget.spent,
        "presets": [bench.coarse_config.method_name, bench.style_config.method_name],
        "coarse_run": "trained here" if options.coarse_run is None else str(options.coarse_run),
        "style_image": "none" if options.style_image is None else options.style_image.name,
        "feature_network": "none" if backbone is None else f"{backbone.name}, {backbone.source}",
        "held_out_views": [str(view) for view in bench.views],
    }
