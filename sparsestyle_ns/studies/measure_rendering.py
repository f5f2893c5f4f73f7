"""What rendering the same fields in other ways costs: samples a ray, skipping, early stops, baking, number formats."""

import contextlib
import copy
import functools
import itertools
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
from sparsestyle_ns.rendering.baked import render_baked
from sparsestyle_ns.rendering.render import POINTS_PER_CALL, render_coarse
from sparsestyle_ns.studies.curves import Curve, Values
from sparsestyle_ns.studies.pareto import decibels, observed_order
from sparsestyle_ns.studies.study import flag_of, get_setting, with_setting
from sparsestyle_ns.studies.time_budget import Budget, Case, OutOfTimeError, Plan, in_turns
from sparsestyle_ns.studies.workbench import Model, Workbench

Colors = Float[Tensor, "rays 3"]
Change = Callable[[], ContextManager[None]]
"""Makes a context in which a model renders differently."""

CONVERGED = 16
"""How many times the samples of the finest point the converged render has."""
REFERENCE_SHARE = 0.4
"""Part of the time that the converged render may take; the number of rays follows from it."""
MIN_RAYS, MAX_RAYS = 64, 4096
PROBE_RAYS = 64
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


@torch.no_grad()
def in_chunks(bundle: RayBundle, samples: int, budget: Budget, render: Callable[[RayBundle], Colors]) -> Colors:
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


# ------------------------------------------------------------------------------------------------------- quadrature


def multiples(preset: int) -> Tuple[int, ...]:
    """The numbers of samples to measure, ascending."""
    return tuple(sorted({max(2, round(preset * factor)) for factor in FACTORS}))


def with_preset(values: Sequence[float], preset: float) -> Tuple[float, ...]:
    """Values and the preset's, ascending."""
    near = any(math.isclose(value, preset) for value in values)
    return tuple(sorted(values if near else (*values, preset)))


def quadrature_plans(bench: Workbench) -> List[Plan]:
    """Samples a ray of the coarse field; and steps, skipping and stopping of stage 2's renders, measured together.

    The last three are looked at in the coarse picture that comes with each stylised one, by the same samples, and share
    a converged render: what the residual field says of empty cells, which training never visits, means nothing, and a
    render that skips nothing would show it.
    """

    def curve(name: str, title: str, place: str) -> Curve:
        config = bench.coarse_config if name == "samples" else bench.style_config
        preset, plots = str(get_setting(config, place)), [("view_seconds", "rmse")]
        return Curve("quadrature", name, title, flag_of(place), preset, *plots[0], plots)

    samples = curve("samples", "Samples a ray of the coarse field", "pipeline.model.num_eval_samples")
    marching = [
        curve("steps", "Steps along a ray of the stylised field", "pipeline.model.num_steps"),
        curve("skipping", "Opacity below which cells are skipped", "pipeline.model.min_alpha"),
        curve("stopping", "Light left at which a ray ends", "pipeline.model.min_transmittance"),
    ]
    return [
        Plan([samples], 3, lambda budget: _measure_samples(bench, samples, budget)),
        Plan(marching, 9, lambda budget: _measure_marching(bench, *marching, budget)),
    ]


def _measure_samples(bench: Workbench, curve: Curve, budget: Budget) -> None:
    if bench.coarse_model is None:
        raise OutOfTimeError
    config = bench.coarse_model.eval().config
    changes = _settings(config, "num_eval_samples", multiples(config.num_eval_samples))
    _sweep(bench, bench.coarse_model, "num_eval_samples", {curve: changes}, contextlib.nullcontext, budget)


