"""A stylised scene as bytes on voxel grids: what a page carries, and how its renderer reads it.

σ_c, σ_f and c_f depend on the position alone, and c_c hardly on more, so that grids of them are the scene, before and
after, and all mixtures (`mixing`). The coarse field, an MLP of low frequencies, has half as many cells along a side.
The page's renderer (raymarch.frag) goes through them in even steps, as baked rendering does; `render_voxels` is that
renderer in torch, by which the page's error against the exact render is measured.
"""

import copy
import math
from dataclasses import dataclass
from typing import Iterator, List, Sequence

import torch
from jaxtyping import Bool, Float, UInt8
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor
from torch.nn import functional as F

from sparsestyle_ns.core.occupancy import Occupancy, march
from sparsestyle_ns.core.spaces import ForwardFacingSpace, Segments, Space
from sparsestyle_ns.models.hier_style import HierStyleModel
from sparsestyle_ns.rendering.baked import DENSITY_STEP, DENSITY_UNIT, SIDE, BakedVolume, render_baked
from sparsestyle_ns.rendering.mixing import STYLISED, Appearance, Mix, mixed
from sparsestyle_ns.rendering.render import render_packed
from sparsestyle_ns.utils.device_sizes import sizes_for
from sparsestyle_ns.utils.progress import track

EMPTY = 1
"""Code of density 0, as in baked rendering, where 0 stands for a value that isn't known."""
ROUNDING = 0.05
"""Error of a graphics card's interpolation, in steps of a code: what is less than this above `EMPTY` is empty."""
LEAST_CODE = 33
"""Cells all of whose voxels have a smaller code of density count as empty: a 128th of a ray is hardly dimmed there."""
CELLS_PER_CALL = 1 << 16
STYLE_CODES, COARSE_CODES = (1, 2, 3, 4), (0, 5, 6, 7)
"""Of the eight codes of a baked volume (`Shade`), those of a stylised field and of the coarse one."""


@dataclass
class Voxels:
    """σ and c of one field as bytes, on a grid of the cube whose borders are voxels too.

    Attributes:
        codes: σ (coded as in `rendering/baked.py`) and c (of 255); `EMPTY` and black where nothing is known.
        known: voxels that have values.
    """

    codes: UInt8[Tensor, "x y z 4"]
    known: Bool[Tensor, "x y z"]

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


@dataclass
class VoxelGrid:
    """Voxels of one or two styles, which know the same places, and of the coarse field that they have in common.

    Attributes:
        occupied: cells of a grid of its own in which samples count (`visible_cells`).
    """

    styles: List[Voxels]
    coarse: Voxels
    occupied: Bool[Tensor, "u v w"]

    @property
    def resolution(self) -> int:
        """Cells along a side, of the styles."""
        return self.styles[0].resolution


def ray_segments(camera: Cameras, space: Space) -> Iterator[Segments]:
    """The segments of one camera's rays, row by row, some thousands at a time."""
    bundle = camera.generate_rays(camera_indices=0, keep_shape=False).flatten()
    at_once = sizes_for(bundle.origins.device).marched_rays
    for start in range(0, len(bundle), at_once):
        part = bundle[start : start + at_once]
        yield space.segments(part.origins, part.directions)


@torch.no_grad()
def bake_voxels(models: Sequence[HierStyleModel], resolution: int, cameras: Sequence[Cameras]) -> VoxelGrid:
    """Evaluates the fields of one or two models with one coarse field, wherever some cameras may see them.

    These are the cells that aren't empty, in bricks of 8³ that the cameras' rays reach before 99.9% of the light is
    gone. A ray is cast for each pixel, so a brick should be some pixels wide.
    """
    model = models[0]
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
    half = -(-resolution // 2)
    fewer_cells = F.adaptive_max_pool3d(cells.float()[None], half)[0] > 0
    volumes = [volume, *(other.bake(resolution) for other in models[1:])]
    styles = [fill_voxels(each, cells, STYLE_CODES) for each in volumes]
    coarse = fill_voxels(model.bake(half), fewer_cells, COARSE_CODES)
    return VoxelGrid(styles, coarse, visible_cells([*styles, coarse], filled.cpu()))


def visible_cells(fields: Sequence[Voxels], filled: Bool[Tensor, "u v w"]) -> Bool[Tensor, "u v w"]:
    """Of filled cells those in which one of the fields has more than next to nothing between its voxels."""
    visible = torch.zeros_like(filled)
    for voxels in fields:
        dense = (voxels.codes[None, ..., 0] >= LEAST_CODE).float()
        between = F.max_pool3d(dense, kernel_size=2, stride=1)
        visible |= F.adaptive_max_pool3d(between, len(filled))[0] > 0
    return visible & filled


def fill_voxels(volume: BakedVolume, cells: Bool[Tensor, "x y z"], chosen: Sequence[int]) -> Voxels:
    """The voxels at the corners of cells, with four of a volume's eight codes: a density, and a colour."""
    for part in track(cells.nonzero().split(CELLS_PER_CALL), "Baking"):
        volume.fill(part)
    known = F.max_pool3d(F.pad(cells.float()[None], (1,) * 6), kernel_size=2, stride=1)[0] > 0
    codes = torch.zeros(*known.shape, 4, dtype=torch.uint8, device=known.device)
    codes[..., 0] = EMPTY
    index = known.nonzero()
    codes[known] = volume.codes.view(-1, 8)[volume.rows(index)][:, list(chosen)]
    return Voxels(codes.cpu(), known.cpu())


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
def picture_of_voxels(
    voxels: VoxelGrid, model: HierStyleModel, camera: Cameras, mix: Mix = STYLISED
) -> Float[Tensor, "H W 3"]:
    """What the page shows of one camera, worked out in torch on the CPU."""
    parts = ray_segments(camera, copy.deepcopy(model.space).cpu())
    colors = [render_voxels(voxels, part, model, mix) for part in parts]
    return torch.cat(colors).view(int(camera.height), int(camera.width), 3)


@torch.no_grad()
def render_voxels(
    voxels: VoxelGrid, segments: Segments, model: HierStyleModel, mix: Mix = STYLISED
) -> Float[Tensor, "rays 3"]:
    """What the page shows on each ray, on the CPU; of the model it takes how it marches, and the background."""
    occupancy = Occupancy(len(voxels.occupied))
    occupancy.occupied = voxels.occupied
    samples = march(segments, occupancy, model.config.num_steps, model.space.unbounded)
    coarse, *styles = (appearance(each, samples.positions) for each in (voxels.coarse, *voxels.styles))
    density, color = mixed(coarse, styles, mix)
    background = None if model.background is None else model.background.cpu()
    return render_packed(samples, len(segments.hit), density, color, background).rgb


def appearance(voxels: Voxels, positions: Float[Tensor, "points 3"]) -> Appearance:
    """σ and c between voxels."""
    values = voxels.interpolate(positions)
    steps = values[:, 0] - EMPTY
    density = torch.where(steps > ROUNDING, DENSITY_UNIT * torch.expm1(DENSITY_STEP * steps), 0.0)
    return Appearance(density, values[:, 1:] / 255.0)
