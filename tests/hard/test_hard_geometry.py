import math

import numpy as np
import pytest
import torch
from conftest import decided
from hard.table import hard_case
from nerfstudio.data.scene_box import SceneBox
from reference import ndc_points
from torch.nn.functional import normalize

from sparsestyle_ns.core.ndc import ndc_distance, ndc_rays
from sparsestyle_ns.core.occupancy import DensityGrid, Occupancy, march
from sparsestyle_ns.core.sampling import even_edges
from sparsestyle_ns.core.spaces import BoxSpace, ContractedSpace, ForwardFacingSpace, contract, intersect_box
from sparsestyle_ns.effects.layouts import build_space
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.rendering.baked import clearance_of
from sparsestyle_ns.rendering.baked_kernels import _empty_steps
from sparsestyle_ns.rendering.render import render_coarse

FOCAL = (1.6, 2.1)
CUBE = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
SCALES = [1e-4, 1e-2, 1e2, 1e4]


def boxed(aabb=CUBE, **settings):
    return BoxSpace(SceneBox(aabb=aabb), **settings)


def forward_facing(scale=1.0, depth_range=(1.5, 9.0)):
    near, far = depth_range
    return ForwardFacingSpace(SceneBox(aabb=CUBE), FOCAL, near=scale, depth_range=(scale * near, scale * far))


def contracted(aabb):
    return build_space(decided("contraction"), SceneBox(aabb=aabb), ndc=None)


def rays(count=64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    directions = normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return 0.5 * torch.randn(count, 3, generator=generator), directions


def coarse_field():
    torch.manual_seed(0)
    return CoarseField(num_layers=2, layer_width=32, feature_dim=8, direction_levels=None, density_bias=1.0)


@torch.no_grad()
def picture(space, origins, directions):
    """Pixels and distances of a random field, on even samples."""
    segments = space.segments(origins, directions)
    edges = even_edges(len(origins), 48, origins.device)
    render = render_coarse(coarse_field(), segments, directions, edges, space.unbounded, None)
    return render.rgb, segments.distance(render.s.clamp(max=1 - 1e-4))


def assert_all_finite(space, origins, directions):
    """Positions, lengths, distances and pixels of rays are numbers, and so are the gradients of the field."""
    segments = space.segments(origins, directions)
    edges = even_edges(len(origins), 16, origins.device)
    for values in (segments.positions(edges), segments.lengths(edges), segments.distance(edges[:, :1])):
        assert values.isfinite().all()
    assert (segments.lengths(edges) >= 0).all()
    field = coarse_field()
    render = render_coarse(field, segments, directions, edges, space.unbounded, torch.ones(3))
    render.rgb.square().mean().backward()
    assert render.rgb.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in field.parameters())
    return segments


@hard_case(
    "geometry",
    case="NDC of rays parallel to the near plane",
    could_go_wrong="division by d_z = 0",
    must_hold="they miss the scene: length 0, everything finite",
)
@pytest.mark.parametrize("zero", [0.0, -0.0, -1e-12, 1e-12])
def test_rays_parallel_to_the_near_plane_miss_the_scene(zero):
    directions = torch.tensor([[1.0, 0.0, zero], [-0.6, 0.8, zero]])
    segments = assert_all_finite(forward_facing(), torch.zeros(2, 3), directions)
    assert segments.hit.tolist() == [False, False]
    assert segments.lengths(torch.tensor([[0.0, 1.0]] * 2)).tolist() == [[0], [0]]


@hard_case(
    "geometry",
    case="NDC of rays that point backwards",
    could_go_wrong="they meet the near plane at a negative distance, and see the scene upside down",
    must_hold="they miss the scene",
)
def test_rays_that_point_backwards_miss_the_scene():
    directions = normalize(torch.tensor([[0.0, 0.0, 1.0], [0.5, -0.5, 0.1]]), dim=-1)
    assert assert_all_finite(forward_facing(), torch.zeros(2, 3), directions).hit.tolist() == [False, False]


@hard_case(
    "geometry",
    case="NDC of rays that reach the near plane a million units aside",
    could_go_wrong="coordinates of 1e6 overflow in the encoding, or its gradients",
    must_hold="all is finite",
)
@pytest.mark.parametrize("slope", [1e-2, 1e-4, 2e-6])
def test_rays_nearly_parallel_to_the_near_plane_are_finite(slope):
    directions = normalize(torch.tensor([[1.0, 0.0, -slope], [-0.6, 0.8, -slope]]), dim=-1)
    assert assert_all_finite(forward_facing(), torch.zeros(2, 3), directions).hit.all()


