import copy
from dataclasses import replace

import pytest
import torch
from conftest import decided
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.field_components import encodings
from torch.nn.functional import normalize

from sparsestyle_ns.data.scene_info import NDC
from sparsestyle_ns.engine.training import FusedAdamConfig
from sparsestyle_ns.field_components.hash_grid import HashGrid
from sparsestyle_ns.field_components.positional_encoding import NoEncoding
from sparsestyle_ns.field_components.tiny_cuda_grid import TinyCudaGrid
from sparsestyle_ns.fields import fine
from sparsestyle_ns.fields.coarse import CoarseFieldConfig
from sparsestyle_ns.models.hier_style import HierStyleModelConfig
from sparsestyle_ns.rendering.baked import MOST_BAKED
from sparsestyle_ns.rendering.look import Look
from sparsestyle_ns.rendering.mixing import Mix
from sparsestyle_ns.utils.errors import InputError

BOX = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))


SPARE = ("box", "background", "empty_space", "residual_density")


def make_model(effects=SPARE, **settings):
    model = make_untrained(effects, **settings)
    with torch.no_grad():
        model.residual.grid.table.uniform_(-1, 1)
        if model.residual.density_head is not None:
            torch.nn.init.normal_(model.residual.density_head.weight, std=0.1)
        torch.nn.init.normal_(model.residual.color_head.weight)
    return model


def make_untrained(effects=SPARE, seed=0, device="cpu", ndc=None, **settings):
    torch.manual_seed(seed)
    config = HierStyleModelConfig(
        coarse_field=CoarseFieldConfig(num_levels=3, num_layers=2, layer_width=16, feature_dim=4, direction_levels=2),
        hash_levels=2,
        min_resolution=4,
        max_resolution=8,
        log2_table_size=8,
        layer_width=16,
        occupancy_resolution=4,
        precision="float32",
        bake_resolution=48,
        **{"num_steps": 24, "bake_steps": None, **settings},
    )
    decisions = decided(*effects, background={"color": [1.0, 0.5, 0.0]})
    return config.setup(scene_box=BOX, num_train_data=1, effects=decisions, ndc=ndc, device=device).eval()


@pytest.fixture
def model():
    return make_model(render_mode="baked")


def test_only_a_scene_seen_from_one_side_has_fewer_cells_along_depth():
    ahead = NDC((1.5, 2.0), near=1.0, depth_range=(1.2, 5.0))
    in_ndc = make_untrained(("ndc", *(each for each in SPARE if each != "box")), ndc=ahead, depth_cells=0.125)
    assert in_ndc.residual.stretch == (1.0, 1.0, 0.125)
    assert make_untrained(depth_cells=0.125).residual.stretch == (1.0, 1.0, 1.0)


@torch.no_grad()
def render(model, mode=None):
    if mode is not None:
        model.display.own = replace(model.display.own, mode=mode)
    generator = torch.Generator().manual_seed(0)
    origins = 3 * normalize(torch.randn(50, 3, generator=generator), dim=-1)
    aim = torch.rand(50, 3, generator=generator) - 0.5
    return model.get_outputs(RayBundle(origins, normalize(aim - origins, dim=-1), torch.ones(50, 1)))


def assert_close(found, expected, tolerance=0.02):
    names = {"rgb", "accumulation", "depth"}
    assert found.keys() == expected.keys() == names | {f"{name}_coarse" for name in names}
    for key, value in expected.items():
        assert found[key].shape == value.shape
        torch.testing.assert_close(found[key], value, atol=tolerance, rtol=0, msg=key)


def volume(model):
    return model.baked.volumes[model.residual][0]


def test_a_baked_picture_is_nearly_the_exact_one_and_exact_is_the_default(model):
    expected = render(make_model())
    assert expected["rgb"].std() > 0.05
    assert_close(render(model), expected)


