"""Whether all of this works on a GPU, gives there what a CPU gives, and how fast it is: `bash benchmarks/gpu_check.sh`.

Its parts run one after another. One that fails doesn't stop the others, and one for which the time is too short is left
out and named. Results are a JSON file, a Markdown file, and a last line that says "passed" or what failed.
"""

import contextlib
import copy
import itertools
import json
import math
import os
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Tuple
from unittest import mock

import torch
import tyro
from torch import Tensor
from torch.backends import cudnn

from benchmarks import summary
from benchmarks._measure import ROOT, Options, commit, in_fresh_process, peak_bytes, write_json
from benchmarks._scene import BACKBONE, Scene, at_size, find_scene
from sparsestyle_ns.effects.decisions import Decisions, EffectSettings
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.evaluation.held_out import exact_outputs
from sparsestyle_ns.field_components.hash_grid import HashGrid, fused_kernels, interpolate, locate_corners
from sparsestyle_ns.fields.coarse import CoarseFieldConfig
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.metrics.image import psnr
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error
from sparsestyle_ns.utils.files import write_whole
from sparsestyle_ns.utils.machine import device_name, synchronize, versions

LEAST_PSNR = 30.0
"""dB between a view of the coarse field after 50 steps on the device and on the CPU. Rounding grows from step to step,
and Muon multiplies in bfloat16. On one CPU, weights that differ by 1e-6 at the start end 51 dB apart (fern)."""
MOST_GRADIENT = 0.05
"""Relative distance of the gradients of a step of stage 2. Of samples that are drawn and neighbours that are nearest by
a hair, some are others: 0.8% on one CPU between coarse fields whose weights differ by 1e-6 (fern at 126 pixels)."""
LEAST_BAKED_PSNR = 25.0
"""dB between baked views of the same fields. Cells that are empty by a hair aren't everywhere, and rays are marched in
another way on a CPU: 33 dB between those two fields, whose colours are much wilder than a style's."""
BENCHMARKS = ("hash_grid", "nnfm", "stage2_step", "render", "memory", "profile", "torch_options")
"""Those of `make bench` that take seconds on a GPU, those that the table lacks last."""
SMALLEST = CoarseFieldConfig(num_levels=3, num_layers=2, layer_width=32, feature_dim=8)


@dataclass
class GpuCheckOptions(Options):
    """What the check takes."""

    skip: Tuple[str, ...] = ()
    """Parts to leave out: kernels, equal, waits, commands, whole, bench."""
    only: Tuple[str, ...] = ()
    """Parts to run, alone; none named: all."""
    minutes: float = 8.0
    """Time in all; parts for which too little is left are named, and don't count as failures."""


class CheckFailedError(Exception):
    """A sentence that says what isn't as it should be."""


# ------------------------------------------------------------------------------------------- the same on both devices


