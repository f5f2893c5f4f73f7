import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox

from sparsestyle_ns.models.coarse_fewshot import CoarseFewShotModelConfig, CoarseFieldConfig

BOX = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))


def make_model(**settings):
    field = CoarseFieldConfig(num_levels=2, num_layers=1, layer_width=8, feature_dim=2)
    config = CoarseFewShotModelConfig(coarse_field=field, precision="float32", **settings)
    metadata = {"space": "box", "background_color": None}
    model = config.setup(scene_box=BOX, num_train_data=1, metadata=metadata).train()
    model.num_steps = 100
    return model


def samples_at(model, step):
    """Samples on each ray in an iteration."""
    model.update_to_step(step)
    rays = RayBundle(torch.tensor([[0.0, 0.0, 3.0]]), torch.tensor([[0.0, 0.0, -1.0]]), torch.ones(1, 1))
    return model(rays)["weights"].shape[-1]


def test_early_iterations_take_fewer_samples():
    model = make_model(num_samples=10, early_num_samples=4, early_share=0.2)
    assert [samples_at(model, step) for step in (0, 19, 20, 99)] == [4, 4, 10, 10]


@pytest.mark.parametrize("settings", [{"early_num_samples": 10}, {"early_share": 0.0}, {"early_num_samples": 50}])
def test_fewer_samples_at_first_can_be_switched_off(settings):
    model = make_model(num_samples=10, **settings)
    assert [samples_at(model, step) for step in (0, 50)] == [10, 10]
