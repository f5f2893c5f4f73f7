"""Where the page's camera may go."""

import math

import pytest
import torch
from small_scenes import KINDS, WIDTH, look_from, scene

from sparsestyle_ns.core.camera_paths import most_central
from sparsestyle_ns.export.orbit import pinholes, rotation, survey, turned


@pytest.mark.parametrize("kind", KINDS)
def test_no_turn_is_the_opening_camera(kind):
    small = scene(kind)
    camera = turned(small.orbit, small.cameras, 0.0, 0.0)
    torch.testing.assert_close(camera.camera_to_worlds, small.cameras.camera_to_worlds[:1])


@pytest.mark.parametrize("kind", KINDS)
def test_a_turn_keeps_the_distance_and_goes_on_looking_at_the_target(kind):
    small = scene(kind)
    pose = turned(small.orbit, small.cameras, 25.0, 10.0).camera_to_worlds[0]
    before = small.cameras.camera_to_worlds[0]
    offset, first = pose[:, 3] - small.orbit.target, before[:, 3] - small.orbit.target
    torch.testing.assert_close(offset.norm(), first.norm())
    torch.testing.assert_close(pose[:, 2], offset / offset.norm())
    assert offset @ small.orbit.up > first @ small.orbit.up  # pitch above 0 is upwards


def test_around_an_object_the_target_is_beside_its_centre_and_one_may_go_all_around():
    small = scene("box")
    torch.testing.assert_close(small.orbit.target, torch.zeros(3), atol=1e-5, rtol=0)
    assert small.orbit.yaw == (-180.0, 180.0)
    for pitch in small.orbit.pitch:
        pose = turned(small.orbit, small.cameras, 0.0, pitch).camera_to_worlds[0]
        assert abs(float(pose[2, 2])) == pytest.approx(math.sin(math.radians(85.0)), abs=1e-4)


def test_in_a_forward_facing_scene_turns_end_a_little_beyond_the_photos():
    small = scene("ndc")
    widest = torch.rad2deg(torch.atan(torch.tensor(0.4 / 2.0)))  # the outermost cameras, at a depth of 2
    assert widest < small.orbit.yaw[1] < 2 * widest
    nearest = small.orbit.target + small.orbit.distance[0] * (
        small.cameras.camera_to_worlds[0, :, 3] - small.orbit.target
    )
    assert nearest[2] > -small.model.space.near


def test_the_opening_camera_is_the_one_that_the_others_stand_around():
    assert most_central(look_from((2.0, 0.1, 0.0), (0.0, -2.0, 0.5), (1.4, -1.5, 0.3))) == 2


def test_a_survey_has_all_photos_and_turns_in_all_directions():
    small = scene("box")
    views = survey(small.orbit, small.cameras)
    assert len(views) > 3 + 13 * 6
    torch.testing.assert_close(views[2].camera_to_worlds[0], small.cameras.camera_to_worlds[2])
    backs = torch.cat([view.camera_to_worlds[:, :, 2] for view in views])
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    assert (directions @ backs.T).amax(dim=1).min() > torch.cos(torch.tensor(25.0).deg2rad())


def test_cameras_are_only_made_smaller():
    small = scene("box")
    assert int(pinholes(small.cameras[:1], 32).width) == 32
    assert int(pinholes(small.cameras[:1], 500).width) == int(small.cameras.width[0]) == WIDTH


def test_rotation_is_right_handed():
    turned_x = rotation(torch.tensor([0.0, 0.0, 1.0]), 90.0) @ torch.tensor([1.0, 0.0, 0.0])
    torch.testing.assert_close(turned_x, torch.tensor([0.0, 1.0, 0.0]), atol=1e-6, rtol=0)


def test_no_cameras_stay_none():
    none = pinholes(look_from((2.0, 0.1, 0.0))[torch.zeros(0, dtype=torch.long)])
    assert len(none.camera_to_worlds) == 0