def drawn_on_cpu(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A function that draws random numbers, which with a generator draws them on the CPU: the same on every device.

    In the threads of backward passes too, to which torch's function modes don't reach.
    """

    def drawn(*args: Any, **kwargs: Any) -> Tensor:
        if kwargs.get("generator") is None:
            return function(*args, **kwargs)
        device = kwargs.pop("device", None)
        found = function(*args, **kwargs)
        return found if device is None else found.to(device)

    return drawn


@contextlib.contextmanager
def comparable() -> Iterator[None]:
    """Number formats and random numbers that a GPU and a CPU have in common."""
    generator, before = torch.Generator, cudnn.allow_tf32
    cudnn.allow_tf32 = False
    try:
        with contextlib.ExitStack() as patches:
            patches.enter_context(mock.patch.object(torch, "Generator", lambda device=None: generator()))
            for name in ("rand", "randn", "randint", "randperm"):
                patches.enter_context(mock.patch.object(torch, name, drawn_on_cpu(getattr(torch, name))))
            torch.manual_seed(0)
            yield
    finally:
        cudnn.allow_tf32 = before


def small_config(method: str, scene: Scene, decided: Decisions, quick: bool) -> Any:
    """A method at 126 pixels, with --quick at 32 and with small fields, in float32."""
    config = at_size(method_config(method), scene, 32 if quick else 126)
    pipeline = config.pipeline
    pipeline.decided, pipeline.backbone, pipeline.model.precision = decided, BACKBONE, "float32"
    if quick:
        pipeline.model.coarse_field = copy.deepcopy(SMALLEST)
    if method == "hier-style":
        pipeline.style_image, pipeline.warm_start_steps = scene.style_image, 0
        pipeline.model.fine_encoding, pipeline.model.render_mode = "hash", "exact"
        if quick:
            pipeline.model.log2_table_size, pipeline.model.occupancy_resolution = 12, 16
            pipeline.model.bake_resolution = 32
    return config


def view_of(training: Training, baked: bool = False) -> Tensor:
    """A held-out view, on the CPU."""
    pipeline = training.pipeline
    pipeline.eval()
    camera = pipeline.datamanager.eval_dataset.cameras[:1].to(pipeline.device)
    model = pipeline.model
    with torch.no_grad():
        if not baked:
            return exact_outputs(model, camera)["rgb"].cpu()
        with model.display.rendering("baked"):
            return model.get_outputs_for_camera(camera)["rgb"].cpu()


def trained_coarse(scene: Scene, decided: Decisions, device: torch.device, quick: bool) -> Training:
    """Stage 1 after 50 steps; with --quick after 10."""
    with comparable():
        training = Training(small_config("coarse-fewshot", scene, decided, quick), device)
        for _ in range(10 if quick else 50):
            training.step()
    return training


def likeness(first: Tensor, second: Tensor) -> float:
    """PSNR of two pictures, in dB; equal ones have 100."""
    return min(100.0, psnr(first, second))


@torch.no_grad()
def paint(training: Training) -> None:
    """Gives a field that is to be stylised shapes and colours, the same on all devices: it begins grey all over."""
    generator = torch.Generator().manual_seed(0)
    for name, part in training.pipeline.model.residual.named_parameters():
        if part.dim() == 2:
            # More from the grid would make each cell another colour, which moves with a sample's last digit.
            size = 0.1 if name == "grid.table" else (2.0 / part.shape[1]) ** 0.5
            part.copy_(size * torch.randn(part.shape, generator=generator))


def style_gradients(training: Training) -> Tensor:
    """Gradients of the first step of stage 2, one after another, on the CPU."""
    with comparable():
        training.pipeline.train()
        losses = training.pipeline.get_train_loss_dict(0)[1]
        sum(losses.values()).backward()
    parameters = training.pipeline.model.residual.parameters()
    return torch.cat([each.grad.flatten().cpu() for each in parameters if each.grad is not None])


def check_equal(check: "Check") -> Dict[str, float]:
    """The same seed on the device and on the CPU: stage 1, a step of stage 2, and a baked view."""
    scene, quick, devices = check.scene, check.options.quick, (torch.device("cpu"), check.device)
    config = at_size(method_config("coarse-fewshot"), scene, 32 if quick else 126)
    manager = config.pipeline.datamanager.setup(device="cpu", test_mode="inference")
    decided = decide(manager.scene, EffectSettings())
    coarse = [trained_coarse(scene, decided, device, quick) for device in devices]
    found = {"coarse_psnr": likeness(*map(view_of, coarse))}
    state = {name: value.cpu() for name, value in coarse[0].pipeline.model.state_dict().items()}
    config, gradients, views = small_config("hier-style", scene, decided, quick), [], []
    for device in devices:
        with comparable():
            style = Training(copy.deepcopy(config), device, state)
        paint(style)
        views.append(view_of(style, baked=True))
        gradients.append(style_gradients(style))
    found["gradient_distance"] = float((gradients[1] - gradients[0]).norm() / gradients[0].norm())
    found["baked_psnr"] = likeness(*views)
    check.holds(found["coarse_psnr"] >= LEAST_PSNR, f"stage 1 gives another view, {found['coarse_psnr']:.1f} dB away")
    distance = found["gradient_distance"]
    check.holds(distance <= MOST_GRADIENT, f"gradients of stage 2 are {distance:.1%} away from the CPU's")
    check.holds(found["baked_psnr"] >= LEAST_BAKED_PSNR, f"a baked view is {found['baked_psnr']:.1f} dB from the CPU's")
    return found


# -------------------------------------------------------------------------------------------------- kernels and waits


def check_kernels(check: "Check") -> Dict[str, Any]:
    """The hash grid's kernels on the device against the readable form, values and gradients, up to 2^22 points."""
    kernels, found = fused_kernels(check.device), {"kernels": "none; the readable form is used"}
    if kernels is None:
        return found
    found["kernels"] = kernels.__name__.rpartition(".")[2]
    torch.manual_seed(0)
    grid = HashGrid(log2_table_size=12 if check.options.quick else 19, init_scale=1.0).to(check.device)
    worst = 0.0
    for count in (1, 127, 129, 10_001) if check.options.quick else (1, 127, 129, 10_001, 1 << 22):
        points = torch.rand(count, 3, device=check.device)
        part = points[: 1 << 16]  # what the readable form has memory for
        corners = locate_corners(part, grid.resolutions, grid.table_size)
        values = [grid(points)[: len(part)], interpolate(grid.table, corners)]
        gradients = [torch.autograd.grad(each.square().sum(), grid.table)[0] for each in values]
        pairs = ((values[0].detach(), values[1].detach()), gradients)
        worst = max(worst, *(float((ours - plain).abs().max() / plain.abs().max()) for ours, plain in pairs))
    check.holds(worst < 1e-4, f"the hash grid's kernels are {worst:.1e} away from the readable form")
    return {**found, "distance": worst}


def check_waits(check: "Check") -> Dict[str, Any]:
    """How often an iteration waits for a GPU, as torch itself counts it."""
    if check.device.type != "cuda":
        return {"waits": "only a GPU is waited for"}
    scene, quick = check.scene, check.options.quick
    config = at_size(method_config("coarse-fewshot"), scene, 32 if quick else 126)
    manager = config.pipeline.datamanager.setup(device="cpu", test_mode="inference")
    decided = decide(manager.scene, EffectSettings())
    stage_1 = Training(small_config("coarse-fewshot", scene, decided, quick), check.device)
    found = {"stage 1": waits_an_iteration(stage_1)}
    state = {name: value.cpu() for name, value in stage_1.pipeline.model.state_dict().items()}
    found["stage 2"] = waits_an_iteration(
        Training(small_config("hier-style", scene, decided, quick), check.device, state)
    )
    return found


def waits_an_iteration(training: Training, steps: int = 5) -> float:
    """Waits of iterations after the first two."""
    for _ in range(2):
        training.step()
    before = torch.cuda.get_sync_debug_mode()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            for _ in range(steps):
                training.step()
    finally:
        torch.cuda.set_sync_debug_mode(before)
    return sum("synchroniz" in str(each.message) for each in caught) / steps


# ------------------------------------------------------------------------------------------------------ whole commands


def run_command(check: "Check", *words: Any) -> float:
    """Runs `sparsestyle`, or a Python module, in a process of its own; seconds.

    A `CheckFailedError`, after the end of what it said, where it fails.
    """
    start, words = time.perf_counter(), tuple(map(str, words))
    program = ("-c", "from sparsestyle_ns.cli import main; main()") if words[0] == "sparsestyle" else ("-m", words[0])
    command, named = [sys.executable, *program, *words[1:]], " ".join(words[:2])
    environment = {**os.environ, "PYTHONWARNINGS": "ignore", "PYTHONPATH": str(ROOT)}
    if check.device.type == "cpu":
        environment["CUDA_VISIBLE_DEVICES"] = ""
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=max(1.0, check.seconds_left())
        )
    except subprocess.TimeoutExpired as error:
        raise CheckFailedError(f"{named} didn't end in the time that was left") from error
    if done.returncode != 0:
        check.log((done.stdout + done.stderr)[-4000:])
        raise CheckFailedError(f"{named} ended with status {done.returncode}; see the lines above")
    return time.perf_counter() - start


