"""Stage 1's model: what its optimisers take, and the pictures of a field while it learns and after."""

import copy

import pytest
import torch
from conftest import decided
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from torch.nn.functional import normalize

from sparsestyle_ns.core.occupancy import DensityVolume
from sparsestyle_ns.engine.training import FusedAdamConfig
from sparsestyle_ns.fields.coarse import CoarseFieldConfig
from sparsestyle_ns.method_configs import coarse_optimizers
from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModelConfig

BOX = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
ATTRIBUTES = TrainingCallbackAttributes(None, None, None, None)


def make_model(*effects, seed=0, **settings):
    torch.manual_seed(seed)
    config = CoarseFewShotModelConfig(
        coarse_field=CoarseFieldConfig(num_levels=3, num_layers=2, layer_width=32, feature_dim=4, direction_levels=2),
        volume_resolution=32,
        precision="float32",
        **settings,
    )
    model = config.setup(
        scene_box=BOX,
        num_train_data=3,
        effects=decided("box", "background", *effects, background={"color": [1.0, 0.5, 0.0]}),
        device="cpu",
    )
    with torch.no_grad():
        model.field.density_head.weight.normal_(std=2.0)
        for layer in model.field.color_head.layers:
            layer.weight.normal_(std=1.0)
    return model.eval()


def rays(count=200):
    generator = torch.Generator().manual_seed(0)
    origins = 3 * normalize(torch.randn(count, 3, generator=generator), dim=-1)
    aim = torch.rand(count, 3, generator=generator) - 0.5
    return RayBundle(origins, normalize(aim - origins, dim=-1), torch.ones(count, 1))


@torch.no_grad()
def picture(model):
    return model.get_outputs(rays())


@pytest.fixture
def measured(monkeypatch):
    """The volumes that are measured, one after another."""
    found, measure = [], DensityVolume.measure

    def watched(volume, *arguments):
        found.append(volume)
        measure(volume, *arguments)

    monkeypatch.setattr(DensityVolume, "measure", watched)
    return found


@pytest.mark.parametrize("effects", [(), ("view_color",), ("exposure", "empty_space")])
def test_the_two_groups_of_parameters_cover_each_once_and_matrices_of_hidden_layers_are_apart(effects):
    model = make_model(*effects)
    groups = model.get_param_groups()
    assert groups.keys() == coarse_optimizers().keys() - {"cameras"} == {"fields", "hidden_layers"}
    taken = [id(parameter) for group in groups.values() for parameter in group]
    assert len(taken) == len(set(taken)) and set(taken) == {
        id(p) for name, p in model.named_parameters() if "indicator" not in name
    }
    names = {id(parameter): name for name, parameter in model.field.named_parameters()}
    hidden = {names[id(parameter)] for parameter in groups["hidden_layers"]}
    # Not the heads that give densities, features and colours, which are no hidden layers.
    assert hidden == {"trunk.layers.0.weight", "trunk.layers.1.weight", "color_head.layers.0.weight"}
    assert all(parameter.dim() == 2 for parameter in groups["hidden_layers"])


def test_a_step_of_both_optimisers_moves_every_parameter():
    model = make_model().train()
    groups = model.get_param_groups()
    optimizers = [coarse_optimizers()[name]["optimizer"].setup(group) for name, group in groups.items()]
    before = copy.deepcopy(model.field.state_dict())
    (model.get_outputs(rays())["rgb"] - 0.5).square().mean().backward()
    for optimizer in optimizers:
        optimizer.step()
    moved = [name for name, value in model.field.state_dict().items() if not torch.equal(value, before[name])]
    assert len(moved) == len(list(model.field.parameters()))


@pytest.mark.parametrize(
    ("effects", "settings", "expected"),
    [
        (("empty_space",), {}, [3, 3, 3, 8, 8]),
        (("empty_space",), {"early_iterations": 0.0}, 5 * [8]),
        (("empty_space",), {"early_samples": 9}, 5 * [8]),  # never more than later
        ((), {}, 5 * [8]),  # without a grid all are even, and few of these would miss what there is
    ],
)
def test_the_first_iterations_have_fewer_samples_a_ray_where_a_grid_places_them(effects, settings, expected):
    model = make_model(*effects, **{"num_samples": 8, "early_samples": 3, "early_iterations": 0.6, **settings}).train()
    model.num_iterations, found = 5, []
    for step in range(5):
        model.update_to_step(step)
        found.append(model.get_outputs(rays())["weights"].shape[1])
    assert found == expected


def test_a_trained_fields_picture_of_six_samples_is_nearly_that_of_all_its_steps():
    model = make_model()
    assert model.config.num_eval_samples == 6
    found = picture(model)
    expected = picture(make_model(num_eval_samples=200, num_steps=512))
    assert expected["rgb"].std(dim=0).mean() > 0.03
    assert ((found["rgb"] - expected["rgb"]) ** 2).mean() < 10**-4.0  # 40 dB
    torch.testing.assert_close(found["accumulation"], expected["accumulation"], atol=0.02, rtol=0)
    assert (found["depth"] - expected["depth"]).abs().mean() < 0.02


def test_no_volume_is_measured_while_the_field_learns_and_one_as_soon_as_it_has(measured):
    model = make_model()
    callbacks = model.get_training_callbacks(ATTRIBUTES)
    learning = picture(model)
    assert model.learns and measured == []
    for callback in callbacks:
        callback.run_callback_at_location(3, TrainingCallbackLocation.AFTER_TRAIN)
    trained = picture(model)
    assert not model.learns and len(measured) == 1
    assert not torch.equal(learning["rgb"], trained["rgb"])
    picture(model.train().eval())
    assert len(measured) == 1


@pytest.mark.parametrize("assign", [False, True])
def test_a_loaded_checkpoint_is_seen_in_the_next_picture(assign, measured):
    model, other = make_model(), make_model(seed=1)
    before, expected = picture(model), picture(other)
    model.load_state_dict(copy.deepcopy(other.state_dict()), assign=assign)
    after = picture(model)
    assert len(measured) == 3
    assert torch.equal(after["rgb"], expected["rgb"]) and not torch.equal(after["rgb"], before["rgb"])


@pytest.mark.parametrize("fused", [True, False])
def test_what_is_learned_after_a_picture_is_seen_in_the_next(fused, measured):
    model = make_model()
    picture(model)
    model.get_training_callbacks(ATTRIBUTES)
    optimizer = FusedAdamConfig(lr=0.1, fused=fused).setup(list(model.field.parameters()))
    (model.train().get_outputs(rays())["rgb"] - 0.5).square().mean().backward()
    optimizer.step()
    model.eval().finish_learning()
    picture(model)
    assert len(measured) == 2
    torch.testing.assert_close(
        measured[1].density(torch.zeros(1, 3)), model.field.density_and_feature(torch.zeros(1, 3))[0], rtol=0.2, atol=0
    )


def test_a_picture_leaves_the_models_state_as_it_is():
    model = make_model()
    names = model.state_dict().keys()
    picture(model)
    assert model.state_dict().keys() == names
