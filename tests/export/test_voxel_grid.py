"""Voxels stand for the fields wherever a page's camera may look."""

import math
from dataclasses import replace

import pytest
import torch
from small_scenes import KINDS, NUM_STEPS, balls, psnr, scene

from sparsestyle_ns.core.occupancy import Occupancy
from sparsestyle_ns.evaluation.held_out import exact_outputs
from sparsestyle_ns.export.orbit import make_orbit, pinholes, survey, turned
from sparsestyle_ns.export.stylised_scene import load_scene
from sparsestyle_ns.export.voxel_grid import (
    LEAST_CODE,
    Voxels,
    bake_voxels,
    last_step_cells,
    picture_of_voxels,
    render_voxels,
    visible_cells,
)
from sparsestyle_ns.export.web_page import median_depth
from sparsestyle_ns.rendering.baked import DENSITY_STEP, DENSITY_UNIT
from sparsestyle_ns.rendering.mixing import Mix


def test_interpolation_is_exact_for_what_is_linear():
    axis = torch.arange(5)
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    codes = torch.stack([10 + x, 20 + 3 * y, 5 * z, x + y + z], dim=-1).to(torch.uint8)
    voxels = Voxels(codes, torch.ones(5, 5, 5, dtype=torch.bool))
    points = 2.0 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) - 1.0
    x, y, z = (2.0 * points + 2.0).unbind(-1)
    torch.testing.assert_close(voxels.interpolate(points), torch.stack([10 + x, 20 + 3 * y, 5 * z, x + y + z], dim=-1))
    corner = torch.tensor([[1.5, 1.0, -3.0]])
    torch.testing.assert_close(voxels.interpolate(corner), codes[4, 4, 0].float()[None])


def test_a_ray_through_voxels_is_the_sum_over_its_samples():
    """Volume rendering in one loop, as it is written in books."""
    small = scene("box")
    camera = small.cameras[:1]
    picture = picture_of_voxels(small.voxels, small.model, camera)
    for row, column in ((24, 30), (20, 40), (30, 18)):
        coords = torch.tensor([row + 0.5, column + 0.5])
        bundle = camera.generate_rays(camera_indices=0, coords=coords)
        segments = small.model.space.segments(bundle.origins.view(1, 3), bundle.directions.view(1, 3))
        color, light = torch.zeros(3), 1.0
        for step in range(NUM_STEPS):
            position = segments.positions(torch.tensor([[(step + 0.5) / NUM_STEPS]]))[0]
            cell = tuple(((0.5 * position[0] + 0.5) * 12).long().clamp(0, 11).tolist())
            if not small.voxels.occupied[cell]:
                continue
            code, *shade = small.voxels.styles[0].interpolate(position)[0].tolist()
            density = DENSITY_UNIT * math.expm1(DENSITY_STEP * (code - 1)) if code > 1.05 else 0.0
            alpha = 1 - math.exp(-density * float(segments.extent.norm()) / NUM_STEPS)
            color, light = color + light * alpha * torch.tensor(shade) / 255, light * (1 - alpha)
        torch.testing.assert_close(picture[row, column], color + light * small.model.background, atol=1e-4, rtol=0)


def test_a_ray_that_misses_the_scene_sees_the_background():
    small = scene("box")
    segments = small.model.space.segments(torch.tensor([[5.0, 5.0, 5.0]]), torch.tensor([[0.0, 0.0, 1.0]]))
    seen = render_voxels(small.voxels, segments, small.model)
    torch.testing.assert_close(seen, small.model.background[None])


@pytest.mark.parametrize("kind", KINDS)
def test_cells_of_the_last_step_are_known(kind):
    small = scene(kind)
    small.model.device = torch.device("cpu")
    cells = last_step_cells(small.model, 61)
    if kind == "box":
        assert not cells.any()
        return
    bundle = small.cameras.generate_rays(camera_indices=torch.arange(3)[:, None]).flatten()
    segments = small.model.space.segments(bundle.origins, bundle.directions)
    last = segments.positions(torch.full((len(bundle), 1), 1.0 - 0.5 / NUM_STEPS))[:, 0]
    index = ((0.5 * last + 0.5) * 61).long().clamp(0, 60)
    assert cells[tuple(index.unbind(-1))].all()
    assert cells.float().mean() < 0.2