@hard_case(
    "geometry",
    case="NDC of directions of length 1e-30 to 1e30",
    could_go_wrong="the square in their length overflows or underflows: rays count as parallel, or as forward",
    must_hold="the same image and the same validity as for length 1",
)
@pytest.mark.parametrize("length", [1e-30, 1e-20, 1e20, 1e30])
def test_the_length_of_a_direction_does_not_matter(length):
    origins, directions = rays()
    expected = ndc_rays(origins, directions, FOCAL)
    found = ndc_rays(origins, length * directions, FOCAL)
    assert torch.equal(found[2], expected[2])
    for left, right in zip(found[:2], expected[:2], strict=True):
        torch.testing.assert_close(left, right, rtol=1e-5, atol=1e-5)


@hard_case(
    "geometry",
    case="origins on, behind and beyond the near plane, points on and behind the camera plane",
    could_go_wrong="division by o_z = 0 or z = 0",
    must_hold="the formula's limit; finite where there is none",
)
def test_ndc_is_finite_on_both_sides_of_its_planes():
    z = torch.tensor([2.0, 1e-30, 0.0, -1e-30, -0.5, -1.0, -7.0])
    origins = torch.stack([torch.full_like(z, 0.3), torch.full_like(z, -0.2), z], dim=-1).requires_grad_()
    directions = torch.tensor([[0.1, 0.2, -1.0]]).expand_as(origins)
    start, extent, _ = ndc_rays(origins, directions, FOCAL)
    points = ndc_points(origins, FOCAL)
    distance = ndc_distance(torch.tensor([[0.0], [0.5], [1.0]])[:, None], origins, directions, max_distance=1e4)
    total = start.sum() + extent.sum() + points.sum() + distance.sum()
    (gradient,) = torch.autograd.grad(total, origins)
    for values in (start, extent, points, distance, gradient):
        assert values.isfinite().all()
    torch.testing.assert_close(start[:, 2], torch.full((7,), -1.0))


@hard_case(
    "geometry",
    case="nearest thing = farthest thing",
    could_go_wrong="the cube's scale is 2 / 0, and 0 · ∞ is not a number",
    must_hold="a scene that is a plane: finite coordinates in the cube, and an opaque picture",
)
@pytest.mark.parametrize("ratio", [1.0, 1 + 1e-7, 1 + 1e-4])
def test_a_scene_of_one_depth_is_a_plane(ratio):
    space = forward_facing(depth_range=(3.0, 3.0 * ratio))
    directions = normalize(torch.tensor([[0.0, 0.0, -1.0], [0.2, -0.1, -1.0]]), dim=-1)
    segments = assert_all_finite(space, torch.zeros(2, 3), directions)
    positions = segments.positions(torch.linspace(0, 1, 5).expand(2, -1))
    # z' is the difference of float32 numbers near 1/3, a few units in the last place of which are the whole range.
    assert positions[..., :2].abs().max() <= 1.001 and positions.abs().max() <= 4
    distance = segments.distance(torch.full((2, 1), 0.5))
    torch.testing.assert_close(distance, 3 / -directions[:, 2:], rtol=1e-3, atol=0)


@hard_case(
    "geometry",
    case="depths from 1 to 1e6, and to infinity",
    could_go_wrong="1 − near/far rounds to 1",
    must_hold="positions stay in the cube, and distances grow along a ray",
)
@pytest.mark.parametrize("farthest", [1e6, 1e12, math.inf])
def test_the_deepest_scenes_stay_in_the_cube(farthest):
    space = forward_facing(depth_range=(1.0, farthest))
    segments = assert_all_finite(space, torch.zeros(1, 3), torch.tensor([[0.0, 0.0, -1.0]]))
    s = torch.linspace(0, 1, 101)[None]
    assert segments.positions(s).abs().max() <= 1 + 1e-5
    distances = torch.cat([segments.distance(step[None, None]) for step in s[0]], dim=-1)
    assert (distances.diff(dim=-1) >= 0).all()


@hard_case(
    "geometry",
    case="a camera inside the box",
    could_go_wrong="rays begin behind the camera, or at it with a length of 0",
    must_hold="they begin at the near distance and end where they leave the box",
)
def test_rays_from_inside_the_box_begin_before_the_camera():
    _, directions = rays()
    origins = torch.rand(64, 3, generator=torch.Generator().manual_seed(1)) * 1.8 - 0.9
    segments = assert_all_finite(boxed(), origins, directions)
    begin, end = (segments.distance(torch.full((64, 1), s)) for s in (0.0, 1.0))
    assert (begin[segments.hit] > 0).all() and (end >= begin).all()
    torch.testing.assert_close(
        (origins + end * directions).abs().amax(dim=-1)[segments.hit], torch.ones(int(segments.hit.sum()))
    )


