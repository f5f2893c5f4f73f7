"""What rendering the same fields in other ways costs: samples a ray, skipping, early stops, baking, number formats."""

import contextlib
import copy
import functools
import math
from typing import Callable, ContextManager, Dict, Iterator, List, Mapping, Optional, Sequence, Tuple

import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_paths import get_interpolated_camera_path
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from sparsestyle_ns.core.occupancy import Occupancy
from sparsestyle_ns.core.precision import Precision, autocast, multiplies_bfloat16, multiplies_tf32
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.baked import BakedVolume, render_baked
from sparsestyle_ns.rendering.render import POINTS_PER_CALL, render_coarse
from sparsestyle_ns.studies.curves import Curve, Values, decibels, observed_order
from sparsestyle_ns.studies.study import with_setting
from sparsestyle_ns.studies.time_budget import Budget, Case, Plan, in_turns
from sparsestyle_ns.studies.workbench import Model, Workbench, setting_curve

Colors = Float[Tensor, "rays 3"]
Change = Callable[[], ContextManager[None]]
"""Makes a context in which a model renders differently."""

CONVERGED = 16
"""How many times the samples of the finest point the converged render has."""
REFERENCE_SHARE = 0.4
"""Part of the time that the converged render may take; the number of rays follows from it."""
MIN_RAYS, MAX_RAYS = 64, 4096
FACTORS = (1 / 8, 1 / 4, 1 / 2, 1, 2)
"""Numbers of samples, as multiples of the preset's."""
MIN_ALPHAS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3)
MIN_TRANSMITTANCES = (0.0, 1e-4, 1e-3, 1e-2, 1e-1)
RESOLUTIONS = (256, 128, 384, 64)
"""Cells along the cube's side of baked volumes, those that matter most first."""
FRAMES_BETWEEN_VIEWS = 10
"""As `ns-render interpolate` has them."""
FORMAT_RAYS = 2048
"""Rays on which number formats are compared."""
PRECISION = "pipeline.model.precision"


def difference(picture: Colors, reference: Colors) -> Dict[str, float]:
    """Root mean square error of colours, and its PSNR in dB."""
    error = float((picture.double() - reference.double()).square().mean().sqrt())
    return {"rmse": error, "psnr": decibels(error)}


def timed_and_compared(
    bench: Workbench, render: Callable[[RayBundle], Colors], rays: RayBundle, reference: Colors
) -> Dict[str, float]:
    """Seconds, scaled to a view, and difference of one render of some rays."""
    seconds, picture = bench.timed(lambda: render(rays))
    return {"view_seconds": seconds * math.prod(bench.size) / len(rays), **difference(picture, reference)}


