"""3D Gaussians, and what a camera sees of them, as viewers of splats draw them (Kerbl et al. 2023, "3D Gaussian
Splatting for Real-Time Radiance Field Rendering", Sec. 4).

A Gaussian with mean μ, scales s and rotation R has the covariance Σ = R S Sᵀ Rᵀ. On a picture its covariance is
Σ' = J W Σ Wᵀ Jᵀ + blur, with W the camera's rotation and J the Jacobian of the projection at μ, and where it is seen at
q = (p − μ')ᵀ Σ'⁻¹ (p − μ') from its centre there, its opacity is α = o exp(−q/2). Gaussians are laid over each other in
the order of their distance along the camera's axis. Viewers differ in details (`Drawing`).
"""

import math
from dataclasses import dataclass
from typing import List, NamedTuple, Tuple

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestyle_ns.export import splat_kernels
from sparsestyle_ns.export.splat_kernels import PARAMETERS, VALUES, Eye
from sparsestyle_ns.rendering.render import Background, over_background
from sparsestyle_ns.utils.numba_kernels import even_parts, run_on_threads

LEAST_ROWS = 32
"""Rows of pixels that a thread draws, at least."""


@dataclass
class Gaussians:
    """Gaussians of one colour each, whatever the direction they are seen from.

    Attributes:
        rows: of each, μ (3) and the logarithms of s (3), in world units, a quaternion (4: w, x, y, z) of any length but
            0, the logit of o, and the colour as it is displayed (RGB in [0, 1]).
    """

    rows: Float[Tensor, "gaussians 14"]

    @classmethod
    def of(
        cls,
        means: Float[Tensor, "gaussians 3"],
        log_scales: Float[Tensor, "gaussians 3"],
        rotations: Float[Tensor, "gaussians 4"],
        logits: Float[Tensor, "gaussians"],
        colors: Float[Tensor, "gaussians 3"],
    ) -> "Gaussians":
        """From their parts, in float32."""
        return cls(torch.cat([means, log_scales, rotations, logits[:, None], colors], dim=-1).float())

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def means(self) -> Float[Tensor, "gaussians 3"]:
        """μ, in world units."""
        return self.rows[:, :3]

    @property
    def log_scales(self) -> Float[Tensor, "gaussians 3"]:
        """Logarithms of s, in world units."""
        return self.rows[:, 3:6]

    @property
    def rotations(self) -> Float[Tensor, "gaussians 4"]:
        """Quaternions (w, x, y, z) of any length but 0."""
        return self.rows[:, 6:10]

    @property
    def logits(self) -> Float[Tensor, "gaussians"]:
        """o is their sigmoid."""
        return self.rows[:, 10]

    @property
    def colors(self) -> Float[Tensor, "gaussians 3"]:
        """RGB in [0, 1], as it is displayed."""
        return self.rows[:, 11:]


class Drawing(NamedTuple):
    """In what viewers differ.

    Attributes:
        blur: what is added to Σ', in square pixels, so that no Gaussian falls between pixels.
        sharpened: whether opacities make up for that: times √(|Σ' before| / |Σ' after|).
        foot: exp(−q/2) − foot, over 1 − foot, in place of exp(−q/2): it ends at 0 where Gaussians end, at q = 8.
    """

    blur: float
    sharpened: bool = False
    foot: float = 0.0


DRAWINGS = {
    "the reference": Drawing(0.3),
    "PlayCanvas": Drawing(0.3 / 4.0, foot=math.exp(-4.0)),
    "Spark": Drawing(0.3, sharpened=True),
}
"""Of Kerbl et al., PlayCanvas 2.23 (its shaders count in half pixels) and Spark 2.2."""


def picture_of_gaussians(
    gaussians: Gaussians, camera: Cameras, background: Background, drawing: Drawing
) -> Float[Tensor, "H W 3"]:
    """What a viewer shows of one pinhole camera, on the CPU; differentiable in the Gaussians' rows."""
    rgb, light = _Laid.apply(gaussians.rows, _eye(camera, drawing))
    return over_background(rgb, 1.0 - light[..., None], background)


def _eye(camera: Cameras, drawing: Drawing) -> Eye:
    numbers = (np.float32(float(getattr(camera, name))) for name in ("fx", "fy", "cx", "cy"))
    pose = camera.camera_to_worlds[0].float().contiguous().numpy()
    size = int(camera.width), int(camera.height)
    return Eye(pose, *numbers, *size, np.float32(drawing.blur), drawing.sharpened, np.float32(drawing.foot))


class _Laid(torch.autograd.Function):
    """Gaussians laid over each other, front to back: their colours, and the light that passes them all."""

    @staticmethod
    def forward(
        ctx, rows: Float[Tensor, "gaussians 14"], eye: Eye
    ) -> Tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
        values, depths = np.empty((len(rows), VALUES), np.float32), torch.empty(len(rows))
        numbers = rows.detach().contiguous().numpy()
        parts = _parts(len(rows))
        run_on_threads(splat_kernels.project, [(*part, numbers, eye, values, depths.numpy()) for part in parts])
        order = (depths < torch.inf).nonzero()[:, 0]
        order = order[depths[order].argsort()].numpy()

        rgb, light = torch.zeros(eye.height, eye.width, 3), torch.ones(eye.height, eye.width)
        last = np.full((eye.height, eye.width), -1, np.int32)
        drawn = (order, values, eye.foot, rgb.numpy(), light.numpy(), last)
        run_on_threads(splat_kernels.lay, [(*part, *drawn) for part in _line_parts(eye)])
        ctx.save_for_backward(rows)
        ctx.eye, ctx.order, ctx.values, ctx.last, ctx.light = eye, order, values, last, light.clone()
        return rgb, light

    @staticmethod
    @once_differentiable
    def backward(ctx, rgb_grad: Tensor, light_grad: Tensor) -> Tuple[Float[Tensor, "gaussians 14"], None]:
        (rows,) = ctx.saved_tensors
        behind, light = (ctx.light * light_grad).numpy(), ctx.light.clone().numpy()
        parts = _line_parts(ctx.eye)
        value_grads = [np.zeros((len(rows), VALUES - 1), np.float32) for _ in parts]
        drawn = (ctx.order, ctx.values, ctx.eye.foot, ctx.last, rgb_grad.contiguous().numpy(), light, behind)
        run_on_threads(
            splat_kernels.lay_backward, [(*part, *drawn, grads) for part, grads in zip(parts, value_grads, strict=True)]
        )
        found = torch.zeros(len(rows), PARAMETERS)
        numbers = (ctx.order, rows.detach().contiguous().numpy(), ctx.eye, ctx.values, sum(value_grads), found.numpy())
        run_on_threads(splat_kernels.project_backward, [(*part, *numbers) for part in _parts(len(ctx.order))])
        return found, None


def _parts(length: int) -> List[Tuple[int, int]]:
    """Runs of numbers, one for each thread."""
    return list(even_parts(length, torch.get_num_threads()))


def _line_parts(eye: Eye) -> List[Tuple[int, int]]:
    """Runs of rows of pixels, one for each thread; each has gradients of its own."""
    return list(even_parts(eye.height, min(torch.get_num_threads(), max(1, eye.height // LEAST_ROWS))))
