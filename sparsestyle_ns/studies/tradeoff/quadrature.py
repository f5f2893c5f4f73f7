"""Samples a ray, empty-space skipping and early stopping: error against a converged render of the same field."""

import contextlib
import math
from typing import Any, Callable, Dict, Iterator, List, Sequence, Tuple

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from sparsestyle_ns.core.occupancy import Occupancy
from sparsestyle_ns.core.precision import autocast
from sparsestyle_ns.rendering.render import POINTS_PER_CALL
from sparsestyle_ns.studies.tradeoff.axis import Axis, Values, in_turns
from sparsestyle_ns.studies.tradeoff.budget import Budget, OutOfTimeError
from sparsestyle_ns.studies.tradeoff.pareto import decibels, observed_order
from sparsestyle_ns.studies.tradeoff.plan import Measure, Plan
from sparsestyle_ns.studies.tradeoff.study import Study

CONVERGED = 16
"""How many times the samples of the finest point the converged render has."""
REFERENCE_SHARE = 0.4
"""Part of an axis' time that the converged render may take; the number of rays follows from it."""
MIN_RAYS, MAX_RAYS = 64, 4096
PROBE_RAYS = 64
MIN_ALPHAS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3)
MIN_TRANSMITTANCES = (0.0, 1e-4, 1e-3, 1e-2, 1e-1)
FACTORS = (1 / 8, 1 / 4, 1 / 2, 1, 2)
"""Numbers of samples, as multiples of the preset's."""


def multiples(preset: int) -> Tuple[int, ...]:
    """The numbers of samples to measure, ascending."""
    return tuple(sorted({max(2, round(preset * factor)) for factor in FACTORS}))


def difference(picture: Float[Tensor, "rays 3"], reference: Float[Tensor, "rays 3"]) -> Dict[str, float]:
    """Root mean square error of colours, and its PSNR in dB."""
    error = float((picture.double() - reference.double()).square().mean().sqrt())
    return {"rmse": error, "psnr": decibels(error)}


