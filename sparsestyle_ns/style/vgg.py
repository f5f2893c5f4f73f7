"""VGG-16 features of block 3, and where their weights come from on a machine without a network.

Two networks with the same convolutions are known:

- `vgg16`: VGG-16 as torchvision has it, with 2×2 max pooling of stride 2;
- `vgg16-shift-tolerant`: the trunk of ST-LPIPS, in which max pooling has stride 1 and a 3×3 binomial blur of stride 2
  follows, after reflecting two pixels over each border. Its maps have one row and one column more: H ↦ ⌊H/2⌋ + 1.
"""

import contextlib
import http.client
import importlib.util
import itertools
import socket
import sys
from pathlib import Path
from typing import Any, ClassVar, Dict, Iterator, Optional, Tuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sparsestyle_ns.style.backbone import Backbone, BackboneDescription, Weights, check_tensor
from sparsestyle_ns.utils.errors import InputError

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
        self.register_buffer("kernel", torch.empty(channels, 1, 3, 3))

    def forward(self, maps: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C h w"]:
        """Each channel pooled and blurred, h = ⌊H/2⌋ + 1 rows and w = ⌊W/2⌋ + 1 columns."""
        peaks = F.max_pool2d(maps, kernel_size=2, stride=1)
        padded = F.pad(peaks, (2, 2, 2, 2), mode="reflect")
        return F.conv2d(padded, self.kernel, stride=2, groups=self.kernel.shape[0])


class VGGBlock3(Backbone):
    """relu3_1, relu3_2 and relu3_3 of VGG-16, joined in this order; what both networks have in common.

    Args:
        description: which of the two networks this is, and its origin.
        trunk: its parameters and buffers, named as in this module.
        memory_format: how its feature maps lie in memory.
    """

    channels = sum(BLOCK_CHANNELS[-1][1:])
    smallest_side = 8
    """Each side is halved twice before block 3."""
    stored_blocks: ClassVar[Tuple[Tuple[str, ...], ...]]
    """What the weight file calls the convolutions of each block."""
    stored_pools: ClassVar[Tuple[str, ...]] = ()
    """And the blurs between the blocks, where it has some."""

    def __init__(
        self,
        description: BackboneDescription,
        trunk: Dict[str, Tensor],
        memory_format: torch.memory_format = torch.channels_last,
    ) -> None:
        super().__init__()
        self.description, self.memory_format = description, memory_format
        # Built without storage: the weights come from `trunk`, and torch's random state stays untouched.
        with torch.device("meta"):
            self.blocks = nn.ModuleList(
                nn.ModuleList(nn.Conv2d(*pair, kernel_size=3, padding=1) for pair in itertools.pairwise(channels))
                for channels in BLOCK_CHANNELS
            )
            self.pools = nn.ModuleList(self.new_pool(channels[-1]) for channels in BLOCK_CHANNELS[:-1])
        self.load_state_dict(trunk, assign=True)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)
        self.requires_grad_(False)
        self.eval()
        self.to(memory_format=memory_format)

    @staticmethod
    def new_pool(channels: int) -> nn.Module:
        """What halves the maps between two blocks."""
        return nn.MaxPool2d(2)

    @classmethod
    def load(cls, weights: Weights, state: Dict[str, Any]) -> "VGGBlock3":
        """See `Backbone.load`."""
        try:
            cls.refuse_relatives(state)
            trunk = {key: check_tensor(state, *stored).float() for key, stored in cls._layout().items()}
        except ValueError as error:
            raise InputError(
                f"The VGG weight file {weights.path} is not VGG-16 up to relu3_3 ({error}): give torchvision's "
                f"{VGG16_FILE} or ST-LPIPS' vgg_shift_tolerant.pth."
            ) from error
        return cls(weights.describe(cls.name), trunk)

    @classmethod
    def refuse_relatives(cls, state: Dict[str, Any]) -> None:
        """Raises a `ValueError` for a network that has the same shapes up to relu3_3, but other weights."""

    @classmethod
    def _layout(cls) -> Dict[str, Tuple[str, Tuple[int, ...]]]:
        """For each parameter of this module its name in the weight file, and its shape."""
        layout: Dict[str, Tuple[str, Tuple[int, ...]]] = {}
        for i, (stored_block, channels) in enumerate(zip(cls.stored_blocks, BLOCK_CHANNELS, strict=True)):
            for j, (stored, (fan_in, fan_out)) in enumerate(
                zip(stored_block, itertools.pairwise(channels), strict=True)
            ):
                layout[f"blocks.{i}.{j}.weight"] = (f"{stored}.weight", (fan_out, fan_in, 3, 3))
                layout[f"blocks.{i}.{j}.bias"] = (f"{stored}.bias", (fan_out,))
        for i, stored in enumerate(cls.stored_pools):
            layout[f"pools.{i}.kernel"] = (f"{stored}.filt", (BLOCK_CHANNELS[i][-1], 1, 3, 3))
        return layout

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B C h w"]:
        """See `Backbone.forward`; h = ⌊⌊H/2⌋/2⌋ for `vgg16`, ⌊(⌊H/2⌋ + 1)/2⌋ + 1 for `vgg16-shift-tolerant`."""
        maps = ((images - self.mean) / self.std).contiguous(memory_format=self.memory_format)
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
    stored_blocks = (
        ("features.0", "features.2"),
        ("features.5", "features.7"),
        ("features.10", "features.12", "features.14"),
    )

    @staticmethod
    def cached_file() -> Path:
        """Where the torch hub cache has it, or would."""
        return Path(torch.hub.get_dir()) / "checkpoints" / VGG16_FILE

    @classmethod
    def find_weights(cls) -> Optional[Weights]:
        """See `Backbone.find_weights`."""
        cached = cls.cached_file()
        if cached.is_file():
            return Weights(cached, f"torchvision's VGG-16 (IMAGENET1K_V1) in the torch hub cache, {cached}")
        if _download(cached):
            return Weights(cached, f"torchvision's VGG-16 (IMAGENET1K_V1), downloaded from {VGG16_URL} to {cached}")
        return None

    @classmethod
    def how_to_get(cls) -> str:
        """See `Backbone.how_to_get`."""
        return f"put {VGG16_FILE} into the folder {cls.cached_file().parent}"

    @classmethod
    def why_absent(cls) -> str:
        """See `Backbone.why_absent`."""
        return f"torchvision's VGG-16 is not in {cls.cached_file().parent} and could not be downloaded"

    @classmethod
    def accepts(cls, state: Dict[str, Any]) -> bool:
        """See `Backbone.accepts`."""
        return not ShiftTolerantVGG16.accepts(state) and any(str(key).startswith("features.") for key in state)

    @classmethod
    def refuse_relatives(cls, state: Dict[str, Any]) -> None:
        """VGG-19 has the same shapes up to relu3_3, but other weights."""
        for key in map(str, state):
            prefix, _, rest = key.partition(".")
            layer = rest.partition(".")[0]
            if prefix == "features" and not (layer.isdigit() and int(layer) in PLAIN_CONVOLUTIONS):
                raise ValueError(f"{key} belongs to another network")