def _measure_marching(bench: Workbench, steps: Curve, skipping: Curve, stopping: Curve, budget: Budget) -> None:
    model = bench.model_to_render()
    config = model.config
    grids = occupancies(model, with_preset(MIN_ALPHAS, float(skipping.preset)), budget)
    changes = {
        steps: _settings(config, "num_steps", multiples(config.num_steps)),
        skipping: {alpha: functools.partial(altered, model, occupancy=grid) for alpha, grid in grids.items()},
        stopping: _settings(config, "min_transmittance", with_preset(MIN_TRANSMITTANCES, float(stopping.preset))),
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
    """Renders some rays of held-out views in different ways, and compares with a converged render.

    Args:
        samples: name of the setting that says how many samples a ray has.
        changes: of each curve the values, and what gives the model this value.
        nothing_skipped: keeps the model from leaving out samples, for the converged render.
    """
    output = "rgb" if model is bench.coarse_model else "rgb_coarse"
    preset = getattr(model.config, samples)
    converged = CONVERGED * max(multiples(preset))

    def render(bundle: RayBundle) -> Colors:
        count = getattr(model.config, samples)
        return in_chunks(bundle, count, budget, lambda part: model.get_outputs(part)[output])

    probe = bench.some_rays(PROBE_RAYS)
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
                seconds, picture = bench.timed(lambda: render(rays))
            return {"": {"view_seconds": seconds * bench.pixels / len(rays), **difference(picture, reference)}}

        return Case([(curve, value)], measure)

    cases = [case(curve, *change) for curve, ways in changes.items() for change in ways.items()]
    in_turns(cases, budget, bench.rounds, bench.watch)
    by_number, *_ = changes
    numbers = [int(point.setting) for point in by_number.points]
    by_number.order = observed_order(numbers, [point.median("rmse") for point in by_number.points])


def occupancies(model: HierStyleModel, thresholds: Sequence[float], budget: Budget) -> Dict[float, Occupancy]:
    """The occupied cells for several thresholds; the field is evaluated once for all of them.

    Raises:
        OutOfTimeError: the time was over before it was evaluated everywhere.
    """
    densities: List[Tensor] = []
    grids = {threshold: Occupancy(model.config.occupancy_resolution).to(model.device) for threshold in thresholds}
    for threshold, grid in grids.items():
        calls = itertools.count()

        def density(points: Tensor, calls: Iterator[int] = calls) -> Tensor:
            number = next(calls)
            if number == len(densities):
                budget.check()
                with autocast(model.device, model.config.precision):
                    densities.append(model.field.density_and_feature(points)[0])
            return densities[number]

        with torch.no_grad():
            grid.measure(density, threshold, POINTS_PER_CALL)
    return grids


# ------------------------------------------------------------------------------------------------ exact and baked


def baking_plan(bench: Workbench) -> Plan:
    """Exact pictures, and baked ones of several resolutions."""
    title, flag, plots = "Exact and baked pictures", "--pipeline.model.bake-resolution", [("fps", "psnr")]
    curve = Curve("rendering", "baking", title, flag, "exact", "view_seconds", "rmse", plots)
    return Plan([curve], 7, lambda budget: _measure_baking(bench, curve, budget))


def _measure_baking(bench: Workbench, curve: Curve, budget: Budget) -> None:
    model = bench.model_to_render()
    height, width = bench.size
    what = "the stylised scene" if bench.is_stylised else "the coarse field (there is no painting)"
    curve.own_error = bench.own_error
    curve.note = (
        f"Pictures of {what}, {width} × {height}, on a flight between views, each from a camera not seen before; "
        "PSNR is against the exact picture. A baked volume's first picture takes longer: it fills the voxels "
        "(render_mode: baked)."
    )
    own, flight, volumes = model.config.bake_resolution, _flight(bench), {}
    exact: Dict[int, Colors] = {}

    def draw(frame: int, resolution: Optional[int]) -> Tuple[float, Colors]:
        def render(rays: RayBundle) -> Colors:
            if resolution is None:
                return bench.picture(model.get_outputs(rays))
            segments = model.space.segments(rays.origins, rays.directions)
            fine, coarse = render_baked([volumes[resolution]], segments, model.marching, model.background)
            return fine.rgb if bench.is_stylised else coarse.rgb

        at = frame % len(flight)
        rays = flight[at : at + 1].generate_rays(camera_indices=0, keep_shape=False).flatten()
        return bench.timed(lambda: in_chunks(rays, model.config.num_steps, budget, render))

    def case(resolution: Optional[int]) -> Case:
        def measure(round_: int) -> Mapping[str, Values]:
            first: Dict[str, float] = {}
            if resolution is None and not exact:
                draw(0, None)  # the first takes longer
            elif resolution is not None and resolution not in volumes:
                volumes[resolution] = model.bake(resolution)
                first["first_seconds"], _ = draw(0, resolution)
            # A frame that another case has no exact picture of is compared with the latest that there is one of.
            frame = round_ + 1 if resolution is None else min(round_ + 1, max(exact))
            seconds, picture = draw(frame, resolution)
            if resolution is None:
                exact[frame] = picture
            else:
                first["memory_mb"] = volumes[resolution].num_bytes / 1e6
            return {"": {**first, "view_seconds": seconds, "fps": 1 / seconds, **difference(picture, exact[frame])}}

        return Case([(curve, resolution or curve.preset)], measure)

    resolutions = [None, *RESOLUTIONS, *([own] if own not in RESOLUTIONS else [])]
    in_turns([case(resolution) for resolution in resolutions], budget, bench.rounds, bench.watch)


def _flight(bench: Workbench) -> Cameras:
    """A camera that flies from one view to the next."""
    cameras = bench.eval_dataset.cameras
    if len(cameras) < 2:
        cameras = bench.manager.train_dataset.cameras
    path = cameras[:1]
    if len(cameras) > 1:
        path = get_interpolated_camera_path(cameras[:2], FRAMES_BETWEEN_VIEWS, order_poses=False)
    return path.to(bench.device)


# ---------------------------------------------------------------------------------------------------- number formats


def precision_plan(bench: Workbench) -> Plan:
    """Number formats of matrix products, those that the device has."""
    preset = bench.coarse_config.pipeline.model.precision
    if preset == "auto":
        preset = "bfloat16" if multiplies_bfloat16(bench.device) else "float32"
    title, plots = "Number format of matrix products", [("view_seconds", "rmse"), ("step_seconds", "rmse")]
    curve = Curve("precision", "precision", title, flag_of(PRECISION), preset, *plots[0], plots)
    return Plan([curve], 3, lambda budget: _measure_precision(bench, curve, budget))


def _measure_precision(bench: Workbench, curve: Curve, budget: Budget) -> None:
    model = bench.coarse_model
    if model is None:
        raise OutOfTimeError
    model.eval()
    has: Dict[Precision, bool] = {
        "float32": True,
        "tf32": multiplies_tf32(bench.device),
        "bfloat16": multiplies_bfloat16(bench.device),
    }
    curve.left_out += [f"{name}: the device has no instructions for it" for name, there in has.items() if not there]
    curve.own_error = bench.own_error
    bundle, samples = bench.some_rays(FORMAT_RAYS), model.config.num_eval_samples
    curve.note = (
        f"{len(bundle)} random rays of held-out views of the coarse field, against the same samples in float64; and "
        "iterations of stage 1."
    )
    reference = in_chunks(bundle, samples, budget, lambda part: in_float64(model, part))

    def render() -> Colors:
        return in_chunks(bundle, samples, budget, lambda part: model.get_outputs(part)["rgb"])

    def case(precision: Precision) -> Case:
        training = bench.start(with_setting(bench.coarse_config, PRECISION, precision), budget)
        training.step()

        def measure(_round: int) -> Mapping[str, Values]:
            with altered(model.config, precision=precision):
                seconds, picture = bench.timed(render)
            budget.check()
            steps = [bench.timed(training.step)[0] for _ in range(3)]
            seconds *= bench.pixels / len(bundle)
            return {"": {"view_seconds": seconds, "step_seconds": steps, **difference(picture, reference)}}

        return Case([(curve, precision)], measure)

    in_turns([case(name) for name, there in has.items() if there], budget, bench.rounds, bench.watch)


def in_float64(model: CoarseFewShotModel, bundle: RayBundle) -> Colors:
    """Colours of rays with the same samples, computed in float64."""
    field = copy.deepcopy(model.field).double()
    edges = model.place_samples(
        model.space.segments(bundle.origins, bundle.directions), model.config.num_eval_samples, None
    )
    background = None if model.background is None else model.background.double()
    origins, directions = bundle.origins.double(), bundle.directions.double()
    segments = model.space.segments(origins, directions)
    return render_coarse(field, segments, directions, edges.double(), model.space.unbounded, background).rgb
