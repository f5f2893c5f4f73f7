"""What rendering the same fields in other ways costs: samples a ray, skipping, early stops, baking, number formats."""

import contextlib
import copy
import dataclasses
import functools
import math
from typing import Callable, ContextManager, Dict, Iterator, List, Mapping, NamedTuple, Optional, Sequence, Tuple

import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_paths import get_interpolated_camera_path
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from sparsestyle_ns.core.occupancy import Occupancy, PackedSamples
from sparsestyle_ns.core.precision import Precision, multiplies_bfloat16, multiplies_tf32
from sparsestyle_ns.core.sampling import even_edges
from sparsestyle_ns.engine.trainer import SparseStyleTrainerConfig
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.baked import BakedVolume, render_baked
from sparsestyle_ns.rendering.few_samples import Stretches, cut_into_stretches
from sparsestyle_ns.rendering.render import POINTS_PER_CALL, render_packed
from sparsestyle_ns.studies.curves import Curve, Values, decibels, observed_order
from sparsestyle_ns.studies.study import with_setting
from sparsestyle_ns.studies.time_budget import Budget, Case, Plan, in_turns
from sparsestyle_ns.studies.workbench import Workbench, setting_curve
from sparsestyle_ns.utils.device_sizes import SIZES

Colors = Float[Tensor, "rays 3"]
Change = Callable[[], ContextManager[None]]
"""Makes a context in which a model renders differently."""

CONVERGED = 16
"""How many times the samples of the finest point the converged render has."""
REFERENCE_SHARE = 0.4
"""Part of the time that the converged render may take; the number of rays follows from it."""
MIN_RAYS, MAX_RAYS = 64, 4096
SAMPLES_PER_RAY = POINTS_PER_CALL // SIZES["cpu"].marched_rays
"""By which rays are cut into batches as pictures are; with fewer at once, work of a batch would count too much."""
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
    """How exact sums along rays are: samples of the coarse field; steps, skipping and stopping; samples of stage 2.

    Steps, skipping and stopping are looked at in the coarse picture that comes with each stylised one: what the
    residual field says of empty cells, which training never visits, means nothing, and a render that skips nothing
    would show it.
    """

    def curve(config: SparseStyleTrainerConfig, setting: str, name: str, title: str) -> Curve:
        return setting_curve(config, f"pipeline.model.{setting}", "quadrature", name, title, [("view_seconds", "rmse")])

    samples = curve(bench.coarse_config, "num_eval_samples", "samples", "Samples a ray of the coarse field")
    marching = [
        curve(bench.style_config, setting, name, title)
        for setting, name, title in (
            ("num_steps", "steps", "Steps along a ray, by which samples are placed"),
            ("min_alpha", "skipping", "Opacity below which cells are skipped"),
            ("min_transmittance", "stopping", "Light left at which a ray ends"),
        )
    ]
    title = "Samples a ray of the stylised field"
    stylised = {
        on: curve(bench.style_config, "num_eval_samples", f"stylised samples, {words}", f"{title}, {words}")
        for on, words in ((False, "no residual density"), (True, "residual density"))
    }
    return [
        Plan([samples], 3, lambda budget: _measure_samples(bench, samples, budget)),
        Plan(marching, 9, lambda budget: _measure_marching(bench, *marching, budget)),
        Plan(list(stylised.values()), 4, lambda budget: _measure_stylised_samples(bench, stylised, budget)),
    ]


def _measure_samples(bench: Workbench, curve: Curve, budget: Budget) -> None:
    model = bench.coarse_to_render()
    converged = CONVERGED * model.config.num_steps
    changes = _settings(model.config, "num_eval_samples", multiples(model.config.num_eval_samples))

    def exact(rays: RayBundle) -> Colors:
        segments = model.space.segments(rays.origins, rays.directions)
        return model.render(segments, rays.directions, even_edges(len(rays), converged, model.device)).rgb

    reference = Reference(f"{converged} even samples a ray", converged, exact)
    _sweep(bench, lambda rays: model.get_outputs(rays)["rgb"], {curve: changes}, reference, budget)
    _find_order(curve)


