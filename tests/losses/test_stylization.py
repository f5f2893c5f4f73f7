import torch
from torch import nn

from sparsestyle_ns.core.feature_maps import feature_rows
from sparsestyle_ns.losses.content import content_loss
from sparsestyle_ns.losses.nnfm import nnfm_loss
from sparsestyle_ns.losses.stylization import StyleTargets, fit_side, sample_rows


class Patches(nn.Module):
    """A feature network that gives each 4 × 4 block of pixels its own colours as features."""

    smallest_side = 4

    def forward(self, images):
        return nn.functional.pixel_unshuffle(images, 4)


def make_targets():
    torch.manual_seed(0)
    return StyleTargets(Patches(), torch.rand(3, 16, 16), feature_side=16)


def test_fit_side_makes_the_longer_side_as_asked_and_keeps_the_proportions():
    assert fit_side(torch.rand(1, 3, 20, 40), 20).shape == (1, 3, 10, 20)
    assert fit_side(torch.rand(1, 3, 40, 20), 80).shape == (1, 3, 80, 40)
    image = torch.rand(1, 3, 20, 40)
    assert fit_side(image, 40) is image


def test_losses_are_those_of_all_features_where_nothing_is_transparent():
    targets, image, photo = make_targets(), torch.rand(16, 16, 3), torch.rand(16, 16, 3)
    content = targets.content(photo)
    losses = targets.losses(targets.view(image, content))
    rows = feature_rows(targets.features(image))
    torch.testing.assert_close(losses["style"], nnfm_loss(rows, targets.style_rows()))
    torch.testing.assert_close(losses["content"], content_loss(rows, feature_rows(content.features)))
    torch.testing.assert_close(targets.losses(targets.view(image, content, torch.ones(16, 16))), losses)


def test_what_the_background_shows_changes_no_loss():
    targets, photo = make_targets(), torch.rand(16, 16, 3)
    content = targets.content(photo)
    accumulation = torch.zeros(16, 16)
    accumulation[:, 8:] = 1.0
    first, second = torch.rand(2, 16, 16, 3)
    second[:, 8:] = first[:, 8:]
    one, other = (targets.losses(targets.view(image, content, accumulation)) for image in (first, second))
    torch.testing.assert_close(one, other)
    one, other = (targets.losses(targets.view(image, content)) for image in (first, second))
    assert one["style"] != other["style"]


def test_with_few_style_features_the_loss_is_that_against_some_of_the_painting():
    torch.manual_seed(0)
    picture, image = torch.rand(3, 16, 16), torch.rand(16, 16, 3)
    losses = []
    for count in (None, 16, 4, 1):
        targets = StyleTargets(Patches(), picture, 16, style_features=count)
        losses.append(float(targets.losses(targets.view(image, targets.content(image)))["style"]))
    assert losses[0] == losses[1]  # there are 16 in all
    assert losses[1] < losses[2] < losses[3]


def test_a_sample_of_rows_keeps_their_order_and_repeats_none():
    rows = torch.arange(100.0)[:, None]
    drawn = sample_rows(rows, 30).flatten()
    assert len(drawn.unique()) == 30
    assert drawn.equal(drawn.sort().values)
    assert drawn.equal(sample_rows(rows, 30).flatten())


def test_colours_are_compared_with_the_painting_as_large_as_the_network_sees_it():
    black_and_white = (torch.arange(64)[:, None] + torch.arange(64)) % 2.0
    targets = StyleTargets(Patches(), black_and_white.expand(3, -1, -1), feature_side=16, losses=["colors"])
    losses = [
        float(targets.losses(targets.view(image, targets.content(image)))["colors"])
        for image in (torch.full((16, 16, 3), 0.5), black_and_white[:16, :16, None].expand(-1, -1, 3))
    ]
    assert losses[0] < 0.01 * losses[1]