class ShiftTolerantVGG16(VGGBlock3):
    """The anti-aliased trunk inside the package stlpips-pytorch, of which only the weight file is read."""

    name = "vgg16-shift-tolerant"
    stored_blocks = (
        ("net.slice1.0", "net.slice1.2"),
        ("net.slice2.6", "net.slice2.8"),
        ("net.slice3.12", "net.slice3.14", "net.slice3.16"),
    )
    stored_pools = ("net.slice2.5", "net.slice3.11")

    @staticmethod
    def new_pool(channels: int) -> nn.Module:
        """See `VGGBlock3.new_pool`."""
        return BlurPool(channels)

    @classmethod
    def find_weights(cls) -> Optional[Weights]:
        """See `Backbone.find_weights`; the file is found without running any of the package's code."""
        package = importlib.util.find_spec("stlpips_pytorch")
        if package is None or not package.submodule_search_locations:
            return None
        path = Path(package.submodule_search_locations[0]) / "weights" / "vST0.0" / "vgg_shift_tolerant.pth"
        if not path.is_file():
            return None
        return Weights(path, f"the anti-aliased VGG-16 inside the package stlpips-pytorch, {path}")

    @classmethod
    def how_to_get(cls) -> str:
        """See `Backbone.how_to_get`."""
        return f"use --backbone {cls.name} (or auto) with the package stlpips-pytorch installed"

    @classmethod
    def why_absent(cls) -> str:
        """See `Backbone.why_absent`."""
        return "the package stlpips-pytorch isn't installed"

    @classmethod
    def accepts(cls, state: Dict[str, Any]) -> bool:
        """See `Backbone.accepts`."""
        return any(str(key).startswith("net.slice") and str(key).endswith(".filt") for key in state)


def _download(target: Path) -> bool:
    """Whether torchvision's VGG-16 could be fetched. The bar of this half gigabyte is shown on a terminal only."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with _socket_timeout(NETWORK_TIMEOUT):
            torch.hub.download_url_to_file(VGG16_URL, str(target), VGG16_HASH, progress=sys.stderr.isatty())
    # RuntimeError is torch's word for a hash that is wrong, as behind a login page.
    except (OSError, http.client.HTTPException, RuntimeError):
        return False
    return True


@contextlib.contextmanager
def _socket_timeout(seconds: float) -> Iterator[None]:
    """torch.hub takes no timeout of its own and would wait for minutes."""
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(seconds)
    try:
        yield
    finally:
        socket.setdefaulttimeout(before)
