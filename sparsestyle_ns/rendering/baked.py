"""Baked rendering: the two fields kept in a voxel grid of the cube, which is filled where rays come by.

σ_f, c_f and σ_c depend on the position alone, so that a value worked out for one picture serves all others, whatever
mixture of the fields they show (`mixing`). Samples, empty cells and early stops are those of the exact render
(`freeze_samples`, `render_mixed`); what differs is that values between voxels are interpolated.

A value takes a byte. Densities are kept as their logarithm, and interpolated so: they are exponentials of a smooth
function, and their error then shows hardly beside that of the colours (fern, 256³ voxels: 42.2 dB against the exact
picture with logarithms, 40.2 dB with densities; bytes instead of floats cost 0.1 dB).
"""

import math
import threading
from typing import Callable, Dict, Iterable, List, Optional, Sequence, Tuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from sparsestyle_ns.core import spaces
from sparsestyle_ns.core.occupancy import Occupancy
from sparsestyle_ns.core.precision import Precision, autocast
from sparsestyle_ns.core.spaces import Segments, Space
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.fine import StylisedField
from sparsestyle_ns.rendering import baked_kernels
from sparsestyle_ns.rendering.lines import RAYS_PER_PART, Lines, lines_of
from sparsestyle_ns.rendering.mixing import STYLISED, Appearance, Mix, mixed
from sparsestyle_ns.rendering.render import POINTS_PER_CALL, Background, PackedRender, composite, render_packed
from sparsestyle_ns.rendering.visible_samples import Marching, visible_samples
from sparsestyle_ns.utils.machine import numbers_on
from sparsestyle_ns.utils.numba_kernels import even_parts, run_on_threads

Shade = Callable[[Float[Tensor, "points 3"]], Float[Tensor, "points 8"]]
"""Gives σ_c, σ_f, c_f and c_c at field coordinates, in this order."""
NUM_DENSITIES = 2
"""The densities come first."""
SIDE = 8
"""Voxels along a brick's side. In a brick, the eight voxels of each block of 2³ lie in one cache line."""
BRICK = SIDE**3
"""Voxels in a brick."""
DENSITY_UNIT = 0.01
"""Densities well above this, per half side of the cube, are coded by their logarithm, those below linearly."""
MAX_DENSITY = 1e5
"""The largest density that has a code; a thousandth of the cube's side is opaque with it."""
DENSITY_STEP = math.log1p(MAX_DENSITY / DENSITY_UNIT) / 254
"""Difference of log(1 + σ/unit) between neighbouring codes: 6% of σ."""
ROUNDING = 1e-3
"""Part of a code's step that interpolation may be off; less than that above the code of 0 is 0 (an infinite interval
makes anything else opaque)."""
ALL_AROUND = ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
MOST_BAKED = 4
"""Styles whose volumes are kept."""
MOST_CLEARANCE = 16
"""Cells of empty space that are crossed in one leap, at most."""


def encode(values: Float[Tensor, "points 8"]) -> UInt8[Tensor, "points 8"]:
    """Bytes for densities, 1 (none) to 255, and for colours, 0 to 255. A density above 0 stays above 0."""
    density, color = values[:, :NUM_DENSITIES], values[:, NUM_DENSITIES:]
    steps = torch.log1p(density.clamp(max=MAX_DENSITY) / DENSITY_UNIT) / DENSITY_STEP
    steps = torch.where(density > 0, steps.round().clamp(min=1.0), 0.0)
    return torch.cat([1.0 + steps, (255.0 * color).round()], dim=-1).to(torch.uint8)


def decode(codes: Float[Tensor, "points 8"]) -> Float[Tensor, "points 8"]:
    """Densities and colours from codes, which may lie between bytes."""
    steps = codes[:, :NUM_DENSITIES] - 1.0
    density = torch.where(steps > ROUNDING, DENSITY_UNIT * torch.expm1(DENSITY_STEP * steps), 0.0)
    return torch.cat([density, codes[:, NUM_DENSITIES:] / 255.0], dim=-1)


