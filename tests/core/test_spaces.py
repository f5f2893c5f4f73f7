import math

import pytest
import reference
import torch
from nerfstudio.data.scene_box import SceneBox

from sparsestyle_ns.core.ndc import ndc_rays
from sparsestyle_ns.core.spaces import (
    MAX_DISTANCE,
    BoxSpace,
    ContractedSpace,
    ForwardFacingSpace,
    contract,
    intersect_box,
    inverse_spacing,
    spacing,
)

FOCAL_OVER_HALF_SIZE = (1.6, 2.1)
NEAR = 0.8
BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 2.0, 5.0]])
RAYS = 40


def random_rays(spread, seed=0):
    """Rays from origins about the world's origin in all directions."""
    generator = torch.Generator().manual_seed(seed)
    origins = spread * torch.randn(RAYS, 3, generator=generator)
    return origins, torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=generator), dim=-1)


def forward_facing(scale=1.0):
    """A space, rays that look along −z, and the map of world points to field coordinates."""
    origins, directions = random_rays(0.3)
    directions[:, 2] = -2
    directions = torch.nn.functional.normalize(directions, dim=-1)
    start, extent, _ = ndc_rays(scale * origins, directions, FOCAL_OVER_HALF_SIZE, scale * NEAR)
    ends = torch.cat([start, start + extent])
    box = torch.stack([ends.amin(dim=0), ends.amax(dim=0)])
    space = ForwardFacingSpace(SceneBox(aabb=box), FOCAL_OVER_HALF_SIZE, scale * NEAR)

    def to_field(points):
        return (reference.ndc_points(points, FOCAL_OVER_HALF_SIZE, scale * NEAR) - box[0]) / (box[1] - box[0]) * 2 - 1

    return space, scale * origins, directions, to_field


