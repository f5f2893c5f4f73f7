"""Style and content loss of a whole view's features, against ARF's algorithm written out."""

import tempfile
from pathlib import Path
from typing import Any, Callable, Dict, Tuple

import psutil
import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float
from torch import Tensor

from benchmarks._measure import Options, Report, check_equal, in_fresh_process, peak_bytes, ratio_of_pairs, timed
from benchmarks._scene import BACKBONE, find_scene, load_photos
from sparsestyle_ns.losses.content import content_loss
from sparsestyle_ns.losses.nnfm import nnfm_loss
from sparsestyle_ns.losses.style_index import StyleIndex
from sparsestyle_ns.losses.stylization import feature_rows, fit_side
from sparsestyle_ns.style.backbones import load_backbone
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import exit_on_input_error

PHOTO_SIDE, STYLE_SIDE = 504, 1000
TARGET = 2.0
SIMILARITIES_AT_ONCE = 100_000_000
"""400 MB in float32."""
TOLERANCE = 1e-4

Losses = Callable[[Tensor, Any, Tensor], Tensor]
"""Features of the view, of the style and of the content picture -> L_style + L_content."""


def arf_nnfm(features: Float[Tensor, "N C"], style_features: Float[Tensor, "M C"]) -> Float[Tensor, ""]:
    """NNFM loss as ARF computes it (Sec. 4): every cosine in float32, a slice of the rows at a time; argmin; gather."""
    with torch.no_grad():
        style_directions = F.normalize(style_features, dim=-1)
        rows = max(1, SIMILARITIES_AT_ONCE // len(style_features))
        distances = (1.0 - F.normalize(part, dim=-1) @ style_directions.T for part in features.split(rows))
        nearest = torch.cat([distance.argmin(dim=-1) for distance in distances])
    return (1.0 - F.cosine_similarity(features, style_features[nearest], dim=-1)).mean()


def ours(features: Tensor, style: StyleIndex, content: Tensor) -> Tensor:
    """Our losses; the style's index is made once for a whole run, so that making it isn't on the clock."""
    return nnfm_loss(features, style) + content_loss(features, content)


def reference(features: Tensor, style: Tensor, content: Tensor) -> Tensor:
    """ARF's; the content loss is divided by the target's mean square, as ours is, so that the two can be compared."""
    return arf_nnfm(features, style) + F.mse_loss(features, content) / content.square().mean()


LOSSES: Dict[str, Losses] = {"ours": ours, "reference": reference}


def prepared(name: str, style: Tensor) -> Any:
    """The style's features as a contender takes them."""
    return StyleIndex(style) if name == "ours" else style


def forward_backward(losses: Losses, features: Tensor, style: Any, content: Tensor) -> Tuple[Tensor, Tensor]:
    """Value and gradient."""
    features = features.detach().requires_grad_()
    value = losses(features, style, content)
    value.backward()
    return value.detach(), features.grad


def peak_of(name: str, tensors: Path, options: Options) -> int:
    """The most memory, in bytes beside the features, that one contender takes, in a process that does nothing else."""
    device = options.set_up()
    features, style, content = (tensor.to(device) for tensor in torch.load(tensors))
    arguments = features, prepared(name, style), content
    before = psutil.Process().memory_info().rss if device.type == "cpu" else torch.cuda.memory_allocated(device)
    forward_backward(LOSSES[name], *arguments)
    return peak_bytes(device) - before


@torch.no_grad()
def features_of_scene(options: Options, device: torch.device) -> Tuple[Tensor, Tensor, Tensor]:
    """Features of one photo, of the painting, and of another photo as content: one vector a row."""
    scene, shrink = find_scene(options), 4 if options.quick else 1
    backbone = load_backbone(BACKBONE).to(device)
    photos = load_photos(scene, PHOTO_SIDE // shrink).train_dataset
    pictures = [photos[index]["image"][..., :3].permute(2, 0, 1)[None] for index in (0, 1)]
    pictures.insert(1, fit_side(Painting.read(scene.style_image).pixels[None], STYLE_SIDE // shrink))
    view, style, content = (feature_rows(backbone(picture.to(device))) for picture in pictures)
    return view, style, content


@exit_on_input_error
def main(options: Options) -> None:
    """Measures time and memory of both."""
    report = Report("nnfm", options)
    tensors = features_of_scene(options, report.device)
    view, style, content = tensors
    work = {name: (losses, view, prepared(name, style), content) for name, losses in LOSSES.items()}
    (value, gradient), (peer_value, peer_gradient) = (forward_backward(*arguments) for arguments in work.values())
    check_equal(value, peer_value, "losses", TOLERANCE)
    # Two style vectors that are equally near up to rounding may be chosen differently, so single rows may differ.
    check_equal(gradient.norm(), peer_gradient.norm(), "size of gradients", 10 * TOLERANCE)

    measures = {
        name: timed(forward_backward, report.device, lambda repetition, arguments=arguments: arguments)
        for name, arguments in work.items()
    }
    found = report.measure("forward_backward", measures, options.repetitions(7), warm_up=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "features.pt"
        torch.save([tensor.cpu() for tensor in tensors], path)
        peaks = {name: in_fresh_process(peak_of, name, path, options) for name in LOSSES}

    sizes = {name: len(rows) for name, rows in zip(("view", "style", "content"), tensors, strict=True)}
    report.extra["settings"] = {"feature_vectors": sizes, "channels": tensors[0].shape[-1]}
    report.extra["peak_bytes"] = peaks
    report.extra["losses"] = {"ours": value.item(), "reference": peer_value.item()}
    report.notes.append("Peaks of memory are beside the features themselves, each in a process of its own.")
    report.add_row(
        "nnfm",
        f"NNFM and content loss, {sizes['view']:,} feature vectors against {sizes['style']:,}, forward and backward",
        "ARF's algorithm in torch",
        ratio_of_pairs(found["reference"], found["ours"]),
        TARGET,
        bytes=peaks["ours"],
        against_bytes=peaks["reference"],
    )
    report.write()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
