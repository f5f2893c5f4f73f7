"""Cameras that are learned with the field: their rays, where they go from stage 1 to all else, and what is measured."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import TINY, TINY_STYLE, ns_train, only_run
from nerfstudio.cameras.cameras import Cameras
from scipy.spatial.transform import Rotation

from sparsestyle_ns.core.rotations import rotation_matrix
from sparsestyle_ns.data.llff import LLFFDataParserConfig
from sparsestyle_ns.data.reading import read_scene
from sparsestyle_ns.data.scene_info import NDC
from sparsestyle_ns.effects.decisions import EffectSettings
from sparsestyle_ns.effects.pose_refinement import (
    MAX_MISS,
    CameraRefinement,
    carried_along,
    measure_pose_refinement,
    moving_unit,
)
from sparsestyle_ns.effects.registry import decide
from sparsestyle_ns.effects.scene import Scene
from sparsestyle_ns.engine.loading import known_views, load_run
from sparsestyle_ns.evaluation.camera_alignment import aligned_to_photo
from sparsestyle_ns.pipelines.datamanager import FewShotDataManagerConfig
from sparsestyle_ns.runs.checkpoints import load_checkpoint, newest_checkpoint
from sparsestyle_ns.runs.run_folder import find_config
from sparsestyle_ns.utils.errors import InputError

LENS = torch.tensor([0.08, -0.02, 0.01, 0.0, 0.004, -0.003])


def some_cameras(count=3, lens=None):
    """Cameras of 12 × 8 pixels that look about -z."""
    generator = torch.Generator().manual_seed(0)
    turns = rotation_matrix(0.1 * torch.randn(count, 3, generator=generator))
    poses = torch.cat([turns, torch.randn(count, 3, 1, generator=generator)], dim=-1)
    distortion = None if lens is None else lens.expand(count, 6)
    return Cameras(poses, fx=14.0, fy=15.0, cx=6.0, cy=4.0, width=12, height=8, distortion_params=distortion)


def refined(cameras, seed=1):
    """A refinement that turns and moves each camera."""
    refinement = CameraRefinement(cameras.camera_to_worlds, unit=2.0)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for part in (refinement.turn, refinement.move):
            part.copy_(0.05 * torch.randn(part.shape, generator=generator))
    return refinement


def all_rays(cameras):
    bundles = [cameras.generate_rays(camera_indices=index, keep_shape=False).flatten() for index in range(len(cameras))]
    views = torch.cat([torch.full((len(bundle),), index) for index, bundle in enumerate(bundles)])
    origins, directions = (torch.cat([getattr(b, name) for b in bundles]) for name in ("origins", "directions"))
    return origins, directions, views


@pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "distorted"])
def test_rays_of_refined_cameras_are_the_refined_rays(lens):
    cameras = some_cameras(lens=lens)
    refinement = refined(cameras)
    origins, directions = refinement(*all_rays(cameras))
    expected_origins, expected_directions, _ = all_rays(refinement.cameras(cameras))
    torch.testing.assert_close(origins, expected_origins)
    # nerfstudio finds by Newton's method which ray a lens bends to a pixel.
    torch.testing.assert_close(directions, expected_directions, atol=2e-5, rtol=0)


def test_nothing_changes_at_first():
    cameras = some_cameras(lens=LENS)
    refinement = CameraRefinement(cameras.camera_to_worlds, unit=1.0)
    origins, directions, views = all_rays(cameras)
    same = refinement(origins, directions, views)
    torch.testing.assert_close(same, (origins, directions))
    after = refinement.cameras(cameras)
    torch.testing.assert_close(after.camera_to_worlds, cameras.camera_to_worlds)
    torch.testing.assert_close(after.distortion_params, cameras.distortion_params)


def test_gradients_of_rays_are_those_of_finite_differences():
    cameras = some_cameras(2)
    refinement = refined(cameras).double()
    origins, directions, views = (part[::17] for part in all_rays(cameras))
    parts = [part.detach().clone().requires_grad_() for part in refinement.parameters()]

    def rays(*values):
        named = dict(zip([name for name, _ in refinement.named_parameters()], values, strict=True))
        return torch.func.functional_call(refinement, named, (origins.double(), directions.double(), views))

    assert torch.autograd.gradcheck(rays, parts)


def test_a_unit_of_moving_is_where_the_near_things_are():
    cameras = some_cameras()
    assert moving_unit(cameras, NDC((1.0, 1.0), 0.7, (1.0, 5.0))) == 0.7
    around = torch.eye(3, 4).repeat(3, 1, 1)
    for pose, angle in zip(around, (0.0, 2.0, 4.0), strict=True):  # all look at the origin from 3 away
        pose[:, :3] = rotation_matrix(torch.tensor([0.0, angle, 0.0]))
        pose[:, 3] = 3.0 * pose[:, 2]
    assert moving_unit(Cameras(around, 10.0, 10.0, 5.0, 5.0), None) == pytest.approx(1.5)


def test_other_cameras_of_the_scene_are_carried_along():
    cameras = some_cameras(5)
    given, other = cameras[:3], cameras[3:]
    after = Cameras(given.camera_to_worlds.clone(), 1.2 * given.fx, 1.2 * given.fy, 6.0, 4.0, 12, 8)
    after.camera_to_worlds[..., 3] *= 2.0
    moved = carried_along(other, given, after)
    torch.testing.assert_close(moved.camera_to_worlds[..., 3], 2.0 * other.camera_to_worlds[..., 3])
    torch.testing.assert_close(moved.camera_to_worlds[..., :3], other.camera_to_worlds[..., :3])
    torch.testing.assert_close(moved.fx, 1.2 * other.fx)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three forward-facing photos, 252 × 189 pixels, whose cameras are known exactly."""
    import make_sample_scene

    folder = tmp_path_factory.mktemp("photos")
    make_sample_scene.main([str(folder), "--layout", "llff", "--width", "252", "--num-views", "3"])
    return folder / "llff"


