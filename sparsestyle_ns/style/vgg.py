"""VGG-16 features of block 3, and where their weights come from on a machine without a network.

Two networks with the same convolutions are known:

- `vgg16`: VGG-16 as torchvision has it, with 2×2 max pooling of stride 2;
- `vgg16-shift-tolerant`: the trunk of ST-LPIPS, in which max pooling has stride 1 and a 3×3 binomial blur of stride 2
  follows, after reflecting two pixels over each border. Its maps have one row and one column more: H ↦ ⌊H/2⌋ + 1.
"""

import contextlib
import hashlib
import http.client
import importlib.util
import itertools
import socket
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterator, Literal, Optional

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sparsestyle_ns.utils.errors import InputError

FEATURE_CHANNELS = 768
"""Channels of relu3_1, relu3_2 and relu3_3 together."""

VGG16_FILE = "vgg16-397923af.pth"
VGG16_URL = f"https://download.pytorch.org/models/{VGG16_FILE}"
VGG16_HASH = "397923af"
NETWORK_TIMEOUT = 5.0
"""Seconds without an answer after which the network counts as absent."""

BLOCK_CHANNELS = ((3, 64, 64), (64, 128, 128), (128, 256, 256, 256))
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

PLAIN = "vgg16"
SHIFT_TOLERANT = "vgg16-shift-tolerant"

PLAIN_BLOCKS = (
    ("features.0", "features.2"),
    ("features.5", "features.7"),
    ("features.10", "features.12", "features.14"),
)
SHIFT_TOLERANT_BLOCKS = (
    ("net.slice1.0", "net.slice1.2"),
    ("net.slice2.6", "net.slice2.8"),
    ("net.slice3.12", "net.slice3.14", "net.slice3.16"),
)
SHIFT_TOLERANT_BLURS = ("net.slice2.5", "net.slice3.11")
PLAIN_CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Where VGG-16 has convolutions; VGG-19 and the variants with batch normalisation have parameters elsewhere too."""


@dataclass(frozen=True)
class Backbone:
    """Which feature network is in use and where its weights came from."""

    name: str
    """`vgg16` or `vgg16-shift-tolerant`."""
    source: str
    """Where the weights came from, in words."""
    sha256: str
    """SHA-256 of the weight file, 64 hexadecimal digits."""


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


class VGGFeatures(nn.Module):
    """VGG-16 up to relu3_3, frozen.

    Args:
        description: which of the two networks this is, and its origin.
        trunk: its parameters and buffers, named as in this module.
        memory_format: how its feature maps lie in memory.
    """

    def __init__(
        self,
        description: Backbone,
        trunk: dict[str, Tensor],
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
            self.pools = nn.ModuleList(
                BlurPool(channels[-1]) if description.name == SHIFT_TOLERANT else nn.MaxPool2d(2)
                for channels in BLOCK_CHANNELS[:-1]
            )
        self.load_state_dict(trunk, assign=True)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)
        self.requires_grad_(False)
        self.eval()
        self.to(memory_format=memory_format)

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 768 h w"]:
        """relu3_1, relu3_2 and relu3_3, joined in this order.

        Args:
            images: RGB in [0, 1], at least 8 pixels a side. A gradient reaches them.

        Returns:
            Features, 0 or more; h = ⌊⌊H/2⌋/2⌋ for `vgg16`, ⌊(⌊H/2⌋ + 1)/2⌋ + 1 for `vgg16-shift-tolerant`.
        """
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


def load_backbone(
    backbone: Literal["auto", "vgg16", "vgg16-shift-tolerant"] = "auto", weights: Optional[Path] = None
) -> VGGFeatures:
    """The feature network, from the first of these that is there.

    1. `weights`; 2. torchvision's VGG-16 (IMAGENET1K_V1) in the torch hub cache, or downloaded into it; 3. the
    anti-aliased trunk inside the package stlpips-pytorch, of which only the weight file is read.

    Args:
        backbone: `auto` takes any of the three, `vgg16` never the third, `vgg16-shift-tolerant` never the second.
        weights: a state dict of torchvision's VGG-16 or of ST-LPIPS' VGG; layers after relu3_3 may be missing.

    Raises:
        InputError: there are no weights to be had, or the file is not of the network asked for.
    """
    path, source = _find_weights(backbone, weights)
    name, trunk = _read_trunk(path)
    if backbone not in ("auto", name):
        raise InputError(f"The weight file {path} is of {name}, not of {backbone}: give another file or --backbone.")
    return VGGFeatures(Backbone(name=name, source=source, sha256=_sha256(path)), trunk)


def available_backbone() -> Optional[str]:
    """The name of the network that `load_backbone()` gives; None where no weights are found or can be downloaded."""
    try:
        path, _ = _find_weights("auto", None)
    except InputError:
        return None
    return SHIFT_TOLERANT if path == _packaged_weights() else PLAIN


def _find_weights(backbone: str, weights: Optional[Path]) -> tuple[Path, str]:
    """The weight file to read, and in words where it was found."""
    if weights is not None:
        path = Path(weights).expanduser()
        if not path.is_file():
            raise InputError(f"There is no VGG weight file {path}: check the path given as --vgg-weights.")
        return path, f"the file {path}, as asked for"

    cached = Path(torch.hub.get_dir()) / "checkpoints" / VGG16_FILE
    if backbone != SHIFT_TOLERANT:
        if cached.is_file():
            return cached, f"torchvision's VGG-16 (IMAGENET1K_V1) in the torch hub cache, {cached}"
        if _download(cached):
            return cached, f"torchvision's VGG-16 (IMAGENET1K_V1), downloaded from {VGG16_URL} to {cached}"

    packaged = _packaged_weights()
    if backbone == PLAIN or packaged is None:
        raise InputError(
            f"There are no weights for --backbone {backbone}: give a file with --vgg-weights, or put {VGG16_FILE} "
            f"into the folder {cached.parent}, or use --backbone {SHIFT_TOLERANT} (or auto) with the package "
            "stlpips-pytorch installed."
        )
    source = f"the anti-aliased VGG-16 inside the package stlpips-pytorch, {packaged}"
    if backbone != SHIFT_TOLERANT:
        source += f"; torchvision's VGG-16 is not in {cached.parent} and could not be downloaded"
    return packaged, source


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


def _packaged_weights() -> Optional[Path]:
    """The weight file of stlpips-pytorch, found without running any of its code; None where it is not installed."""
    package = importlib.util.find_spec("stlpips_pytorch")
    if package is None or not package.submodule_search_locations:
        return None
    path = Path(package.submodule_search_locations[0]) / "weights" / "vST0.0" / "vgg_shift_tolerant.pth"
    return path if path.is_file() else None


def _read_trunk(path: Path) -> tuple[str, dict[str, Tensor]]:
    """The network's name, and its layers up to relu3_3 under the names they have in `VGGFeatures`."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    # A file that is no checkpoint surfaces as any of a dozen errors from the middle of torch and pickle.
    except Exception as error:
        raise InputError(
            f"The VGG weight file {path} is damaged or not a PyTorch state dict: fetch it again, or give another "
            "with --vgg-weights."
        ) from error
    if not isinstance(state, dict):
        raise _not_a_trunk(path, "it holds no state dict")

    keys = [key for key in state if isinstance(key, str)]
    is_shift_tolerant = any(key.startswith("net.slice") and key.endswith(".filt") for key in keys)
    name = SHIFT_TOLERANT if is_shift_tolerant else PLAIN
    if name == PLAIN:
        _refuse_relatives_of_vgg16(path, keys)
    trunk = {}
    for key, (stored, shape) in _layout(name).items():
        tensor = state.get(stored)
        _check_tensor(path, stored, tensor, shape)
        trunk[key] = tensor.float()
    return name, trunk


