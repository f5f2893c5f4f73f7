"""The sample scene: what its files say is what its pictures show."""

import filecmp
import json
import math
from dataclasses import replace

import cv2
import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from make_sample_scene import main
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from sample_scene.cameras import circling_cameras, forward_facing_cameras, look_at, rays_of_rows, surrounding_cameras
from sample_scene.scene import Scene, objects_on_a_plinth, still_life
from sample_scene.shapes import Box, Sphere
from sample_scene.textures import ValueNoise
from sample_scene.tracer import render_sample
from sample_scene.writers import BLENDER_CAMERA_ANGLE_X, photo_gains, poses_bounds_row

WIDTH, HEIGHT, FOCAL = 120, 90, 102.0
NUM_VIEWS = 4


@pytest.fixture(scope="module")
def llff(tmp_path_factory):
    output = tmp_path_factory.mktemp("sample")
    assert main([str(output), "--layout", "llff", "--width", "64", "--num-views", str(NUM_VIEWS)]) == 0
    return output / "llff"


@pytest.fixture(scope="module")
def blender(tmp_path_factory):
    output = tmp_path_factory.mktemp("sample")
    counts = ["--num-train", "3", "--num-val", "1", "--num-test", "2"]
    assert main([str(output), "--layout", "blender", "--width", "40", *counts]) == 0
    return output / "blender"


@pytest.fixture(scope="module")
def two_views():
    """The outermost cameras of a row of the grid, with what they see: (pose, rgb, depth) each."""
    poses = forward_facing_cameras(20)[[5, 9]]
    renders = [render_sample(pose, FOCAL, HEIGHT, WIDTH, still_life()) for pose in poses]
    return [(pose, rgb, depth) for pose, (rgb, _, depth) in zip(poses, renders, strict=True)]


def world_points(pose, depth, focal):
    """Back-projects a depth map to world points (height, width, 3)."""
    height, width = depth.shape
    y, x = np.mgrid[0:height, 0:width] + 0.5
    rays = np.stack([(x - width / 2) / focal, (height / 2 - y) / focal, -np.ones_like(x)], axis=-1)
    return (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]


def project(pose, points, focal, height, width):
    """World points (..., 3) -> x, y in pixels and depth, each (...)."""
    x, y, z = np.moveaxis((points - pose[:3, 3]) @ pose[:3, :3], -1, 0)
    return width / 2 - focal * x / z, height / 2 + focal * y / z, -z


def warp(first, second):
    """Looks up every pixel of the first view in the second one.

    Returns which pixels fall into the second picture, depth of their points there, and depth and colour it shows there.
    """
    (pose, _, depth), (other_pose, other_rgb, other_depth) = first, second
    x, y, z = project(other_pose, world_points(pose, depth, FOCAL), FOCAL, HEIGHT, WIDTH)
    is_inside = (x > 1) & (x < WIDTH - 1) & (y > 1) & (y < HEIGHT - 1)
    column, row = np.clip(x, 0, WIDTH - 1).astype(int), np.clip(y, 0, HEIGHT - 1).astype(int)
    # cv2.remap calls a pixel's centre an integer, this project calls it an integer and a half.
    colour = cv2.remap(other_rgb, (x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32), cv2.INTER_LINEAR)
    return is_inside, z, other_depth[row, column], colour


def test_the_second_camera_sees_what_the_first_one_shows_where_nothing_occludes(two_views):
    first, second = two_views
    is_inside, z, shown_z, colour = warp(first, second)
    is_visible = is_inside & (np.abs(shown_z - z) < 0.02 * z)
    difference = np.abs(colour - first[1]).mean(axis=-1)[is_visible]
    unwarped = np.abs(second[1] - first[1]).mean(axis=-1)[is_visible]
    assert is_visible.mean() > 0.5
    # Not zero: the pixels of the two views average over different patches of the texture.
    assert np.median(difference) < 0.03
    assert np.median(difference) < 0.25 * np.median(unwarped)


def test_some_of_what_the_first_camera_shows_is_occluded_for_the_second_one(two_views):
    is_inside, z, shown_z, _ = warp(*two_views)
    is_occluded = is_inside & (shown_z < 0.9 * z)
    assert 0.01 < is_occluded.mean() < 0.4


def test_depths_never_lie_behind_what_the_other_camera_proves_to_be_empty(two_views):
    is_inside, z, shown_z, _ = warp(*two_views)
    # A point seen by the first camera is matter, so the second camera cannot look far past it; only at silhouettes
    # does the nearest pixel's centre miss it.
    assert (is_inside & (shown_z > 1.05 * z)).mean() < 0.03


