"""The largest learning rate at which a method still trains: its default, doubled until training fails.

A rate is stable where no step has to be skipped for a gradient that isn't finite, and the loss ends at most half as
high again as at the default. The rate stays the same all along, without the method's schedule. Where a method has
several groups of parameters, all their rates are doubled together, and the one that is named is that of its fields.
"""

import copy
from dataclasses import dataclass
from typing import Any, Dict, List, Literal, Optional

import torch
import tyro

from benchmarks._measure import Options, Report
from benchmarks._scene import BACKBONE, at_size, find_or_train_coarse, find_scene
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.runs.coarse_run import CoarseRun
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error

WORSE = 1.5
"""Times the default's loss that still counts as trained."""
LAST = 0.2
"""Share of the iterations, the last ones, over which the loss is averaged."""


@dataclass
class StabilityOptions(Options):
    """What this benchmark takes."""

    method: Literal["coarse-fewshot", "coarse-fewshot-draft", "hier-style", "hier-style-draft"] = "coarse-fewshot-draft"
    """The method whose learning rate is tried."""
    iterations: Optional[int] = None
    """Iterations at each rate; None: 400 in stage 1, 60 in stage 2."""
    side: int = 64
    """Longer side of the photos; in stage 2 the feature network sees views at twice that."""
    doublings: int = 10
    """How often the rate is doubled at most."""


@dataclass(frozen=True)
class Trial:
    """What came of one learning rate.

    Attributes:
        rate: the learning rate.
        loss: at the end, averaged over the last iterations; NaN or infinite where it wasn't finite.
        skipped: steps that were skipped because their gradients weren't finite.
    """

    rate: float
    loss: float
    skipped: int


def largest_stable(trials: List[Trial]) -> float:
    """The last rate before the first that isn't stable.

    Args:
        trials: by rising rate; the first is the default, which others are compared with.

    Raises:
        InputError: not even the default is stable.
    """
    stable = 0.0
    for trial in trials:
        if trial.skipped > 0 or not trial.loss <= WORSE * trials[0].loss:
            break
        stable = trial.rate
    if stable == 0.0:
        raise InputError(f"Not even the default of {trials[0].rate:g} trains; give more --iterations.")
    return stable


def attempt(config: Any, coarse: Optional[CoarseRun], factor: int, iterations: int, device: torch.device) -> Trial:
    """Trains at so many times the default rates."""
    config = copy.deepcopy(config)
    config.max_num_iterations = iterations
    for group in config.optimizers.values():
        group["scheduler"] = None
        group["optimizer"].lr *= factor
    torch.manual_seed(0)
    training = Training(config, device, None if coarse is None else coarse.model_state())
    losses = [training.step().item() for _ in range(iterations)]
    last = losses[-max(1, round(LAST * iterations)) :]
    return Trial(config.optimizers["fields"]["optimizer"].lr, sum(last) / len(last), training.optimizers.skipped()[0])


@exit_on_input_error
def main(options: StabilityOptions) -> None:
    """Tries rates until one fails."""
    is_style = options.method.startswith("hier-style")
    report = Report(f"stability-{options.method}", options)
    scene = find_scene(options)
    config = at_size(method_config(options.method), scene, options.side)
    coarse = None
    if is_style:
        coarse = find_or_train_coarse(scene, options)
        pipeline = config.pipeline
        pipeline.style_image, pipeline.backbone, pipeline.feature_side = scene.style_image, BACKBONE, 2 * options.side
        pipeline.model.coarse_field = copy.deepcopy(coarse.config.pipeline.model.coarse_field)
    iterations = options.iterations or (2 if options.quick else 60 if is_style else 400)
    default = config.optimizers["fields"]["optimizer"].lr
    trials: List[Trial] = []
    for doubling in range((1 if options.quick else options.doublings) + 1):
        trials.append(attempt(config, coarse, 2**doubling, iterations, report.device))
        print(f"  {trials[-1].rate:<10.4g} loss {trials[-1].loss:.4g}, {trials[-1].skipped} steps skipped", flush=True)
        if largest_stable(trials) < trials[-1].rate:
            break
    stable = largest_stable(trials)
    found_end = stable < trials[-1].rate
    result: Dict[str, Any] = {"default": default, "largest_stable": stable, "margin": stable / default}
    report.extra.update(
        method=options.method,
        iterations=iterations,
        side=options.side,
        trials=[vars(trial) for trial in trials],
        found_end=found_end,
        **result,
    )
    at_least = "" if found_end else "at least "
    print(f"Stable up to {at_least}{stable:g}, {stable / default:g} times the default of {default:g}.")
    report.write()


if __name__ == "__main__":
    main(tyro.cli(StabilityOptions, description=__doc__))