def test_baked_pictures_have_steps_of_their_own():
    own = make_model(render_mode="baked", num_steps=48, bake_steps=24)
    assert_close(render(own), render(make_model(render_mode="baked", num_steps=24)), tolerance=0.0)
    assert_close(render(own, "exact"), render(make_model(num_steps=48)), tolerance=0.0)


def test_exact_pictures_bake_nothing(model):
    render(model, "exact")
    assert not model.baked.volumes


def test_a_baked_model_has_the_state_of_an_exact_one(model):
    names = make_model().state_dict().keys()
    render(model)
    assert model.state_dict().keys() == names
    assert not any("bake" in name for name, _ in [*model.named_modules(), *model.named_buffers()])


def test_the_volume_stays_while_the_weights_do(model):
    render(model)
    first = volume(model)
    model.train().eval()
    render(model)
    assert volume(model) is first


@pytest.mark.parametrize("fused", [True, False])
def test_a_training_step_is_seen_in_the_next_picture(fused):
    # So large a step makes new surfaces, of which a few samples a ray would show less than the baked picture.
    model = make_model(render_mode="baked", num_samples=None, num_eval_samples=None)
    before = render(model)
    model.train()
    parameters = model.get_param_groups()["fields"]
    optimizer = FusedAdamConfig(lr=0.1, fused=fused).setup(parameters)
    frozen = model.freeze(torch.tensor([[-3.0, 0.1, 0.2]]), torch.tensor([[1.0, 0.0, 0.0]]))
    model.stylised(frozen).rgb.sum().backward()
    optimizer.step()
    model.eval()
    after = render(model)
    assert (after["rgb"] - before["rgb"]).abs().max() > 0.05
    assert_close(after, render(model, "exact"))


@pytest.mark.parametrize("assign", [False, True])
def test_a_loaded_checkpoint_is_seen_in_the_next_picture(model, assign):
    state = copy.deepcopy(model.state_dict())
    state["residual.grid.table"] *= -1  # nothing but the table differs
    before = render(model)
    model.load_state_dict(state, assign=assign)
    after = render(model)
    assert (after["rgb"] - before["rgb"]).abs().max() > 0.05
    assert_close(after, render(model, "exact"))


def test_another_coarse_field_is_seen_in_the_next_picture():
    model, other = make_model(render_mode="baked", num_eval_samples=None), make_model()
    render(model)
    first = volume(model)
    torch.nn.init.constant_(other.field.density_head.bias, 2.0)
    model.adopt_coarse(other.state_dict())
    found = render(model)
    assert volume(model) is not first
    assert_close(found, render(model, "exact"))


def test_pictures_are_exact_while_the_model_trains(model):
    found = render(model.train())
    assert not model.baked.volumes
    assert_close(found, render(make_model()), tolerance=0)


def test_a_coarse_colour_that_depends_on_the_direction_is_baked_as_its_mean_and_the_rest_as_it_is():
    model = make_model((*SPARE, "view_color"))
    expected, found = render(model, "exact"), render(model, "baked")
    colors = (expected.pop("rgb_coarse"), found.pop("rgb_coarse"))
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, atol=0.02, rtol=0, msg=key)
    assert 0 < (colors[0] - colors[1]).abs().mean() < 0.1


def test_a_coarse_field_that_is_fine_tuned_starts_as_it_is_and_alone_learns():
    model = make_untrained(stylised_field="coarse")
    model.adopt_coarse(make_untrained(seed=1).state_dict())
    before = render(model, "exact")
    torch.testing.assert_close(before["rgb"], before["rgb_coarse"])
    torch.testing.assert_close(before["depth"], before["depth_coarse"])
    parameters = model.get_param_groups()["fields"]
    assert sum(p.numel() for p in parameters) == sum(p.numel() for p in model.field.parameters())
    model.train()
    optimizer = torch.optim.Adam(parameters, lr=0.01)
    frozen = model.freeze(torch.tensor([[-3.0, 0.1, 0.2]]), torch.tensor([[1.0, 0.0, 0.0]]))
    model.stylised(frozen).rgb.sum().backward()
    optimizer.step()
    after = render(model.eval(), "exact")
    assert (after["rgb"] - before["rgb"]).abs().max() > 1e-3
    assert (after["accumulation"] - before["accumulation"]).abs().max() > 1e-4
    torch.testing.assert_close(after["rgb_coarse"], before["rgb_coarse"], atol=0, rtol=0)


