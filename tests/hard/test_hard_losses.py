import pytest
import torch
from hard.table import hard_case

from sparsestyle_ns.core.feature_maps import feature_rows
from sparsestyle_ns.losses.coarse import near_density, reconstruction_loss
from sparsestyle_ns.losses.content import content_loss
from sparsestyle_ns.losses.nnfm import nearest_neighbors, nnfm_loss
from sparsestyle_ns.losses.style_index import StyleIndex
from sparsestyle_ns.losses.stylization import StyleTargets, fit_side
from sparsestyle_ns.style.backbone import Backbone
from sparsestyle_ns.style.backbones import load_backbone

CHANNELS = 32


@pytest.fixture(scope="module")
def backbone() -> Backbone:
    """The network that comes with a package: it is the one that reflects pixels over borders."""
    return load_backbone("vgg16-shift-tolerant")


def features_of(count, seed=0, dtype=torch.float32):
    """Feature vectors after a ReLU: 0 or more, half of them 0."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, CHANNELS, generator=generator, dtype=torch.float64).clamp(min=0).to(dtype)


def both_searches(features, style):
    return nearest_neighbors(features, style), StyleIndex(style, block_size=16).nearest(features)


def loss_and_gradient(loss, features, *arguments):
    features = features.clone().requires_grad_()
    value = loss(features, *arguments)
    (gradient,) = torch.autograd.grad(value, features)
    return value.detach(), gradient


@hard_case(
    "losses",
    case="features that are all zero",
    could_go_wrong="0 / 0 in the cosine, and in its gradient",
    must_hold="the style loss is 1, its gradient 0; the content loss is finite with a finite gradient",
)
def test_features_without_direction_have_no_gradient():
    zero = torch.zeros(20, CHANNELS)
    for style in (features_of(50), zero, StyleIndex(features_of(50)), StyleIndex(zero)):
        loss, gradient = loss_and_gradient(nnfm_loss, zero, style)
        assert loss == 1 and (gradient == 0).all()
    loss, gradient = loss_and_gradient(content_loss, zero, features_of(20))
    assert loss == 1 and (gradient <= 0).all() and gradient.isfinite().all()
    assert loss_and_gradient(content_loss, zero, zero)[0] == 0


@hard_case(
    "losses",
    case="some feature vectors that are zero among others",
    could_go_wrong="one vector's NaN reaches all by the mean",
    must_hold="the others have the gradient they have without them, per vector",
)
def test_vectors_without_direction_leave_the_others_alone():
    features, style = features_of(30), features_of(40, seed=1)
    features[::3] = 0
    _, gradient = loss_and_gradient(nnfm_loss, features, style)
    rest = features.abs().sum(dim=-1) > 0
    _, expected = loss_and_gradient(nnfm_loss, features[rest], style)
    torch.testing.assert_close(gradient[rest] * 30, expected * int(rest.sum()))
    assert (gradient[~rest] == 0).all()


@hard_case(
    "losses",
    case="features of length 1e-10 and 1e15",
    could_go_wrong="squares that underflow or overflow in the length",
    must_hold="the loss does not depend on the length; the gradient is float64's",
)
@pytest.mark.parametrize("size", [1e-10, 1e-5, 1e5, 1e15])
def test_the_style_loss_does_not_depend_on_the_size_of_features(size):
    features, style = features_of(30), features_of(40, seed=1)
    expected, _ = loss_and_gradient(nnfm_loss, features.double(), style.double())
    for target in (style, size * style):
        loss, gradient = loss_and_gradient(nnfm_loss, size * features, target)
        torch.testing.assert_close(loss.double(), expected, rtol=1e-5, atol=0)
        _, exact = loss_and_gradient(nnfm_loss, (size * features).double(), target.double())
        torch.testing.assert_close(gradient.double(), exact, rtol=1e-4, atol=1e-6 * exact.abs().max().item())


@hard_case(
    "losses",
    case="a style equal to the content",
    could_go_wrong="rounding makes the loss negative, and drives the picture away from where it should stay",
    must_hold="loss 0 and gradient 0, to float32's rounding of cosines; never below 0",
)
def test_a_style_equal_to_the_content_asks_for_nothing():
    features = features_of(300)
    for style in (features, StyleIndex(features)):
        loss, gradient = loss_and_gradient(nnfm_loss, features, style)
        assert 0 <= loss <= 1e-6
        # A gradient of 1 cosine is 1 / length; 300 vectors share the mean.
        assert (gradient.abs() * features.norm(dim=-1, keepdim=True)).max() * 300 <= 1e-6
    loss, gradient = loss_and_gradient(content_loss, features, features)
    assert loss == 0 and (gradient == 0).all()
    loss, gradient = loss_and_gradient(reconstruction_loss, features[:, :3], features[:, :3])
    assert loss == 0 and (gradient == 0).all()


@hard_case(
    "losses",
    case="cosines of exactly 1 and −1",
    could_go_wrong="1 + 1e-7 by rounding: a loss outside of [0, 2]",
    must_hold="each vector's loss is in [0, 2], 0 or 2 to 1e-6, with a finite gradient",
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_vectors_along_and_against_a_style_have_losses_in_range(sign):
    style = torch.randn(200, CHANNELS, generator=torch.Generator().manual_seed(0))
    for row in range(len(style)):
        loss, gradient = loss_and_gradient(nnfm_loss, sign * 3 * style[row : row + 1], style[row : row + 1])
        assert 0 <= loss <= 2 and gradient.isfinite().all()
        assert loss.item() == pytest.approx(1 - sign, abs=1e-6)


@hard_case(
    "losses",
    case="duplicated neighbours",
    could_go_wrong="ties that are broken one way here, another way there",
    must_hold="the first of the equal ones, by both searches, with one and the same loss",
)
def test_of_equal_neighbours_the_first_is_chosen():
    style = features_of(40, seed=1).repeat(5, 1)
    features = style[torch.randperm(200, generator=torch.Generator().manual_seed(0))][:60] * 2
    plain, indexed = both_searches(features, style)
    assert plain.max() < 40 and torch.equal(plain, indexed)
    constant = torch.ones(70, CHANNELS)
    assert all(found.tolist() == [0] * 60 for found in both_searches(features, constant))


@hard_case(
    "losses",
    case="a style of a single feature vector",
    could_go_wrong="the variance of one point; principal axes of nothing",
    must_hold="it is everyone's neighbour, by both searches",
)
def test_a_style_of_one_vector_is_everyones_neighbour():
    features, style = features_of(30), features_of(1, seed=1)
    assert all(found.tolist() == [0] * 30 for found in both_searches(features, style))
    loss, gradient = loss_and_gradient(nnfm_loss, features, StyleIndex(style))
    assert 0 <= loss <= 1 and gradient.isfinite().all()


@hard_case(
    "losses",
    case="a style of 20,000 feature vectors, half of them equal, some zero",
    could_go_wrong="bounds of the index that rule out the winner; blocks of equal vectors that can't be split",
    must_hold="the plain search's neighbours have the same similarity as the index's",
)
def test_a_large_style_with_repeats_is_searched_as_by_comparing_all():
    style = features_of(20_000, seed=1)
    style[1::2] = style[1]
    style[::100] = 0
    features = torch.cat([features_of(200), style[5:40], torch.zeros(3, CHANNELS)])
    plain, indexed = nearest_neighbors(features, style), StyleIndex(style).nearest(features)
    directions = torch.nn.functional.normalize(style.double(), dim=-1)
    similarities = (features.double() @ directions.T).gather(1, torch.stack([plain, indexed], dim=1))
    length = features.double().norm(dim=-1)
    assert ((similarities[:, 0] - similarities[:, 1]).abs() <= 1e-6 * length).all()
    assert (indexed < 20_000).all() and (indexed >= 0).all()


@hard_case(
    "losses",
    case="features in bfloat16 and float16, lengths up to 1e4",
    could_go_wrong="squares overflow at 65,504; the smallest length rounds to 0, and 0 / 0 follows",
    must_hold="losses are float32's of the same numbers, gradients finite, also where features are zero",
)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_features_give_float32_losses(dtype):
    features, style = (400 * features_of(30)).to(dtype), (400 * features_of(40, seed=1)).to(dtype)
    features[3] = 0
    photo, rendered = torch.rand(9, 3).to(dtype), torch.rand(9, 3).to(dtype)
    for loss, arguments in (
        (nnfm_loss, (features, style)),
        (nnfm_loss, (features, StyleIndex(style))),
        (content_loss, (features, style[:30])),
        (reconstruction_loss, (rendered, photo)),
    ):
        value, gradient = loss_and_gradient(loss, *arguments)
        exact = (each.float() if isinstance(each, torch.Tensor) else each for each in arguments)
        torch.testing.assert_close(value, loss_and_gradient(loss, *exact)[0])
        assert value.dtype == torch.float32 and gradient.isfinite().all()
    assert torch.equal(nearest_neighbors(features, style), nearest_neighbors(features.float(), style.float()))


@hard_case(
    "losses",
    case="style and content losses under bfloat16 and float16 autocast",
    could_go_wrong="similarities with three digits: other neighbours, and bounds of the index that do not bound",
    must_hold="neighbours and losses are float32's",
)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_losses_under_autocast_are_those_in_float32(dtype):
    features, style = features_of(300), features_of(400, seed=1)
    neighbors, loss = nearest_neighbors(features, style), nnfm_loss(features, style)
    content = content_loss(300 * features, 300 * style[:300])
    with torch.autocast("cpu", dtype=dtype):
        index = StyleIndex(style)
        assert torch.equal(nearest_neighbors(features, style), neighbors)
        assert torch.equal(index.nearest(features), neighbors)
        for target in (style, index):
            torch.testing.assert_close(nnfm_loss(features, target), loss)
        torch.testing.assert_close(content_loss(300 * features, 300 * style[:300]), content)


@hard_case(
    "losses",
    case="content features of size 1e-30 to 1e30",
    could_go_wrong="their squares underflow to 0, or overflow, and ∞ / ∞ is not a number",
    must_hold="the relative error of the features, whatever their size, with a finite gradient",
)
@pytest.mark.parametrize("size", [1e-30, 1e-18, 1.0, 1e18, 1e30])
def test_the_content_loss_does_not_depend_on_the_size_of_features(size):
    features, target = features_of(30), features_of(30, seed=1)
    loss, gradient = loss_and_gradient(content_loss, size * features, size * target)
    expected, exact = loss_and_gradient(content_loss, features.double(), target.double())
    torch.testing.assert_close(loss.double(), expected, rtol=1e-5, atol=0)
    torch.testing.assert_close(size * gradient.double(), exact, rtol=1e-4, atol=1e-6 * exact.abs().max().item())


@hard_case(
    "losses",
    case="densities of 3e6 close to the camera",
    could_go_wrong="the mean of large densities overflows, or one that isn't near counts",
    must_hold="the mean of those within reach, finite",
)
def test_the_densest_fog_near_the_camera_has_a_finite_loss():
    edges = torch.linspace(0, 1, 65).expand(4096, -1)
    loss, gradient = loss_and_gradient(near_density, torch.full((4096, 64), 3e6), edges, 0.25)
    assert loss.item() == pytest.approx(3e6 / 4, rel=1e-5)
    assert gradient.isfinite().all() and (gradient[:, 16:] == 0).all()


@hard_case(
    "losses",
    case="constant images: black, grey and white",
    could_go_wrong="features without variance: every neighbour ties",
    must_hold="losses and gradients are finite; a constant style equal to the picture asks for nothing",
)
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_constant_images_have_finite_losses(backbone, value):
    picture = torch.full((16, 16, 3), value, requires_grad=True)
    for style, content in (
        (torch.full((3, 16, 16), value), picture.detach()),
        (torch.rand(3, 20, 16), torch.rand(16, 16, 3)),
    ):
        targets = StyleTargets(backbone, style, feature_side=16)
        losses = list(targets.losses(targets.view(picture, targets.content(content))).values())
        (gradient,) = torch.autograd.grad(sum(losses), picture)
        assert all(loss.isfinite() for loss in losses) and gradient.isfinite().all()
        if content.equal(picture):
            assert max(losses) < 1e-5


@hard_case(
    "losses",
    case="styles of one pixel, and of 20,000 × 8 pixels",
    could_go_wrong="a side that rounds to 0 pixels, or too few for the network",
    must_hold="at least 8 pixels a side reach the network; features are finite",
)
@pytest.mark.parametrize("height, width", [(1, 1), (8, 20_000), (20_000, 1), (3, 2)])
def test_the_smallest_and_the_longest_style_have_features(backbone, height, width):
    style = torch.rand(3, height, width, generator=torch.Generator().manual_seed(0))
    targets = StyleTargets(backbone, style, feature_side=48)
    assert min(fit_side(style[None], 48, backbone.smallest_side).shape[-2:]) >= 8
    view = targets.view(torch.rand(16, 16, 3), targets.content(torch.rand(16, 16, 3)))
    assert targets.losses(view)["style"].isfinite()


@hard_case(
    "losses",
    case="a picture that has the asked-for longer side and is 1 to 7 pixels high",
    could_go_wrong="it reaches the network as it is, which has no feature for it",
    must_hold="it is enlarged to 8 pixels",
)
@pytest.mark.parametrize("height", [1, 4, 7])
def test_a_low_picture_of_the_right_width_is_enlarged(backbone, height):
    picture = torch.rand(1, 3, height, 32)
    assert fit_side(picture, 32, backbone.smallest_side).shape == (1, 3, 8, 32)
    assert feature_rows(backbone(fit_side(picture, 32, backbone.smallest_side))).isfinite().all()


@hard_case(
    "losses",
    case="views that the scene covers nowhere, or in one pixel",
    could_go_wrong="the mean of no feature is not a number",
    must_hold="losses and gradients are finite",
)
@pytest.mark.parametrize("covered", [0, 1, 256])
def test_views_of_hardly_anything_have_finite_losses(backbone, covered):
    picture = torch.rand(16, 16, 3, requires_grad=True)
    accumulation = torch.zeros(256)
    accumulation[:covered] = 1
    targets = StyleTargets(backbone, torch.rand(3, 16, 16), feature_side=16)
    view = targets.view(picture, targets.content(torch.rand(16, 16, 3)), accumulation.view(16, 16))
    losses = list(targets.losses(view).values())
    (gradient,) = torch.autograd.grad(sum(losses), picture)
    assert all(loss.isfinite() for loss in losses) and gradient.isfinite().all()