def test_fog_outside_of_what_is_occupied_counts_only_in_the_last_step():
    small = scene("ndc")
    empty = replace(small.voxels, occupied=torch.zeros_like(small.voxels.occupied))
    before = picture_of_voxels(empty, small.model, small.cameras[:1])
    assert torch.equal(before, torch.zeros_like(before))
    foggy = balls(31, 12)
    foggy.styles[0].codes[..., -1, :] = torch.tensor([60, 0, 255, 0], dtype=torch.uint8)
    after = picture_of_voxels(replace(foggy, occupied=empty.occupied), small.model, small.cameras[:1])
    assert after[..., 1].mean() > 0.5


@pytest.fixture(scope="module")
def exported(patterned_run):
    """A run, its voxels and its orbit."""
    loaded = load_scene(patterned_run / "config.yml")
    exact = exact_outputs(loaded.model, loaded.cameras[1:2])
    orbit = make_orbit(loaded.model.space, loaded.cameras, 1, median_depth(exact))
    return loaded, bake_voxels([loaded.model], 95, survey(orbit, loaded.cameras)), orbit


def test_turned_views_that_no_photo_shows_are_there_as_well(exported):
    loaded, voxels, orbit = exported
    # Not so far that rays leave the cube, where voxels repeat its border and the fields go on somehow.
    for yaw, pitch in ((4.0, -3.0), (-5.0, 2.0)):
        camera = turned(orbit, loaded.cameras, yaw, pitch)
        exact = exact_outputs(loaded.model, camera)["rgb"]
        assert psnr(picture_of_voxels(voxels, loaded.model, camera), exact) > 33


def test_voxels_hold_the_fields_values(exported):
    loaded, voxels, _ = exported
    style = voxels.styles[0]
    index = style.known.nonzero()[::97]
    shade = loaded.model.bake(8).shade(index.float() * (2.0 / 95) - 1.0)
    density = DENSITY_UNIT * torch.expm1(DENSITY_STEP * (style.codes[tuple(index.unbind(-1))][:, 0].float() - 1))
    torch.testing.assert_close(density, shade[:, 1], rtol=0.04, atol=0.5 * DENSITY_UNIT)
    torch.testing.assert_close(
        style.codes[tuple(index.unbind(-1))][:, 1:] / 255.0, shade[:, 2:5], atol=0.6 / 255, rtol=0
    )


def test_where_no_empty_space_is_skipped_every_cell_counts(exported):
    """As for a run with `--pipeline.effects.empty-space off`."""
    loaded, _, _ = exported
    camera, before, baked = pinholes(loaded.cameras[1:2], 16), loaded.model.occupancy, []
    for occupancy in (None, Occupancy(4)):
        loaded.model.occupancy = occupancy
        baked.append(bake_voxels([loaded.model], 32, [camera]))
    loaded.model.occupancy = before
    without, everywhere = baked
    assert without.occupied.all()
    for one, other in ((without.styles[0], everywhere.styles[0]), (without.coarse, everywhere.coarse)):
        assert torch.equal(one.known, other.known) and one.known.any()
        assert torch.equal(one.codes, other.codes)


@pytest.mark.parametrize("mix", [Mix(0.0), Mix(0.5, 0.3)])
def test_a_run_whose_config_asks_for_less_of_the_style_is_exported_so(exported, mix):
    loaded, _, _ = exported
    camera, before = loaded.cameras[1:2], loaded.model.display.own
    loaded.model.display.own = replace(before, mix=mix)
    voxels, exact = bake_voxels([loaded.model], 95, [camera]), exact_outputs(loaded.model, camera)["rgb"]
    loaded.model.display.own = before
    assert psnr(picture_of_voxels(voxels, loaded.model, camera, mix), exact) > 33
    assert psnr(exact, exact_outputs(loaded.model, camera)["rgb"]) < 30


def test_cells_are_visible_where_a_dense_voxel_reaches_into_them_and_nowhere_else():
    codes = torch.full((32, 32, 32, 4), LEAST_CODE - 1, dtype=torch.uint8)
    codes[9, 20, 31, 0] = LEAST_CODE
    voxels, filled = Voxels(codes, codes[..., 0] > 0), torch.ones(12, 12, 12, dtype=torch.bool)
    visible = visible_cells([voxels], filled)
    points = 2.0 * torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0)) - 1.0
    dense = points[voxels.interpolate(points)[:, 0] > LEAST_CODE - 1 + 1e-3]
    reached = torch.zeros_like(filled)
    reached[tuple(((0.5 * dense + 0.5) * 12).long().unbind(-1))] = True
    assert torch.equal(visible, reached)
    filled[2:4] = False
    assert not visible_cells([voxels], filled)[2:4].any()
