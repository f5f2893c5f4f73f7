"""Time until the coarse field shows views it hasn't seen to a given PSNR, against another way to get there.

Contenders train on the same photos until the mean PSNR of the held-out views reaches the target. Only iterations are on
the clock, not the views that are rendered to see how far it is. One that takes too long is stopped; the ratio is then a
lower bound.
"""

import contextlib
import copy
from dataclasses import dataclass
from typing import Any, Callable, Dict, Iterator, List, Literal, Optional, Tuple
from unittest import mock

import torch
import tyro
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.engine.trainer import TrainerConfig

from benchmarks._measure import Duration, Measure, Options, Report, ratio_of_pairs, timed
from benchmarks._scene import COARSE_METHOD, Scene, at_size, find_scene, load_photos
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.metrics.image import psnr
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error

SIDE = 126
EVEN_SAMPLES = 64
TARGETS = {"vanilla-nerf": 20.0, "dense": 3.0, "even": 3.0}
IN_WORDS = {
    "vanilla-nerf": "nerfstudio's vanilla-nerf",
    "dense": f"the same field with {EVEN_SAMPLES} even samples a ray, all of them in the backward pass too",
    "even": f"the same field with {EVEN_SAMPLES} even samples a ray",
}

Peer = Literal["vanilla-nerf", "dense", "even"]
History = List[Tuple[float, float]]
"""(seconds of training, PSNR) at each check."""


@dataclass
class Stage1Options(Options):
    """What this benchmark takes."""

    psnr: float = 19.0
    """dB to reach, mean over the held-out views."""
    check_every: int = 50
    """Iterations between checks."""
    cap: float = 21.0
    """How many times our own time a peer may use before it is stopped."""
    peer: Peer = "even"
    """Whom to compare with. Results of each peer go into a file of their own."""


def time_to_reach(
    step: Callable[[], float],
    evaluate: Callable[[], float],
    target: float,
    check_every: int,
    max_seconds: float = float("inf"),
    max_steps: Optional[int] = None,
) -> Tuple[Duration, History]:
    """Trains until a PSNR is reached, or for `max_seconds` or `max_steps`.

    Args:
        step: does an iteration and returns its seconds.
        evaluate: gives the PSNR in dB; its time doesn't count.

    Returns:
        When the PSNR was reached, by linear interpolation between the checks around it (one whose iterations are long
        isn't charged for those between reaching it and the check), and the checks.
    """
    seconds, steps, history = 0.0, 0, []
    while True:
        seconds, steps = seconds + step(), steps + 1
        over = seconds >= max_seconds or steps == max_steps
        if steps % check_every != 0 and not over:
            continue
        history.append((seconds, evaluate()))
        print(f"    {steps} iterations, {seconds:.1f} s: {history[-1][1]:.2f} dB", flush=True)
        if history[-1][1] >= target:
            return Duration(_crossing(history, target)), history
        if over:
            return Duration(seconds, stopped=True), history


def _crossing(history: History, target: float) -> float:
    if len(history) == 1:
        return history[0][0]
    (earlier, below), (later, above) = history[-2:]
    return earlier + (target - below) / (above - below) * (later - earlier)


# ---------------------------------------------------------------------------------------------------------- contenders


