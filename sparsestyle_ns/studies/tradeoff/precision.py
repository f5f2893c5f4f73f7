"""Number formats of matrix products: those that the device has."""

import copy
from typing import Callable, List

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from sparsestyle_ns.core.precision import Precision, multiplies_bfloat16, multiplies_tf32
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModel
from sparsestyle_ns.rendering.render import render_coarse
from sparsestyle_ns.studies.tradeoff.axis import Axis, Values, in_turns, with_setting
from sparsestyle_ns.studies.tradeoff.budget import Budget, OutOfTimeError
from sparsestyle_ns.studies.tradeoff.plan import Plan
from sparsestyle_ns.studies.tradeoff.quadrature import difference, in_chunks, settings
from sparsestyle_ns.studies.tradeoff.study import Study

RAYS = 2048
"""Rays that are compared."""


def formats(device: torch.device) -> List[Precision]:
    """The formats that a device multiplies at full speed."""
    found: List[Precision] = ["float32"]
    if multiplies_tf32(device):
        found.append("tf32")
    if multiplies_bfloat16(device):
        found.append("bfloat16")
    return found


def in_float64(model: CoarseFewShotModel, bundle: RayBundle) -> Tensor:
    """Colours of rays with the same samples, computed in float64."""
    field = copy.deepcopy(model.field).double()
    origins, directions = bundle.origins.double(), bundle.directions.double()
    edges = model.place_samples(
        model.space.segments(bundle.origins, bundle.directions), model.config.num_eval_samples, None
    )
    background = None if model.background is None else model.background.double()
    segments = model.space.segments(origins, directions)
    return render_coarse(field, segments, directions, edges.double(), model.space.unbounded, background).rgb


class PrecisionGroup:
    """The axis."""

    def __init__(self, study: Study) -> None:
        self.study = study

    def plans(self) -> List[Plan]:
        """One."""
        preset = self.study.coarse_config.pipeline.model.precision
        if preset == "auto":
            preset = "bfloat16" if multiplies_bfloat16(self.study.device) else "float32"
        axis = Axis(
            *("precision", "precision", "Number format of matrix products", "--pipeline.model.precision", preset),
            *("view_seconds", "rmse", [("view_seconds", "rmse"), ("step_seconds", "rmse")]),
        )
        return [Plan(axis, 3, self._measure)]

    def _measure(self, axis: Axis, budget: Budget) -> None:
        study, model = self.study, self.study.coarse_model
        if model is None:
            raise OutOfTimeError
        model.eval()
        available = formats(study.device)
        missing = {"tf32", "bfloat16"} - set(available)
        axis.left_out += [f"{name}: the device has no instructions for it" for name in sorted(missing)]
        axis.own_error = study.own_error
        bundle = study.some_rays(RAYS)
        samples = model.config.num_eval_samples
        axis.note = (
            f"{len(bundle)} random rays of held-out views of the coarse field, against the same samples in float64; "
            "and iterations of stage 1."
        )
        reference = in_chunks(bundle, samples, budget, lambda part: in_float64(model, part))

        def render() -> Tensor:
            return in_chunks(bundle, samples, budget, lambda part: model.render_rays(part, samples)[0].rgb)

        def case(precision: Precision) -> Callable[[], Values]:
            training = study.start(with_setting(study.coarse_config, "pipeline.model.precision", precision), budget)
            training.step()

            def measure() -> Values:
                with settings(model.config, precision=precision):
                    seconds, picture = study.timed(render)
                budget.check()
                steps = [study.timed(training.step)[0] for _ in range(3)]
                seconds *= study.pixels / len(bundle)
                return {"view_seconds": seconds, "step_seconds": steps, **difference(picture, reference)}

            return measure

        in_turns(axis, {name: case(name) for name in available}, budget, study.options.rounds, study.watch)