def test_depth_at_a_balls_centre_is_its_distance_less_its_radius_along_the_viewing_axis():
    ball = next(shape for shape in still_life().shapes if isinstance(shape, Sphere))
    pose = look_at((0.1, -0.2, 1.4), (0.0, 5.0, 0.9))
    *_, depth = render_sample(pose, FOCAL, HEIGHT, WIDTH, still_life(), supersample=1)
    x, y, z = project(pose, np.array(ball.centre), FOCAL, HEIGHT, WIDTH)
    distance = np.linalg.norm(np.array(ball.centre) - pose[:3, 3])
    # Half a pixel off the centre, the ball's surface is less than 0.1% farther away.
    assert depth[int(y), int(x)] == pytest.approx((distance - ball.radius) * z / distance, rel=5e-3)


def test_every_forward_facing_ray_ends_on_a_surface(two_views):
    for _, _, depth in two_views:
        assert np.isfinite(depth).all()


def test_the_order_in_which_shapes_are_listed_does_not_matter():
    scene = still_life()
    reversed_scene = replace(scene, shapes=scene.shapes[::-1], backdrop=scene.backdrop[::-1])
    pose = look_at((0.1, -0.2, 1.4), (0.0, 5.0, 0.9))
    for one, other in zip(
        render_sample(pose, FOCAL, HEIGHT, WIDTH, scene),
        render_sample(pose, FOCAL, HEIGHT, WIDTH, reversed_scene),
        strict=True,
    ):
        # Summation order of the soft shadows aside; surfaces that touch may swap in a few pixels.
        assert np.mean(np.abs(one - other) > 1e-4) < 1e-3


def test_a_ball_shades_the_ground_on_the_side_away_from_the_sun():
    ground = Box((0, 0, -0.1), (3, 3, 0.1), lambda p, n: np.full_like(p, 0.5))
    ball = Sphere((0, 0, 1), 0.3, lambda p, n: np.full_like(p, 0.5))
    scene = Scene((ball,), ValueNoise(0), sun=(-1, 0, 1), backdrop=(ground,))
    pose = look_at((0, -6, 4), (0, 0, 0))
    rgb, *_ = render_sample(pose, FOCAL, HEIGHT, WIDTH, scene)

    def brightness(point):
        x, y, _ = project(pose, np.array(point), FOCAL, HEIGHT, WIDTH)
        return rgb[int(y), int(x)].mean()

    # The sun stands at 45 degrees to the left, so the middle of the shadow is as far to the right as the ball is high.
    assert brightness((1, 0, 0)) < 0.75 * brightness((-1, 0, 0))


def test_a_ball_on_the_viewing_axis_looks_the_same_in_a_mirror():
    scene = Scene((Sphere((0, 0, 0), 0.8, lambda p, n: np.ones_like(p)),), ValueNoise(0), sun=(0, -1, 1))
    for height, width in ((30, 40), (31, 41)):
        _, alpha, depth = render_sample(look_at((0, -4, 0), (0, 0, 0)), 35.0, height, width, scene)
        # A ray that all but touches the outline may fall to either side.
        assert np.mean(alpha != alpha[:, ::-1]) < 0.01
        assert np.mean(alpha != alpha[::-1]) < 0.01
        inside = alpha == 1
        np.testing.assert_allclose(depth[inside], depth[::-1, ::-1][inside], rtol=1e-4)


def test_alpha_of_a_lone_ball_sums_to_the_area_of_its_outline():
    scene = Scene((Sphere((0, 0, 0), 0.8, lambda p, n: np.full_like(p, 0.5)),), ValueNoise(0), sun=(0, -1, 1))
    _, alpha, _ = render_sample(look_at((0, -4, 0), (0, 0, 0)), FOCAL, HEIGHT, WIDTH, scene)
    outline_radius = FOCAL * 0.8 / math.sqrt(4**2 - 0.8**2)
    assert alpha.sum() == pytest.approx(math.pi * outline_radius**2, rel=0.01)


def test_colours_are_not_multiplied_by_alpha():
    scene = Scene((Sphere((0, 0, 0), 0.8, lambda p, n: np.ones_like(p)),), ValueNoise(0), (0, -1, 1), sun_light=0)
    rgb, alpha, _ = render_sample(look_at((0, -4, 0), (0, 0, 0)), FOCAL, HEIGHT, WIDTH, scene)
    darkest_inside = rgb[alpha == 1].min()
    at_the_edge = (alpha > 0) & (alpha < 0.5)
    assert at_the_edge.any()
    assert rgb[at_the_edge].min() > 0.95 * darkest_inside
    assert (rgb[alpha == 0] == 0).all()


