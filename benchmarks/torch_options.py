"""What torch's own means of speed do for the parts of an iteration: compiling, number formats, memory layout.

The parts run as they do in training, and with one thing changed. Beside the times stands how far the results, gradients
where there are any, are from those of float32. On a GPU `torch.compile` is tried with CUDA graphs too.
"""

import contextlib
import copy
import statistics
from typing import Any, Callable, ContextManager, Dict, Iterator, List

import torch
import torch.nn.functional as F
import tyro
from torch import Tensor, nn
from torch.backends import cudnn

from benchmarks._measure import Duration, Measure, Options, Report, ratio_of_pairs, timed
from benchmarks._scene import BACKBONE
from benchmarks.nnfm import features_of_scene
from sparsestyle_ns.core.precision import Precision, autocast
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.losses.nnfm import CHUNK_SIZE
from sparsestyle_ns.losses.style_index import StyleIndex
from sparsestyle_ns.losses.stylization import feature_rows
from sparsestyle_ns.style.backbones import load_backbone
from sparsestyle_ns.utils.errors import exit_on_input_error

USUAL, EXACT = "as it is", "float32"
Work = Callable[[], Tensor]
"""Does a part once, and returns what the options' results are compared by."""


def compiled(module: nn.Module, names: List[str], **settings: Any) -> nn.Module:
    """A copy of a module with some of its functions compiled for the shapes that they meet."""
    module = copy.deepcopy(module)
    for name in names:
        setattr(module, name, torch.compile(getattr(module, name), dynamic=False, **settings))
    return module


def compilers(device: torch.device) -> Dict[str, Dict[str, Any]]:
    """Settings of torch.compile that are tried on a device, by what the table calls them."""
    graphs = {"torch.compile with CUDA graphs": {"mode": "reduce-overhead"}}
    return {"torch.compile": {}, **(graphs if device.type == "cuda" else {})}


def formats(device: torch.device) -> Dict[str, Callable[[], ContextManager]]:
    """Contexts of the number formats that a device may multiply in."""
    names = ("float32", "bfloat16", *(("tf32",) if device.type == "cuda" else ()))
    return {name: lambda name=name: _all_in(device, name) for name in names}


@contextlib.contextmanager
def _all_in(device: torch.device, precision: Precision) -> Iterator[None]:
    """As `autocast`, for convolutions too: left alone, cuDNN runs them in TF32 whatever the matrix products have."""
    before, cudnn.allow_tf32 = cudnn.allow_tf32, precision == "tf32"
    try:
        with autocast(device, precision):
            yield
    finally:
        cudnn.allow_tf32 = before


def feature_works(side: int, device: torch.device) -> Dict[str, Work]:
    """The feature network on a picture, and back to the picture."""
    torch.manual_seed(0)
    network = load_backbone(BACKBONE).to(device)
    picture = torch.rand(1, 3, round(side * 0.75), side, device=device)

    def work(module: nn.Module, context: Callable[[], ContextManager] = contextlib.nullcontext) -> Tensor:
        leaf = picture.clone().requires_grad_()
        with context():
            rows = feature_rows(module(leaf))
        (gradient,) = torch.autograd.grad(rows.float().square().mean(), leaf)
        return gradient

    turned = copy.deepcopy(network).to(memory_format=torch.contiguous_format)
    works: Dict[str, Work] = {USUAL: lambda: work(network), "channels first": lambda: work(turned)}
    for name, context in formats(device).items():
        works[name] = lambda context=context: work(network, context)
    for name, settings in compilers(device).items():
        module = compiled(network, ["forward"], **settings)
        works[name] = lambda module=module: work(module)
    return works


def residual_works(count: int, device: torch.device) -> Dict[str, Work]:
    """The residual field at points, and back to its parameters."""
    torch.manual_seed(0)
    field = ResidualField(HashGrid(), feature_dim=64).to(device)
    nn.init.normal_(field.density_head.weight, std=0.1)
    location = field.locate(2.0 * torch.rand(count, 3, device=device) - 1.0)
    feature, density = torch.randn(count, 64, device=device), torch.rand(count, device=device)

    def work(module: ResidualField, context: Callable[[], ContextManager]) -> Tensor:
        with context():
            fine, color = module(location, feature, density)
        parameters = [*module.mlp.parameters(), module.grid.table]
        found = torch.autograd.grad(fine.mean() + color.square().mean(), parameters)
        return torch.cat([gradient.flatten() for gradient in found])

    return _field_works(field, work, "forward", device)