def shade_of(field: CoarseField, style: StylisedField, space: Space, precision: Precision) -> Shade:
    """The two fields as they are whenever it is called.

    c_c, where it depends on the view direction, is that of a camera that looks straight ahead in a forward-facing
    scene, and elsewhere the mean over the directions of the axes; c_f and the densities depend on no direction.
    """
    seen_from = ALL_AROUND
    if field.direction_encoding is None or isinstance(space, spaces.ForwardFacingSpace):
        seen_from = ((0.0, 0.0, -1.0),)

    def shade(points: Float[Tensor, "points 3"]) -> Float[Tensor, "points 8"]:
        with autocast(points.device, precision):
            density, feature = field.density_and_feature(points)
            feature = feature.float()
            fine_density, fine_color = style(style.locate(points), feature, density)
            ways = numbers_on(seen_from, points.device, points.dtype)
            colors = [field.color(feature, way.expand_as(points)) for way in ways]
            color = torch.stack(colors).mean(dim=0)
        return torch.cat([density[:, None], fine_density[:, None], fine_color, color], dim=-1)

    return shade


class BakedVolume:
    """σ_c, σ_f, c_f and c_c on a grid of the cube [−1, 1]³, filled where it is asked for.

    Voxels lie at the corners of `resolution` cells along a side, in bricks of 8³. A brick takes memory, 4 KiB, from its
    first value on: at most 147 MB with 256 cells along a side. Outside of the cube the values on its border count.
    """

    def __init__(self, shade: Shade, resolution: int, device: torch.device) -> None:
        if resolution < 1:
            raise ValueError(f"A baked volume of {resolution} cells along a side is none; set bake_resolution to 256.")
        self.shade = shade
        self.resolution = resolution
        bricks = resolution // SIDE + 1
        # Slot 0 has no values, and stands for all bricks that aren't there yet.
        self.slots = torch.zeros(bricks, bricks, bricks, dtype=torch.int32, device=device)
        self.codes = torch.zeros(1, BRICK, 8, dtype=torch.uint8, device=device)
        self.num_slots = 1
        self._clearance: Optional[Tuple[Tuple[int, int], np.ndarray]] = None
        self._offsets = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], device=device)

    @property
    def num_bytes(self) -> int:
        """Memory that it takes now."""
        return self.codes.numel() + 4 * self.slots.numel()

    def rows(self, voxels: Int[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Where the codes of voxels lie."""
        x, y, z = (voxels // SIDE).unbind(-1)
        half = SIDE // 2
        block = _ravel(voxels % SIDE // 2, half)
        return (self.slots[x, y, z].long() * half**3 + block) * 8 + _ravel(voxels % 2, 2)

    @torch.no_grad()
    def fill(self, cells: Int[Tensor, "cells 3"]) -> None:
        """Evaluates the voxels at the corners of cells, given by their lower ones, that haven't been before."""
        lower = _unravel(_ravel(cells, self.resolution).unique(), self.resolution)
        voxels = (lower[:, None] + self._offsets).flatten(0, 1)
        voxels = voxels[self.codes.view(-1, 8)[self.rows(voxels), 0] == 0]
        voxels = _unravel(_ravel(voxels, self.resolution + 1).unique(), self.resolution + 1)
        if len(voxels) == 0:
            return
        self._make_room(voxels)
        codes = self.codes.view(-1, 8)
        for part in voxels.split(POINTS_PER_CALL):
            positions = part.float() * (2.0 / self.resolution) - 1.0
            codes[self.rows(part)] = encode(self.shade(positions))

    def clearance(self, occupancy: Occupancy) -> UInt8[np.ndarray, "x y z"]:
        """`clearance_of` the occupied cells, worked out anew where they have changed."""
        occupied = occupancy.occupied
        state = (occupied.data_ptr(), occupied._version)
        if self._clearance is None or self._clearance[0] != state:
            self._clearance = state, clearance_of(occupied).numpy()
        return self._clearance[1]

    def _make_room(self, voxels: Int[Tensor, "voxels 3"]) -> None:
        """Gives a slot to each brick that voxels lie in and that has none."""
        bricks = _ravel(voxels // SIDE, len(self.slots)).unique()
        bricks = bricks[self.slots.view(-1)[bricks] == 0]
        first, self.num_slots = self.num_slots, self.num_slots + len(bricks)
        if self.num_slots > len(self.codes):
            room = min(max(self.num_slots, len(self.codes) * 3 // 2), 1 + self.slots.numel())
            self.codes = torch.cat([self.codes, self.codes.new_zeros(room - len(self.codes), BRICK, 8)])
        slots = torch.arange(first, self.num_slots, dtype=torch.int32, device=self.slots.device)
        self.slots.view(-1)[bricks] = slots

    def density_and_feature(
        self, positions: Float[Tensor, "points 3"]
    ) -> Tuple[Float[Tensor, "points"], Float[Tensor, "points 7"]]:
        """σ_c, and all else that `shade` gives as the feature, interpolated, with what is missing filled in first."""
        scaled = (0.5 * positions + 0.5).clamp(0.0, 1.0) * self.resolution
        lower = scaled.long().clamp(0, self.resolution - 1)
        fraction = scaled - lower
        self.fill(lower)
        near = torch.where(self._offsets.bool(), fraction[:, None], 1.0 - fraction[:, None])
        codes = self.codes.view(-1, 8)[self.rows(lower[:, None] + self._offsets)]
        values = decode((near.prod(dim=-1)[..., None] * codes).sum(dim=1))
        return values[:, 0], values[:, 1:]


def clearance_of(occupied: Bool[Tensor, "x y z"]) -> UInt8[Tensor, "x y z"]:
    """How many cells away the nearest occupied one is, on the axis where it is farthest; at most `MOST_CLEARANCE`.

    Empty space is crossed in leaps (Zuiderveld et al. 1992).
    """
    reached = occupied.float()[None]
    clearance = torch.zeros_like(occupied, dtype=torch.uint8)
    for _ in range(MOST_CLEARANCE):
        clearance += reached[0] == 0
        reached = F.max_pool3d(reached, kernel_size=3, stride=1, padding=1)
    return clearance


def _ravel(index: Int[Tensor, "*batch 3"], size: int) -> Int[Tensor, "*batch"]:
    return (index[..., 0] * size + index[..., 1]) * size + index[..., 2]


def _unravel(index: Int[Tensor, "points"], size: int) -> Int[Tensor, "points 3"]:
    return torch.stack([index // size**2, index // size % size, index % size], dim=-1)


def render_baked(
    volumes: Sequence[BakedVolume], segments: Segments, marching: Marching, background: Background, mix: Mix = STYLISED
) -> Tuple[PackedRender, PackedRender]:
    """The render of a mixture of one or two styles, which share coarse field and resolution, and the coarse render."""
    lines = lines_of(segments, marching.num_steps, marching.unbounded)
    if lines is None:
        return march_in_torch(volumes, segments, marching, background, mix)
    return march_compiled(volumes, lines, marching, background, mix)


@torch.no_grad()
def march_in_torch(
    volumes: Sequence[BakedVolume], segments: Segments, marching: Marching, background: Background, mix: Mix = STYLISED
) -> Tuple[PackedRender, PackedRender]:
    """`render_baked` on any device: the exact render, with the volumes in the fields' place."""
    samples, density, values = visible_samples(volumes[0].density_and_feature, segments, marching)
    found = [values, *(volume.density_and_feature(samples.positions)[1] for volume in volumes[1:])]
    coarse, styles = Appearance(density, values[:, 4:]), [Appearance(each[:, 0], each[:, 1:4]) for each in found]
    num_rays = len(segments.hit)
    render = render_packed(samples, num_rays, *mixed(coarse, styles, mix), background)
    return render, render_packed(samples, num_rays, *coarse, background)


@torch.no_grad()
def march_compiled(
    volumes: Sequence[BakedVolume], lines: Lines, marching: Marching, background: Background, mix: Mix = STYLISED
) -> Tuple[PackedRender, PackedRender]:
    """`render_baked` on a CPU: rays are marched until none has come by a voxel that isn't filled."""
    left = torch.arange(len(lines.hit))
    sums = torch.zeros(len(left), 10)
    shares = tuple(map(np.float32, (mix.density_share, mix.strength, mix.blend)))
    while len(left):
        missing = torch.full((len(left), baked_kernels.LOOKAHEAD), baked_kernels.NO_CELL)
        voxels = (*(_voxels(each, marching.occupancy) for each in volumes), None)[:2]
        results = (lines, *voxels, shares, np.float32(marching.min_transmittance), sums.numpy(), missing.numpy())
        parts = even_parts(len(left), -(-len(left) // RAYS_PER_PART))
        run_on_threads(baked_kernels.march_rays, [(left.numpy(), *part, *results) for part in parts])
        waiting = missing[:, 0] != baked_kernels.NO_CELL
        left, missing = left[waiting], missing[waiting]
        for each in volumes if len(left) else []:
            each.fill(_unravel(missing[missing != baked_kernels.NO_CELL], each.resolution))
    return composite(sums[:, :5], background), composite(sums[:, 5:], background)


def _voxels(volume: BakedVolume, occupancy: Optional[Occupancy]) -> baked_kernels.Voxels:
    return baked_kernels.Voxels(
        np.zeros((1, 1, 1), dtype=np.uint8) if occupancy is None else volume.clearance(occupancy),
        volume.slots.numpy(),
        volume.codes.numpy().view("<u8").squeeze(-1),
        volume.resolution,
        *map(np.float32, (DENSITY_UNIT, DENSITY_STEP, ROUNDING)),
    )


class BakedCache:
    """Keeps a baked volume for each of the styles that were shown last, for as long as no weight in it changes.

    `bake` makes a style's volume, with nothing in it yet; `shared` gives the modules that the pictures of all styles
    depend on. Any number of threads may render: they take turns.
    """

    def __init__(self, bake: Callable[[StylisedField], BakedVolume], shared: Callable[[], Iterable[nn.Module]]) -> None:
        self._bake, self._shared = bake, shared
        self.volumes: Dict[StylisedField, Tuple[BakedVolume, List[Tensor]]] = {}
        """By style, the volume and the weights that it was made of; the style that was shown last comes last."""
        self._lock = threading.Lock()  # volumes grow while they are rendered, and a viewer has several threads

    def render(
        self,
        styles: Sequence[StylisedField],
        segments: Segments,
        marching: Marching,
        background: Background,
        mix: Mix = STYLISED,
    ) -> Tuple[PackedRender, PackedRender]:
        """`render_baked` of one or two styles; what these rays need and the volumes don't have yet is filled in."""
        with self._lock:
            return render_baked(list(map(self._current, styles)), segments, marching, background, mix)

    def kept(self, style: StylisedField) -> Optional[BakedVolume]:
        """The volume of a style's next picture; None where it would start a new one, as when weights have changed."""
        volume, known = self.volumes.get(style, (None, []))
        return volume if volume is not None and all(map(torch.equal, known, self._weights(style))) else None

    def _current(self, style: StylisedField) -> BakedVolume:
        """A style's volume, a new one if what it shows has changed since the last picture."""
        weights, volume = self._weights(style), self.kept(style) or self._bake(style)
        # The viewer may break a picture off between any two lines; here that loses nothing.
        others = {each: kept for each, kept in self.volumes.items() if each is not style}
        self.volumes = dict([*others.items(), (style, (volume, weights))][-MOST_BAKED:])
        return volume

    def _weights(self, style: StylisedField) -> List[Tensor]:
        """What changes with every change of the weights that a style's pictures show, and is quick to compare."""
        # torch doesn't count the changes that fused optimisers make; these change every parameter of the residual MLP.
        tensors = [tensor for part in (*self._shared(), style) for tensor in (*part.parameters(), *part.buffers())]
        versions = torch.tensor([(tensor.data_ptr(), tensor._version) for tensor in tensors])
        values = [parameter for name, parameter in style.named_parameters() if not name.startswith("grid")]
        return [versions, torch.cat([value.detach().flatten() for value in values])]