def test_alpha_and_depth_agree_on_where_objects_are():
    for pose in circling_cameras(2):
        _, alpha, depth = render_sample(pose, 140.0, 100, 100, objects_on_a_plinth())
        assert np.isinf(depth[alpha == 0]).all()
        assert np.isfinite(depth[alpha == 1]).all()
        assert (alpha == 0).mean() > 0.3
        assert (alpha == 1).mean() > 0.1
        assert ((alpha > 0) & (alpha < 1)).any()


def test_the_objects_lie_within_the_unit_cube_and_fill_much_of_it():
    points = []
    for pose in circling_cameras(4):
        *_, depth = render_sample(pose, 140.0, 100, 100, objects_on_a_plinth(), supersample=1)
        is_hit = np.isfinite(depth)
        points.append(world_points(pose, np.where(is_hit, depth, 0), 140.0)[is_hit])
    points = np.concatenate(points)
    assert np.abs(points).max() <= 1
    assert (np.ptp(points, axis=0) > 1.2).all()


def test_a_pixel_needs_an_odd_number_of_rays_so_that_depth_is_of_its_centre():
    with pytest.raises(ValueError, match="odd"):
        render_sample(np.eye(4), FOCAL, 4, 4, still_life(), supersample=2)


def test_a_camera_that_looks_straight_down_is_refused():
    with pytest.raises(ValueError, match="straight up or down"):
        look_at((0, 0, 1), (0, 0, 0))


def test_a_row_of_poses_bounds_holds_down_right_back_position_and_size_then_bounds():
    pose = np.array([[1, 0, 0, 7], [0, 0, -1, 8], [0, 1, 0, 9.0]])  # right +x, up +z, back -y
    row = poses_bounds_row(pose, height=30, width=40, focal=50.0, near=1.5, far=6.0)
    matrix = row[:15].reshape(3, 5)
    np.testing.assert_array_equal(matrix[:, 0], [0, 0, -1])
    np.testing.assert_array_equal(matrix[:, 1], [1, 0, 0])
    np.testing.assert_array_equal(matrix[:, 2], [0, -1, 0])
    np.testing.assert_array_equal(matrix[:, 3], [7, 8, 9])
    np.testing.assert_array_equal(matrix[:, 4], [30, 40, 50])
    np.testing.assert_array_equal(row[15:], [1.5, 6.0])


def test_written_rotations_are_right_handed_and_orthonormal(llff):
    for row in np.load(llff / "poses_bounds.npy"):
        down, right, back = row[:15].reshape(3, 5)[:, :3].T
        rotation = np.stack([right, -down, back], axis=1)
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1)


def test_written_cameras_stand_upright_and_face_the_wall(llff):
    rows = np.load(llff / "poses_bounds.npy")
    assert rows.shape == (NUM_VIEWS, 17)
    for row in rows:
        down, right, back = row[:15].reshape(3, 5)[:, :3].T
        assert down @ (0, 0, -1) > 0.95
        assert right @ (1, 0, 0) > 0.95
        assert back @ (0, -1, 0) > 0.95


def test_pictures_show_what_the_written_poses_and_bounds_say(llff):
    rows = np.load(llff / "poses_bounds.npy")
    paths = sorted((llff / "images").iterdir())
    assert [path.name for path in paths] == [f"image{i:03d}.png" for i in range(NUM_VIEWS)]
    for path, row in zip(paths, rows, strict=True):
        matrix, (near, far) = row[:15].reshape(3, 5), row[15:]
        down, right, back, position, (height, width, focal) = matrix.T
        picture = imageio.imread(path)
        assert picture.shape == (height, width, 3) == (48, 64, 3)
        pose = np.stack([right, -down, back, position], axis=1)
        rgb, _, depth = render_sample(pose, focal, int(height), int(width), still_life())
        np.testing.assert_allclose(picture / 255, rgb, atol=0.5 / 255 + 1e-6)
        assert near < depth.min() < 1.2 * near
        assert far == pytest.approx(depth.max())


def test_the_grid_reaches_a_quarter_of_the_nearest_depth_to_either_side():
    poses = forward_facing_cameras(20)
    outermost = poses[[0, 2, 4, 15, 17, 19]]
    nearest = min(render_sample(pose, FOCAL, HEIGHT, WIDTH, still_life(), 1)[2].min() for pose in outermost)
    reach = np.ptp(poses[:, 0, 3]) / 2
    assert 0.2 < reach / nearest < 0.33
    assert np.ptp(poses[:, 2, 3]) > 0.5 * reach


