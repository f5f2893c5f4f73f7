import threading

import pytest
import torch

from sparsestyle_ns.core.precision import autocast, multiplies_tf32

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


@pytest.mark.parametrize("first_out", [0, 1])
def test_tf32_stays_allowed_until_the_last_thread_is_out_and_is_then_as_before(first_out):
    products = torch.backends.cuda.matmul
    before = products.allow_tf32
    entered, leave = threading.Barrier(3), [threading.Event(), threading.Event()]

    def work(number):
        with autocast(CPU, "tf32"):
            entered.wait(10)
            leave[number].wait(10)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    entered.wait(10)
    seen = []
    for number in (first_out, 1 - first_out):
        seen.append(products.allow_tf32)
        leave[number].set()
        threads[number].join(10)
    assert seen == [True, True]
    assert products.allow_tf32 == before


def test_tf32_within_tf32_and_an_error_leave_it_as_it_was():
    products = torch.backends.cuda.matmul
    before = products.allow_tf32
    with pytest.raises(ZeroDivisionError), autocast(CPU, "tf32"):
        with autocast(CPU, "tf32"):
            pass
        assert products.allow_tf32
        1 / 0  # noqa: B018
    assert products.allow_tf32 == before


def test_a_cpu_multiplies_no_tf32():
    assert not multiplies_tf32(CPU)