def box(scale=1.0):
    """A box, rays from within, from outside and past it, and the map of world points to field coordinates."""
    origins, directions = random_rays(4.0)
    aim = BOX[0] + torch.rand(RAYS // 2, 3, generator=torch.Generator().manual_seed(1)) * (BOX[1] - BOX[0])
    directions[: RAYS // 2] = torch.nn.functional.normalize(aim - origins[: RAYS // 2], dim=-1)
    space = BoxSpace(SceneBox(aabb=scale * BOX))

    def to_field(points):
        return (points / scale - torch.tensor([0.0, 0.0, 2.5])) / 2.5

    return space, scale * origins, directions, to_field


def contracted():
    """All of space, rays in all directions, and the map of world points to field coordinates."""

    def to_field(points):
        flat = [reference.contract(point) for point in points.reshape(-1, 3).tolist()]
        return torch.tensor(flat).view(points.shape)

    return ContractedSpace(), *random_rays(0.7), to_field


@pytest.fixture(params=[forward_facing, box, contracted], ids=lambda make: make.__name__)
def scene(request):
    return request.param()


def test_the_way_to_the_world_is_back_along_the_ray(scene):
    space, origins, directions, _ = scene
    segments = space.segments(origins, directions)
    s = torch.linspace(0.02, 0.9, 7).expand(RAYS, 7)
    distances = torch.cat([segments.distance(column[:, None]) for column in s.T], dim=-1)
    expected = origins[:, None] + distances[..., None] * directions[:, None]
    found = space.to_world(segments.positions(s))
    torch.testing.assert_close(found[segments.hit], expected[segments.hit], rtol=1e-3, atol=1e-3)


def test_a_segment_stays_in_the_cube(scene):
    space, origins, directions, _ = scene
    segments = space.segments(origins, directions)
    assert segments.hit.sum() >= RAYS // 2
    positions = segments.positions(torch.linspace(0, 1, 101).expand(RAYS, -1))
    # A border of the cube is a sum of float32 numbers of the size of the origins, at most 1e2.
    assert positions[segments.hit].abs().max() <= 1 + 1e-5


def test_lengths_are_the_distances_between_positions(scene):
    space, origins, directions, _ = scene
    segments = space.segments(origins, directions)
    edges = torch.rand(RAYS, 12, generator=torch.Generator().manual_seed(2)).sort(dim=-1).values
    positions = segments.positions(edges)
    expected = torch.zeros(RAYS, 11)
    for sample in range(11):
        expected[:, sample] = (positions[:, sample + 1] - positions[:, sample]).square().sum(dim=-1).sqrt()
    torch.testing.assert_close(segments.lengths(edges), expected, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("s", [0.0, 0.2, 0.5, 0.9, 0.99])
def test_a_walk_along_the_world_ray_arrives_at_the_field_coordinates(scene, s):
    space, origins, directions, to_field = scene
    segments = space.segments(origins, directions)
    s = torch.full((RAYS, 1), s)
    arrived = to_field(origins + segments.distance(s) * directions)
    # Far distances, up to some hundreds, take digits from the small coordinates.
    torch.testing.assert_close(segments.positions(s)[segments.hit, 0], arrived[segments.hit], atol=1e-4, rtol=0)


@pytest.mark.parametrize("s", [0.0, 0.2, 0.5, 0.9, 0.99])
def test_at_distance_is_the_inverse_of_distance(scene, s):
    space, origins, directions, _ = scene
    segments = space.segments(origins, directions)
    s = torch.full((RAYS, 1), s)
    found = segments.at_distance(segments.distance(s))
    torch.testing.assert_close(found[segments.hit], s[segments.hit], atol=2e-4, rtol=0)


def test_what_lies_before_or_behind_the_scene_is_at_the_ends_of_its_segments(scene):
    space, origins, directions, _ = scene
    segments = space.segments(origins, directions)
    for distance, end in ((-1.0, 0.0), (0.0, 0.0), (1e30, 1.0)):
        found = segments.at_distance(torch.full((RAYS, 1), distance))[segments.hit]
        torch.testing.assert_close(found, torch.full_like(found, end))


def test_distance_grows_along_a_segment_and_ends_at_the_distance_that_stands_for_infinity(scene):
    space, origins, directions, _ = scene
    segments = space.segments(origins, directions)
    distances = torch.cat([segments.distance(torch.full((RAYS, 1), s / 50)) for s in range(51)], dim=-1)
    assert (distances[segments.hit].diff(dim=-1) > 0).all()
    assert distances.max() <= MAX_DISTANCE
    if space.unbounded:
        unit = NEAR if isinstance(space, ForwardFacingSpace) else 1.0
        # s = 1 − 0.5e-4 in float32 is good to a thousandth of the rest.
        torch.testing.assert_close(distances[:, -1], torch.full((RAYS,), MAX_DISTANCE * unit), rtol=2e-3, atol=0)


def test_what_a_ray_sees_that_misses_the_box_is_behind_all_of_it():
    space = BoxSpace(SceneBox(aabb=BOX))
    origins, directions = random_rays(6.0)
    segments = space.segments(origins, directions)
    assert 0 < int(segments.hit.sum()) < RAYS
    corners = torch.cartesian_prod(*BOX.T)
    farthest = torch.cdist(origins, corners).amax(dim=-1, keepdim=True)
    seen = segments.distance(torch.full((RAYS, 1), 0.3))
    assert (seen >= farthest)[~segments.hit].all()
    assert (seen <= farthest)[segments.hit].all()


def test_packed_positions_are_the_dense_ones(scene):
    space, origins, directions, _ = scene
    segments = space.segments(origins, directions)
    s = torch.rand(RAYS, 5, generator=torch.Generator().manual_seed(3))
    ray_indices = torch.arange(RAYS).repeat_interleave(5)
    torch.testing.assert_close(segments.positions(s.flatten(), ray_indices), segments.positions(s).flatten(0, 1))


@pytest.mark.parametrize("scale", [0.01, 7.0, 1000.0])
@pytest.mark.parametrize("make", [forward_facing, box])
def test_the_unit_of_the_world_does_not_matter(make, scale):
    s = torch.linspace(0, 0.98, 9).expand(RAYS, -1)
    segments, scaled = (space.segments(o, d) for space, o, d, _ in (make(), make(scale)))
    assert torch.equal(segments.hit, scaled.hit)
    torch.testing.assert_close(scaled.positions(s), segments.positions(s), atol=2e-5, rtol=0)
    torch.testing.assert_close(scaled.lengths(s), segments.lengths(s), atol=2e-5, rtol=0)
    torch.testing.assert_close(
        scaled.distance(s[:, 4:5])[segments.hit], scale * segments.distance(s[:, 4:5])[segments.hit]
    )


@pytest.mark.parametrize(
    "space, direction",
    [
        (forward_facing()[0], (0.0, 0.0, 1.0)),
        (forward_facing()[0], (1.0, 0.0, 0.0)),
        (BoxSpace(SceneBox(aabb=BOX)), (0.0, 0.0, -1.0)),
    ],
)
def test_rays_that_miss_the_scene_have_length_0(space, direction):
    origins = torch.tensor([[0.5, -0.2, -1.0]])
    segments = space.segments(origins, torch.tensor([direction]))
    assert segments.hit.tolist() == [False]
    assert segments.lengths(torch.tensor([[0.0, 0.5, 1.0]])).tolist() == [[0, 0]]
    assert segments.positions(torch.tensor([[0.0, 1.0]])).isfinite().all()
    assert segments.distance(torch.tensor([[0.5]])).isfinite().all()


@pytest.mark.parametrize(
    "origin, direction, expected",
    [
        ((-3, 0, 0), (1, 0, 0), (2, 4)),
        ((0, 0.5, 5), (0, 0, -1), (4, 6)),
        ((0, 0, 0), (0, 0, 1), (0.05, 1)),  # from within, but not closer than `near`
        ((0.25, 0, 0), (-1, 0, 0), (0.05, 1.25)),
        ((-2, -1.5, 0), (0.6, 0.8, 0), (5 / 3, 25 / 8)),  # enters at x = −1 and leaves at y = 1
        ((-3, 2, 0), (1, 0, 0), None),  # parallel to a face and past it
        ((-3, -2, 0.5), (1, 0, 0), None),
        ((3, 0, 0), (1, 0, 0), None),  # behind the origin
        ((-3, 0, 0), (0.6, 0.8, 0), None),
        ((-2, 0, 0), (0.5**0.5, 0.5**0.5, 0), None),  # touches an edge in one point
        ((0.97, 0, 0), (1, 0, 0), None),  # leaves before `near`
    ],
)
def test_a_ray_and_a_box_worked_out_by_hand(origin, direction, expected):
    entry, leave, hit = intersect_box(
        torch.tensor([origin], dtype=torch.float32),
        torch.tensor([direction], dtype=torch.float32),
        torch.tensor([-1.0, -1.0, -1.0]),
        torch.tensor([1.0, 1.0, 1.0]),
        near=0.05,
    )
    assert hit.tolist() == [expected is not None]
    assert (entry.item(), leave.item()) == pytest.approx(expected or (0.05, 0.05))


@pytest.mark.parametrize("face", [-1.0, 1.0])
@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_a_ray_within_the_plane_of_a_face_is_a_hit_or_a_miss_but_a_number(face, zero):
    entry, leave, hit = intersect_box(
        torch.tensor([[-3.0, face, 0.0]]), torch.tensor([[1.0, zero, zero]]), -torch.ones(3), torch.ones(3)
    )
    assert (entry.item(), leave.item()) == ((2, 4) if hit.item() else (0, 0))


def test_contraction_keeps_directions_and_halves_what_lies_near():
    points = 3 * torch.randn(200, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    expected = [reference.contract(point) for point in points.tolist()]
    torch.testing.assert_close(contract(points), torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(contract(torch.tensor([0.5, -0.25, 0.0])), torch.tensor([0.25, -0.125, 0.0]))
    torch.testing.assert_close(contract(torch.tensor([-4.0, 2.0, 0.0])), torch.tensor([-0.875, 0.4375, 0.0]))


def test_contraction_has_no_jump_at_norm_1():
    directions = random_rays(1.0)[1].double()
    directions = directions / directions.abs().amax(dim=-1, keepdim=True)
    inner, outer = contract((1 - 1e-9) * directions), contract((1 + 1e-9) * directions)
    torch.testing.assert_close(inner, outer, atol=2e-9, rtol=0)
    torch.testing.assert_close(contract(directions), 0.5 * directions)


def test_contraction_stays_below_1_at_any_distance():
    norms = contract(torch.tensor([[10.0, 0, 0], [0, -MAX_DISTANCE, 0], [0, 0, 1e30]])).abs().amax(dim=-1)
    assert norms[0] < norms[1] <= norms[2] <= 1
    assert norms[1] < 1


def test_spacing_is_even_in_distance_near_by_and_in_disparity_far_away():
    assert spacing(torch.tensor([0.0, 0.5, 1.0, 2.0, 4.0])).tolist() == [0, 0.25, 0.5, 0.75, 0.875]
    distances = torch.logspace(-3, 3, 50, dtype=torch.float64)
    torch.testing.assert_close(inverse_spacing(spacing(distances)), distances)
    assert inverse_spacing(torch.tensor([1.0])).item() == pytest.approx(MAX_DISTANCE)


def test_the_longest_side_of_a_box_fills_the_cube_and_the_others_keep_their_proportion():
    origins = torch.tensor([[0.0, 0.0, -10.0], [-10.0, 0.0, 2.5]])
    segments = BoxSpace(SceneBox(aabb=BOX)).segments(origins, torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]))
    ends = segments.positions(torch.tensor([[0.0, 1.0]]).expand(2, -1))
    torch.testing.assert_close(ends[0], torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    torch.testing.assert_close(ends[1], torch.tensor([[-0.4, 0.0, 0.0], [0.4, 0.0, 0.0]]))
    assert math.isclose(segments.lengths(torch.tensor([[0.0, 1.0]]))[1].item(), 0.8, rel_tol=1e-6)


def test_a_camera_that_has_flown_into_a_forward_facing_scene_sees_what_is_ahead_of_it() -> None:
    space = ForwardFacingSpace(SceneBox(torch.tensor([[-2.0, -2, -1], [2, 2, 1]])), (1.0, 1.0), 1.0, (1.5, 9.0))
    origins = torch.tensor([[0.0, 0, 0], [0, 0, -3], [0, 0, -20]])
    segments = space.segments(origins, torch.tensor([[0.0, 0, -1]]).expand(3, 3))
    start, end = (segments.distance(torch.full((3, 1), s)).flatten() for s in (0.0, 1.0))
    torch.testing.assert_close(start, torch.tensor([1.5, 0.0, 0.0]), rtol=0, atol=1e-4)
    torch.testing.assert_close(end, torch.tensor([9.0, 6.0, 0.0]), rtol=0, atol=1e-4)
    assert segments.hit.tolist() == [True, True, False]  # the last one has the whole scene behind it


@pytest.mark.parametrize(("near", "far"), [(0.0, 1e6), (1.5, 3.0), (2.0, 2.5), (3.0, 2.0), (1e10, 1e10)])
def test_a_part_between_two_distances_is_all_of_the_ray_that_lies_there(scene, near, far):
    space, origins, directions, _ = scene
    segments = space.segments(origins, directions)
    part = segments.between(torch.full((RAYS, 1), near), torch.full((RAYS, 1), far))
    s = torch.linspace(0, 1, 9).expand(RAYS, -1)
    # A distance is met where the whole segment has it, so the same points have the same positions in the cube.
    at = torch.cat([segments.at_distance(part.distance(column[:, None])) for column in s.T], dim=-1)
    torch.testing.assert_close(part.positions(s)[part.hit], segments.positions(at)[part.hit], atol=2e-3, rtol=0)
    start, end = (part.distance(torch.full((RAYS, 1), side))[part.hit] for side in (0.0, 1.0))
    assert ((start >= near * (1 - 1e-3) - 1e-3) & (end <= far * (1 + 1e-2) + 1e-3)).all()
    reach = [segments.distance(torch.full((RAYS, 1), side)).squeeze(-1) for side in (0.0, 1.0)]
    inside = segments.hit & (reach[0] < far - 0.1) & (reach[1] > near + 0.1) & (far > near)
    assert part.hit[inside].all()
    assert not part.hit[~segments.hit].any()
    lengths = part.lengths(s)
    assert (lengths >= 0).all() and torch.isfinite(lengths).all()


def test_packed_positions_of_a_part_are_the_dense_ones(scene):
    space, origins, directions, _ = scene
    part = space.segments(origins, directions).between(torch.full((RAYS, 1), 1.5), torch.full((RAYS, 1), 4.0))
    s = torch.rand(RAYS, 5, generator=torch.Generator().manual_seed(3))
    ray_indices = torch.arange(RAYS).repeat_interleave(5)
    torch.testing.assert_close(part.positions(s.flatten(), ray_indices), part.positions(s).flatten(0, 1))
