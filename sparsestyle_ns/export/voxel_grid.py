"""A stylised scene as bytes on a voxel grid: what a page carries, and how its renderer reads it.

σ_f and c_f depend on the position alone, so that a grid of them is the scene. The page's renderer (raymarch.frag) goes
through it in even steps, as baked rendering does; `render_voxels` is that renderer in torch, by which the page's error
against the exact render is measured.
"""

import copy
import math
from dataclasses import dataclass
from typing import Iterator, Sequence

import torch
from jaxtyping import Bool, Float, Int, UInt8
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.nn import functional as F

from sparsestyle_ns.core.occupancy import Occupancy, march
from sparsestyle_ns.core.spaces import ForwardFacingSpace, Segments, Space
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.baked import DENSITY_STEP, DENSITY_UNIT, SIDE, BakedVolume, decode, encode, render_baked
from sparsestyle_ns.rendering.mixing import Appearance, Mix, mixed
from sparsestyle_ns.rendering.render import render_packed
from sparsestyle_ns.utils.device_sizes import sizes_for
from sparsestyle_ns.utils.progress import track

EMPTY = 1
"""Code of density 0, as in baked rendering, where 0 stands for a value that isn't known."""
ROUNDING = 0.05
"""Error of a graphics card's interpolation, in steps of a code: what is less than this above `EMPTY` is empty."""
CELLS_PER_CALL = 1 << 16


@dataclass
class VoxelGrid:
    """σ_f and c_f as bytes, on a grid of the cube whose borders are voxels too.

    Attributes:
        codes: σ_f (coded as in `rendering/baked.py`) and c_f (of 255); `EMPTY` and black where nothing is known.
        known: voxels that have values.
        occupied: cells of a grid of its own in which samples count.
    """

    codes: UInt8[Tensor, "x y z 4"]
    known: Bool[Tensor, "x y z"]
    occupied: Bool[Tensor, "u v w"]

    @property
    def resolution(self) -> int:
        """Cells along a side; there is one voxel more."""
        return len(self.codes) - 1

    def interpolate(self, positions: Float[Tensor, "points 3"]) -> Float[Tensor, "points 4"]:
        """Codes between voxels, trilinear; outside of the cube those on its border."""
        scaled = (0.5 * positions + 0.5).clamp(0.0, 1.0) * self.resolution
        lower = scaled.long().clamp(max=self.resolution - 1)
        fraction = scaled - lower
        total = positions.new_zeros(len(positions), 4)
        for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
            weight = torch.where(corner.bool(), fraction, 1.0 - fraction).prod(dim=-1)
            total += weight[:, None] * self.codes[tuple((lower + corner).unbind(-1))]
        return total


def ray_segments(camera: Cameras, space: Space) -> Iterator[Segments]:
    """The segments of one camera's rays, row by row, some thousands at a time."""
    bundle = camera.generate_rays(camera_indices=0, keep_shape=False).flatten()
    at_once = sizes_for(bundle.origins.device).marched_rays
    for start in range(0, len(bundle), at_once):
        part = bundle[start : start + at_once]
        yield space.segments(part.origins, part.directions)


@torch.no_grad()
def bake_voxels(model: HierStyleModel, resolution: int, cameras: Sequence[Cameras]) -> VoxelGrid:
    """Evaluates a model's fields wherever some cameras may see them, mixed as the model's pictures show them.

    These are the cells that aren't empty, in bricks of 8³ that the cameras' rays reach before 99.9% of the light is
    gone. A ray is cast for each pixel, so a brick should be some pixels wide.
    """
    volume = model.bake(resolution)
    for camera in track(cameras, "Finding what can be seen"):
        for segments in ray_segments(camera.to(model.device), model.space):
            render_baked([volume], segments, model.marching, model.background)
    filled = torch.ones(1, 1, 1, dtype=torch.bool, device=model.device)  # where nothing is known to be empty
    if model.occupancy is not None:
        filled = model.occupancy.occupied
    seen = volume.slots > 0
    for axis in range(3):
        seen = seen.repeat_interleave(SIDE, dim=axis).narrow(axis, 0, resolution)
    occupied = F.adaptive_max_pool3d(filled.float()[None], resolution)[0] > 0
    cells = seen & (occupied | last_step_cells(model, resolution))
    for part in track(cells.nonzero().split(CELLS_PER_CALL), "Baking"):
        volume.fill(part)
    known = F.max_pool3d(F.pad(cells.float()[None], (1,) * 6), kernel_size=2, stride=1)[0] > 0
    codes = torch.zeros(*known.shape, 4, dtype=torch.uint8, device=known.device)
    codes[..., 0] = EMPTY
    index = known.nonzero()
    codes[known] = torch.cat([shown_codes(volume, part, model.display.own.mix) for part in index.split(CELLS_PER_CALL)])
    return VoxelGrid(codes.cpu(), known.cpu(), filled.cpu())


def shown_codes(volume: BakedVolume, voxels: Int[Tensor, "voxels 3"], mix: Mix) -> UInt8[Tensor, "voxels 4"]:
    """Codes of the density and colour that a mixture of the fields shows: by default those of σ_f and c_f."""
    values = decode(volume.codes.view(-1, 8)[volume.rows(voxels)].float())
    density, color = mixed(Appearance(values[:, 0], values[:, 5:]), [Appearance(values[:, 1], values[:, 2:5])], mix)
    return encode(torch.cat([density[:, None], density[:, None], color, color], dim=-1))[:, 1:5]


def last_step_cells(model: HierStyleModel, resolution: int) -> Bool[Tensor, "x y z"]:
    """Cells that a ray's last step may lie in, where it goes on to infinity and counts in empty cells too."""
    indices = torch.arange(resolution, device=model.device)
    last = indices >= math.floor((1.0 - 1.0 / model.config.num_steps) * resolution)
    last = last & model.space.unbounded
    if isinstance(model.space, ForwardFacingSpace):
        return last.expand(resolution, resolution, resolution)
    last = last | last.flip(0)  # infinity is on all sides of the cube
    return last[:, None, None] | last[:, None] | last


@torch.no_grad()
def picture_of_voxels(voxels: VoxelGrid, model: HierStyleModel, camera: Cameras) -> Float[Tensor, "H W 3"]:
    """What the page shows of one camera, worked out in torch on the CPU."""
    colors = [render_voxels(voxels, part, model) for part in ray_segments(camera, copy.deepcopy(model.space).cpu())]
    return torch.cat(colors).view(int(camera.height), int(camera.width), 3)


@torch.no_grad()
def render_voxels(voxels: VoxelGrid, segments: Segments, model: HierStyleModel) -> Float[Tensor, "rays 3"]:
    """What the page shows on each ray, on the CPU; of the model it takes how it marches, and the background."""
    occupancy = Occupancy(len(voxels.occupied))
    occupancy.occupied = voxels.occupied
    samples = march(segments, occupancy, model.config.num_steps, model.space.unbounded)
    values = voxels.interpolate(samples.positions)
    steps = values[:, 0] - EMPTY
    density = torch.where(steps > ROUNDING, DENSITY_UNIT * torch.expm1(DENSITY_STEP * steps), 0.0)
    background = None if model.background is None else model.background.cpu()
    return render_packed(samples, len(segments.hit), density, values[:, 1:] / 255.0, background).rgb