def test_any_number_of_views_has_cameras():
    for num_views in (1, 2, 3, 7):
        poses = forward_facing_cameras(num_views)
        assert poses.shape == (num_views, 4, 4)
        assert np.isfinite(poses).all()


def test_blender_cameras_look_at_the_origin_from_the_upper_half_of_a_sphere():
    for pose in [*surrounding_cameras(20, np.random.default_rng(0)), *circling_cameras(5)]:
        position, back = pose[:3, 3], pose[:3, 2]
        np.testing.assert_allclose(position, 4.03 * back, atol=1e-9)
        assert position[2] > 0
        assert pose[2, 1] > 0  # the camera's up points up


def test_transforms_have_the_layout_of_nerfs_synthetic_scenes(blender):
    for split, count in (("train", 3), ("val", 1), ("test", 2)):
        transforms = json.loads((blender / f"transforms_{split}.json").read_text())
        assert transforms["camera_angle_x"] == BLENDER_CAMERA_ANGLE_X
        assert [frame["file_path"] for frame in transforms["frames"]] == [f"./{split}/r_{i}" for i in range(count)]
        for frame in transforms["frames"]:
            assert set(frame) == {"file_path", "rotation", "transform_matrix"}
            assert np.shape(frame["transform_matrix"]) == (4, 4)
            assert imageio.imread(blender / f"{frame['file_path']}.png").shape == (40, 40, 4)


def test_nerfstudios_blender_dataparser_reads_cameras_that_see_the_pictures(blender):
    parsed = BlenderDataParserConfig(data=blender).setup().get_dataparser_outputs("train")
    assert len(parsed.image_filenames) == 3
    for i, path in enumerate(parsed.image_filenames):
        rays = parsed.cameras.generate_rays(i, coords=torch.tensor([[20.0, 20.0]]))
        pose, focal = parsed.cameras.camera_to_worlds[i].numpy(), parsed.cameras.fx[i].item()
        torch.testing.assert_close(rays.directions[0], -torch.from_numpy(pose[:, 2]), rtol=0, atol=1e-5)
        rgb, alpha, _ = render_sample(pose, focal, 40, 40, objects_on_a_plinth())
        # The parser keeps poses in single precision, which can move a ray across a silhouette.
        difference = np.abs(imageio.imread(path) / 255 - np.dstack([rgb, alpha]))
        assert np.mean(difference > 1 / 255) < 0.01


def test_the_same_seed_writes_the_same_bytes_and_another_seed_others(tmp_path):
    arguments = ["--width", "24", "--num-views", "2", "--num-train", "2", "--num-val", "0", "--num-test", "1"]
    for name, seed in (("one", 3), ("two", 3), ("three", 4)):
        assert main([str(tmp_path / name), *arguments, "--seed", str(seed)]) == 0
    names = [str(path.relative_to(tmp_path / "one")) for path in (tmp_path / "one").rglob("*") if path.is_file()]
    assert len(names) == 2 + 1 + 2 + 1 + 2
    assert filecmp.cmpfiles(tmp_path / "one", tmp_path / "two", names, shallow=False)[0] == names
    pictures = [name for name in names if name.endswith(".png")]
    assert filecmp.cmpfiles(tmp_path / "one", tmp_path / "three", pictures, shallow=False)[0] == []


def test_a_scene_that_exists_is_replaced_only_when_told_to(tmp_path, capsys):
    (tmp_path / "llff").mkdir()
    (tmp_path / "llff" / "precious.txt").write_text("mine")
    arguments = [str(tmp_path), "--layout", "llff", "--width", "16", "--num-views", "1"]
    assert main(arguments) == 1
    assert "--force" in capsys.readouterr().err
    assert (tmp_path / "llff" / "precious.txt").exists()
    assert main([*arguments, "--force"]) == 0
    assert sorted(path.name for path in (tmp_path / "llff").iterdir()) == ["images", "poses_bounds.npy"]
    assert [path.name for path in tmp_path.iterdir()] == ["llff"]


def test_an_output_that_cannot_be_written_is_one_sentence_and_status_1(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main([str(tmp_path / "file"), "--layout", "llff", "--width", "16", "--num-views", "1"]) == 1
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("flag", ["--width=0", "--num-views=0", "--supersample=2", "--seed=-1", "--num-train=-1"])
def test_a_senseless_number_is_refused_by_name(flag, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path), flag])
    assert flag.split("=")[0] in capsys.readouterr().err