@pytest.mark.parametrize("encoding, numbers", [("hash", 8), ("frequency", 3 + 6 * 5), ("none", 0)])
def test_the_residual_field_sees_what_the_config_says_beside_the_coarse_feature(encoding, numbers):
    model = make_untrained(fine_encoding=encoding, frequency_levels=5)
    assert model.residual.mlp.layers[0].in_features == numbers + 4
    assert any("grid.table" in name for name in model.state_dict()) == (encoding == "hash")
    assert render(model, "exact")["rgb"].isfinite().all()


@pytest.mark.parametrize(
    "installed, device, chosen", [(True, "cuda", "tiny-cuda-nn"), (True, "cpu", "hash"), (False, "cuda", "hash")]
)
def test_the_hash_grid_is_tiny_cuda_nns_on_a_gpu_where_it_is_installed_and_the_config_keeps_that(
    monkeypatch, installed, device, chosen
):
    monkeypatch.setattr(encodings, "TCNN_EXISTS", installed)
    assert HierStyleModelConfig().fine_encoding == "auto"
    built = []
    for name in ("TinyCudaGrid", "HashGrid"):
        kind = getattr(fine, name)
        monkeypatch.setattr(fine, name, lambda *shape, kind=kind, **at: built.append((kind, at)) or NoEncoding())
    model = make_untrained(device=device)
    assert model.config.fine_encoding == chosen
    expected = (TinyCudaGrid, {"device": torch.device(device)}) if chosen == "tiny-cuda-nn" else (HashGrid, {})
    assert built == [expected]


def test_a_picture_in_one_mode_leaves_the_models_own_as_it_was(model):
    with pytest.raises(RuntimeError), model.display.rendering("exact"):
        assert model.display.look.mode == "exact"
        raise RuntimeError
    assert model.display.look.mode == "baked"


BOTH_MODES = pytest.mark.parametrize("mode", ["exact", "baked"])
PARTS = ("rgb", "accumulation", "depth")


def shown(model, mode, *styles, **mix):
    model.display.own = Look(mode, Mix(**mix), styles or None)
    return render(model)


def another_style(model):
    style = model.new_style()
    with torch.no_grad():
        style.grid.table.uniform_(-1, 1)
        torch.nn.init.normal_(style.density_head.weight, std=0.1)
        torch.nn.init.normal_(style.color_head.weight)
    return style


@BOTH_MODES
def test_strength_goes_from_the_coarse_picture_to_the_stylised_one_exactly(model, mode):
    stylised = shown(model, mode)
    coarse = shown(model, mode, strength=0.0)
    between = shown(model, mode, strength=0.5)
    assert (stylised["rgb"] - coarse["rgb"]).abs().max() > 0.1
    for name in PARTS:
        assert torch.equal(coarse[name], stylised[f"{name}_coarse"])
        assert torch.equal(between[f"{name}_coarse"], stylised[f"{name}_coarse"])
    assert 0.01 < (between["rgb"] - coarse["rgb"]).abs().max() < (stylised["rgb"] - coarse["rgb"]).abs().max() + 0.1


@BOTH_MODES
def test_without_geometry_strength_the_geometry_is_the_coarse_one_and_the_colour_is_the_styles(model, mode):
    stylised, painted = shown(model, mode), shown(model, mode, geometry=0.0)
    torch.testing.assert_close(painted["accumulation"], stylised["accumulation_coarse"], rtol=0, atol=1e-6)
    torch.testing.assert_close(painted["depth"], stylised["depth_coarse"], rtol=0, atol=1e-5)
    assert (stylised["accumulation"] - painted["accumulation"]).abs().max() > 1e-3
    assert (painted["rgb"] - stylised["rgb_coarse"]).abs().max() > 0.1