def _measure_marching(bench: Workbench, steps: Curve, skipping: Curve, stopping: Curve, budget: Budget) -> None:
    model = bench.model_to_render()
    config = model.config
    converged = CONVERGED * max(multiples(config.num_steps))

    @contextlib.contextmanager
    def at_every_step(change: Change) -> Iterator[None]:
        with altered(config, num_eval_samples=None), change():
            yield

    def exact(rays: RayBundle) -> Colors:
        everywhere = Occupancy(1).to(model.device)
        finest = altered(config, num_eval_samples=None, num_steps=converged, min_transmittance=0.0)
        with finest, altered(model, occupancy=everywhere):
            return model.get_outputs(rays)["rgb_coarse"]

    transmittances = sorted({*MIN_TRANSMITTANCES, config.min_transmittance})
    skips = {alpha: functools.partial(altered, model, occupancy=grid) for alpha, grid in occupancies(model).items()}
    stops = _settings(config, "min_transmittance", transmittances)
    changes = {
        steps: _settings(config, "num_steps", multiples(config.num_steps)),
        skipping: {alpha: functools.partial(at_every_step, change) for alpha, change in skips.items()},
        stopping: {light: functools.partial(at_every_step, change) for light, change in stops.items()},
    }
    reference = Reference(f"{converged} steps a ray with nothing skipped and no early stop", converged, exact)
    _sweep(bench, lambda rays: model.get_outputs(rays)["rgb_coarse"], changes, reference, budget)
    for curve in (skipping, stopping):
        curve.note += " With a sample at every step, as baked rendering and a fine-tuned coarse field have them."
    _find_order(steps)


def _measure_stylised_samples(bench: Workbench, curves: Mapping[bool, Curve], budget: Budget) -> None:
    """Both curves, without residual density and with it, where the field has any; with a render of their own each."""
    model = bench.model_to_render()
    config, output = model.config, "rgb" if bench.is_stylised else "rgb_coarse"
    preset = config.num_eval_samples or config.num_steps
    converged = CONVERGED * max(multiples(preset))
    finest = {"num_eval_samples": converged, "num_steps": CONVERGED * config.num_steps}

    def draw(rays: RayBundle) -> Colors:
        return model.get_outputs(rays)[output]

    def exact(rays: RayBundle) -> Colors:
        with altered(config, **finest):
            return draw(rays)

    reference = Reference(f"{converged} samples a ray, placed by {finest['num_steps']} steps", converged, exact)
    decision, look = model.effects["residual_density"], model.display.own
    ways = [False, True] if decision.on else [False]
    for on in (on for on in curves if on not in ways):
        curves[on].left_out.append("all: there is no residual density here")
    for number, on in enumerate(ways):
        effects = model.effects.replaced(dataclasses.replace(decision, on=on))
        flat = dataclasses.replace(look, mix=look.mix._replace(geometry=look.mix.geometry if on else 0.0))
        changes = _settings(config, "num_eval_samples", multiples(preset))
        with altered(model, effects=effects), altered(model.display, own=flat):
            part = budget.part(budget.left / (len(ways) - number))
            _sweep(bench, draw, {curves[on]: changes}, reference, part)
        _find_order(curves[on])


def _settings(config: object, name: str, values: Sequence[float]) -> Dict[float, Change]:
    return {value: functools.partial(altered, config, **{name: value}) for value in values}


def _find_order(curve: Curve) -> None:
    """Notes the observed order of a curve over numbers of samples."""
    errors = [point.median("rmse") for point in curve.points]
    curve.order = observed_order([int(point.setting) for point in curve.points], errors)


class Reference(NamedTuple):
    """A converged render."""

    words: str
    """What it has."""
    samples: int
    """A ray."""
    render: Callable[[RayBundle], Colors]