def train(check: "Check", method: str, outputs: Path, *flags: Any) -> float:
    """`ns-train` of a method on the scene; seconds."""
    words = ["nerfstudio.scripts.train", method, "--data", check.scene.folder, "--output-dir", outputs]
    words += ["--machine.device-type", check.device.type, "--vis", "tensorboard", "--pipeline.backbone", BACKBONE]
    words += ["--viewer.quit-on-train-completion", "True", *flags, "llff-data"]
    return run_command(check, *words)


def newest_run(outputs: Path, method: str) -> Path:
    """The folder of a method's newest run."""
    return max(outputs.glob(f"*/{method}/*/config.yml"), key=lambda path: path.stat().st_mtime).parent


def check_commands(check: "Check") -> Dict[str, float]:
    """Every command once, at a small size: training, going on, rendering, measuring, exporting, a gallery."""
    size = ["--max-image-side", "32" if check.options.quick else "126"]
    style = ["--style-image", check.scene.style_image]
    seconds: Dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        outputs, made = Path(folder), Path(folder) / "made"
        few = ["--max-num-iterations", 10]
        seconds["coarse-fewshot-draft"] = train(check, "coarse-fewshot-draft", outputs, *few, *size)
        seconds["hier-style-draft"] = train(check, "hier-style-draft", outputs, *few, *size, *style)
        run = newest_run(outputs, "hier-style-draft")
        resumed = ["--load-dir", run / "nerfstudio_models", "--max-num-iterations", 12]
        seconds["going on"] = train(check, "hier-style-draft", outputs / "on", *resumed, *size, *style)
        config = run / "config.yml"
        rendering = ["nerfstudio.scripts.render", "interpolate", "--load-config", config, "--output-format", "images"]
        rendering += ["--output-path", made / "film", "--interpolation-steps", 2]
        others = {
            "ns-render": rendering,
            "ns-eval": ["nerfstudio.scripts.eval", "--load-config", config, "--output-path", made / "eval.json"],
            "evaluate": ["sparsestyle", "evaluate", run, "--baked", "--output-path", made / "report.json"],
            "effects": ["sparsestyle", "effects", "--data", check.scene.folder],
            "gallery": ["sparsestyle", "gallery", run, "--output-path", made / "page.html", "--frames", 4],
        }
        for kind, suffix in (("html", "html"), ("ply", "ply")):
            others[f"export {kind}"] = ["sparsestyle", "export", run, "--format", kind]
            others[f"export {kind}"] += ["--output-path", made / f"scene.{suffix}"]
        made.mkdir()
        for name, words in others.items():
            seconds[name] = run_command(check, *words)
            if "--output-path" in words:
                path = Path(words[words.index("--output-path") + 1])
                check.holds(path.exists(), f"{name} ended without {path.name}")
    return seconds


