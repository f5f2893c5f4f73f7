import math

import pytest
import torch
from nerfstudio.data.scene_box import SceneBox

from sparsestyle_ns.core.occupancy import Occupancy
from sparsestyle_ns.core.spaces import BoxSpace
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.fields.coarse import CoarseField
from sparsestyle_ns.fields.residual import ResidualField
from sparsestyle_ns.rendering.frozen_view import FrozenView, equal_runs
from sparsestyle_ns.rendering.render import freeze_samples, render_stylised
from sparsestyle_ns.rendering.visible_samples import Marching

RAYS, STEPS = 20, 10
SPACE = BoxSpace(SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])))


class Scene:
    """Two small fields and the rays of a view, some of which miss the cube; counts what is asked of it."""

    def __init__(self):
        torch.manual_seed(0)
        self.coarse = CoarseField(num_levels=3, num_layers=2, layer_width=16, feature_dim=4).requires_grad_(False)
        self.residual = ResidualField(HashGrid(2, 4, 8, 2, 8, init_scale=1.0), 4, layer_width=16)
        torch.nn.init.normal_(self.residual.density_head.weight)
        self.occupancy = Occupancy(6)
        self.occupancy.occupied.copy_(torch.rand(6, 6, 6) < 0.7)
        origins = 3 * torch.nn.functional.normalize(torch.randn(RAYS, 3), dim=-1)
        aim = torch.rand(RAYS, 3) * 1.6 - 0.8
        aim[5:18:4] += 9
        self.rays = origins, torch.nn.functional.normalize(aim - origins, dim=-1)
        self.target = torch.rand(RAYS, 3)
        self.frozen_runs, self.rendered_chunks = [], 0

    def freeze(self, run):
        self.frozen_runs.append(run)
        segments = SPACE.segments(*(part[run] for part in self.rays))
        return freeze_samples(self.coarse, self.residual, segments, Marching(self.occupancy, STEPS, False, 0.0))

    def render_chunk(self, frozen):
        self.rendered_chunks += 1
        return render_stylised(self.residual, frozen, torch.ones(3)).rgb

    def view(self, max_samples, keep_bytes):
        self.frozen_runs.clear()
        return FrozenView(equal_runs(RAYS, max_samples // STEPS), self.freeze, keep_bytes)

    def picture_and_gradients(self, view):
        """The picture, and the gradient of its squared error for each parameter of the residual field."""
        picture = view.render(self.render_chunk)
        parameters = dict(self.residual.named_parameters())
        gradients = torch.autograd.grad((picture - self.target).square().sum(), list(parameters.values()))
        return picture.detach(), dict(zip(parameters, gradients, strict=True))


@pytest.fixture
def scene():
    return Scene()


def assert_same(found, expected):
    """Pictures and gradients of two computations; sums of some hundred float32 numbers in another order."""
    torch.testing.assert_close(found[0], expected[0], atol=1e-6, rtol=0)
    assert found[1].keys() == expected[1].keys()
    for name, gradient in expected[1].items():
        assert gradient.abs().sum() > 0, name
        torch.testing.assert_close(found[1][name], gradient, atol=1e-5 * gradient.abs().max().item(), rtol=1e-4)


@pytest.mark.parametrize("keep_bytes", [0, float("inf")])
@pytest.mark.parametrize("max_samples", [1, 25, 60, 10**9])
def test_chunks_give_the_picture_and_the_gradient_of_the_whole(max_samples, keep_bytes, scene):
    whole = render_stylised(scene.residual, scene.freeze(slice(0, RAYS)), torch.ones(3)).rgb
    gradients = torch.autograd.grad((whole - scene.target).square().sum(), list(scene.residual.parameters()))
    names = [name for name, _ in scene.residual.named_parameters()]
    expected = whole.detach(), dict(zip(names, gradients, strict=True))
    view = scene.view(max_samples, keep_bytes)
    assert (view.num_chunks == 1) == (max_samples == 10**9)
    assert_same(scene.picture_and_gradients(view), expected)


def test_chunks_kept_and_chunks_frozen_again_give_the_same(scene):
    kept, again = scene.view(30, float("inf")), scene.view(30, 0)
    half = scene.view(30, kept.kept_bytes / 2)
    assert kept.is_kept and not again.is_kept and not half.is_kept
    assert any(chunk is not None for chunk in half.kept)
    expected = scene.picture_and_gradients(kept)
    assert_same(scene.picture_and_gradients(again), expected)
    assert_same(scene.picture_and_gradients(half), expected)


def test_the_second_step_sees_what_the_first_has_learned(scene):
    view = scene.view(30, float("inf"))
    before, gradients = scene.picture_and_gradients(view)
    with torch.no_grad():
        for name, parameter in scene.residual.named_parameters():
            parameter -= 0.02 * gradients[name]
    after = scene.picture_and_gradients(view)[0]
    assert (after - scene.target).square().sum() < (before - scene.target).square().sum()
    assert_same(scene.picture_and_gradients(scene.view(30, 0)), scene.picture_and_gradients(view))


def test_kept_chunks_are_frozen_once_and_the_others_whenever_they_are_rendered(scene):
    view = scene.view(30, float("inf"))
    assert scene.frozen_runs == view.runs
    scene.picture_and_gradients(view)
    assert scene.frozen_runs == view.runs
    view = scene.view(30, 0)
    assert scene.frozen_runs == []
    scene.picture_and_gradients(view)
    # Once in the forward and once in the backward pass.
    assert sorted(run.start for run in scene.frozen_runs) == sorted(2 * [run.start for run in view.runs])


def test_activations_are_computed_again_only_where_that_saves_memory(scene):
    view = scene.view(30, float("inf"))
    scene.picture_and_gradients(view)
    assert scene.rendered_chunks == 2 * view.num_chunks
    scene.rendered_chunks = 0
    with torch.no_grad():
        view.render(scene.render_chunk)
    assert scene.rendered_chunks == view.num_chunks
    scene.rendered_chunks = 0
    scene.picture_and_gradients(scene.view(10**9, float("inf")))
    assert scene.rendered_chunks == 1


def test_no_more_memory_is_kept_than_allowed(scene):
    sizes = [chunk.num_bytes for chunk in scene.view(30, float("inf")).kept]
    assert len(sizes) >= 4
    for allowed in (0, 1, sizes[0] - 1, sizes[0], sum(sizes[:2]), sum(sizes) - 1, sum(sizes)):
        view = scene.view(30, allowed)
        kept = [chunk is not None for chunk in view.kept]
        count = sum(kept)
        assert kept == [True] * count + [False] * (len(sizes) - count)
        assert view.kept_bytes == sum(sizes[:count]) <= allowed
        assert count == len(sizes) or sum(sizes[: count + 1]) > allowed
        assert view.is_kept == (allowed == sum(sizes))


def test_a_chunk_holds_the_samples_of_its_rays(scene):
    view = scene.view(30, 0)
    whole = scene.freeze(slice(0, RAYS))
    positions = torch.cat([view.chunk(index).samples.positions for index in range(view.num_chunks)])
    assert torch.equal(positions, whole.samples.positions)
    assert sum(view.chunk(index).num_rays for index in range(view.num_chunks)) == RAYS


@pytest.mark.parametrize("most", [1, 7, 64, 199, 200, 10**6])
def test_runs_are_consecutive_as_few_as_can_be_and_of_about_one_length(most):
    runs = equal_runs(200, most)
    assert [ray for run in runs for ray in range(run.start, run.stop)] == list(range(200))
    assert len(runs) == math.ceil(200 / most)
    lengths = {run.stop - run.start for run in runs}
    assert max(lengths) <= most and max(lengths) - min(lengths) <= 1


def test_runs_worked_out_by_hand():
    assert equal_runs(10, 4) == [slice(0, 3), slice(3, 6), slice(6, 10)]
    assert equal_runs(8, 4) == [slice(0, 4), slice(4, 8)]
    assert equal_runs(0, 4) == [slice(0, 0)]


@pytest.mark.parametrize("most", [1, 0, -5])
def test_rays_that_have_more_samples_than_may_be_at_once_come_one_by_one(most):
    assert equal_runs(3, most) == [slice(0, 1), slice(1, 2), slice(2, 3)]
