"""All feature networks, and the one that a run gets. A new one is a `Backbone` and its line in `BACKBONES`."""

from pathlib import Path
from typing import Dict, Literal, Optional, Type

from sparsestyle_ns.style.backbone import Backbone, Weights
from sparsestyle_ns.style.vgg import VGG16, ShiftTolerantVGG16
from sparsestyle_ns.utils.errors import InputError

BACKBONES: Dict[str, Type[Backbone]] = {kind.name: kind for kind in (VGG16, ShiftTolerantVGG16)}
"""By name, in the order in which `auto` looks for weights."""

BackboneChoice = Literal[("auto", *BACKBONES)]


def load_backbone(name: str = "auto", weights: Optional[Path] = None) -> Backbone:
    """The feature network, on the CPU, with weights from a file or from wherever this machine has them.

    `auto` is the network that the file is of, else the first that has weights here. An `InputError` where there are no
    weights to be had, or the file is not of the network asked for.
    """
    if weights is not None:
        return _load_file(name, Path(weights).expanduser())
    absent = ""
    for kind in BACKBONES.values() if name == "auto" else (BACKBONES[name],):
        found = kind.find_weights()
        if found is not None:
            found = Weights(found.path, found.source + absent)
            return kind.load(found, found.read())
        absent += f"; {kind.why_absent()}"
    ways = ", or ".join(kind.how_to_get() for kind in BACKBONES.values())
    raise InputError(f"There are no weights for --backbone {name}", f"give a file with --vgg-weights, or {ways}")


def available_backbone() -> Optional[str]:
    """The name of the network that `load_backbone()` gives; None where it would find no weights."""
    return next((kind.name for kind in BACKBONES.values() if kind.find_weights() is not None), None)


def _load_file(name: str, path: Path) -> Backbone:
    if not path.is_file():
        raise InputError(f"There is no VGG weight file {path}", "check the path given as --vgg-weights")
    weights = Weights(path, f"the file {path}, as asked for")
    state = weights.read()
    kind = next((kind for kind in BACKBONES.values() if kind.accepts(state)), VGG16)  # which says what is wrong
    if name not in ("auto", kind.name):
        raise InputError(f"The weight file {path} is of {kind.name}, not of {name}", "give another file or --backbone")
    return kind.load(weights, state)
