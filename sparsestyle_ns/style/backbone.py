"""What a feature network is to the rest of the package, and how its weight file is read."""

import hashlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Dict, Optional, Tuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sparsestyle_ns.utils.errors import InputError


@dataclass(frozen=True)
class BackboneDescription:
    """Which feature network is in use and where its weights came from.

    Attributes:
        name: of the network, as on the command line.
        source: where the weights came from, in words.
        sha256: of the weight file, 64 hexadecimal digits.
    """

    name: str
    source: str
    sha256: str


@dataclass(frozen=True)
class Weights:
    """A weight file on this machine.

    Attributes:
        path: the file.
        source: how it was found, in words.
    """

    path: Path
    source: str

    def read(self) -> Dict[str, Any]:
        """The file's state dict, on the CPU.

        Raises:
            InputError: it is damaged, or holds something else.
        """
        try:
            state = torch.load(self.path, map_location="cpu", weights_only=True)
        # A file that is no checkpoint surfaces as any of a dozen errors from the middle of torch and pickle.
        except Exception as error:
            raise InputError(
                f"The VGG weight file {self.path} is damaged or not a PyTorch state dict: fetch it again, or give "
                "another with --vgg-weights."
            ) from error
        if not isinstance(state, dict):
            raise InputError(
                f"The VGG weight file {self.path} is no weight file, it holds no state dict: give another with "
                "--vgg-weights."
            )
        return state

    def describe(self, name: str) -> BackboneDescription:
        """The description of the network `name` with these weights."""
        digest = hashlib.sha256()
        with self.path.open("rb") as file:
            while chunk := file.read(1 << 20):
                digest.update(chunk)
        return BackboneDescription(name, self.source, digest.hexdigest())


class Backbone(nn.Module, ABC):
    """A frozen network that turns pictures into feature maps.

    Attributes:
        name: on the command line, `--backbone NAME`.
        channels: of the feature maps.
        smallest_side: pixels that each side of a picture must have.
        description: which network this is, and where its weights came from.
    """

    name: ClassVar[str]
    channels: ClassVar[int]
    smallest_side: ClassVar[int]
    description: BackboneDescription

    @classmethod
    @abstractmethod
    def find_weights(cls) -> Optional[Weights]:
        """The weights on this machine, fetched where that is possible; None if there are none."""

    @classmethod
    @abstractmethod
    def how_to_get(cls) -> str:
        """What a person can do to have these weights; completes the sentence "… , or"."""

    @classmethod
    @abstractmethod
    def why_absent(cls) -> str:
        """Where the weights were looked for in vain; a clause."""

    @classmethod
    @abstractmethod
    def accepts(cls, state: Dict[str, Any]) -> bool:
        """Whether a state dict looks like one of this network."""

    @classmethod
    @abstractmethod
    def load(cls, weights: Weights, state: Dict[str, Any]) -> "Backbone":
        """The network with these weights, on the CPU, in evaluation mode and without gradients of its own.

        Raises:
            InputError: the state isn't one of this network.
        """

    @abstractmethod
    def forward(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        """Feature maps, 0 or more, of RGB images in [0, 1]; a gradient reaches the images."""


def check_tensor(state: Dict[str, Any], key: str, shape: Tuple[int, ...]) -> Tensor:
    """The tensor of a state dict under this name.

    Raises:
        ValueError: it is missing, has another shape, or isn't finite; the message says which.
    """
    value = state.get(key)
    if not isinstance(value, Tensor):
        raise ValueError(f"{key} is missing")
    if tuple(value.shape) != shape:
        raise ValueError(f"{key} has the shape {tuple(value.shape)} instead of {shape}")
    if not value.isfinite().all():
        raise ValueError(f"{key} has values that are not finite")
    return value
