"""Runs of both stages: what held-out views are like, against the time of training, of an iteration, and memory."""

import gc
import math
import statistics
from typing import Callable, Dict, List, NamedTuple, Sequence, Tuple

from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.studies.curves import Curve, Values
from sparsestyle_ns.studies.study import get_setting, with_setting
from sparsestyle_ns.studies.study_options import Group
from sparsestyle_ns.studies.time_budget import Budget, Case, OutOfTimeError, Plan, in_turns
from sparsestyle_ns.studies.workbench import Workbench, setting_curve, squeezed
from sparsestyle_ns.utils.machine import PeakMemory

LONG_STOPS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1)
SHORT_STOPS = (1 / 4, 1 / 2, 1)
"""Shares of a run at which it is evaluated."""
MIN_ITERATIONS = 3
PROBE_STEPS = 3
"""Iterations from which the time of one is estimated, after one that doesn't count."""
EVALUATION_SHARE = 0.3
"""Part of a run's time that evaluating it may take; how often, and on how many views, follows from it."""
WARM_START_SHARE = 0.8
"""Part of a stylised run's time that its iterations may take; the warm start comes before."""


class Knob(NamedTuple):
    """A setting and the values to measure beside the preset's, those that matter most first."""

    name: str
    title: str
    place: str
    around: Callable[[int], Tuple[int, ...]]