@hard_case(
    "geometry",
    case="rays along faces, edges and corners of the box, with directions of ±0 and 1e-42",
    could_go_wrong="0 / 0 in the slab method",
    must_hold="a hit or a miss, but numbers, with entry before exit",
)
def test_rays_along_the_boxs_skin_are_numbers():
    numbers = torch.tensor([-1.0, 0.0, 1.0])
    origins = torch.cartesian_prod(numbers * 3, numbers, numbers)
    directions = torch.cartesian_prod(*[torch.tensor([-1.0, -1e-42, -0.0, 0.0, 1e-42, 1.0])] * 3)
    directions = directions[directions.abs().amax(dim=-1) > 0.5]
    origins, directions = (
        part.reshape(-1, 3) for part in torch.broadcast_tensors(origins[:, None], normalize(directions, dim=-1)[None])
    )
    entry, leave, hit = intersect_box(origins, directions, *CUBE, near=0.05)
    assert entry.isfinite().all() and leave.isfinite().all() and (leave >= entry).all()
    assert torch.equal(leave > entry, hit[:, None])
    assert_all_finite(boxed(), origins, directions)


@hard_case(
    "geometry",
    case="rays that miss the box, all of a batch",
    could_go_wrong="no sample at all: the maximum or the mean of nothing",
    must_hold="no samples, length 0, the background",
)
def test_a_batch_that_misses_everything_sees_the_background():
    origins, directions = torch.tensor([[0.0, 0.0, 5.0]]).repeat(3, 1), torch.tensor([[0.0, 0.0, 1.0]]).repeat(3, 1)
    segments = assert_all_finite(boxed(), origins, directions)
    edges = even_edges(3, 16, origins.device)
    render = render_coarse(coarse_field(), segments, directions, edges, False, torch.full((3,), 0.25))
    assert render.rgb.tolist() == [[0.25] * 3] * 3
    assert len(march(segments, Occupancy(4), 8, unbounded=False).s) == 0


@hard_case(
    "geometry",
    case="a box without thickness",
    could_go_wrong="0 / 0 where its sides become the cube's",
    must_hold="rays cross it at one distance; all is finite",
)
def test_a_flat_box_is_finite():
    flat = torch.tensor([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
    assert_all_finite(boxed(flat), *rays())


@hard_case(
    "geometry",
    case="a box seen from 1e4 times its size",
    could_go_wrong="positions are differences of large numbers",
    must_hold="rays aimed at its middle cross it, within float32's rounding of such distances",
)
def test_a_box_that_is_far_away_is_still_hit():
    _, directions = rays()
    segments = assert_all_finite(boxed(), -1e4 * directions, directions)
    middle = segments.positions(torch.full((64, 1), 0.5))
    # Each coordinate is a product of 1e4, good to 24 bits, or half a unit in its last place: 5e-4.
    assert segments.hit.all() and middle.abs().max() < 5e-3


@hard_case(
    "geometry",
    case="points outside the grid, up to 3e38 and ±∞",
    could_go_wrong="the integer overflows, and a point far right counts as far left",
    must_hold="they belong to the nearest cell, in each grid",
)
@pytest.mark.parametrize("size", [1 + 1e-6, 3.0, 1e10, 1e30, 3e38, math.inf])
def test_points_outside_belong_to_the_nearest_cell(size):
    grid, occupancy = DensityGrid(8), Occupancy(8)
    occupancy.occupied.zero_()
    occupancy.occupied[7, 0, 2] = True
    point = torch.tensor([[size, -size, -0.3]])
    assert grid.cells(point).tolist() == [(7 * 8 + 0) * 8 + 2]
    assert occupancy.contains(point).tolist() == [True]
    clearance = clearance_of(occupancy.occupied).numpy()
    assert _empty_steps(clearance, *point[0].numpy(), np.float32(0.1)) == 0
    assert grid.cells(torch.full((1, 3), math.nan)).tolist() == [0]


@hard_case(
    "geometry",
    case="steps through empty cells of a length of 0, 1e-30, 1e30, ∞ or no number",
    could_go_wrong="a leap of a negative or endless number of steps, out of the arrays or never ending",
    must_hold="at least one step and no more than the empty cells have",
)
@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-3, 0.2, 1e30, math.inf, math.nan])
def test_a_leap_over_empty_cells_is_one_step_at_least_and_ends_before_the_occupied_ones(length):
    clearance = np.zeros((8, 8, 8), dtype=np.uint8)
    clearance[:, :, :] = 5
    steps = _empty_steps(clearance, *np.zeros(3, dtype=np.float32), np.float32(length))
    assert steps >= 1
    assert not (steps - 1) * length > 4 * 2 / 8


