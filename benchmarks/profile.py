"""Where the time of an iteration goes, in either stage: the operators' own time, gathered into parts. Ours alone."""

import re
from collections import defaultdict
from typing import Any, Dict, List, Tuple

import torch
import tyro
from torch.profiler import ProfilerActivity, profile

from benchmarks._measure import Options, Report
from benchmarks._scene import COARSE_METHOD, at_size, find_or_train_coarse, find_scene, style_config
from sparsestyle_ns.engine.training import Training
from sparsestyle_ns.method_configs import method_config
from sparsestyle_ns.utils.errors import exit_on_input_error

STAGE_1_SIDE, STAGE_2_SIDE = 126, 252
PARTS: Tuple[Tuple[str, str], ...] = (
    ("hash grid", r"_Fused"),
    ("layers in blocks or thinned, without their products", r"_ThinnedMLP|_BlockedMLP"),
    ("feature network's convolutions and pooling", r"conv|pool2d"),
    ("matrix products", r"::(mm|addmm|bmm|linear|matmul)$|mkldnn_linear"),
    ("optimiser", r"[Aa]dam|[Oo]ptimizer"),
    ("number formats and copies", r"::(to|_to_copy|copy_|clone|contiguous|cat)$"),
)
"""Name and pattern of the operators; the first that fits counts."""
REST = "all else"


def part_of(operator: str) -> str:
    """Which part an operator belongs to."""
    return next((part for part, pattern in PARTS if re.search(pattern, operator)), REST)


def gather(times: List[Tuple[str, float]]) -> Dict[str, Any]:
    """Shares of the parts, largest first, and of each part the operators that take most.

    Args:
        times: (operator, its own time) pairs, in any unit.
    """
    parts: Dict[str, float] = defaultdict(float)
    operators: Dict[str, Dict[str, float]] = defaultdict(lambda: defaultdict(float))
    whole = sum(time for _, time in times)
    for operator, time in times:
        parts[part_of(operator)] += time / whole
        operators[part_of(operator)][operator] += time / whole
    largest = sorted(parts, key=lambda part: -parts[part])
    return {
        part: {"share": parts[part], "operators": dict(sorted(operators[part].items(), key=lambda item: -item[1])[:4])}
        for part in largest
    }


def profiled(training: Training, warm_up: int, steps: int) -> Dict[str, Any]:
    """Shares of an iteration's time, after some that don't count."""
    for _ in range(warm_up):
        training.step()
    on_gpu = torch.cuda.is_available() and training.pipeline.device.type == "cuda"
    activities = [ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU]
    with profile(activities=activities) as record:
        for _ in range(steps):
            training.step()
    time = "self_device_time_total" if on_gpu else "self_cpu_time_total"
    return gather([(event.key, getattr(event, time)) for event in record.key_averages()])


@exit_on_input_error
def main(options: Options) -> None:
    """Profiles both stages and prints the shares."""
    report = Report("profile", options)
    scene = find_scene(options)
    side = STAGE_1_SIDE // 4 if options.quick else STAGE_1_SIDE
    stage_1 = Training(at_size(method_config(COARSE_METHOD), scene, side), report.device)
    coarse = find_or_train_coarse(scene, options)
    config = style_config(scene, coarse, STAGE_2_SIDE, options, only_whole=True)
    config.pipeline.warm_start_steps = 0
    warm_up, steps = (2, 2) if options.quick else (50, 50)
    found = {"stage 1": profiled(stage_1, warm_up, steps)}
    stage_2 = Training(config, report.device, coarse.model_state())
    found["stage 2"] = profiled(stage_2, 1 if options.quick else 3, 1 if options.quick else 6)
    for stage, parts in found.items():
        print(f"{stage}:")
        for part, content in parts.items():
            names = ", ".join(f"{name} {share:.0%}" for name, share in content["operators"].items())
            print(f"  {content['share']:4.0%} {part}: {names}")
    report.extra["settings"] = {"sides": [STAGE_1_SIDE, STAGE_2_SIDE]}
    report.extra["shares"] = found
    report.notes.append("Shares of the operators' own time, by torch's profiler, which takes time itself.")
    report.write()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