@torch.no_grad()
def in_chunks(
    bundle: RayBundle, samples: int, budget: Budget, render: Callable[[RayBundle], Float[Tensor, "rays 3"]]
) -> Float[Tensor, "rays 3"]:
    """Renders rays a few at a time, so that memory is bounded and time can end in between.

    Raises:
        OutOfTimeError: it did.
    """
    rays = max(1, POINTS_PER_CALL // samples)
    parts: List[Tensor] = []
    for start in range(0, len(bundle), rays):
        budget.check()
        parts.append(render(bundle[start : start + rays]))
    return torch.cat(parts)


@contextlib.contextmanager
def settings(config: Any, **values: Any) -> Iterator[None]:
    """A model's config with other values for a while."""
    before = {name: getattr(config, name) for name in values}
    vars(config).update(values)
    try:
        yield
    finally:
        vars(config).update(before)


class Renders:
    """Renders some rays of held-out views in different ways, and compares them with a converged render.

    Args:
        render: colours of rays with a number of samples each.
        converged: the same with nothing skipped and no ray ended early.
        finest: the most samples that are compared.
        preset: samples from which the time of a ray is estimated.
    """

    def __init__(
        self,
        study: Study,
        render: Callable[[RayBundle, int], Tensor],
        converged: Callable[[RayBundle, int], Tensor],
        finest: int,
        preset: int,
        budget: Budget,
    ) -> None:
        self.study, self._render = study, render
        probe = study.some_rays(PROBE_RAYS)
        self.render(probe, preset, budget)
        seconds, _ = study.timed(lambda: self.render(probe, preset, budget))
        samples = CONVERGED * finest
        per_ray = seconds / len(probe) * samples / preset
        count = min(MAX_RAYS, max(MIN_RAYS, int(REFERENCE_SHARE * budget.left / max(per_ray, 1e-12))))
        self.rays = study.some_rays(count)
        self.samples = samples
        self.reference = in_chunks(self.rays, samples, budget, lambda part: converged(part, samples))

    def render(self, bundle: RayBundle, samples: int, budget: Budget) -> Tensor:
        """Colours of rays."""
        return in_chunks(bundle, samples, budget, lambda part: self._render(part, samples))

    def measure(self, samples: int, budget: Budget) -> Values:
        """One repetition: seconds a view, and the error."""
        seconds, picture = self.study.timed(lambda: self.render(self.rays, samples, budget))
        scale = self.study.pixels / len(self.rays)
        return {"view_seconds": seconds * scale, **difference(picture, self.reference)}

    @property
    def note(self) -> str:
        """What was compared with what."""
        height, width = self.study.size
        return (
            f"{len(self.rays)} random rays of held-out views, against {self.samples} samples a ray with nothing "
            f"skipped and no early stop; seconds are scaled to a view of {width} × {height}."
        )


class Quadrature:
    """The four axes; the converged render of the frozen fields is shared by three of them."""

    def __init__(self, study: Study) -> None:
        self.study = study
        self._frozen: List[Renders] = []
        self._alphas: Dict[float, Occupancy] = {}

    def plans(self) -> List[Plan]:
        """Samples of the coarse field; steps, skipping and stopping of stage 2's renders.

        The latter are looked at in the coarse picture that comes with each stylised one, by the same samples: what the
        residual field says of empty cells, which training never visits, means nothing, and a render that skips
        nothing would show it.
        """
        coarse, style = self.study.coarse_config.pipeline.model, self.study.style_config.pipeline.model

        def plan(name: str, title: str, setting: str, preset: float, measure: Measure) -> Plan:
            flag = f"--pipeline.model.{setting.replace('_', '-')}"
            plots = [("view_seconds", "rmse")]
            return Plan(Axis("quadrature", name, title, flag, str(preset), "view_seconds", "rmse", plots), 3, measure)

        samples, steps = "Samples a ray of the coarse field", "Steps along a ray of the stylised field"
        alpha, light = "Opacity below which cells are skipped", "Light left at which a ray ends"
        return [
            plan("samples", samples, "num_eval_samples", coarse.num_eval_samples, self._samples),
            plan("steps", steps, "num_steps", style.num_steps, self._steps),
            plan("skipping", alpha, "min_alpha", style.min_alpha, self._skipping),
            plan("stopping", light, "min_transmittance", style.min_transmittance, self._stopping),
        ]

    def _by_number(self, axis: Axis, renders: Renders, numbers: Sequence[int], budget: Budget) -> None:
        axis.note, axis.own_error = renders.note, self.study.own_error

        def case(number: int) -> Callable[[], Values]:
            return lambda: renders.measure(number, budget)

        in_turns(
            axis, {number: case(number) for number in numbers}, budget, self.study.options.rounds, self.study.watch
        )
        axis.order = observed_order(
            [int(point.setting) for point in axis.points], [point.median("rmse") for point in axis.points]
        )

    def _samples(self, axis: Axis, budget: Budget) -> None:
        model = self.study.coarse_model
        if model is None:
            raise OutOfTimeError
        model.eval()
        preset = model.config.num_eval_samples
        numbers = multiples(preset)

        def render(bundle: RayBundle, samples: int) -> Tensor:
            return model.render_rays(bundle, samples)[0].rgb

        renders = Renders(self.study, render, render, max(numbers), preset, budget)
        self._by_number(axis, renders, numbers, budget)

    def _frozen_renders(self, budget: Budget) -> Renders:
        if not self._frozen:
            model = self.study.model_to_render()
            preset = model.config.num_steps

            def render(bundle: RayBundle, steps: int) -> Tensor:
                with settings(model.config, num_steps=steps):
                    return model.get_outputs(bundle)["rgb_coarse"]

            def converged(bundle: RayBundle, steps: int) -> Tensor:
                occupancy, model.occupancy = model.occupancy, Occupancy(1).to(self.study.device)
                try:
                    with settings(model.config, min_transmittance=0.0):
                        return render(bundle, steps)
                finally:
                    model.occupancy = occupancy

            self._frozen.append(Renders(self.study, render, converged, max(multiples(preset)), preset, budget))
        return self._frozen[0]

    def _steps(self, axis: Axis, budget: Budget) -> None:
        renders = self._frozen_renders(budget)
        self._by_number(axis, renders, multiples(self.study.model_to_render().config.num_steps), budget)

    def _stopping(self, axis: Axis, budget: Budget) -> None:
        renders, model = self._frozen_renders(budget), self.study.model_to_render()
        axis.note, axis.own_error = renders.note, self.study.own_error

        def case(threshold: float) -> Callable[[], Values]:
            def measure() -> Values:
                with settings(model.config, min_transmittance=threshold):
                    return renders.measure(model.config.num_steps, budget)

            return measure

        cases = {value: case(value) for value in with_preset(MIN_TRANSMITTANCES, float(axis.preset))}
        in_turns(axis, cases, budget, self.study.options.rounds, self.study.watch)

    def _skipping(self, axis: Axis, budget: Budget) -> None:
        renders, model = self._frozen_renders(budget), self.study.model_to_render()
        axis.note, axis.own_error = renders.note, self.study.own_error
        values = with_preset(MIN_ALPHAS, float(axis.preset))
        grids = self._occupancies(values, budget)

        def case(threshold: float) -> Callable[[], Values]:
            def measure() -> Values:
                before, model.occupancy = model.occupancy, grids[threshold]
                try:
                    return renders.measure(model.config.num_steps, budget)
                finally:
                    model.occupancy = before

            return measure

        in_turns(axis, {value: case(value) for value in values}, budget, self.study.options.rounds, self.study.watch)

    def _occupancies(self, thresholds: Sequence[float], budget: Budget) -> Dict[float, Occupancy]:
        """The occupied cells for several thresholds; the field is evaluated once for all of them."""
        model, densities = self.study.model_to_render(), []
        grids = {}
        for threshold in thresholds:
            grid = Occupancy(model.config.occupancy_resolution).to(self.study.device)
            remembered = iter(list(densities))

            def density(points: Tensor, remembered: Iterator[Tensor] = remembered) -> Tensor:
                known = next(remembered, None)
                if known is None:
                    budget.check()
                    with autocast(self.study.device, model.config.precision):
                        known = model.field.density_and_feature(points)[0]
                    densities.append(known)
                return known

            grid.measure(density, threshold, POINTS_PER_CALL)
            grids[threshold] = grid
        return grids


def with_preset(values: Sequence[float], preset: float) -> Tuple[float, ...]:
    """Values and the preset's, ascending."""
    near = any(math.isclose(value, preset) for value in values)
    return tuple(sorted(values if near else (*values, preset)))