@torch.no_grad()
def render_in_chunks(bundle: RayBundle, samples: int, budget: Budget, render: Callable[[RayBundle], Colors]) -> Colors:
    """Renders rays a few at a time, so that memory is bounded and the budget can end in between."""
    rays = max(1, POINTS_PER_CALL // samples)
    parts: List[Tensor] = []
    for start in range(0, len(bundle), rays):
        budget.check()
        parts.append(render(bundle[start : start + rays]))
    return torch.cat(parts)


@contextlib.contextmanager
def altered(thing: object, **values: object) -> Iterator[None]:
    """A config or a model with other values for a while."""
    before = {name: getattr(thing, name) for name in values}
    try:
        for name, value in values.items():
            setattr(thing, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(thing, name, value)


def multiples(preset: int) -> List[int]:
    """The numbers of samples to measure, ascending."""
    return sorted({max(2, round(preset * factor)) for factor in FACTORS})


def quadrature_plans(bench: Workbench) -> List[Plan]:
    """Samples a ray of the coarse field; and steps, skipping and stopping of stage 2's renders, measured together.

    The last three are looked at in the coarse picture that comes with each stylised one: what the residual field says
    of empty cells, which training never visits, means nothing, and a render that skips nothing would show it.
    """

    samples, *marching = (
        setting_curve(config, f"pipeline.model.{setting}", "quadrature", name, title, [("view_seconds", "rmse")])
        for config, setting, name, title in (
            (bench.coarse_config, "num_eval_samples", "samples", "Samples a ray of the coarse field"),
            (bench.style_config, "num_steps", "steps", "Steps along a ray of the stylised field"),
            (bench.style_config, "min_alpha", "skipping", "Opacity below which cells are skipped"),
            (bench.style_config, "min_transmittance", "stopping", "Light left at which a ray ends"),
        )
    )
    return [
        Plan([samples], 3, lambda budget: _measure_samples(bench, samples, budget)),
        Plan(marching, 9, lambda budget: _measure_marching(bench, *marching, budget)),
    ]


def _measure_samples(bench: Workbench, curve: Curve, budget: Budget) -> None:
    model = bench.coarse_to_render()
    changes = _settings(model.config, "num_eval_samples", multiples(model.config.num_eval_samples))
    _sweep(bench, model, "num_eval_samples", {curve: changes}, contextlib.nullcontext, budget)


def _measure_marching(bench: Workbench, steps: Curve, skipping: Curve, stopping: Curve, budget: Budget) -> None:
    model = bench.model_to_render()
    config = model.config
    grids = occupancies(model, sorted({*MIN_ALPHAS, config.min_alpha}), budget)
    transmittances = sorted({*MIN_TRANSMITTANCES, config.min_transmittance})
    changes = {
        steps: _settings(config, "num_steps", multiples(config.num_steps)),
        skipping: {alpha: functools.partial(altered, model, occupancy=grid) for alpha, grid in grids.items()},
        stopping: _settings(config, "min_transmittance", transmittances),
    }

    @contextlib.contextmanager
    def nothing_skipped() -> Iterator[None]:
        everywhere = Occupancy(1).to(model.device)
        with altered(model, occupancy=everywhere), altered(config, min_transmittance=0.0):
            yield

    _sweep(bench, model, "num_steps", changes, nothing_skipped, budget)


def _settings(config: object, name: str, values: Sequence[float]) -> Dict[float, Change]:
    return {value: functools.partial(altered, config, **{name: value}) for value in values}


def _sweep(
    bench: Workbench,
    model: Model,
    samples: str,
    changes: Mapping[Curve, Mapping[float, Change]],
    nothing_skipped: Change,
    budget: Budget,
) -> None:
    """Renders some rays of held-out views in different ways, and compares with a converged render, `nothing_skipped`.

    The first curve's setting is `samples`; `changes` has of each curve the values, and what gives the model this value.
    """
    output = "rgb" if model is bench.coarse_model else "rgb_coarse"
    preset = getattr(model.config, samples)
    converged = CONVERGED * max(multiples(preset))

    def render(bundle: RayBundle) -> Colors:
        count = getattr(model.config, samples)
        return render_in_chunks(bundle, count, budget, lambda part: model.get_outputs(part)[output])

    probe = bench.some_rays(MIN_RAYS)
    render(probe)
    seconds_a_ray = bench.timed(lambda: render(probe))[0] / len(probe) * converged / preset
    fitting = int(REFERENCE_SHARE * budget.left / max(seconds_a_ray, 1e-12))
    rays = bench.some_rays(min(MAX_RAYS, max(MIN_RAYS, fitting)))
    with nothing_skipped(), altered(model.config, **{samples: converged}):
        reference = render(rays)
    height, width = bench.size
    for curve in changes:
        curve.own_error = bench.own_error
        curve.note = (
            f"{len(rays)} random rays of held-out views, against {converged} samples a ray with nothing skipped and no "
            f"early stop; seconds are scaled to a view of {width} × {height}."
        )

    def case(curve: Curve, value: float, change: Change) -> Case:
        def measure(_round: int) -> Mapping[str, Values]:
            with change():
                return {"": timed_and_compared(bench, render, rays, reference)}

        return Case([(curve, value)], measure)

    cases = [case(curve, *change) for curve, ways in changes.items() for change in ways.items()]
    in_turns(cases, budget, bench.rounds, bench.watch)
    first, *_ = changes
    errors = [point.median("rmse") for point in first.points]
    first.order = observed_order([int(point.setting) for point in first.points], errors)


@torch.no_grad()
def occupancies(model: HierStyleModel, thresholds: Sequence[float], budget: Budget) -> Dict[float, Occupancy]:
    """The occupied cells for several thresholds; the field is evaluated once for all of them, if there is time."""
    densities: List[Tensor] = []

    def evaluate(points: Tensor) -> Tensor:
        budget.check()
        with autocast(model.device, model.config.precision):
            densities.append(model.field.density_and_feature(points)[0])
        return densities[-1]

    grids = {threshold: Occupancy(model.config.occupancy_resolution).to(model.device) for threshold in thresholds}
    for threshold, grid in grids.items():
        known = iter(densities) if densities else None
        grid.measure(evaluate if known is None else lambda _, known=known: next(known), threshold, POINTS_PER_CALL)
    return grids


def baking_plan(bench: Workbench) -> Plan:
    """Exact pictures, and baked ones of several resolutions."""
    title, flag, plots = "Exact and baked pictures", "--pipeline.model.bake-resolution", [("fps", "psnr")]
    curve = Curve("rendering", "baking", title, flag, "exact", "view_seconds", "rmse", plots)
    return Plan([curve], 7, lambda budget: _measure_baking(bench, curve, budget))


def _measure_baking(bench: Workbench, curve: Curve, budget: Budget) -> None:
    model, flight = bench.model_to_render(), _flight(bench)
    height, width = bench.size
    what = "the stylised scene" if bench.is_stylised else "the coarse field (there is no painting)"
    curve.own_error = bench.own_error
    curve.note = (
        f"Pictures of {what}, {width} × {height}, on a flight between views, each from a camera not seen before; "
        "PSNR is against the exact picture. A baked volume's first picture takes longer: it fills the voxels "
        "(render_mode: baked)."
    )
    volumes: Dict[int, BakedVolume] = {}
    exact: Dict[int, Colors] = {}

    def draw(frame: int, volume: Optional[BakedVolume]) -> Tuple[float, Colors]:
        def render(rays: RayBundle) -> Colors:
            if volume is None:
                return model.get_outputs(rays)["rgb" if bench.is_stylised else "rgb_coarse"]
            segments = model.space.segments(rays.origins, rays.directions)
            fine, coarse = render_baked([volume], segments, model.marching, model.background)
            return fine.rgb if bench.is_stylised else coarse.rgb

        at = frame % len(flight)
        rays = flight[at : at + 1].generate_rays(camera_indices=0, keep_shape=False).flatten()
        return bench.timed(lambda: render_in_chunks(rays, model.config.num_steps, budget, render))

    def measure_exact(round_: int) -> Mapping[str, Values]:
        if not exact:
            draw(0, None)  # the first takes longer
        seconds, exact[round_ + 1] = draw(round_ + 1, None)
        return {"": {"view_seconds": seconds, "fps": 1 / seconds, "rmse": 0.0, "psnr": math.inf}}

    def measure_baked(resolution: int, round_: int) -> Mapping[str, Values]:
        found: Dict[str, float] = {}
        if resolution not in volumes:
            volumes[resolution] = model.bake(resolution)
            found["first_seconds"], _ = draw(0, volumes[resolution])
        # A frame that there is no exact picture of is replaced by the latest that there is one of.
        frame = min(round_ + 1, max(exact))
        seconds, picture = draw(frame, volumes[resolution])
        found |= {"memory_mb": volumes[resolution].num_bytes / 1e6, "view_seconds": seconds, "fps": 1 / seconds}
        return {"": {**found, **difference(picture, exact[frame])}}

    cases = [Case([(curve, curve.preset)], measure_exact)]
    for resolution in dict.fromkeys((*RESOLUTIONS, model.config.bake_resolution)):
        cases.append(Case([(curve, resolution)], functools.partial(measure_baked, resolution)))
    in_turns(cases, budget, bench.rounds, bench.watch)


def _flight(bench: Workbench) -> Cameras:
    """A camera that flies from one view to the next."""
    cameras = bench.eval_dataset.cameras if len(bench.eval_dataset) > 1 else bench.manager.train_dataset.cameras
    if len(cameras) > 1:
        cameras = get_interpolated_camera_path(cameras[:2], FRAMES_BETWEEN_VIEWS, order_poses=False)
    return cameras.to(bench.device)


def precision_plan(bench: Workbench) -> Plan:
    """Number formats of matrix products, those that the device has."""
    title, plots = "Number format of matrix products", [("view_seconds", "rmse"), ("step_seconds", "rmse")]
    curve = setting_curve(bench.coarse_config, PRECISION, "precision", "precision", title, plots)
    if curve.preset == "auto":
        curve.preset = "bfloat16" if multiplies_bfloat16(bench.device) else "float32"
    return Plan([curve], 3, lambda budget: _measure_precision(bench, curve, budget))


def _measure_precision(bench: Workbench, curve: Curve, budget: Budget) -> None:
    model, device = bench.coarse_to_render(), bench.device
    has: Dict[Precision, bool] = {"float32": True}
    has |= {"tf32": multiplies_tf32(device), "bfloat16": multiplies_bfloat16(device)}
    curve.left_out += [f"{name}: the device has no instructions for it" for name, there in has.items() if not there]
    curve.own_error = bench.own_error
    rays, samples = bench.some_rays(FORMAT_RAYS), model.config.num_eval_samples
    curve.note = (
        f"{len(rays)} random rays of held-out views of the coarse field, against the same samples in float64; and "
        "iterations of stage 1."
    )
    reference = render_in_chunks(rays, samples, budget, lambda part: in_float64(model, part))

    def render(bundle: RayBundle) -> Colors:
        return render_in_chunks(bundle, samples, budget, lambda part: model.get_outputs(part)["rgb"])

    def case(precision: Precision) -> Case:
        training = bench.start(with_setting(bench.coarse_config, PRECISION, precision), budget)
        training.step()

        def measure(_round: int) -> Mapping[str, Values]:
            with altered(model.config, precision=precision):
                found = timed_and_compared(bench, render, rays, reference)
            budget.check()
            return {"": {**found, "step_seconds": [bench.timed(training.step)[0] for _ in range(3)]}}

        return Case([(curve, precision)], measure)

    in_turns([case(name) for name, there in has.items() if there], budget, bench.rounds, bench.watch)


def in_float64(model: CoarseFewShotModel, bundle: RayBundle) -> Colors:
    """Colours of rays with the same samples, computed in float64."""
    in_float32 = model.space.segments(bundle.origins, bundle.directions)
    edges = model.place_samples(in_float32, model.config.num_eval_samples, None).double()
    background = None if model.background is None else model.background.double()
    directions = bundle.directions.double()
    segments = model.space.segments(bundle.origins.double(), directions)
    field = copy.deepcopy(model.field).double()
    return render_coarse(field, segments, directions, edges, model.space.unbounded, background).rgb
