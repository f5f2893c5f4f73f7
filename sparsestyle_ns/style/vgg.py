"""VGG-16 features of block 3, by either of two networks with the same convolutions.

`vgg16` is torchvision's, with 2×2 max pooling of stride 2. In `vgg16-shift-tolerant`, ST-LPIPS' trunk, max pooling has
stride 1 and a 3×3 binomial blur of stride 2 follows, with two pixels reflected over each border: H ↦ ⌊H/2⌋ + 1.
"""

import http.client
import itertools
import socket
import sys
from pathlib import Path
from typing import Any, ClassVar, Dict, Optional, Tuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sparsestyle_ns.style.backbone import Backbone, BackboneDescription, Weights
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.weight_files import check_tensor, hub_file, shift_tolerant_file

VGG16_FILE = "vgg16-397923af.pth"
VGG16_URL = f"https://download.pytorch.org/models/{VGG16_FILE}"
VGG16_HASH = "397923af"
NETWORK_TIMEOUT = 5.0
"""Seconds without an answer after which the network counts as absent."""

BLOCK_CHANNELS = ((3, 64, 64), (64, 128, 128), (128, 256, 256, 256))
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
PLAIN_CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Where VGG-16 has convolutions; VGG-19 and the variants with batch normalisation have parameters elsewhere too."""


class BlurPool(nn.Module):
    """Max pooling of stride 1, then a blur of stride 2: halves an image without aliasing."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("filt", torch.empty(channels, 1, 3, 3))

    def forward(self, maps: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C h w"]:
        """Each channel pooled and blurred, h = ⌊H/2⌋ + 1 and w = ⌊W/2⌋ + 1."""
        padded = F.pad(F.max_pool2d(maps, kernel_size=2, stride=1), (2, 2, 2, 2), mode="reflect")
        return F.conv2d(padded, self.filt, stride=2, groups=self.filt.shape[0])


class VGGBlock3(Backbone):
    """relu3_1, relu3_2 and relu3_3 of VGG-16, joined in this order; what both networks have in common."""

    channels = sum(BLOCK_CHANNELS[-1][1:])
    smallest_side = 8
    stored: ClassVar[Tuple[str, ...]]
    """What the weight file calls the layers that have weights, in order, convolutions first."""
    is_blurred: ClassVar[bool] = False

    def __init__(self, description: BackboneDescription) -> None:
        super().__init__()
        self.description = description
        with torch.device("meta"):  # weights are given to it, and torch's random state stays untouched
            self.blocks = nn.ModuleList(
                nn.ModuleList(nn.Conv2d(*pair, kernel_size=3, padding=1) for pair in itertools.pairwise(channels))
                for channels in BLOCK_CHANNELS
            )
            self.pools = nn.ModuleList(
                BlurPool(channels[-1]) if self.is_blurred else nn.MaxPool2d(2) for channels in BLOCK_CHANNELS[:-1]
            )
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    @classmethod
    def accepts(cls, state: Dict[str, Any]) -> bool:
        """See `Backbone.accepts`."""
        return any(str(key).rpartition(".")[0] in cls.stored for key in state)

    @classmethod
    def load(cls, weights: Weights, state: Dict[str, Any]) -> "VGGBlock3":
        """See `Backbone.load`."""
        network, trunk = cls(weights.describe(cls.name)), {}
        try:
            _refuse_relatives(state)
            layers = dict.fromkeys(key.rpartition(".")[0] for key in network.state_dict())
            stored = dict(zip(layers, cls.stored, strict=True))
            for key, value in network.state_dict().items():
                layer, _, parameter = key.rpartition(".")
                trunk[key] = check_tensor(state, f"{stored[layer]}.{parameter}", value.shape).float()
        except ValueError as error:
            raise InputError(
                f"The VGG weight file {weights.path} is not VGG-16 up to relu3_3 ({error}): give torchvision's "
                f"{VGG16_FILE} or ST-LPIPS' vgg_shift_tolerant.pth."
            ) from error
        network.load_state_dict(trunk, assign=True)
        return network.requires_grad_(False).eval().to(memory_format=torch.channels_last)

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        """See `Backbone.forward`; h = ⌊⌊H/2⌋/2⌋ for `vgg16`, ⌊(⌊H/2⌋ + 1)/2⌋ + 1 for `vgg16-shift-tolerant`."""
        maps = ((images - self.mean) / self.std).contiguous(memory_format=torch.channels_last)
        for block, pool in zip(self.blocks[:-1], self.pools, strict=True):
            for convolution in block:
                maps = F.relu(convolution(maps))
            maps = pool(maps)
        features = []
        for convolution in self.blocks[-1]:
            maps = F.relu(convolution(maps))
            features.append(maps)
        return torch.cat(features, dim=1)


class VGG16(VGGBlock3):
    """torchvision's VGG-16 (IMAGENET1K_V1): from the torch hub cache, or downloaded into it."""

    name = "vgg16"
    stored: ClassVar = tuple(f"features.{n}" for n in PLAIN_CONVOLUTIONS[:7])

    @classmethod
    def find_weights(cls) -> Optional[Weights]:
        """See `Backbone.find_weights`."""
        cached = hub_file(VGG16_FILE)
        if cached.is_file():
            return Weights(cached, f"torchvision's VGG-16 (IMAGENET1K_V1) in the torch hub cache, {cached}")
        if _download(cached):
            return Weights(cached, f"torchvision's VGG-16 (IMAGENET1K_V1), downloaded from {VGG16_URL} to {cached}")
        return None

    @classmethod
    def how_to_get(cls) -> str:
        """See `Backbone.how_to_get`."""
        return f"put {VGG16_FILE} into the folder {hub_file(VGG16_FILE).parent}"

    @classmethod
    def why_absent(cls) -> str:
        """See `Backbone.why_absent`."""
        return f"torchvision's VGG-16 is not in {hub_file(VGG16_FILE).parent} and could not be downloaded"


class ShiftTolerantVGG16(VGGBlock3):
    """The anti-aliased trunk inside the package stlpips-pytorch, of which only the weight file is read."""

    name = "vgg16-shift-tolerant"
    stored: ClassVar = tuple(
        f"net.slice{n}" for n in ["1.0", "1.2", "2.6", "2.8", "3.12", "3.14", "3.16", "2.5", "3.11"]
    )
    is_blurred = True

    @classmethod
    def find_weights(cls) -> Optional[Weights]:
        """See `Backbone.find_weights`."""
        path = shift_tolerant_file("vgg_shift_tolerant.pth")
        return path and Weights(path, f"the anti-aliased VGG-16 inside the package stlpips-pytorch, {path}")

    @classmethod
    def how_to_get(cls) -> str:
        """See `Backbone.how_to_get`."""
        return f"use --backbone {cls.name} (or auto) with the package stlpips-pytorch installed"

    @classmethod
    def why_absent(cls) -> str:
        """See `Backbone.why_absent`."""
        return "the package stlpips-pytorch isn't installed"


def _refuse_relatives(state: Dict[str, Any]) -> None:
    """Raises a `ValueError` for VGG-19, say, whose shapes up to relu3_3 are the same."""
    for key in map(str, state):
        network, layer, *_ = [*key.split("."), ""]
        if network == "features" and not (layer.isdigit() and int(layer) in PLAIN_CONVOLUTIONS):
            raise ValueError(f"{key} belongs to another network")


def _download(target: Path) -> bool:
    """Whether torchvision's VGG-16, half a gigabyte, could be fetched."""
    before = socket.getdefaulttimeout()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        socket.setdefaulttimeout(NETWORK_TIMEOUT)  # torch.hub takes no timeout of its own and would wait for minutes
        torch.hub.download_url_to_file(VGG16_URL, str(target), VGG16_HASH, progress=sys.stderr.isatty())
    # RuntimeError is torch's word for a hash that is wrong, as behind a login page.
    except (OSError, http.client.HTTPException, RuntimeError):
        return False
    finally:
        socket.setdefaulttimeout(before)
    return True