def turned(scene: Path, folder: Path, degrees: float) -> Path:
    """A scene whose cameras are wrongly turned by so much, each about another axis."""
    shutil.copytree(scene, folder)
    rows = np.load(folder / "poses_bounds.npy")
    matrices = rows[:, :15].reshape(-1, 3, 5)
    for matrix, axis in zip(matrices, np.eye(3), strict=True):
        matrix[:, :3] = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix() @ matrix[:, :3]
    np.save(folder / "poses_bounds.npy", np.c_[matrices.reshape(-1, 15), rows[:, 15:]])
    return folder


def scene_of(folder: Path) -> Scene:
    return Scene(read_scene(LLFFDataParserConfig(data=folder).setup()))


@pytest.mark.parametrize(("degrees", "on"), [(0.0, False), (0.2, True), (0.4, True)])
def test_it_is_on_where_rays_to_matched_points_miss_each_other(photos, tmp_path, degrees, on):
    found = measure_pose_refinement(scene_of(turned(photos, tmp_path / "scene", degrees)))
    assert found.on == on and (found.value >= MAX_MISS) == on
    assert "matched points miss each other" in found.reason and "known" in found.reason


def test_where_nothing_matches_it_cannot_be_measured_and_is_off(llff_scene):
    found = measure_pose_refinement(scene_of(llff_scene))
    assert (found.on, found.value) == (False, None) and "not measurable" in found.reason


REFINED = ["--pipeline.effects.pose-refinement", "on"]


