"""Small scenes of voxels in each kind of space, with cameras that look at them."""

import math
from types import SimpleNamespace

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox

from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace
from sparsestyle_ns.export.orbit import Orbit, make_orbit
from sparsestyle_ns.export.voxel_grid import EMPTY, VoxelGrid, Voxels
from sparsestyle_ns.rendering.mixing import STYLISED

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
NUM_STEPS = 48


def look_from(*places, target=(0.0, 0.0, 0.0)) -> Cameras:
    """Cameras that look at a target, z up; they don't have their centre in the middle."""
    poses = []
    for place in places:
        back = torch.nn.functional.normalize(torch.tensor(place) - torch.tensor(target), dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back), dim=0)
        poses.append(torch.stack([right, torch.linalg.cross(back, right), back, torch.tensor(place)], dim=-1))
    return Cameras(torch.stack(poses), fx=FOCAL, fy=0.9 * FOCAL, cx=30.0, cy=27.0, width=WIDTH, height=HEIGHT)


def look_ahead(*places) -> Cameras:
    """Cameras that look along −z, y up, as those of a forward-facing scene do."""
    poses = torch.eye(4)[:3].repeat(len(places), 1, 1)
    poses[:, :, 3] = torch.tensor(places)
    return Cameras(poses, fx=FOCAL, fy=FOCAL, cx=32.0, cy=24.0, width=WIDTH, height=HEIGHT)


def balls(resolution: int, cells: int, styles: int = 1) -> VoxelGrid:
    """Two coloured balls, soft at the edge, in a thin fog; cells away from them are empty.

    In the second style they have other colours and one is larger, in the coarse field they are grey and one is smaller.
    """
    middle = (torch.arange(cells) + 0.5) * (2.0 / cells) - 1.0
    at = torch.stack(torch.meshgrid(middle, middle, middle, indexing="ij"), dim=-1)
    coarse = ball_voxels(-(-resolution // 2), 0.25, lambda points: 0.4 + 0.3 * points.sum(dim=-1, keepdim=True).sin())
    voxels = [
        ball_voxels(resolution, 0.3, lambda points: 0.5 + 0.5 * torch.sin(6.0 * points)),
        ball_voxels(resolution, 0.4, lambda points: 0.5 + 0.5 * torch.cos(4.0 * points.flip(-1))),
    ]
    return VoxelGrid(voxels[:styles], coarse, distances(at).amin(dim=-1) < 0.6)


def distances(points):
    """From the middles of the two balls."""
    centers = torch.tensor([[-0.35, 0.1, 0.0], [0.4, -0.2, 0.15]])
    return (points[..., None, :] - centers).norm(dim=-1)


def ball_voxels(resolution, radius, shade) -> Voxels:
    """The balls in one field."""
    axis = torch.linspace(-1.0, 1.0, resolution + 1)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    first, second = distances(points).unbind(-1)
    code = EMPTY + 170.0 * torch.sigmoid(30.0 * (radius - first)) + 140.0 * torch.sigmoid(30.0 * (0.35 - second))
    shades = shade(points).expand_as(points)
    colors = torch.where((first < second)[..., None], shades, 1.0 - shades.flip(-1))
    codes = torch.cat([code[..., None], 255.0 * colors], dim=-1).round().clamp(0, 255).to(torch.uint8)
    known = (distances(points).amin(dim=-1) < 0.9) | (points.abs().amax(dim=-1) > 0.9)
    codes[~known] = torch.tensor([EMPTY, 0, 0, 0], dtype=torch.uint8)
    return Voxels(codes, known)


def scene(kind: str, styles: int = 1) -> SimpleNamespace:
    """What a page needs of a `StylisedScene`, with `.voxels` of one or two styles, and `.orbit`."""
    background = None
    if kind == "ndc":
        box = SceneBox(torch.tensor([[-1.2, -1.3, -1.0], [1.2, 1.3, 1.0]]))
        space = ForwardFacingSpace(box, (2 * FOCAL / WIDTH, 2 * FOCAL / HEIGHT), 1.0, (1.4, 6.0))
        cameras = look_ahead((-0.2, 0.0, 0.0), (0.0, 0.1, 0.0), (0.2, 0.0, 0.05))
    elif kind == "box":
        space = BoxSpace(SceneBox(torch.tensor([[-1.0, -1.2, -0.8], [1.0, 1.2, 0.8]])))
        cameras = look_from((2.5, 0.4, 0.9), (-1.5, 2.0, 1.2), (0.3, -2.6, 0.2))
        background = torch.tensor([1.0, 0.9, 0.8])
    else:
        space = ContractedSpace(unit=3.0)
        cameras = look_from((3.3, 1.2, 1.5), (-3.0, 2.4, 1.2), (0.9, -3.9, 0.6))
    display = SimpleNamespace(own=SimpleNamespace(mix=STYLISED))
    config = SimpleNamespace(num_steps=NUM_STEPS)
    model = SimpleNamespace(space=space, background=background, config=config, display=display)
    names = [f"{number}.png" for number in range(len(cameras))]
    orbit: Orbit = make_orbit(space, cameras, 0, 6.0 if kind == "contracted" else 2.0)
    voxels = balls(31, 12, styles)
    if kind == "contracted":
        put_walls(voxels)
    made = {"name": "scene", "painting": "sea.jpg", "style": "sea", "method": "hier-style", "iterations": 7}
    return SimpleNamespace(
        model=model, voxels=voxels, cameras=cameras, names=names, orbit=orbit, title="A scene", **made
    )


def put_walls(grid: VoxelGrid) -> None:
    """Coloured walls far away, where the contraction bends rays."""
    for voxels in (*grid.styles, grid.coarse):
        axis = torch.linspace(-1.0, 1.0, len(voxels.codes))
        points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        wall = points.abs().amax(dim=-1) > 0.7
        density = torch.full_like(points[..., :1], 120.0)
        voxels.codes[wall] = torch.cat([density, 127.0 + 120.0 * torch.sin(9.0 * points)], -1)[wall].to(torch.uint8)
        voxels.known |= wall
    grid.occupied[:] = True


def put_specks(grid: VoxelGrid, cells: int) -> VoxelGrid:
    """The grid with specks of a voxel each, far apart, in place of all else; cells of its own, as many a side."""
    generator = torch.Generator().manual_seed(0)
    occupied = torch.zeros(cells, cells, cells, dtype=torch.bool)
    for voxels in (*grid.styles, grid.coarse):
        voxels.known[:] = True
        voxels.codes[..., 0] = EMPTY
        side = len(voxels.codes)
        at = torch.randint(1, side - 1, (40, 3), generator=generator)
        voxels.codes[tuple(at.T)] = torch.tensor([250, 255, 200, 0], dtype=torch.uint8)
        low, high = (((at + change) / (side - 1) * cells).long().clamp(0, cells - 1) for change in (-1, 1))
        for first, last in zip(low.tolist(), high.tolist(), strict=True):
            occupied[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))] = True
    return VoxelGrid(grid.styles, grid.coarse, occupied)


def psnr(first, second) -> float:
    """In dB, of pictures in [0, 1]."""
    error = float((torch.as_tensor(first) - torch.as_tensor(second)).square().mean())
    return math.inf if error == 0 else -10.0 * math.log10(error)


KINDS = ("ndc", "box", "contracted")