@BOTH_MODES
def test_a_blend_goes_from_one_style_to_the_other_exactly(model, mode):
    first, second = model.residual, another_style(model)
    ends = [shown(model, mode, each) for each in (first, second)]
    assert (ends[0]["rgb"] - ends[1]["rgb"]).abs().max() > 0.1
    for blend, expected in zip((0.0, 1.0), ends, strict=True):
        found = shown(model, mode, first, second, blend=blend)
        assert all(torch.equal(found[name], expected[name]) for name in expected)
    half = [shown(model, mode, *pair, blend=share) for pair, share in (((first, second), 0.3), ((second, first), 0.7))]
    for name in PARTS:
        torch.testing.assert_close(half[0][name], half[1][name], rtol=1e-5, atol=1e-5)


def test_baked_mixtures_are_nearly_the_exact_ones(model):
    second = another_style(model)
    mix = {"strength": 0.7, "geometry": 0.4, "blend": 0.25}
    exact, baked = (shown(model, mode, model.residual, second, **mix) for mode in ("exact", "baked"))
    assert_close(baked, exact)


def test_moving_a_slider_evaluates_no_field(model, monkeypatch):
    second = another_style(model)
    shown(model, "baked", model.residual, second, blend=0.5)
    for part in (model.field, model.residual, second):
        monkeypatch.setattr(part, "forward", None)
    monkeypatch.setattr(model.field, "density_and_feature", None)
    for mix in ({"strength": 0.2}, {"geometry": 0.1}, {"blend": 0.9}):
        shown(model, "baked", model.residual, second, **mix)


def test_only_so_many_styles_stay_baked_the_latest_ones(model):
    styles = [model.residual, *(another_style(model) for _ in range(MOST_BAKED))]
    for style in styles:
        shown(model, "baked", style)
    assert list(model.baked.volumes) == styles[1:]


def test_a_run_shows_the_strengths_in_its_config_and_training_shows_none(model):
    weak = make_model(strength=0.0)
    assert torch.equal(render(weak)["rgb"], render(weak)["rgb_coarse"])
    frozen = weak.freeze(torch.tensor([[-3.0, 0.1, 0.2]]), torch.tensor([[1.0, 0.0, 0.0]]))
    assert torch.equal(weak.stylised(frozen).rgb, model.stylised(frozen).rgb)
    with pytest.raises(InputError, match=r"--pipeline\.model\.geometry-strength is 1\.5; give a number from 0 to 1"):
        make_model(geometry_strength=1.5)


def test_a_new_style_is_no_part_of_the_model_and_starts_on_the_coarse_geometry(model):
    names = set(model.state_dict())
    found = shown(model, "exact", model.new_style())
    assert set(model.state_dict()) == names
    assert torch.equal(found["depth"], found["depth_coarse"])


def test_pictures_have_samples_of_their_own_and_views_that_are_learned_from_others():
    model = make_model(num_samples=2, num_eval_samples=9, even_share=0.0)
    assert (model.learning.few.count, model.marching.few.count) == (2, 9)
    model = make_model(num_samples=None, num_eval_samples=8, even_share=0.5)
    assert model.learning.few is None and model.marching.few.count == 16


@pytest.mark.parametrize("name", ["num_samples", "num_eval_samples"])
def test_no_samples_at_all_are_refused(name):
    with pytest.raises(InputError, match=f"--pipeline.model.{name.replace('_', '-')} is 0; give 1 or more"):
        make_model(**{name: 0})


@pytest.mark.parametrize("name", ["num_steps", "bake_steps"])
def test_a_single_step_is_refused(name):
    with pytest.raises(InputError, match=rf"--pipeline\.model\.{name.replace('_', '-')} is 1; give 2 or more"):
        make_model(**{name: 1})
