"""Stage 1: PSNR and SSIM of held-out views against the time of training, along one run for each value of a setting."""

import math
from typing import Dict, List, Optional, Sequence, Tuple

from nerfstudio.engine.trainer import TrainerConfig

from sparsestyle_ns.studies.tradeoff.axis import Axis, Knob, Values, with_setting
from sparsestyle_ns.studies.tradeoff.budget import Budget, OutOfTimeError
from sparsestyle_ns.studies.tradeoff.plan import Plan
from sparsestyle_ns.studies.tradeoff.study import Study, squeezed

LONG_STOPS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1)
SHORT_STOPS = (1 / 4, 1 / 2, 1)
"""Shares of a run at which it is evaluated."""
MIN_ITERATIONS = 3
PLOTS = [("train_seconds", "psnr"), ("train_seconds", "ssim")]

Moments = List[Tuple[str, Values, bool]]
"""(when, what was found, whether the machine was busy) along a run."""


def stops_of(iterations: int, shares: Sequence[float]) -> List[int]:
    """Ascending, different iterations, from 1 on, at shares of a run."""
    return sorted({max(1, math.ceil(iterations * share)) for share in shares})


class Stage1:
    """One long run, whose field all other axes build on, and short ones of equal time, one for each value."""

    def __init__(self, study: Study) -> None:
        self.study = study
        model = study.coarse_config.pipeline.model
        rays = study.coarse_config.pipeline.datamanager.train_num_rays_per_batch
        width, levels = model.coarse_field.layer_width, model.coarse_field.num_levels
        field = "pipeline.model.coarse_field"
        batch = "pipeline.datamanager.train_num_rays_per_batch"
        self.knobs = (
            Knob("width", "Width of the coarse field", f"{field}.layer_width", (width // 2, width // 4)),
            Knob("levels", "Octaves of the encoding", f"{field}.num_levels", (levels - 2, levels + 2)),
            Knob("batch", "Rays a batch", batch, (rays // 4, rays * 4)),
        )
        self._presets: Dict[int, Moments] = {}
        self._seconds: Optional[float] = None
        self._views: List[int] = []
        self._stops: Sequence[float] = SHORT_STOPS

    def long_plan(self) -> Plan:
        """The long run."""
        preset = str(self.study.coarse_config.max_num_iterations)
        axis = Axis(
            *("training", "stage-1 iterations", "Iterations of stage 1", "--max-num-iterations", preset),
            *("train_seconds", "psnr", PLOTS),
        )
        return Plan(axis, 20, self._long)

    def short_plans(self) -> List[Plan]:
        """A plan for each setting. The first has the preset's run beside its own."""
        plans = []
        for knob in self.knobs:
            preset = str(knob.read(self.study.coarse_config))
            axis = Axis("training", knob.name, knob.title, knob.flag, preset, "train_seconds", "psnr", PLOTS)
            runs = len(knob.values) + (not plans)
            plans.append(Plan(axis, 3.5 * runs, lambda axis, budget, knob=knob: self._short(axis, knob, budget)))
        return plans

    def _step_seconds(self, config: TrainerConfig, budget: Budget) -> float:
        """Seconds of an iteration, from a few; makes sure that the time of a held-out view is known."""
        probe = self.study.start(config, budget)
        seconds = self.study.step_seconds(probe, budget)
        if not self.study.coarse_view_seconds:
            self.study.estimate_coarse_view(probe.pipeline.model)
        return seconds

    def _long(self, axis: Axis, budget: Budget) -> None:
        study, config = self.study, self.study.coarse_config
        step = self._step_seconds(config, budget)
        stops = study.stops_that_fit(budget, LONG_STOPS, study.coarse_view_seconds)
        views = study.views_that_fit(budget, len(stops), study.coarse_view_seconds)
        iterations = self._fitting(config, step, budget, len(stops), len(views))
        axis.note = (
            f"One run of {config.method_name}, its schedules fitted to {iterations} iterations (the preset has "
            f"{config.max_num_iterations}); mean over {len(views)} held-out views. The clock stands still while they "
            "are evaluated."
        )
        training = study.start(squeezed(config, iterations), budget)
        model = training.pipeline.model
        reserve = len(views) * study.coarse_view_seconds
        for checkpoint in study.train(training, stops_of(iterations, stops), budget, reserve):
            if study.options.coarse_run is None:
                study.keep_coarse(model)
            values = {"train_seconds": checkpoint.seconds, **study.evaluate_coarse(model, views)}
            axis.add(checkpoint.iterations, values, checkpoint.busy)

    def _fitting(self, config: TrainerConfig, step: float, budget: Budget, stops: int, views: int) -> int:
        """How many iterations fit, besides evaluating."""
        left = budget.left - stops * views * self.study.coarse_view_seconds
        return min(config.max_num_iterations, max(MIN_ITERATIONS, int(left / step)))

    def _run(self, config: TrainerConfig, budget: Budget, seed: int) -> Moments:
        study = self.study
        step = self._step_seconds(config, budget)
        if not self._views:
            self._stops = study.stops_that_fit(budget, SHORT_STOPS, study.coarse_view_seconds)
            self._views = study.views_that_fit(budget, len(self._stops), study.coarse_view_seconds)
        iterations = self._fitting(config, step, budget, len(self._stops), len(self._views))
        training = study.start(squeezed(config, iterations), budget, seed)
        moments: Moments = []
        reserve = len(self._views) * study.coarse_view_seconds
        stops = stops_of(iterations, self._stops)
        try:
            for number, checkpoint in enumerate(study.train(training, stops, budget, reserve)):
                values: Values = {"train_seconds": checkpoint.seconds, "iterations": checkpoint.iterations}
                values.update(study.evaluate_coarse(training.pipeline.model, self._views))
                moments.append((f"stop {number + 1}", values, checkpoint.busy))
        except OutOfTimeError:
            if not moments:
                raise
        return moments

    def _short(self, axis: Axis, knob: Knob, budget: Budget) -> None:
        study = self.study
        preset = knob.read(study.coarse_config)
        values = [preset, *(value for value in knob.values if value >= 1)]
        if self._seconds is None:
            self._seconds = budget.left / len(values)
        try:
            for round_ in range(study.options.rounds):
                for value in values:
                    moments = self._presets.get(round_) if value == preset else None
                    if moments is None and budget.left >= 0.8 * self._seconds:
                        config = with_setting(study.coarse_config, knob.path, value)
                        moments = self._run(config, budget.part(self._seconds), seed=round_)
                    if value == preset and moments:
                        self._presets[round_] = moments
                    for moment, found, busy in moments or []:
                        axis.add(value, found, busy, moment)
        finally:
            axis.left_out += [f"{value}: no time was left" for value in values if axis.last(value) is None]
            axis.note = (
                f"One run for each value, {self._seconds:.3g} s each with its evaluations, schedules fitted to the "
                f"iterations that fit; {len(self._views)} held-out views."
            )