def coarse_works(count: int, device: torch.device) -> Dict[str, Work]:
    """The coarse field at points, without gradients, as stage 2 and rendering have it."""
    torch.manual_seed(0)
    field = CoarseField(density_activation="exp").to(device).requires_grad_(False)
    positions = 2.0 * torch.rand(count, 3, device=device) - 1.0

    def work(module: CoarseField, context: Callable[[], ContextManager]) -> Tensor:
        with context(), torch.no_grad():
            density, feature = module.density_and_feature(positions)
        return torch.cat([density[:, None], feature.float()], dim=-1).flatten()

    return _field_works(field, work, "_evaluate", device)


def _field_works(field: nn.Module, work: Callable[..., Tensor], function: str, device: torch.device) -> Dict[str, Work]:
    works: Dict[str, Work] = {USUAL: lambda: work(field, lambda: autocast(device, "auto"))}
    for name, context in formats(device).items():
        works[name] = lambda context=context: work(field, context)
    for name, settings in compilers(device).items():
        module = compiled(field, [function], **settings)
        works[name] = lambda module=module: work(module, lambda: autocast(device, "auto"))
    return works


def search_works(view: Tensor, style: Tensor) -> Dict[str, Work]:
    """The nearest style feature of each of a view's: by the index, and by comparing all with all in either format."""
    index = StyleIndex(style)

    def compare_all(precision: torch.dtype) -> Tensor:
        directions, style_directions = (F.normalize(rows, dim=-1).to(precision) for rows in (view, style))
        found = [(part @ style_directions.T).argmax(dim=-1) for part in directions.split(CHUNK_SIZE)]
        return torch.cat(found)

    return {
        USUAL: lambda: index.nearest(view),
        EXACT: lambda: compare_all(torch.float32),
        "bfloat16": lambda: compare_all(torch.bfloat16),
        "float16": lambda: compare_all(torch.float16),
    }


def tried(works: Dict[str, Work]) -> Dict[str, Tensor]:
    """What the options make of a part; those that can't run here, as without a compiler, are named and left out."""
    found = {}
    for name in list(works):
        try:
            found[name] = works[name]()
        except Exception as error:  # torch.compile fails in many ways, and each is an answer
            if name in (USUAL, EXACT):
                raise
            print(f"{name} doesn't run here: {type(error).__name__} {error}".splitlines()[0], flush=True)
            del works[name]
    return found


def times_as_fast(durations: Dict[str, List[Duration]], results: Dict[str, Tensor]) -> Dict[str, Dict[str, Any]]:
    """Of each option how many times as fast as usual it is, and how far its results are from float32's."""
    rows = {}
    for name, ours in durations.items():
        ratio = ratio_of_pairs(durations[USUAL], ours)
        rows[name] = {
            "seconds": statistics.median(duration.seconds for duration in ours),
            "times_as_fast": ratio.median,
            "spread": list(ratio.spread),
            "distance_to_float32": distance(results[name], results[EXACT]),
        }
    return rows


def distance(result: Tensor, exact: Tensor) -> float:
    """Relative distance of two vectors; of two choices the share that differs."""
    if not exact.is_floating_point():
        return (result != exact).float().mean().item()
    return ((result - exact).norm() / exact.norm()).item()


@exit_on_input_error
def main(options: Options) -> None:
    """Measures all parts with all options in turn."""
    report = Report("torch_options", options)
    points, side = (4_096, 64) if options.quick else (65_536, 252)
    device = report.device
    view, style, _ = features_of_scene(options, device)
    view = view[:: 1 if device.type == "cuda" else 4]  # comparing all with all takes seconds on a CPU
    parts = {
        f"feature network, {side} pixels, forward and backward": feature_works(side, device),
        f"residual field, {points:,} points, forward and backward": residual_works(points, device),
        f"coarse field, {points:,} points, no gradients": coarse_works(points, device),
        f"search, {len(view):,} feature vectors against {len(style):,}": search_works(view, style),
    }
    tables = {}
    for part, works in parts.items():
        print(part, flush=True)
        results = tried(works)
        contenders: Dict[str, Measure] = {name: timed(work, device) for name, work in works.items()}
        tables[part] = times_as_fast(report.measure(part, contenders, options.repetitions(5)), results)
        for name, row in tables[part].items():
            low, high = row["spread"]
            print(
                f"  {name}: {row['times_as_fast']:.2f} times as fast ({low:.2f} to {high:.2f}), "
                f"{row['distance_to_float32']:.1e} from float32"
            )
    report.extra["options"] = tables
    report.write()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