def check_whole(check: "Check") -> Dict[str, Any]:
    """Whole runs of both methods with their defaults at 504 pixels, then frames a second and the most memory."""
    flags = ["--previews"]
    if check.options.quick:
        flags += ["--max-image-side", "32", "--max-num-iterations", "10"]
    with tempfile.TemporaryDirectory() as folder:
        outputs = Path(folder)
        found: Dict[str, Any] = {"coarse-fewshot, seconds": train(check, "coarse-fewshot", outputs, *flags)}
        style = ["--style-image", check.scene.style_image]
        found["hier-style, seconds"] = train(check, "hier-style", outputs, *flags, *style)
        words = ["sparsestyle", "evaluate", newest_run(outputs, "hier-style"), "--output-path"]
        run_command(check, *words, outputs / "report.json")
        results = json.loads((outputs / "report.json").read_text())["results"]
        found |= {name: results[name] for name in ("coarse_psnr", "style_loss", "content_loss") if name in results}
        check.holds(all(map(math.isfinite, results.values())), "a figure of the stylised run isn't finite")
        found |= in_fresh_process(frames_a_second, newest_run(outputs, "hier-style"), check.options)
    return found


def frames_a_second(run: Path, options: Options) -> Dict[str, float]:
    """Exact pictures, baked ones of a camera that comes for the first time, and of the same one again; peak bytes."""
    from sparsestyle_ns.engine.loading import load_run

    device = options.set_up()
    pipeline = load_run(run / "config.yml").pipeline
    cameras = pipeline.datamanager.train_dataset.cameras.to(device)
    height, width = int(cameras.height[0]), int(cameras.width[0])
    found: Dict[str, float] = {"width": width, "height": height}

    def speed(mode: str, index: int) -> float:
        synchronize(device)
        start = time.perf_counter()
        with torch.no_grad(), pipeline.model.display.rendering(mode):
            pipeline.model.get_outputs_for_camera(cameras[index : index + 1])
        synchronize(device)
        return 1.0 / (time.perf_counter() - start)

    speed("exact", 0)  # compiles
    found["exact, frames a second"] = speed("exact", 1)
    speed("baked", 0)
    found["baked, a new camera, frames a second"] = speed("baked", 1)
    found["baked, the same again, frames a second"] = max(speed("baked", 1) for _ in range(3))
    return {**found, "peak bytes of rendering": float(peak_bytes(device))}