KNOBS: Dict[Group, Tuple[Knob, ...]] = {
    "training": (
        Knob("width", "Width of the field", "pipeline.model.coarse_field.layer_width", lambda n: (n // 2, n // 4)),
        Knob("levels", "Octaves of the encoding", "pipeline.model.coarse_field.num_levels", lambda n: (n - 2, n + 2)),
        Knob("batch", "Rays a batch", "pipeline.datamanager.train_num_rays_per_batch", lambda n: (n // 4, 4 * n)),
    ),
    "fine-field": (
        Knob("hash levels", "Levels of the hash grid", "pipeline.model.hash_levels", lambda n: (n // 2, 2 * n)),
        Knob("resolution", "Finest level's cells", "pipeline.model.max_resolution", lambda n: (n // 2, 2 * n)),
        Knob("table", "Length of a level's table (log2)", "pipeline.model.log2_table_size", lambda n: (n - 2, n - 4)),
    ),
    "style": (
        Knob("feature size", "Size that the feature network sees", "pipeline.feature_side", lambda n: (n // 2, 2 * n)),
        Knob("style features", "Style features that count", "pipeline.style_features", lambda n: (1024, 128)),
    ),
}


class RunPlan(NamedTuple):
    """A run that fits into a time: how many iterations it has, and when and on which views it is evaluated."""

    iterations: int
    stops: List[int]
    views: Sequence[int]


class StageRuns:
    """Runs of one stage: a long one, whose field other curves build on, and short ones for each value of a setting.

    The short runs take equally long in stage 1, whose settings change what an iteration costs; in stage 2 they have
    equally many iterations.
    """

    def __init__(self, bench: Workbench, is_style: bool) -> None:
        self.bench, self.is_style = bench, is_style
        self.preset = bench.style_config if is_style else bench.coarse_config
        self.metrics = ("style_loss", "content_loss") if is_style else ("psnr", "ssim")

    def long_plan(self) -> Plan:
        """Quality over iterations, along one long run."""
        stage, group, weight = ("2", "style", 15) if self.is_style else ("1", "training", 20)
        curve = self._curve(group, f"stage-{stage} iterations", f"Iterations of stage {stage}", "max_num_iterations")
        return Plan([curve], weight, lambda budget: self._long(curve, budget))

    def short_plan(self, groups: Sequence[Group]) -> Plan:
        """All settings of some groups, which share the preset's run."""
        curves = {k: self._curve(group, k.name, k.title, k.place) for group in groups for k in KNOBS[group]}
        weight = (2.5 if self.is_style else 3.5) * (1 + 2 * len(curves))
        return Plan(list(curves.values()), weight, lambda budget: self._short(curves, budget))

    def _curve(self, group: Group, name: str, title: str, place: str) -> Curve:
        time = "step_seconds" if group == "fine-field" else "train_seconds"
        plots = [(time, metric) for metric in self.metrics]
        if group == "fine-field":
            plots.append(("memory_mb", self.metrics[0]))
        return setting_curve(self.preset, place, group, name, title, plots)

    def _config(self) -> SparseStyleTrainerConfig:
        return self.bench.adapted_style_config() if self.is_style else self.preset

    def _fitting(self, config: SparseStyleTrainerConfig, budget: Budget, shares: Sequence[float]) -> RunPlan:
        """A run that fits into the budget; a few iterations, and a view, are tried to find out.

        It is evaluated at `shares` of it, where there is time for all of them.
        """
        bench = self.bench
        budget.check()
        if self.is_style:
            config = with_setting(config, "pipeline.warm_start_steps", 0)
            if bench.scene_views is None:
                bench.start(config, budget)  # freezes the views, once for all runs
                budget.check()
        setup, probe = bench.timed(lambda: bench.start(config, budget))
        seconds_a_step, model = self._seconds_a_step(probe, budget), probe.pipeline.model
        budget.check()
        if type(model) not in bench.view_seconds:
            bench.evaluate(model, bench.views[:1])
        seconds = max(bench.view_seconds[type(model)], 1e-9)
        # At least the last stop, and at least one view.
        shares = shares[-max(1, int(EVALUATION_SHARE * budget.left / seconds)) :]
        views = bench.views[: max(1, int(EVALUATION_SHARE * budget.left / (len(shares) * seconds)))]
        left = budget.left - setup - len(shares) * len(views) * seconds
        fitting = int((WARM_START_SHARE if self.is_style else 1.0) * left / seconds_a_step)
        iterations = min(config.max_num_iterations, max(MIN_ITERATIONS, fitting))
        return RunPlan(iterations, sorted({math.ceil(iterations * share) for share in shares}), views)

    def _seconds_a_step(self, probe: Training, budget: Budget) -> float:
        """Mean over a run's iterations, by a few of them; in stage 2 by a few at each size of the views."""
        starts = {0: 1.0}
        if self.is_style:
            schedules = [level.schedule for level in probe.pipeline.task.levels]
            starts = {schedule.first: float(schedule.length) for schedule in schedules}
        total = 0.0
        for first, length in starts.items():
            probe.num_steps = first
            steps = self.bench.train(probe, first + 1 + PROBE_STEPS, budget)
            total += length * statistics.mean(steps[1:] or steps)
        return total / sum(starts.values())

    def _long(self, curve: Curve, budget: Budget) -> None:
        bench, config = self.bench, self._config()
        plan = self._fitting(config, budget, LONG_STOPS)
        curve.note = (
            f"One run of {config.method_name}, its schedules fitted to {plan.iterations} iterations (the preset has "
            f"{config.max_num_iterations}); mean over {len(plan.views)} held-out views. The clock stands still while "
            f"they are evaluated{', and during preparation and warm start' if self.is_style else ''}."
        )
        training = bench.start(squeezed(config, plan.iterations), budget)
        model, seconds = training.pipeline.model, 0.0
        if self.is_style:
            bench.style_model, bench.is_stylised = model, True
        for stop in plan.stops:
            with bench.watch:
                seconds += sum(bench.train(training, stop, budget, plan.views))
            if not self.is_style and bench.trains_coarse:
                bench.keep_coarse(model)
            values = {"train_seconds": seconds, **bench.evaluate(model, plan.views)}
            curve.add(training.num_steps, values, bench.watch.busy)
            if training.num_steps < stop:
                break

    def _short(self, curves: Dict[Knob, Curve], budget: Budget) -> None:
        bench, config = self.bench, self._config()
        presets = {knob: get_setting(config, knob.place) for knob in curves}
        values = {knob: [n for n in knob.around(preset) if n >= 1] for knob, preset in presets.items()}
        share = budget.left / (1.5 + sum(map(len, values.values())))
        plan = self._fitting(config, budget.part(share), SHORT_STOPS[1:] if self.is_style else SHORT_STOPS)
        what = f"{plan.iterations} iterations" if self.is_style else f"{share:.3g} s with its evaluations"
        for curve in curves.values():
            curve.note = (
                f"One run of {what} for each value, its schedules fitted to them; mean over {len(plan.views)} held-out "
                f"views{', with the features and the painting of the preset for all' if self.is_style else ''}."
            )

        def case(points: Sequence[Tuple[Curve, object]], config: SparseStyleTrainerConfig) -> Case:
            return Case(points, lambda round_: self._run(config, plan, share, budget, round_))

        cases = [case([(curves[knob], preset) for knob, preset in presets.items()], config)]
        for knob, around in values.items():
            cases += [case([(curves[knob], value)], with_setting(config, knob.place, value)) for value in around]
        in_turns(cases, budget, bench.rounds, bench.watch)

    def _run(
        self, config: SparseStyleTrainerConfig, plan: RunPlan, seconds: float, budget: Budget, seed: int
    ) -> Dict[str, Values]:
        """What was found at the stops of one run, and as that of no moment, of its iterations.

        A run of stage 2 that is out of time before its end gives nothing: the others have more iterations.
        """
        bench = self.bench
        gc.collect()  # what is left of the run before would count as this one's memory
        gc.freeze()  # what is there before a run needn't be searched again, which takes most time
        if not self.is_style:
            budget = budget.part(seconds)
            iterations = self._fitting(config, budget, SHORT_STOPS).iterations
            stops = [math.ceil(iterations * stop / plan.iterations) for stop in plan.stops]
            plan = RunPlan(iterations, stops, plan.views)
        training = bench.start(squeezed(config, plan.iterations), budget, seed)
        model, steps, memory, found = training.pipeline.model, [], 0, {}
        for number, stop in enumerate(plan.stops, 1):
            with PeakMemory(bench.device) as peak:
                steps += bench.train(training, stop, budget, plan.views)
            if self.is_style and training.num_steps < stop:
                raise OutOfTimeError
            memory, values = max(memory, peak.bytes), bench.evaluate(model, plan.views)
            done = {"train_seconds": sum(steps), "iterations": training.num_steps}
            found[f"stop {number}"] = {**done, **values}
            if training.num_steps < stop:
                break
        return {**found, "": {"step_seconds": steps[1:] or steps, "memory_mb": memory / 1e6, **values}}
