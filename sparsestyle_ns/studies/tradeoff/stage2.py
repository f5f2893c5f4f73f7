"""Stage 2: style and content loss of held-out views, against the time of a run, of an iteration, and memory."""

from dataclasses import dataclass, field
from typing import Dict, List, Optional, Sequence, Tuple

from nerfstudio.engine.trainer import TrainerConfig

from sparsestyle_ns.studies.tradeoff.axis import Axis, Knob, Values, with_setting
from sparsestyle_ns.studies.tradeoff.budget import Budget, Costs, OutOfTimeError
from sparsestyle_ns.studies.tradeoff.plan import Plan
from sparsestyle_ns.studies.tradeoff.stage1 import LONG_STOPS, MIN_ITERATIONS, Moments, stops_of
from sparsestyle_ns.studies.tradeoff.study import PeakMemory, Study, squeezed

SHORT_STOPS = (1 / 2, 1)
WARM_START_SHARE = 0.8
"""Part of a run's time that its iterations may take; the warm start comes before."""
SPREAD_WARM_UP = 1
"""Iterations that don't count for the time of one."""


@dataclass
class Run:
    """A short run.

    Attributes:
        moments: what was found along it.
        steps: seconds of each iteration.
        memory: peak bytes during them.
    """

    moments: Moments = field(default_factory=list)
    steps: List[float] = field(default_factory=list)
    memory: int = 0