@hard_case(
    "geometry",
    case="points exactly on cell borders, at 0 and 1 of the cube",
    could_go_wrong="a cell −1 or one past the last",
    must_hold="a point on a border belongs to the cell above it, the last border to the last cell",
)
def test_points_on_borders_belong_to_one_cell():
    grid = DensityGrid(8)
    borders = torch.linspace(-1, 1, 9)
    points = torch.stack([borders, torch.full((9,), -1.0), torch.full((9,), -1.0)], dim=-1)
    assert (grid.cells(points) // 64).tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 7]


@hard_case(
    "geometry",
    case="scene scales of 1e-4 to 1e4, forward-facing",
    could_go_wrong="a constant in world units: near plane, cap of distances",
    must_hold="the same picture; distances grow with the scale",
)
@pytest.mark.parametrize("scale", SCALES)
def test_a_forward_facing_scene_looks_alike_at_any_scale(scale):
    origins, directions = rays()
    origins, directions[:, 2] = 0.1 * origins, -2
    directions = normalize(directions, dim=-1)
    rgb, distance = picture(forward_facing(), origins, directions)
    scaled_rgb, scaled_distance = picture(forward_facing(scale), scale * origins, directions)
    torch.testing.assert_close(scaled_rgb, rgb, rtol=0, atol=1e-4)
    torch.testing.assert_close(scaled_distance, scale * distance, rtol=1e-3, atol=0)


@hard_case(
    "geometry",
    case="scene scales of 1e-4 to 1e4, in a box",
    could_go_wrong="rays begin at a distance in world units, behind all of a small scene",
    must_hold="the same picture; distances grow with the scale",
)
@pytest.mark.parametrize("scale", SCALES)
def test_a_box_looks_alike_at_any_scale(scale):
    origins, directions = rays()
    rgb, distance = picture(boxed(), origins, directions)
    space = boxed(scale * CUBE)
    scaled_rgb, scaled_distance = picture(space, scale * origins, directions)
    torch.testing.assert_close(scaled_rgb, rgb, rtol=0, atol=1e-4)
    torch.testing.assert_close(scaled_distance, scale * distance, rtol=1e-3, atol=0)


@hard_case(
    "geometry",
    case="scene scales of 1e-4 to 1e4, contracted",
    could_go_wrong="the contraction's unit is the world's: a small scene is a point, a large one all at the border",
    must_hold="the same picture in a scene box of any size; distances grow with the scale",
)
@pytest.mark.parametrize("scale", SCALES)
def test_a_contracted_scene_looks_alike_at_any_scale(scale):
    origins, directions = rays()
    rgb, distance = picture(contracted(CUBE), origins, directions)
    space = contracted(scale * CUBE)
    scaled_rgb, scaled_distance = picture(space, scale * origins, directions)
    torch.testing.assert_close(scaled_rgb, rgb, rtol=0, atol=1e-4)
    torch.testing.assert_close(scaled_distance, scale * distance, rtol=1e-3, atol=0)


@hard_case(
    "geometry",
    case="contraction of points at 1e-38, exactly 1, and 3e38",
    could_go_wrong="1/|x| at 0; a jump at 1; |x| / |x| that overflows",
    must_hold="within the cube, continuous, with finite gradients",
)
def test_the_contraction_is_finite_everywhere():
    sizes = torch.tensor([0.0, 1e-38, 1 - 6e-8, 1.0, 1 + 1.2e-7, 1e10, 3e38])
    points = (sizes[:, None] * torch.tensor([1.0, -0.5, 0.25])).requires_grad_()
    bent = contract(points)
    (gradient,) = torch.autograd.grad(bent.sum(), points)
    assert bent.abs().max() <= 1 and gradient.isfinite().all()
    torch.testing.assert_close(bent[2:5], bent[3].expand(3, -1), rtol=0, atol=2e-7)


@hard_case(
    "geometry",
    case="contracted rays from a camera far outside, and from the origin",
    could_go_wrong="the bent ray's chords are 0 or not numbers",
    must_hold="positions in the cube, lengths 0 or more, all finite",
)
@pytest.mark.parametrize("distance", [0.0, 1.0, 1e4, 1e20])
def test_contracted_rays_are_finite_from_anywhere(distance):
    _, directions = rays()
    segments = assert_all_finite(ContractedSpace(), distance * directions.flip(0), directions)
    assert segments.positions(torch.linspace(0, 1, 33).expand(64, -1)).abs().max() <= 1