def _sweep(
    bench: Workbench,
    draw: Callable[[RayBundle], Colors],
    changes: Mapping[Curve, Mapping[float, Change]],
    reference: Reference,
    budget: Budget,
) -> None:
    """Renders some rays of held-out views in different ways, and compares with a converged render.

    `changes` has of each curve the values, and what makes `draw` render with this value.
    """

    def render(bundle: RayBundle) -> Colors:
        return render_in_chunks(bundle, SAMPLES_PER_RAY, budget, draw)

    def converged(bundle: RayBundle) -> Colors:
        return render_in_chunks(bundle, reference.samples, budget, reference.render)

    probe = bench.some_rays(MIN_RAYS)
    render(probe)
    seconds_a_ray = bench.timed(lambda: converged(probe))[0] / len(probe)
    fitting = int(REFERENCE_SHARE * budget.left / max(seconds_a_ray, 1e-12))
    rays = bench.some_rays(min(MAX_RAYS, max(MIN_RAYS, fitting)))
    picture = converged(rays)
    height, width = bench.size
    for curve in changes:
        curve.own_error = bench.own_error
        curve.note = (
            f"{len(rays)} random rays of held-out views, against {reference.words}; seconds are scaled to a view of "
            f"{width} × {height}."
        )

    def case(curve: Curve, value: float, change: Change) -> Case:
        def measure(_round: int) -> Mapping[str, Values]:
            with change():
                return {"": timed_and_compared(bench, render, rays, picture)}

        return Case([(curve, value)], measure)

    cases = [case(curve, *change) for curve, ways in changes.items() for change in ways.items()]
    in_turns(cases, budget, bench.rounds, bench.watch)


def occupancies(model: HierStyleModel) -> Dict[float, Occupancy]:
    """The occupied cells for several thresholds, by the densities that the model has measured."""
    grids = {}
    for threshold in sorted({*MIN_ALPHAS, model.config.min_alpha}):
        grids[threshold] = Occupancy(model.config.occupancy_resolution).to(model.device)
        grids[threshold].measure(model.volume, threshold)
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
            marching = model.baked_marching if bench.is_stylised else model.marching
            fine, coarse = render_baked([volume], segments, marching, model.background)
            return fine.rgb if bench.is_stylised else coarse.rgb

        at = frame % len(flight)
        rays = flight[at : at + 1].generate_rays(camera_indices=0, keep_shape=False).flatten()
        return bench.timed(lambda: render_in_chunks(rays, SAMPLES_PER_RAY, budget, render))

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
    rays = bench.some_rays(FORMAT_RAYS)
    curve.note = (
        f"{len(rays)} random rays of held-out views of the coarse field, against the same samples in float64; and "
        "iterations of stage 1."
    )
    reference = render_in_chunks(rays, SAMPLES_PER_RAY, budget, lambda part: in_float64(model, part))

    def render(bundle: RayBundle) -> Colors:
        return render_in_chunks(bundle, SAMPLES_PER_RAY, budget, lambda part: model.get_outputs(part)["rgb"])

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
    marching, directions = model.marching(), bundle.directions.double()
    in_float32 = model.space.segments(bundle.origins, bundle.directions)
    stretches = cut_into_stretches(in_float32, marching.few, marching.num_steps, marching.unbounded)
    segments = model.space.segments(bundle.origins.double(), directions)
    on_ray, s, lengths, _ = stretches.samples
    s, lengths = s.double(), lengths.double()
    samples = PackedSamples(on_ray, s, lengths, segments.positions(s, on_ray))
    field = copy.deepcopy(model.field).double()
    density, feature = field.density_and_feature(samples.positions)
    mean = Stretches(samples, stretches.depth.double()).density(marching.few.volume, density)
    background = None if model.background is None else model.background.double()
    return render_packed(samples, len(bundle), mean, field.color(feature, directions[on_ray]), background).rgb
