"""How alike the structure of two pictures is: SSIM (Wang et al. 2004) of some of their pixels."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

SIGMA, RADIUS, CONSTANTS = 1.5, 5, (0.01**2, 0.03**2)
"""The Gaussian window of SSIM, 11 × 11, and what keeps its quotients finite."""


def masked_ssim(
    first: Float[Tensor, "H W C"], second: Float[Tensor, "H W C"], visible: Bool[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """Mean SSIM of pictures in [0, 1], by visible pixels alone; NaN where none is visible. Differentiable.

    Windows at borders, of the picture or of what is visible, weigh the pixels that they have.
    """
    offsets = torch.arange(-RADIUS, RADIUS + 1, device=first.device, dtype=first.dtype)
    profile = torch.exp(-0.5 * (offsets / SIGMA).square())
    row = (profile / profile.sum())[None, None, None]
    mask = visible.to(first.dtype)[None, None]

    def weighed(values: Float[Tensor, "C 1 H W"]) -> Float[Tensor, "C 1 H W"]:
        # The window is a product, and twice eleven pixels are quicker than eleven times eleven.
        return F.conv2d(F.conv2d(values, row, padding=(0, RADIUS)), row.mT, padding=(RADIUS, 0))

    share = weighed(mask).clamp_min(torch.finfo(first.dtype).tiny)

    def mean(values: Float[Tensor, "C 1 H W"]) -> Float[Tensor, "C 1 H W"]:
        return weighed(values * mask) / share

    x, y = (picture.permute(2, 0, 1)[:, None] for picture in (first, second))
    mean_x, mean_y = mean(x), mean(y)
    variance_x, variance_y = mean(x * x) - mean_x.square(), mean(y * y) - mean_y.square()
    covariance = mean(x * y) - mean_x * mean_y
    c1, c2 = CONSTANTS
    likeness = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    likeness = likeness / ((mean_x.square() + mean_y.square() + c1) * (variance_x + variance_y + c2))
    # A product with the mask, since picking pixels would wait for a GPU.
    return (likeness * mask).sum() / (mask.sum() * len(likeness))
