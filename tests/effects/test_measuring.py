"""What effects measure, against cases worked out by hand."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from sparsestyle_ns.data.features import mutual_matches
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.data.matches import (
    LENSES,
    PointMatches,
    epipolar_error,
    near_epipolar_lines,
    rays_of,
    sample,
    undistorted,
)
from sparsestyle_ns.data.reading import read_scene
from sparsestyle_ns.effects.lens_distortion import largest_shift, measure_lens_distortion
from sparsestyle_ns.effects.matched_colors import fit_gains, measure_exposure, measure_view_color
from sparsestyle_ns.effects.matched_depth import measure_matched_depth, triangulate
from sparsestyle_ns.effects.scene import Scene, border, read_rgba
from sparsestyle_ns.utils.errors import InputError


def camera_at(position, back) -> np.ndarray:
    """A camera, upright, with this vector pointing backwards out of it."""
    back = np.asarray(back, float) / np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back, np.asarray(position, float)], axis=-1)


def test_a_true_match_obeys_the_cameras_and_a_shifted_one_is_off_by_the_shift():
    poses = camera_at((-1, 0, 0), (0, 0, 1)), camera_at((1, 0, 0), (0, 0, 1))
    points = np.random.default_rng(0).uniform((-1, -1, -6), (1, 1, -3), (20, 3))

    def seen(pose):
        local = (points - pose[:, 3]) @ pose[:, :3]
        return local / -local[:, 2:]

    first, second = seen(poses[0]), seen(poses[1])

    def error(first, second):
        rays = (rays_of(points[:, :2] * [1, -1], CameraType.PERSPECTIVE) for points in (first, second))
        return epipolar_error(*rays, *poses)

    assert error(first, second) == pytest.approx(np.zeros(20), abs=1e-9)
    # Beside each other, cameras allow any shift sideways and none upwards; Sampson shares it between both photos.
    assert error(first, second + np.array([0.1, 0, 0])) == pytest.approx(np.zeros(20), abs=1e-9)
    assert error(first, second + np.array([0, 0.1, 0])) == pytest.approx(np.full(20, 0.1 / np.sqrt(2)))


IMAGE_POINTS = np.random.default_rng(2).uniform(-0.9, 0.9, (30, 2))
"""Over the focal length."""


@pytest.mark.parametrize("kind", LENSES)
def test_points_are_seen_where_nerfstudios_rays_go(kind):
    """Of a fisheye, too, and with all six parameters of its distortion."""
    lens = torch.tensor([[0.05, -0.02, 0.01, 0.004, 0.003, -0.002]])
    pose = torch.eye(4)[None, :3]
    cameras = Cameras(pose, 100.0, 90.0, 110.0, 95.0, 220, 190, distortion_params=lens, camera_type=kind)
    pixels = torch.from_numpy(IMAGE_POINTS * [100.0, 90.0] + [110.0, 95.0]).float()
    expected = cameras.generate_rays(camera_indices=0, coords=pixels.flip(-1)).directions.numpy()
    found = rays_of(undistorted(IMAGE_POINTS, cameras, 0), kind).directions
    np.testing.assert_allclose(found / np.linalg.norm(found, axis=-1, keepdims=True), expected, atol=2e-6)


@pytest.mark.parametrize("kind", LENSES)
def test_tangents_are_the_derivatives_of_directions(kind):
    points = np.concatenate([IMAGE_POINTS, [[0.0, 0.0], [1e-5, -1e-5]]])
    for axis, step in enumerate(1e-6 * np.eye(2)):
        ahead, behind = (rays_of(points + sign * step, kind).directions for sign in (1, -1))
        np.testing.assert_allclose(rays_of(points, kind).tangents[..., axis], (ahead - behind) / 2e-6, atol=1e-8)


def test_a_match_of_fisheyes_is_off_by_its_shift_in_the_image_up_to_the_side():
    """Cameras beside each other; points up to 80 degrees aside, where a perspective image is stretched sixfold."""
    poses = camera_at((-1, 0, 0), (0, 0, 1)), camera_at((1, 0, 0), (0, 0, 1))
    generator = np.random.default_rng(0)
    angle, turn = generator.uniform(0.2, 1.4, 50), generator.uniform(0, 2 * np.pi, 50)
    directions = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)], axis=-1)
    points = 1e5 * directions

    def seen(pose):
        local = (points - pose[:, 3]) @ pose[:, :3]
        aside = np.linalg.norm(local[:, :2], axis=-1, keepdims=True)
        return np.arctan2(aside, -local[:, 2:]) * local[:, :2] / aside * [1, -1]

    def error(first, second):
        rays = (rays_of(points, CameraType.FISHEYE) for points in (first, second))
        return epipolar_error(*rays, *poses)

    first, second = seen(poses[0]), seen(poses[1])
    assert error(first, second) == pytest.approx(np.zeros(50), abs=1e-9)
    # Far points are seen alike by both; the shift along the gradient is shared between both photos.
    shift = 1e-4
    slopes = [(error(first, second + step) - error(first, second)) / shift for step in shift * np.eye(2)]
    assert np.hypot(*slopes) == pytest.approx(np.full(50, 1 / np.sqrt(2)), rel=0.01)


def test_of_other_cameras_effects_say_that_nothing_is_measured():
    kinds = torch.tensor([[CameraType.PERSPECTIVE.value], [CameraType.EQUIRECTANGULAR.value]])
    poses = torch.eye(4)[None, :3].repeat(2, 1, 1)
    cameras = Cameras(poses, 50.0, 50.0, 50.0, 25.0, 100, 50, camera_type=kinds)
    scene = Scene(DataparserOutputs([Path("a.png"), Path("b.png")], cameras))
    scene.photos = [np.random.default_rng(index).uniform(size=(50, 100, 4)).astype(np.float32) for index in range(2)]
    for measure in (measure_exposure, measure_view_color, measure_matched_depth):
        found = measure(scene)
        assert (found.on, found.value) == (False, None)
        assert found.reason.startswith("not measurable: points are matched between perspective and fisheye cameras")
        assert "equirectangular" in found.reason


def test_only_the_nearest_neighbours_of_each_other_match_and_only_where_they_stand_out():
    first = np.eye(4)[:3]
    second = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0.02, 0, 0.7, 0.71], [0, 0, 0.71, 0.7]])
    here, there = mutual_matches(first, second / np.linalg.norm(second, axis=1, keepdims=True), max_ratio=0.8)
    assert (here.tolist(), there.tolist()) == ([0, 1], [1, 0])


def test_colours_are_sampled_at_pixel_centres_and_between_them():
    image = np.arange(12, dtype=np.float32).reshape(3, 4)[..., None] * np.array([1, 10], dtype=np.float32)
    found = sample(image, np.array([[1.0, 2.0], [1.5, 0.0], [0.0, 0.5]]))
    assert found.tolist() == [[9.0, 90.0], [1.5, 15.0], [2.0, 20.0]]


def colour_matches(gains, outliers: int = 0) -> PointMatches:
    """A hundred grey points in each pair of photos with these gains, some of them of another colour in one."""
    generator = np.random.default_rng(1)
    pairs, seen = list(itertools.combinations(range(len(gains)), 2)), []
    for first, second in pairs:
        colors = generator.uniform(0.3, 0.6, (100, 3))
        other = colors * gains[second]
        other[:outliers] = generator.uniform(0, 1, (outliers, 3))
        seen.append(np.stack([colors * gains[first], other]))
    views, colors = np.repeat(np.array(pairs).T, 100, axis=1), np.concatenate(seen, axis=1)
    return PointMatches(views, colors, directions=np.zeros_like(colors), num_views=len(gains))


@pytest.mark.parametrize("outliers", [0, 20])
def test_gains_are_found_up_to_their_mean_even_among_points_that_differ(outliers):
    gains = np.exp(np.array([[0.3, 0.2, 0.1], [-0.2, 0.0, 0.1], [0.1, -0.1, 0.0]]))
    found, unexplained = fit_gains(colour_matches(gains, outliers))
    expected = np.log(gains) - np.log(gains).mean(axis=0)
    # 0.02 is added to colours of about 0.45 before their ratio is taken, which takes 4% off.
    assert np.abs(found - expected).max() < 0.03
    assert np.median(np.abs(unexplained)) < 0.02


def test_photos_that_hang_together_by_nothing_have_no_measurable_gain():
    whole = colour_matches(np.ones((4, 3)))
    assert whole.fewest_in_a_view() == 300
    apart = (whole.views[0] < 2) == (whole.views[1] < 2)
    parts = (part[:, apart] for part in (whole.views, whole.colors, whole.directions))
    assert PointMatches(*parts, num_views=4).fewest_in_a_view() == 0


def test_points_of_a_made_scene_are_matched_at_their_true_depth(tmp_path):
    import make_sample_scene

    make_sample_scene.main([str(tmp_path), "--layout", "llff", "--width", "200", "--num-views", "5"])
    scene = Scene(read_scene(LLFFDataParserConfig(data=tmp_path / "llff").setup()))
    rays = triangulate(scene)
    assert len(rays) >= 200
    # Both rays of a point end in the same place, and nearly all between the bounds that the scene was made with.
    ends = (rays.origins + rays.distances * rays.directions).view(2, -1, 3)
    assert ((ends[0] - ends[1]).norm(dim=-1) < 0.01 * rays.distances[: len(ends[0]), 0]).float().mean() > 0.95
    near, far = scene.ndc.depth_range
    depth = -ends[0, :, 2]
    assert ((depth > near) & (depth < far)).float().mean() > 0.95


def lens(k1: float) -> Cameras:
    pose = torch.eye(4)[None, :3]
    distortion = torch.tensor([[k1, 0, 0, 0, 0, 0]])
    return Cameras(pose, 100.0, 100.0, 50.0, 40.0, 100, 80, distortion_params=distortion)


def test_the_shift_by_a_lens_is_that_of_the_corner():
    seen = np.hypot(0.5, 0.4)
    for k1 in (0.1, 0.4):
        flat = np.roots([k1, 0, 1, -seen])
        flat = flat[np.isreal(flat)].real[0]
        assert largest_shift(lens(k1)) == pytest.approx(100 * (seen - flat), rel=1e-5)
    assert largest_shift(lens(0.0)) == 0


def test_parameters_without_which_a_camera_has_no_rays_are_kept():
    cameras = lens(0.0)
    cameras.camera_type[:] = CameraType.FISHEYE624.value
    found = measure_lens_distortion(Scene(DataparserOutputs([Path("a.png")], cameras)))
    assert (found.on, found.value) == (True, None)


def test_the_border_of_a_photo_is_its_rim():
    photo = np.zeros((50, 100, 1))
    photo[2:-2, 2:-2] = 1
    assert len(border(photo)) == 2 * 2 * 100 + 2 * 2 * 46 and border(photo).max() == 0


def test_a_photo_that_cant_be_read_is_named(tmp_path):
    (tmp_path / "photo.png").write_text("no picture")
    with pytest.raises(InputError, match=r"photo\.png"):
        read_rgba(tmp_path / "photo.png")


def test_points_near_each_others_epipolar_lines_are_those_of_a_small_epipolar_error():
    random = np.random.default_rng(0)
    first, second = (rays_of(random.uniform(-0.5, 0.5, (count, 2)), CameraType.PERSPECTIVE) for count in (30, 40))
    poses = [np.concatenate([cv2.Rodrigues(random.normal(0, 0.2, 3))[0], random.normal(0, 1, (3, 1))], 1) for _ in "ab"]
    near = near_epipolar_lines(first, second, *poses, 0.05)
    rows, others = (index.ravel() for index in np.indices(near.shape))
    error = epipolar_error(first[rows], second[others], *poses)
    assert 0 < near.sum() < near.size
    assert np.array_equal(near.ravel(), error < 0.05)
