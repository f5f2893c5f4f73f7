"""How like a photo a picture is: PSNR, SSIM, LPIPS and ST-LPIPS; and how like a painting, by Gram matrices.

ST-LPIPS (Ghildyal and Liu 2022) is LPIPS with a network that isn't moved by tiny shifts; its numbers are not LPIPS's.
"""

import functools
from pathlib import Path
from typing import Callable, Dict, List, Optional, Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sparsestyle_ns.utils.weight_files import hub_file, read_state, shift_tolerant_file

Metric = Callable[[Float[Tensor, "B 3 H W"], Float[Tensor, "B 3 H W"]], Float[Tensor, ""]]
"""Distance of pictures in [0, 1]."""
ALEXNET_FILE = "alexnet-owt-7be5be79.pth"
SHIFT_TOLERANT_LAYERS = (("1.0", "1.1"), ("2.5", "2.4"), ("3.9", "3.8"), ("4.11", None), ("5.13", None))
"""Each layer's convolution and blur in the weight file, after "net.slice"."""
MIN_LPIPS_SIDE, MIN_SHIFT_TOLERANT_SIDE = 31, 24
"""Pixels a side below which nothing is left of a picture for the last layers."""


def psnr(image: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]) -> float:
    """Peak signal-to-noise ratio in dB, of images in [0, 1]."""
    return float(psnr_of_error((image - reference).square().mean()))


def psnr_of_error(error: Float[Tensor, ""]) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio in dB, −10 log10 of the mean squared error of colours in [0, 1]."""
    return -10.0 * torch.log10(error)


def has_lpips() -> bool:
    """Whether the weights that LPIPS needs are in the torch hub cache."""
    return hub_file(ALEXNET_FILE).is_file()


@functools.cache
def _load_lpips(weights: Path) -> Metric:
    """The metric with these weights, which torchmetrics finds by itself."""
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)


def lpips_metric(size: Tuple[int, ...]) -> Optional[Metric]:
    """LPIPS with AlexNet for pictures of a height and width, on the CPU; None for tiny ones or without its weights."""
    # torchmetrics would download the weights; measuring a picture must not depend on a network.
    return _load_lpips(hub_file(ALEXNET_FILE)) if has_lpips() and min(size) >= MIN_LPIPS_SIDE else None


class ShiftTolerantLPIPS:
    """ST-LPIPS with AlexNet: squared differences of unit feature vectors of five layers, weighted by channel.

    Averaged over the picture and summed over the layers (Zhang et al. 2018, Eq. 1). `state` is the weight file's.
    """

    def __init__(self, state: Dict[str, Tensor]) -> None:
        self.state = state

    def features(self, pictures: Float[Tensor, "B 3 H W"]) -> List[Float[Tensor, "B C h w"]]:
        """Feature maps of pictures in [0, 1], each layer's vectors of length 1."""
        state, maps = self.state, []
        hidden = (2.0 * pictures - 1.0 - state["scaling_layer.shift"]) / state["scaling_layer.scale"]
        for index, (convolution, blur) in enumerate(SHIFT_TOLERANT_LAYERS):
            weight, bias = state[f"net.slice{convolution}.weight"], state[f"net.slice{convolution}.bias"]
            if index == 0:
                hidden = F.relu(self._blur(F.conv2d(hidden, weight, bias, padding=2), blur))
            else:
                if blur is not None:
                    hidden = self._blur(F.max_pool2d(hidden, kernel_size=3, stride=1), blur)
                hidden = F.relu(F.conv2d(hidden, weight, bias, padding=weight.shape[-1] // 2))
            maps.append(hidden / (hidden.norm(dim=1, keepdim=True) + 1e-10))
        return maps

    def _blur(self, maps: Tensor, name: str) -> Tensor:
        padded = F.pad(maps, (2, 2, 2, 2), mode="reflect")
        return F.conv2d(padded, self.state[f"net.slice{name}.filt"], stride=2, groups=maps.shape[1])

    @torch.no_grad()
    def __call__(self, first: Float[Tensor, "B 3 H W"], second: Float[Tensor, "B 3 H W"]) -> Float[Tensor, ""]:
        """The distance of pictures in [0, 1], at least `MIN_SHIFT_TOLERANT_SIDE` pixels a side; 0 for equal ones."""
        distance = first.new_zeros(())
        for index, (a, b) in enumerate(zip(self.features(first), self.features(second), strict=True)):
            distance += F.conv2d((a - b).square(), self.state[f"lin{index}.model.1.weight"]).mean()
        return distance


@functools.cache
def _load_st_lpips() -> Optional[ShiftTolerantLPIPS]:
    path = shift_tolerant_file("alex_shift_tolerant.pth")
    return path and ShiftTolerantLPIPS(read_state(path))


def st_lpips_metric(size: Tuple[int, ...]) -> Optional[ShiftTolerantLPIPS]:
    """ST-LPIPS for pictures of a height and width, on the CPU; None where these are too small or its weights gone."""
    return _load_st_lpips() if min(size) >= MIN_SHIFT_TOLERANT_SIDE else None


def perceptual_metrics(size: Tuple[int, ...]) -> Dict[str, Metric]:
    """`lpips` and `st_lpips`, as far as pictures of this height and width can be measured by them."""
    metrics = {"lpips": lpips_metric(size), "st_lpips": st_lpips_metric(size)}
    return {name: metric for name, metric in metrics.items() if metric is not None}


def structural_similarity(image: Float[Tensor, "H W 3"], photo: Float[Tensor, "H W 3"]) -> float:
    """SSIM of images in [0, 1]; the first is clipped to that."""
    from torchmetrics.functional import structural_similarity_index_measure

    pictures = image.detach().clamp(0.0, 1.0).cpu(), photo.cpu()
    batch, reference = (picture.permute(2, 0, 1)[None] for picture in pictures)
    return float(structural_similarity_index_measure(batch, reference, data_range=1.0))


def image_metrics(image: Float[Tensor, "H W 3"], photo: Float[Tensor, "H W 3"]) -> Dict[str, float]:
    """`psnr` in dB, `ssim`, and `lpips` and `st_lpips` where there are weights for them, of images in [0, 1]."""
    image, photo = image.detach().clamp(0.0, 1.0).cpu(), photo.cpu()
    batch, reference = (picture.permute(2, 0, 1)[None] for picture in (image, photo))
    return {
        "psnr": psnr(image, photo),
        "ssim": structural_similarity(image, photo),
        **{name: float(metric(batch, reference)) for name, metric in perceptual_metrics(photo.shape[:2]).items()},
    }


def gram_matrix(features: Float[Tensor, "N C"]) -> Float[Tensor, "C C"]:
    """(1/N) Σ f fᵀ: how much of each pair of channels occurs together (Gatys et al. 2016, Eq. 3, over the pixels)."""
    return features.T @ features / len(features)


def gram_distance(gram: Float[Tensor, "C C"], style_gram: Float[Tensor, "C C"]) -> Float[Tensor, ""]:
    """|G − G_style|² / |G_style|²: Gatys et al. (2016), Eq. 4, but relative to the style, for any network."""
    return torch.linalg.matrix_norm(gram - style_gram).square() / torch.linalg.matrix_norm(style_gram).square()
