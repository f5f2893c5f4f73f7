"""What a feature network is, and the weight file it is made from."""

import hashlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Dict, Optional

from jaxtyping import Float
from torch import Tensor, nn

from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.weight_files import read_state


@dataclass(frozen=True)
class BackboneDescription:
    """Which feature network is in use, and where its weights came from, in words."""

    name: str
    source: str
    sha256: str
    """Of the weight file, 64 hexadecimal digits."""


@dataclass(frozen=True)
class Weights:
    """A weight file on this machine, and how it was found, in words."""

    path: Path
    source: str

    def read(self) -> Dict[str, Any]:
        """The file's state dict, on the CPU; an `InputError` where it is damaged, or holds something else."""
        try:
            return read_state(self.path)
        except ValueError as error:
            raise InputError(
                f"The VGG weight file {self.path} is {error}", "fetch it again, or give another with --vgg-weights"
            ) from error

    def describe(self, name: str) -> BackboneDescription:
        """The description of the network `name` with these weights."""
        return BackboneDescription(name, self.source, hashlib.sha256(self.path.read_bytes()).hexdigest())


class Backbone(nn.Module, ABC):
    """A frozen network, `--backbone NAME`, that turns pictures into feature maps."""

    name: ClassVar[str]
    channels: ClassVar[int]
    smallest_side: ClassVar[int]
    """Pixels that each side of a picture must have."""
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
        """The network, on the CPU, frozen and in evaluation mode; an `InputError` where the state isn't one of it."""

    @abstractmethod
    def forward(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        """Feature maps, 0 or more, of RGB images in [0, 1]; a gradient reaches the images."""