def test_exposures_have_a_geometric_mean_of_one_and_stay_within_the_stops_asked_for():
    gains = photo_gains(12, 0.5, [0, 8])
    exposed = np.delete(gains, [0, 8], axis=0)
    assert (gains[[0, 8]] == 1).all()
    assert np.log2(exposed).mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)
    assert np.abs(np.log2(exposed)).max() == pytest.approx(0.5)
    assert (photo_gains(5, 0.0, []) == 1).all()


def test_only_training_pictures_are_exposed_differently(llff, tmp_path):
    options = ["--width", "24", "--num-views", "9", "--supersample", "1"]
    for name, more in (("plain", []), ("exposed", ["--exposure", "1"])):
        assert main([str(tmp_path / name), "--layout", "llff", *options, *more]) == 0
    for view in range(9):
        plain, exposed = (
            imageio.imread(tmp_path / name / "llff" / "images" / f"image{view:03d}.png")
            for name in ("plain", "exposed")
        )
        assert (plain == exposed).all() == (view in (0, 8))


def test_what_shines_looks_different_from_elsewhere_and_only_brighter(two_views):
    pose, matt, _ = two_views[0]
    shiny, _, _ = render_sample(pose, FOCAL, HEIGHT, WIDTH, still_life(shine=0.8))
    assert (shiny >= matt - 1e-6).all()
    assert (shiny - matt).max() > 0.3


def test_a_bent_lens_sees_along_the_rays_that_nerfstudio_makes_of_its_parameters(tmp_path):
    import torch
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    options = ["--width", "24", "--num-views", "9", "--supersample", "1", "--distortion", "0.3"]
    assert main([str(tmp_path), "--layout", "nerfstudio", *options]) == 0
    parser = NerfstudioDataParserConfig(data=tmp_path / "nerfstudio").setup()
    outputs = parser.get_dataparser_outputs("train")
    assert [path.name for path in outputs.image_filenames] == [f"image{i:03d}.png" for i in range(1, 8)]
    found = outputs.cameras.generate_rays(camera_indices=0, keep_shape=True).directions
    pose = outputs.cameras.camera_to_worlds[0].numpy()
    expected, _ = rays_of_rows(pose, float(outputs.cameras.fx[0]), 18, 24, np.arange(18), 1, 0.3)
    # nerfstudio inverts the lens in float32 up to 1e-3.
    torch.testing.assert_close(found.reshape(-1, 3), torch.from_numpy(expected.T).float(), atol=2e-3, rtol=0)


def test_distortion_is_refused_where_the_layout_has_no_place_for_it(tmp_path):
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--layout", "llff", "--distortion", "0.1"])
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--layout", "llff", "--shiny", "2"])


def test_mist_takes_light_by_the_length_of_its_way(two_views):
    pose, _, _ = two_views[0]
    # One ray a pixel: a pixel's way is its depth over the cosine with the viewing axis.
    clear, _, depth = render_sample(pose, FOCAL, HEIGHT, WIDTH, still_life(), supersample=1)
    scene = still_life(haze=0.3)
    hazy, _, _ = render_sample(pose, FOCAL, HEIGHT, WIDTH, scene, supersample=1)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    way = depth * np.sqrt(1 + ((x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2) / FOCAL**2)
    seen = np.exp(-0.3 * way)[..., None]
    np.testing.assert_allclose(hazy, seen * clear + (1 - seen) * np.array(scene.haze_color), atol=1e-5)


def test_mist_is_refused_where_objects_have_an_outline(tmp_path):
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--layout", "blender", "--haze", "0.3"])


def test_cameras_that_wander_look_past_each_other(tmp_path):
    for name, flags in (("still", ()), ("wandering", ("--wander", "0.5"))):
        sizes = ["--width", "8", "--num-views", "9", "--supersample", "1"]
        assert main([str(tmp_path / name), "--layout", "nerfstudio", *sizes, *flags]) == 0
        frames = json.loads((tmp_path / name / "nerfstudio" / "transforms.json").read_text())["frames"]
        poses = np.array([frame["transform_matrix"] for frame in frames])
        # How far the axes pass by the point that still cameras look at.
        aside = np.linalg.norm(np.cross(poses[:, :3, 3] - (0, 0, -0.1), poses[:, :3, 2]), axis=-1)
        assert aside.max() < 1e-5 if name == "still" else 0.1 < aside.max() < 0.5 * math.sqrt(2)
