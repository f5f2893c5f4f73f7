"""Which pixels of one view are found where in another, on planes whose parallax is known by hand."""

import pytest
import torch

from sparsestyle_ns.metrics.warping import Pinhole, Surface, correspond, is_occluded, pixel_centers, sample_picture

HEIGHT, WIDTH, FOCAL = 12, 32, 40.0
SHIFT = 0.3
"""Of the second camera to the right: 3 pixels for what is 4 away, 6 for what is 2 away."""


def pinhole(x: float) -> Pinhole:
    pose = torch.eye(4)[:3]
    pose[0, 3] = x
    return Pinhole(pose, (FOCAL, FOCAL), (WIDTH / 2, HEIGHT / 2))


def surface(x: float, depth: torch.Tensor, covered: torch.Tensor | None = None) -> Surface:
    """What a camera at (x, 0, 0) that looks along −z sees, given each pixel's depth."""
    centers = pixel_centers(HEIGHT, WIDTH, depth)
    right = (centers[..., 0] - WIDTH / 2) / FOCAL * depth
    up = -(centers[..., 1] - HEIGHT / 2) / FOCAL * depth
    points = torch.stack([right + x, up, -depth], dim=-1)
    return Surface(pinhole(x), points, torch.ones_like(depth, dtype=torch.bool) if covered is None else covered)


def plane(depth: float = 4.0) -> torch.Tensor:
    return torch.full((HEIGHT, WIDTH), depth)


def with_square(columns: slice) -> torch.Tensor:
    """A wall 4 away and, over all rows of some columns, a board 2 away before it."""
    depth = plane()
    depth[:, columns] = 2.0
    return depth


def test_points_are_projected_to_the_pixels_that_show_them() -> None:
    seen = surface(0.0, plane())
    pixels, in_front = seen.camera.project(seen.points)
    torch.testing.assert_close(pixels, pixel_centers(HEIGHT, WIDTH, seen.points))
    assert in_front.all()


def test_projection_undoes_the_rays_of_nerfstudios_cameras() -> None:
    from nerfstudio.cameras.cameras import Cameras

    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    pose = torch.cat([turn * turn.det(), torch.tensor([[0.5], [-1.0], [2.0]])], dim=-1)
    cameras = Cameras(pose[None], fx=30.0, fy=25.0, cx=15.0, cy=7.0, width=WIDTH, height=HEIGHT)
    rays = cameras.generate_rays(camera_indices=0, keep_shape=True)
    pixels, _ = Pinhole(pose, (30.0, 25.0), (15.0, 7.0)).project(rays.origins + 2.5 * rays.directions)
    torch.testing.assert_close(pixels, pixel_centers(HEIGHT, WIDTH, pixels), atol=1e-4, rtol=0)


def test_points_behind_a_camera_are_not_in_front_of_it() -> None:
    _, in_front = pinhole(0.0).project(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]))
    assert in_front.tolist() == [False, True, False]


def test_a_plane_moves_by_its_parallax_and_only_what_leaves_the_picture_is_lost() -> None:
    found = correspond(surface(0.0, plane()), surface(SHIFT, plane()))
    expected = pixel_centers(HEIGHT, WIDTH, plane()) - torch.tensor([3.0, 0.0])
    torch.testing.assert_close(found.pixels, expected, atol=1e-4, rtol=0)
    visible = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    visible[:, :3] = False
    assert torch.equal(found.visible, visible)


def test_a_board_hides_the_strip_of_wall_that_it_moves_over() -> None:
    # The board, 2 away, moves by 6 pixels: columns 12 to 19 become 6 to 13. The wall, 4 away, moves by 3: columns 9 to
    # 11 would become 6 to 8, where the board is now.
    found = correspond(surface(0.0, with_square(slice(12, 20))), surface(SHIFT, with_square(slice(6, 14))))
    visible = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    visible[:, :3] = False
    visible[:, 9:12] = False
    assert torch.equal(found.visible, visible)


def test_pixels_that_show_a_background_in_either_view_are_not_compared() -> None:
    covered = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    covered[2] = False
    empty = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    empty[:, 20] = False
    found = correspond(surface(0.0, plane(), covered), surface(SHIFT, plane(), empty))
    expected = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    expected[:, :3] = False
    expected[2] = False
    expected[:, 23] = False  # column 20 of the second view
    # Column 20's neighbours are read without it where coordinates are whole; rounding may read a trace of it.
    certain = torch.ones(WIDTH, dtype=torch.bool)
    certain[[22, 24]] = False
    assert torch.equal(found.visible[:, certain], expected[:, certain])


@pytest.mark.parametrize("error, occluded", [(0.0, False), (0.7, False), (0.8, True)])
def test_the_way_back_may_miss_by_a_fraction_of_a_pixel(error: float, occluded: bool) -> None:
    # The bound is √(0.01 (1 + (1 − e)²) + 0.5): about 0.71.
    forward, backward = torch.tensor([1.0, 0.0]), torch.tensor([error - 1.0, 0.0])
    assert bool(is_occluded(forward, backward)) == occluded


def test_the_bound_grows_with_the_motion() -> None:
    forward, backward = torch.tensor([100.0, 0.0]), torch.tensor([-95.0, 0.0])
    assert not is_occluded(forward, backward)
    assert is_occluded(forward / 100, backward / 100 + torch.tensor([0.0, 1.0]))


def test_a_picture_is_read_bilinearly_between_pixel_centres() -> None:
    picture = torch.arange(8.0).view(2, 4, 1)
    pixels = torch.tensor([[[0.5, 0.5], [1.0, 0.5], [3.5, 1.0], [-5.0, 0.5]]])
    assert sample_picture(picture, pixels).flatten().tolist() == pytest.approx([0.0, 0.5, 5.0, 0.0], abs=1e-5)
