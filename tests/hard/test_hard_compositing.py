import pytest
import torch
from hard.table import hard_case

from sparsestyle_ns.rendering.compositing import dense_weights, optical_depth


@hard_case(
    "compositing",
    case="density 0 on a whole ray",
    could_go_wrong="0 / 0 where weights are divided by their sum",
    must_hold="weights are 0 and gradients finite",
)
@pytest.mark.parametrize("n", [1, 3])
def test_an_empty_ray_has_weights_of_0(n):
    assert dense_weights(optical_depth(torch.zeros(n), torch.ones(n))).tolist() == [0] * n
