"""How like a photo a picture is: PSNR, SSIM, and LPIPS where its weights are on the machine."""

import functools
from pathlib import Path
from typing import Callable, Dict, Optional

import torch
from jaxtyping import Float
from torch import Tensor

ALEXNET_FILE = "alexnet-owt-7be5be79.pth"


def psnr(image: Float[Tensor, "H W 3"], reference: Float[Tensor, "H W 3"]) -> float:
    """Peak signal-to-noise ratio in dB, of images in [0, 1]."""
    return float(-10.0 * torch.log10((image - reference).square().mean()))


@functools.cache
def lpips_metric() -> Optional[Callable[[Tensor, Tensor], Tensor]]:
    """LPIPS with AlexNet, on the CPU; None where the network's weights are not in the torch hub cache.

    torchmetrics would download them; measuring a picture must not depend on a network.
    """
    if not (Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET_FILE).is_file():
        return None
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)


def image_metrics(image: Float[Tensor, "H W 3"], photo: Float[Tensor, "H W 3"]) -> Dict[str, float]:
    """`psnr` in dB, `ssim`, and `lpips` where `lpips_metric` has it, of images in [0, 1]."""
    from torchmetrics.functional import structural_similarity_index_measure

    image, photo = image.detach().clamp(0.0, 1.0).cpu(), photo.cpu()
    batch, reference = (picture.permute(2, 0, 1)[None] for picture in (image, photo))
    metrics = {
        "psnr": psnr(image, photo),
        "ssim": float(structural_similarity_index_measure(batch, reference, data_range=1.0)),
    }
    lpips = lpips_metric()
    if lpips is not None:
        metrics["lpips"] = float(lpips(batch, reference))
    return metrics
