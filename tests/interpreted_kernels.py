"""The hash grid's Triton kernels in Triton's interpreter, which runs them without a GPU."""

import functools
import importlib.util
from types import ModuleType

import pytest


@functools.cache
def interpreted_kernels() -> ModuleType:
    """The module of kernels beside the compiled one; a test without Triton is skipped."""
    triton = pytest.importorskip("triton", reason="triton comes with torch for CUDA only")
    name = "sparsestyle_ns.field_components.hash_grid_triton"
    specification = importlib.util.find_spec(name)
    module = importlib.util.module_from_spec(specification)
    before, triton.knobs.runtime.interpret = triton.knobs.runtime.interpret, True  # looked at where kernels are defined
    try:
        specification.loader.exec_module(module)
    finally:
        triton.knobs.runtime.interpret = before
    return module