def check_bench(check: "Check") -> Dict[str, Any]:
    """The benchmarks of `make bench` that end soon on a GPU; torch.compile, CUDA graphs and TF32 are among them."""
    options, found = check.options, {}
    flags = ["--device", check.device.type, "--output-dir", check.folder, "--repeats", 1 if options.quick else 3]
    flags += ["--coarse-iterations", 20 if options.quick else 500]
    flags += [flag for flag in ("--quick", "--sample") if getattr(options, flag[2:])]
    if options.data is not None:
        flags += ["--data", options.data]
    for name in BENCHMARKS:
        if check.seconds_left() < 20 and not options.quick:
            found[name] = "left out: no time was left"
            continue
        try:
            found[name] = run_command(check, f"benchmarks.{name}", *flags)
        except CheckFailedError as error:
            check.holds(False, str(error))
    with contextlib.suppress(InputError):
        check.table = summary.table(summary.collect(check.folder))
    return found


# ------------------------------------------------------------------------------------------------------------ the check

PARTS: Dict[str, Tuple[Callable[["Check"], Dict[str, Any]], float]] = {
    "kernels": (check_kernels, 10),
    "equal": (check_equal, 30),
    "waits": (check_waits, 20),
    "commands": (check_commands, 90),
    "whole": (check_whole, 120),
    "bench": (check_bench, 60),
}
"""Each part, and the seconds that it should have. All the time is shared out by these numbers among the parts that were
asked for: 8 minutes among all make a part's end at most 1.45 times as late as they say, and what one leaves is the
next one's. Processes that a part starts are ended by then; `kernels`, `equal` and `waits` work in this one, a fixed
number of steps."""