def _layout(name: str) -> dict[str, tuple[str, tuple[int, ...]]]:
    """For each parameter of `VGGFeatures` its name in the weight file, and its shape."""
    layout: dict[str, tuple[str, tuple[int, ...]]] = {}
    for i, stored_block in enumerate(SHIFT_TOLERANT_BLOCKS if name == SHIFT_TOLERANT else PLAIN_BLOCKS):
        channels = BLOCK_CHANNELS[i]
        pairs = itertools.pairwise(channels)
        for j, (stored, (fan_in, fan_out)) in enumerate(zip(stored_block, pairs, strict=True)):
            layout[f"blocks.{i}.{j}.weight"] = (f"{stored}.weight", (fan_out, fan_in, 3, 3))
            layout[f"blocks.{i}.{j}.bias"] = (f"{stored}.bias", (fan_out,))
    if name == SHIFT_TOLERANT:
        for i, stored in enumerate(SHIFT_TOLERANT_BLURS):
            layout[f"pools.{i}.kernel"] = (f"{stored}.filt", (BLOCK_CHANNELS[i][-1], 1, 3, 3))
    return layout


def _check_tensor(path: Path, key: str, value: Any, shape: tuple[int, ...]) -> None:
    if not isinstance(value, Tensor):
        raise _not_a_trunk(path, f"{key} is missing")
    if tuple(value.shape) != shape:
        raise _not_a_trunk(path, f"{key} has the shape {tuple(value.shape)} instead of {shape}")
    if not value.isfinite().all():
        raise _not_a_trunk(path, f"{key} has values that are not finite")


def _refuse_relatives_of_vgg16(path: Path, keys: list[str]) -> None:
    """VGG-19 has the same shapes up to relu3_3, but other weights."""
    for key in keys:
        prefix, _, rest = key.partition(".")
        layer = rest.partition(".")[0]
        if prefix == "features" and not (layer.isdigit() and int(layer) in PLAIN_CONVOLUTIONS):
            raise _not_a_trunk(path, f"{key} belongs to another network")


def _not_a_trunk(path: Path, reason: str) -> InputError:
    return InputError(
        f"The VGG weight file {path} is not VGG-16 up to relu3_3 ({reason}): give torchvision's {VGG16_FILE} or "
        "ST-LPIPS' vgg_shift_tolerant.pth."
    )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()