class Stage2:
    """One long run, whose field is rendered, and short ones with equally many iterations, one for each value."""

    def __init__(self, study: Study) -> None:
        self.study = study
        pipeline = study.style_config.pipeline
        model, side = pipeline.model, pipeline.feature_side
        levels, finest, table = model.hash_levels, model.max_resolution, model.log2_table_size
        tables = (table - 2, table - 4)
        self.fine_knobs = (
            Knob("hash levels", "Levels of the hash grid", "pipeline.model.hash_levels", (levels // 2, levels * 2)),
            Knob("resolution", "Finest level's cells", "pipeline.model.max_resolution", (finest // 2, finest * 2)),
            Knob("table", "Length of a level's table (log2)", "pipeline.model.log2_table_size", tables),
        )
        sides = (side // 2, side * 2)
        self.style_knobs = (
            Knob("feature size", "Size that the feature network sees", "pipeline.feature_side", sides),
            Knob("style features", "Style features that count", "pipeline.style_features", (1024, 128)),
        )
        self._presets: Dict[int, Run] = {}
        self._iterations: Optional[int] = None
        self._views: List[int] = []
        self._stops: Sequence[float] = SHORT_STOPS
        self._costs = Costs()

    def long_plan(self) -> Plan:
        """The long run: style loss over iterations."""
        preset = str(self.study.style_config.max_num_iterations)
        axis = Axis(
            *("style", "stage-2 iterations", "Iterations of stage 2", "--max-num-iterations", preset),
            *("train_seconds", "style_loss", [("train_seconds", "style_loss"), ("train_seconds", "content_loss")]),
        )
        return Plan(axis, 15, self._long)

    def fine_plans(self) -> List[Plan]:
        """The shape of the hash grid. The first has the preset's run beside its own."""
        plots = [("step_seconds", "style_loss"), ("step_seconds", "content_loss"), ("memory_mb", "style_loss")]
        return self._plans("fine-field", self.fine_knobs, "step_seconds", plots, extra_run=True)

    def style_plans(self, after_fine: bool) -> List[Plan]:
        """What the losses look at. The first has the preset's run where no other plan comes before."""
        plots = [("train_seconds", "style_loss"), ("train_seconds", "content_loss")]
        return self._plans("style", self.style_knobs, "train_seconds", plots, extra_run=not after_fine)

    def _plans(
        self,
        group: str,
        knobs: Sequence[Knob],
        time: str,
        plots: List[Tuple[str, str]],
        extra_run: bool,
    ) -> List[Plan]:
        plans = []
        for knob in knobs:
            preset = str(knob.read(self.study.style_config))
            axis = Axis(group, knob.name, knob.title, knob.flag, preset, time, "style_loss", plots)
            runs = len(knob.values) + (extra_run and not plans)
            plans.append(Plan(axis, 2.5 * runs, lambda axis, budget, knob=knob: self._short(axis, knob, budget)))
        return plans

    def _config(self, budget: Budget) -> TrainerConfig:
        budget.check()
        if self.study.coarse_model is None:
            raise OutOfTimeError
        return self.study.adapted_style_config()

    def _plan_run(
        self, config: TrainerConfig, budget: Budget, shares: Sequence[float]
    ) -> Tuple[int, Sequence[float], List[int]]:
        """How many iterations fit into the budget of a run, where to stop, and the held-out views to look at."""
        study = self.study
        cold = with_setting(config, "pipeline.warm_start_steps", 0)
        if not study.shared.frozen:
            study.start(cold, budget)  # freezes the views, once for all runs
            budget.check()
        setup, probe = study.timed(lambda: study.start(cold, budget))
        step = study.step_seconds(probe, budget)
        if not study.style_view_seconds:
            study.estimate_style_view(probe.pipeline.model)
        stops = study.stops_that_fit(budget, shares, study.style_view_seconds)
        views = study.views_that_fit(budget, len(stops), study.style_view_seconds)
        left = budget.left - setup - len(stops) * len(views) * study.style_view_seconds
        fitting = max(MIN_ITERATIONS, int(WARM_START_SHARE * left / step))
        return min(config.max_num_iterations, fitting), stops, views

    def _long(self, axis: Axis, budget: Budget) -> None:
        study, config = self.study, self._config(budget)
        iterations, stops, views = self._plan_run(config, budget, LONG_STOPS)
        axis.note = (
            f"One run of {config.method_name}, its schedules fitted to {iterations} iterations (the preset has "
            f"{config.max_num_iterations}); mean over {len(views)} held-out views. The clock stands still while they "
            "are evaluated, and doesn't run during preparation and warm start."
        )
        training = study.start(squeezed(config, iterations), budget)
        model = training.pipeline.model
        study.keep_style(model)
        reserve = len(views) * study.style_view_seconds
        for checkpoint in study.train(training, stops_of(iterations, stops), budget, reserve):
            values = {"train_seconds": checkpoint.seconds, **study.evaluate_style(model, views)}
            axis.add(checkpoint.iterations, values, checkpoint.busy)

    def _run(self, config: TrainerConfig, budget: Budget, seed: int) -> Run:
        study, run = self.study, Run()
        assert self._iterations is not None
        study.collect_garbage()  # what is left of the run before would count as this one's memory
        training = study.start(squeezed(config, self._iterations), budget, seed)
        reserve = len(self._views) * study.style_view_seconds
        stops = stops_of(self._iterations, self._stops)
        checkpoints = study.train(training, stops, budget, reserve, run.steps)
        for number in range(len(stops)):
            with PeakMemory(study.device) as memory:
                checkpoint = next(checkpoints)
            if checkpoint.iterations < stops[number]:
                raise OutOfTimeError  # fewer iterations than the others have can't be set beside them
            run.memory = max(run.memory, memory.bytes)
            values: Values = {"train_seconds": checkpoint.seconds, "iterations": checkpoint.iterations}
            values.update(study.evaluate_style(training.pipeline.model, self._views))
            run.moments.append((f"stop {number + 1}", values, checkpoint.busy))
        return run

    def _short(self, axis: Axis, knob: Knob, budget: Budget) -> None:
        study, config = self.study, self._config(budget)
        preset = knob.read(config)
        values = [preset, *(value for value in knob.values if value >= 1)]
        try:
            if self._iterations is None:
                part = budget.part(budget.left / (len(values) + 0.5))
                self._iterations, self._stops, self._views = self._plan_run(config, part, SHORT_STOPS)
            for round_ in range(study.options.rounds):
                for value in values:
                    run = self._presets.get(round_) if value == preset else None
                    name = "preset" if value == preset else f"{knob.path} {value}"
                    if run is None and budget.left > self._costs.expected(name):
                        start = study.clock()
                        run = self._run(with_setting(config, knob.path, value), budget, seed=round_)
                        self._costs.note(name, study.clock() - start)
                    if value == preset and run is not None:
                        self._presets[round_] = run
                    if run is not None:
                        self._add(axis, value, run)
        finally:
            axis.left_out += [f"{value}: no time was left" for value in values if axis.last(value) is None]
            if self._iterations is not None:
                axis.note = (
                    f"One run of {self._iterations} iterations for each value, schedules fitted to them; mean over "
                    f"{len(self._views)} held-out views, with the preset's features and painting for all."
                )

    def _add(self, axis: Axis, value: object, run: Run) -> None:
        """Adds a run: its end, with the time of an iteration; or its moments, where time is that of the run."""
        if axis.time == "train_seconds":
            for moment, found, busy in run.moments:
                axis.add(value, found, busy, moment)
            return
        _, found, _ = run.moments[-1]
        losses = {name: found[name] for name in ("style_loss", "content_loss")}
        steps = run.steps[SPREAD_WARM_UP:] or run.steps
        busy = any(moment[2] for moment in run.moments)
        axis.add(value, {"step_seconds": steps, "memory_mb": run.memory / 1e6, **losses}, busy)