class Check:
    """One run of the check: what it was told, what it has found, and how much time is left."""

    def __init__(self, options: GpuCheckOptions) -> None:
        self.options, self.device = options, options.set_up()
        self.begins = time.monotonic()
        self.ends = self.begins
        self.folder = options.results
        for name in (*options.skip, *options.only):
            if name not in PARTS:
                raise InputError(f"--skip and --only know the parts {', '.join(PARTS)}; {name} is none of them.")
        self.scene = find_scene(options)
        self.parts: Dict[str, Dict[str, Any]] = {}
        self.failures: List[str] = []
        self.table = ""

    def seconds_left(self) -> float:
        """Until the time of the part that runs is over."""
        return self.ends - time.monotonic()

    def part_ends(self, asked: List[str]) -> Dict[str, float]:
        """When each part's time is over."""
        so_far = list(itertools.accumulate(max(1.0, PARTS[name][1]) for name in asked))
        share = 60.0 * self.options.minutes / max([1.0, *so_far[-1:]])
        return {name: self.begins + share * total for name, total in zip(asked, so_far, strict=True)}

    def log(self, words: str) -> None:
        """Says something at once."""
        print(words, flush=True)

    def holds(self, condition: bool, otherwise: str) -> None:
        """Notes a failure where a condition doesn't hold."""
        if not condition:
            self.failures.append(otherwise)

    def run(self) -> None:
        """Runs the parts that were asked for."""
        asked = [name for name in self.options.only or PARTS if name not in self.options.skip]
        for name, ends in self.part_ends(asked).items():
            self.ends, (part, needed) = ends, PARTS[name]
            if self.seconds_left() < needed:
                self.parts[name] = {
                    "left out": f"{self.seconds_left():.0f} s were left, and it takes up to {needed:.0f}"
                }
                continue
            self.log(f"{name}: {part.__doc__}")
            start, failures = time.monotonic(), len(self.failures)
            try:
                found = part(self)
            except Exception as error:  # each part's answer counts, whatever ails another
                if not isinstance(error, CheckFailedError):
                    self.log(traceback.format_exc())
                self.failures.append(f"{name}: {type(error).__name__}: {error}".replace("\n", " "))
                found = {}
            seconds = round(time.monotonic() - start, 1)
            self.parts[name] = {"passed": len(self.failures) == failures, "seconds": seconds, "found": found}
            self.log(json.dumps(self.parts[name], ensure_ascii=False))

    def verdict(self) -> str:
        """The last line."""
        left_out = [name for name, part in self.parts.items() if "left out" in part]
        remark = f" (left out, as the time was over: {', '.join(left_out)})" if left_out else ""
        return f"gpu_check: {'failed: ' + '; '.join(self.failures) if self.failures else 'passed'}{remark}"

    def write(self) -> None:
        """Writes gpu_check.json and gpu_check.md."""
        content = {
            "device": device_name(self.device),
            **commit(),
            "versions": versions(),
            "scene": self.scene.name,
            "quick": self.options.quick,
            "verdict": self.verdict(),
            "parts": self.parts,
        }
        write_json(self.folder / "gpu_check.json", content)
        lines = [f"# {content['device']}", "", self.verdict(), "", "| part | what | found |", "| --- | --- | --- |"]
        for name, part in self.parts.items():
            if "left out" in part:
                lines.append(f"| {name} | left out | {part['left out']} |")
            lines += [f"| {name} | {what} | {_words(value)} |" for what, value in part.get("found", {}).items()]
        write_whole(self.folder / "gpu_check.md", "\n".join([*lines, "", self.table]) + "\n")
        self.log(f"Wrote {self.folder / 'gpu_check.json'} and gpu_check.md")


def _words(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@exit_on_input_error
def main(options: GpuCheckOptions) -> None:
    """Runs the parts, writes the results, and ends with status 1 where something failed."""
    data = options.data or Path(os.environ.get("SPARSESTYLE_DATA") or ROOT.parent / "shared" / "data")
    if options.quick or not (data / "llff" / "fern").is_dir():
        options.sample = True
    check = Check(options)
    check.log(f"{device_name(check.device)}, {versions()}, {check.scene.name}")
    check.run()
    check.write()
    check.log(check.verdict())
    if check.failures:
        raise SystemExit(1)


if __name__ == "__main__":
    main(tyro.cli(GpuCheckOptions, description=__doc__))