def our_config(scene: Scene, options: Stage1Options) -> Any:
    """coarse-fewshot-draft."""
    return at_size(method_config(COARSE_METHOD), scene, SIDE // 4 if options.quick else SIDE)


def even_config(scene: Scene, options: Stage1Options) -> Any:
    """The same with even samples on every ray, as NeRF's first pass."""
    config = our_config(scene, options)
    config.pipeline.effects = EffectSettings(empty_space="off")
    config.pipeline.model.num_samples = EVEN_SAMPLES
    return config


def dense_config(scene: Scene, options: Stage1Options) -> Any:
    """Even samples, none of which is left out of the backward pass: every sample counts in both directions."""
    config = even_config(scene, options)
    config.pipeline.model.thinning = 0.0
    return config


def vanilla_config(scene: Scene, options: Stage1Options) -> Any:
    """nerfstudio's vanilla-nerf with its own settings (batch, samples, network, optimiser) on the same photos.

    Nothing is decided about the scene, so no rays to matched points, which have no colours, are in its batches. It
    knows no NDC, so it has the scene as every nerfstudio method would: in the dataparser's world, with the near and far
    plane at the scene's bounds, which llff-data gives, with the margin that ours have too.
    """
    method: TrainerConfig = copy.deepcopy(method_configs["vanilla-nerf"])
    ours = our_config(scene, options).pipeline.datamanager
    ours.train_num_rays_per_batch = 32 if options.quick else method.pipeline.datamanager.train_num_rays_per_batch
    method.pipeline.datamanager = ours
    near, far = load_photos(scene).scene.ndc.depth_range
    method.pipeline.model.collider_params = {"near_plane": near, "far_plane": far}
    return method


@contextlib.contextmanager
def without_lpips() -> Iterator[None]:
    """Keeps vanilla-nerf from fetching AlexNet for a metric, LPIPS, that neither its training nor PSNR needs."""
    with mock.patch("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", lambda **settings: None):
        yield


def make_training(name: str, scene: Scene, options: Stage1Options, device: torch.device, seed: int) -> Training:
    """A contender that hasn't trained yet."""
    configs = {"ours": our_config, "dense": dense_config, "even": even_config, "vanilla-nerf": vanilla_config}
    config = configs[name](scene, options)
    config.pipeline.datamanager.seed += seed
    if hasattr(config.pipeline.model, "seed"):
        config.pipeline.model.seed += seed
    torch.manual_seed(seed)
    with without_lpips():
        training = Training(config, device)
    if name == "vanilla-nerf":
        # Rendered from the near plane on, as it was trained; nerfstudio would look for something in front of it.
        training.pipeline.model.collider.reset_near_plane = False
        training.pipeline.datamanager.load_pixels()  # which our own pipelines do once effects are decided
    return training


@torch.no_grad()
def held_out_psnr(training: Training) -> float:
    """Mean PSNR, in dB, of the held-out views."""
    pipeline = training.pipeline
    pipeline.eval()
    dataset, values = pipeline.datamanager.eval_dataset, []
    for index in range(len(dataset)):
        outputs = pipeline.model.get_outputs_for_camera(dataset.cameras[index : index + 1].to(pipeline.device))
        image = outputs["rgb_fine" if "rgb_fine" in outputs else "rgb"]
        values.append(psnr(image.clamp(0.0, 1.0).cpu(), dataset[index]["image"][..., :3]))
    pipeline.train()
    return sum(values) / len(values)


# ---------------------------------------------------------------------------------------------------------------- race


class Race:
    """Trains contenders in turn. Ours goes first, and bounds the others' time."""

    def __init__(self, scene: Scene, options: Stage1Options, device: torch.device) -> None:
        self.scene, self.options, self.device = scene, options, device
        self.cap = options.cap
        self.our_seconds = float("nan")
        self.histories: Dict[str, List[History]] = {}

    def contender(self, name: str) -> Measure:
        """One of them; for the warm-up it does a single iteration."""

        def measure(repetition: int) -> Duration:
            training = make_training(name, self.scene, self.options, self.device, seed=max(0, repetition))
            iteration = timed(training.step, self.device)
            if repetition < 0:
                return iteration(repetition)
            is_ours = name == "ours"
            duration, history = time_to_reach(
                lambda: iteration(repetition).seconds,
                lambda: held_out_psnr(training),
                self.options.psnr,
                self.options.check_every,
                max_seconds=float("inf") if is_ours else self.cap * self.our_seconds,
                max_steps=method_config(COARSE_METHOD).max_num_iterations if is_ours else None,
            )
            if is_ours:
                if duration.stopped:
                    raise InputError(
                        f"Ours got to {history[-1][1]:.2f} dB in all its iterations; ask for less with --psnr."
                    )
                self.our_seconds = duration.seconds
            self.histories.setdefault(name, []).append(history)
            return duration

        return measure


@exit_on_input_error
def main(options: Stage1Options) -> None:
    """Measures ours and each peer."""
    name = f"stage1_{options.peer.replace('-', '_')}"
    report = Report(name, options)
    if options.quick:
        options.psnr, options.check_every, options.cap = min(options.psnr, 14.5), 5, min(options.cap, 3.0)
    race = Race(find_scene(options), options, report.device)
    contenders = {contender: race.contender(contender) for contender in ("ours", options.peer)}
    found = report.measure("stage1", contenders, options.repetitions(3))
    report.extra["settings"] = {"psnr": options.psnr, "check_every": options.check_every, "cap": options.cap}
    report.extra["psnr_over_seconds"] = race.histories
    report.notes.append(
        f"Seconds of training, without evaluation, until the held-out views have {options.psnr:g} dB on average. Ours: "
        f"{COARSE_METHOD}. vanilla-nerf: nerfstudio's model and settings, in the world's coordinates between the "
        f"scene's bounds. even: ours with {EVEN_SAMPLES} even samples a ray, thinned in the backward pass as ours. "
        "dense: the same without thinning."
    )
    report.add_row(
        name,
        f"stage 1 up to {options.psnr:g} dB on held-out views of {race.scene.name}",
        IN_WORDS[options.peer],
        ratio_of_pairs(found[options.peer], found["ours"]),
        TARGETS[options.peer],
    )
    report.write()


if __name__ == "__main__":
    main(tyro.cli(Stage1Options, description=__doc__))
