import torch

from sparsestyle_ns.rendering.precision import autocast, multiplies_tf32

CPU = torch.device("cpu")


def test_bfloat16_products_are_rounded_and_float32_ones_are_not():
    left, right = torch.rand(8, 8) + 1.0, torch.rand(8, 8) + 1.0
    with autocast(CPU, "bfloat16"):
        assert (left @ right).dtype == torch.bfloat16
    with autocast(CPU, "float32"):
        assert (left @ right).dtype == torch.float32


def test_tf32_is_allowed_inside_only():
    products = torch.backends.cuda.matmul
    before = products.allow_tf32
    with autocast(CPU, "tf32"):
        assert products.allow_tf32
    assert products.allow_tf32 == before


def test_a_cpu_multiplies_no_tf32():
    assert not multiplies_tf32(CPU)