@pytest.fixture(scope="module")
def refined_runs(llff_scene: Path, painting: Path, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """As `runs`, with cameras that are refined."""
    outputs = tmp_path_factory.mktemp("outputs")
    rate = ["--optimizers.cameras.optimizer.lr", "0.01"]
    ns_train("coarse-fewshot", llff_scene, outputs, "--max-num-iterations", "12", *TINY, *REFINED, *rate)
    coarse = only_run(outputs, "coarse-fewshot")
    flags = ["--style-image", str(painting), "--max-num-iterations", "2", *TINY_STYLE, *REFINED]
    ns_train("hier-style", llff_scene, outputs, *flags, "--coarse-run", str(coarse))
    return SimpleNamespace(outputs=outputs, coarse=coarse, style=only_run(outputs, "hier-style"))


def state_of(run):
    state = load_checkpoint(newest_checkpoint(run / "nerfstudio_models"))["pipeline"]
    return {name.split(".")[-1]: part for name, part in state.items() if ".refinement." in name}


def test_both_stages_keep_the_refined_cameras_in_their_checkpoints(refined_runs):
    coarse, style = state_of(refined_runs.coarse), state_of(refined_runs.style)
    assert coarse.keys() == style.keys() == {"turn", "move"}
    for name, part in coarse.items():
        assert (part != 0).all()
        torch.testing.assert_close(style[name], part, rtol=0, atol=0)


def test_loaded_runs_train_render_and_stylise_by_the_refined_cameras(refined_runs):
    cameras = []
    for run in (refined_runs.coarse, refined_runs.style):
        manager = load_run(find_config(run)).pipeline.datamanager
        dataset = manager.train_dataset
        turn = state_of(run)["turn"]
        expected = dataset.given_cameras.camera_to_worlds[..., :3] @ rotation_matrix(turn)
        torch.testing.assert_close(dataset.cameras.camera_to_worlds[..., :3], expected)
        pixels, own = manager.pixels, dataset.cameras.generate_rays(camera_indices=1, keep_shape=False).flatten()
        rows = pixels.rows(1)
        found = manager.refined_rays(pixels.origins[rows], pixels.directions[rows], pixels.views[rows])
        torch.testing.assert_close(found, (own.origins, own.directions), atol=1e-5, rtol=0)
        held_out = manager.eval_dataset  # they go along
        expected = carried_along(held_out.given_cameras, dataset.given_cameras, dataset.cameras)
        torch.testing.assert_close(held_out.cameras.camera_to_worlds, expected.camera_to_worlds)
        cameras.append(dataset.cameras.camera_to_worlds)
    torch.testing.assert_close(*cameras, rtol=0, atol=0)


def test_what_is_off_has_no_cameras_to_learn(runs):
    pipeline = load_run(find_config(runs.coarse)).pipeline
    assert pipeline.model.refinement is None and "cameras" not in pipeline.model.get_param_groups()
    dataset = pipeline.datamanager.train_dataset
    assert dataset.cameras is dataset.given_cameras


def test_depths_of_matched_points_follow_the_refined_cameras(photos):
    manager = FewShotDataManagerConfig(data=photos, dataparser=LLFFDataParserConfig()).setup(device="cpu")
    manager.set_effects(decide(manager.scene, EffectSettings(matched_depth="on", pose_refinement="on")))
    given = manager.train_dataset.cameras.camera_to_worlds
    before = manager.next_train(0)[0].metadata["matched_distance"]
    refinement = CameraRefinement(given, 1.0)
    manager.refine_cameras(refinement)
    same = manager.next_train(0)[0].metadata["matched_distance"]
    torch.testing.assert_close(same, before, rtol=1e-3, atol=0)  # rays that all but meet, in single precision
    with torch.no_grad():  # all cameras come half way to their middle, so that what they see is half as far
        to_middle = 0.5 * (given[..., 3].mean(dim=0) - given[..., 3])
        refinement.move.copy_(torch.einsum("nij,ni->nj", given[..., :3], to_middle))
    bundle, _ = manager.next_train(0)
    torch.testing.assert_close(bundle.metadata["matched_distance"], 0.5 * before, rtol=1e-2, atol=0)
    assert not bundle.metadata["matched_distance"].requires_grad
    assert bundle.origins.requires_grad and bundle.directions.requires_grad


def test_held_out_views_of_a_known_scene_stand_where_the_runs_photos_say(refined_runs, llff_scene):
    pipeline = load_run(find_config(refined_runs.coarse)).pipeline
    manager = pipeline.datamanager
    ids = manager.train_dataset.metadata["scene_info"].view_ids
    views = known_views(manager, llff_scene, ids)
    # The same scene, so that they are where its own held-out views were carried along to.
    torch.testing.assert_close(views.cameras.camera_to_worlds, manager.eval_dataset.cameras.camera_to_worlds)
    assert views.image_filenames == manager.eval_dataset.image_filenames
    with pytest.raises(InputError, match="--known-views names 1 photos"):
        known_views(manager, llff_scene, ids[:1])
    assert pipeline.held_out_report(views=views).means["psnr"] > 0


def test_a_camera_is_aligned_to_its_photo(patterned_run):
    pipeline = load_run(find_config(patterned_run)).pipeline
    model, camera = pipeline.model, pipeline.datamanager.eval_dataset.cameras[:1]
    with torch.no_grad():
        photo = model.get_outputs_for_camera(camera)["rgb_coarse"]
    moved = refined(camera, seed=3)
    with torch.no_grad():
        moved.turn *= 0.2
        moved.move *= 0.2
    off = moved.cameras(camera)
    found = aligned_to_photo(model, off, photo, moving_unit(camera, model.ndc), steps=60)
    errors = [
        torch.nn.functional.mse_loss(model.get_outputs_for_camera(each)["rgb_coarse"], photo).item()
        for each in (off, found)
    ]
    assert errors[1] < 0.5 * errors[0]
