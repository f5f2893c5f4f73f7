"""Which number format matrix products run in, and what must not run in fewer digits than float32 has."""

import functools
import itertools
import threading
from contextlib import AbstractContextManager, contextmanager
from typing import Callable, Iterator, Literal, ParamSpec, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")
Precision = Literal["auto", "float32", "tf32", "bfloat16"]
"""auto: bfloat16 where the device multiplies it, else float32. tf32: NVIDIA's 19-bit format, in forward passes and from
Ampere on; elsewhere as float32."""


def multiplies_tf32(device: torch.device) -> bool:
    """Whether the device has instructions for TF32 matrix products."""
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether the device has instructions for bfloat16 matrix products, which makes them faster than float32 ones."""
    if device.type != "cpu":
        return multiplies_tf32(device)  # both came with Ampere
    probes = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(getattr(torch.cpu, probe, bool)() for probe in probes)


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager:
    """A context in which matrix products run in `precision`; parameters and sums stay float32."""
    if precision == "tf32":
        return _tf32_products()
    enabled = precision == "bfloat16" or (precision == "auto" and multiplies_bfloat16(device))
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=enabled)


_lock, _within, _before = threading.Lock(), 0, False


@contextmanager
def _tf32_products() -> Iterator[None]:
    """Turns on torch's switch for TF32 products while any thread is within; all threads have the one switch."""
    global _within, _before
    products = torch.backends.cuda.matmul
    with _lock:
        if _within == 0:
            _before, products.allow_tf32 = products.allow_tf32, True
        _within += 1
    try:
        yield
    finally:
        with _lock:
            _within -= 1
            if _within == 0:
                products.allow_tf32 = _before


def at_least_float32(values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Values of half precision in float32, others as they are."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def without_autocast(function: Callable[P, R]) -> Callable[P, R]:
    """Makes `function` compute in the number format of its arguments, of which one is a tensor, under autocast too."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        tensors = (value for value in itertools.chain(args, kwargs.values()) if isinstance(value, Tensor))
        with torch.autocast(next(tensors).device.type, enabled=False):
            return function(*args, **kwargs)

    return wrapper
