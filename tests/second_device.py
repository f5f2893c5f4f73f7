"""A second device on a machine that has only one: what a forgotten `.to(device)` would do on a GPU, found on a CPU.

Inside of `SecondDevice()` there is a device `cuda:0`. Its tensors are kept and worked on in main memory, so every
operator runs; but their storages are marked, and what CUDA would refuse is refused:

- an operator on tensors of both devices, in a backward pass and an optimiser's step too;
- a random number generator of the other device; numpy on a tensor of the device;
- an operator that torch has no CUDA kernel for (where torch is built with CUDA, it says which it has).

What CUDA allows is allowed: numbers of no dimensions of the CPU in operators that work element by element, indices of
the CPU, copies. What makes the CPU wait for a GPU is counted, by the line of the package that it happens in
(`SecondDevice.waits`), and so is the memory of tensors (`SecondDevice.peak_bytes`).

Why storages are marked, and not a class of tensors made that says it is elsewhere: storages outlive every path through
autograd, views and optimisers, and the tensors stay those that torch, numba and Triton's interpreter know.
torch's own means, a backend in Python for the device `privateuseone`, would never take the paths for CUDA.
"""

import contextlib
import functools
import sys
import threading
from collections import Counter
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Optional, Set, Tuple
from unittest import mock

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

PACKAGES = ("sparsestyle_ns", "nerfstudio")
SMALL = 1 << 14
"""Bytes; tensors of fewer aren't counted."""
CPU, CUDA = torch.device("cpu"), torch.device("cuda", 0)
INDEXING = ("index", "_unsafe_index", "index_put", "index_put_", "_index_put_impl_")
"""Operators that take indices of the CPU on a GPU; the first argument says where the result is."""
SCALARS_OF_CPU = ("where", "fill", "masked_fill", "index_put", "lerp", "_foreach_mul", "_foreach_div", "_foreach_add")
"""Operators beside those that work element by element which take a number that lies on the CPU."""
WAITING = {
    "_local_scalar_dense": "item",
    "nonzero": "nonzero",
    "masked_select": "boolean mask",
    "_unique2": "unique",
    "unique_dim": "unique",
    "unique_consecutive": "unique",
    "bincount": "bincount",
    "equal": "item",
    "repeat_interleave": "repeat_interleave",
    "_linalg_eigh": "decomposition",
    "_linalg_svd": "decomposition",
    "linalg_qr": "decomposition",
}
"""Operators after which the CPU knows something that a GPU has worked out, and what they count as."""


class Wait(NamedTuple):
    """Something that waits for a GPU, and the line of the package that asks for it."""

    kind: str
    place: str


class DeviceError(RuntimeError):
    """What CUDA would refuse."""


def is_second(device: Any) -> bool:
    """Whether an argument names the second device."""
    return isinstance(device, (str, torch.device)) and torch.device(device).type == "cuda"


def _names_device(value: Any) -> bool:
    if isinstance(value, torch.device):
        return True
    return isinstance(value, str) and value.split(":")[0] in ("cpu", "cuda", "meta")


def _tensors(*values: Any) -> List[Tensor]:
    return [leaf for leaf in tree_flatten(values)[0] if isinstance(leaf, Tensor)]


def _storage(tensor: Tensor) -> Optional[torch.UntypedStorage]:
    while torch._C._functorch.is_functorch_wrapped_tensor(tensor):  # as torch.func's functions see their arguments
        tensor = torch._C._functorch.get_unwrapped(tensor)
    return None if tensor.is_meta else tensor.untyped_storage()


class _Marks:
    """Which storages are on the second device."""

    def __init__(self) -> None:
        # A weak reference keeps the address from being used again, so it stands for one storage.
        self._known: Dict[int, StorageWeakRef] = {}

    def __call__(self, tensor: Tensor) -> bool:
        storage = _storage(tensor)
        return storage is not None and storage._cdata in self._known

    def storage(self, storage: torch.UntypedStorage, marked: bool) -> None:
        if not marked:
            self._known.pop(storage._cdata, None)
            return
        if len(self._known) % 1000 == 999:
            self._known = {key: kept for key, kept in self._known.items() if not kept.expired()}
        self._known.setdefault(storage._cdata, StorageWeakRef(storage))

    def set(self, tensor: Tensor, marked: bool) -> None:
        if (storage := _storage(tensor)) is not None:
            self.storage(storage, marked)


class SecondDevice:
    """The second device, within a `with`.

    Args:
        kernels: refuse operators without a CUDA kernel.
    """

    active: Optional["SecondDevice"] = None

    def __init__(self, kernels: bool = True) -> None:
        self.marks = _Marks()
        self.waits: Counter[Wait] = Counter()
        self.mistakes: List[str] = []
        """All that was refused, also where someone caught the error."""
        self.operators: Set[str] = set()
        """Names of the operators that ran on the second device."""
        self.copied_bytes: Counter[str] = Counter()
        """From the CPU, by line of the package."""
        self.peak_bytes = 0
        """Of all tensors there at once, but for small ones; what an operator needs inside isn't seen."""
        self._live: List[Tuple[StorageWeakRef, int]] = []
        self.kernels = kernels and torch.version.cuda is not None
        self._state = threading.local()
        self._lock = threading.Lock()

    # ------------------------------------------------------------------------------------------------- entering, errors

    def __enter__(self) -> "SecondDevice":
        assert SecondDevice.active is None
        SecondDevice.active = self
        self._exits = contextlib.ExitStack()
        for patch in _patches(self):
            self._exits.enter_context(patch)
        self._exits.enter_context(self.modes())
        return self

    def __exit__(self, *error: object) -> None:
        self._exits.close()
        SecondDevice.active = None

    @contextlib.contextmanager
    def modes(self) -> Iterator[None]:
        """The modes of torch, which are a thread's own."""
        with _Operators(self), _Functions(self):
            yield

    def refuse(self, why: str) -> None:
        """Raises an error, and remembers it."""
        words = f"{why}, at {place()}"
        with self._lock:
            self.mistakes.append(words)
        raise DeviceError(words)

    def wait(self, kind: str, num_bytes: int = 0) -> None:
        """Counts something that waits for a GPU."""
        where = place()
        with self._lock:
            self.waits[Wait(kind, where)] += 1
            self.copied_bytes[where] += num_bytes

    def count_memory(self, tensor: Tensor) -> None:
        """Takes note of a new tensor's memory, and of the most that there is at once."""
        storage = tensor.untyped_storage()
        if storage.nbytes() < SMALL:
            return
        with self._lock:
            self._live.append((StorageWeakRef(storage), storage.nbytes()))
            self._live = [each for each in self._live if not each[0].expired()]
            self.peak_bytes = max(self.peak_bytes, sum(num_bytes for _, num_bytes in self._live))

    @property
    def within(self) -> Optional[bool]:
        """Whether a function of torch's runs on the second device, which then makes tensors there; None: none runs."""
        return getattr(self._state, "within", None)

    @contextlib.contextmanager
    def function(self, on_second: Optional[bool], moving: bool = False) -> Iterator[None]:
        """While a function of torch's runs."""
        before = getattr(self._state, "within", None), getattr(self._state, "moving", False)
        self._state.within, self._state.moving = on_second, moving
        try:
            yield
        finally:
            self._state.within, self._state.moving = before

    @property
    def in_backward(self) -> bool:
        """Whether autograd works on the second device."""
        return getattr(self._state, "in_backward", False)

    @contextlib.contextmanager
    def backward(self, on_second: bool) -> Iterator[None]:
        """While autograd works."""
        before, self._state.in_backward = self.in_backward, on_second
        try:
            yield
        finally:
            self._state.in_backward = before

    @property
    def moving(self) -> bool:
        """Whether a tensor is being moved between the devices."""
        return getattr(self._state, "moving", False)


def place() -> str:
    """The innermost line of the package or of nerfstudio, and where there is none, of a test."""
    frame, of_test = sys._getframe(1), "torch"
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        for package in PACKAGES:
            if package in path.parts[:-1]:
                inside = Path(*path.parts[len(path.parts) - 1 - path.parts[::-1].index(package) :])
                return f"{inside}:{frame.f_lineno} {frame.f_code.co_name}"
        if path.name.startswith("test_") and of_test == "torch":
            of_test = f"{path.name}:{frame.f_lineno}"
        frame = frame.f_back
    return of_test


# ----------------------------------------------------------------------------------------------------------- operators


class _Operators(TorchDispatchMode):
    """Sees every operator, in a backward pass too."""

    def __init__(self, device: SecondDevice) -> None:
        super().__init__()
        self.device = device

    def __torch_dispatch__(self, func: Any, types: Any, args: Tuple = (), kwargs: Optional[Dict] = None) -> Any:
        with torch._C.DisableTorchFunction():
            kwargs = kwargs or {}
            device, inputs = self.device, _tensors(args, kwargs)
            marked = [device.marks(each) for each in inputs]
            known = {each.untyped_storage()._cdata for each in inputs if not each.is_meta}
            if not device.moving:
                self._check(func, args, kwargs, inputs, marked)
                self._count(func, args, inputs, marked)
            result = func(*args, **kwargs)
            on_second = _where(func, inputs, marked, device)
            if any(marked) or on_second:
                device.operators.add(func._schema.name)
            for each in _tensors(result):
                if on_second and not each.is_meta and each.untyped_storage()._cdata not in known:
                    device.marks.set(each, True)
                    device.count_memory(each)
            return result

    def _check(self, func: Any, args: Tuple, kwargs: Dict, inputs: List[Tensor], marked: List[bool]) -> None:
        name = func._schema.name.split("::")[1]
        if not any(marked):
            return
        if self.device.kernels and not has_cuda_kernel(func):
            self.device.refuse(f"torch has no kernel of {func} for CUDA")
        others = [each for each, second in zip(inputs, marked, strict=True) if not second and not each.is_meta]
        if not others or name in ("copy_", "_to_copy", "_foreach_copy_"):
            return
        written = {id(each) for each in _written(func, args, kwargs)}
        allowed = name in INDEXING and self.device.marks(args[0])
        if allowed:
            values = _tensors(args[2:3])
            others = [each for each in others if any(each is value for value in values)]
        is_pointwise = torch.Tag.pointwise in func.tags or name.rstrip("_") in SCALARS_OF_CPU
        scalars = [each for each in others if each.dim() == 0 and id(each) not in written]
        if others and not (is_pointwise and len(scalars) == len(others) == 1):
            shapes = ", ".join(f"{tuple(each.shape)}" for each in others)
            self.device.refuse(f"{func} has tensors of cuda:0, and of the cpu (of shape {shapes})")

    def _count(self, func: Any, args: Tuple, inputs: List[Tensor], marked: List[bool]) -> None:
        name, device = func._schema.name.split("::")[1], self.device
        if not any(marked):
            return
        if name in WAITING and not (name == "repeat_interleave" and func._overloadname != "Tensor"):
            device.wait(WAITING[name])
        elif name in INDEXING and device.marks(args[0]):
            masks = [each for each in _tensors(args[1]) if each.dtype in (torch.bool, torch.uint8)]
            # A number for the places of a mask is filled in without a look at how many these are.
            fills = len(args) > 2 and args[2].numel() == 1 and not device.marks(args[2])
            if masks and not fills:
                device.wait("boolean mask")
            for each in _tensors(args[1]):
                if not device.marks(each):
                    device.wait("copy from the cpu", each.nbytes)
        elif name == "copy_" and len(set(marked[:2])) == 2:
            device.wait("copy to the cpu" if marked[1] else "copy from the cpu", 0 if marked[1] else inputs[1].nbytes)


def _where(func: Any, inputs: List[Tensor], marked: List[bool], device: SecondDevice) -> bool:
    """Whether an operator's results are on the second device."""
    if device.moving:
        return False
    if inputs and not all(each.is_meta for each in inputs):
        return any(marked)
    # What no function of Python's asked for is made by autograd, beside the gradients that it has.
    return device.in_backward if device.within is None else device.within


def _written(func: Any, args: Tuple, kwargs: Dict) -> List[Tensor]:
    found: List[Tensor] = []
    for place_of, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            value = args[place_of] if place_of < len(args) else kwargs.get(argument.name)
            found += _tensors(value)
    return found


@functools.cache
def has_cuda_kernel(func: Any) -> bool:
    """Whether torch can do an operator on CUDA; where it was built without, this says no."""
    name = func._schema.name + (f".{func._schema.overload_name}" if func._schema.overload_name else "")
    keys = ("CUDA", "CompositeExplicitAutograd", "CompositeImplicitAutograd", "CompositeExplicitAutogradNonFunctional")
    return any(torch._C._dispatch_has_kernel_for_dispatch_key(name, key) for key in keys)


# ----------------------------------------------------------------------------------------------------------- functions


class _Functions(TorchFunctionMode):
    """Sees the functions and methods that Python calls, with the devices that they name."""

    def __init__(self, device: SecondDevice) -> None:
        super().__init__()
        self.device = device

    def __torch_function__(self, func: Any, types: Any, args: Tuple = (), kwargs: Optional[Dict] = None) -> Any:
        device, kwargs = self.device, dict(kwargs or {})
        if func in SPECIAL:
            return SPECIAL[func](self, *args, **kwargs)
        target, args, kwargs = _target(device, func, args, kwargs)
        inputs = _tensors(args, kwargs)
        within = any(map(device.marks, inputs)) if target is None else target
        _check_generator(device, func, within, kwargs.get("generator"))
        moves = func is Tensor.to and target is not None and target != device.marks(inputs[0])
        if moves and target:  # from memory that isn't pinned a copy waits for what was asked before, unless told not to
            device.wait("copy on the way" if kwargs.get("non_blocking") else "copy from the cpu", inputs[0].nbytes)
        elif moves:
            device.wait("copy to the cpu")
        with device.function(within, moving=moves):
            result = func(*args, **kwargs)
        if within and func in (torch.tensor, torch.as_tensor, Tensor.new_tensor):
            device.wait("copy from the cpu", result.nbytes)
        return result if target is None else tree_map(lambda value: _put(device, value, target), result)


def _target(device: SecondDevice, func: Any, args: Tuple, kwargs: Dict) -> Tuple[Optional[bool], Tuple, Dict]:
    """Where a function is told to put its result, and its arguments with the CPU in the second device's place."""
    if func is Tensor.to and len(args) > 1 and isinstance(args[1], Tensor):
        return device.marks(args[1]), args, kwargs
    if func is Tensor.new_tensor and kwargs.get("device") is None:
        return device.marks(args[0]), args, kwargs
    named = kwargs.get("device")
    if func is Tensor.to and named is None and len(args) > 1 and _names_device(args[1]):
        named = args[1]
    if named is None or torch.device(named).type == "meta":
        return None, args, kwargs
    args = tuple(CPU if func is Tensor.to and _names_device(value) else value for value in args)
    return is_second(named), args, {key: CPU if key == "device" else value for key, value in kwargs.items()}


def _put(device: SecondDevice, value: Any, target: bool) -> Any:
    """A function's result on the device that it was told: a copy where it is an argument itself."""
    if not isinstance(value, Tensor) or value.is_meta or device.marks(value) == target:
        return value
    with device.function(None, moving=True):
        value = value.clone()
    device.marks.set(value, target)
    return value


def _check_generator(device: SecondDevice, func: Any, expected: bool, generator: Any) -> None:
    if isinstance(generator, torch._C.Generator) and getattr(generator, "is_second", False) != expected:
        kinds = ("cpu", "cuda")
        device.refuse(f"{func.__name__} needs a generator of {kinds[expected]} and got one of {kinds[not expected]}")


def _device_of(mode: _Functions, tensor: Tensor) -> torch.device:
    return CUDA if mode.device.marks(tensor) else tensor.device


def _move(mode: _Functions, tensor: Tensor, target: bool) -> Tensor:
    with mode:
        return tensor.to(CUDA if target else CPU)


def _no_numpy(mode: _Functions, method: Callable, tensor: Tensor, *args: Any, **kwargs: Any) -> Any:
    if mode.device.marks(tensor):
        mode.device.refuse("numpy can't see a tensor of cuda:0")
    return method(tensor, *args, **kwargs)


def _to_list(mode: _Functions, tensor: Tensor) -> Any:
    if mode.device.marks(tensor):
        mode.device.wait("tolist")
    return tensor.tolist()


def _backward(mode: _Functions, tensor: Tensor, *args: Any, **kwargs: Any) -> None:
    names = ("gradient", "retain_graph", "create_graph", "inputs")
    settings = {**dict(zip(names, args, strict=False)), **kwargs}
    # Backward passes written in Python are the package's: they go through the mode, too.
    with mode, mode.device.function(None):
        gradient = settings.pop("gradient", None)
        torch.autograd.backward(tensor, gradient, **settings)


def _deep_copy(mode: _Functions, tensor: Tensor, memo: Dict) -> Tensor:
    copied = tensor.__deepcopy__(memo)
    mode.device.marks.set(copied, mode.device.marks(tensor))
    return copied


SPECIAL: Dict[Any, Callable] = {
    Tensor.device.__get__: _device_of,
    Tensor.is_cuda.__get__: lambda mode, tensor: mode.device.marks(tensor),
    Tensor.is_cpu.__get__: lambda mode, tensor: tensor.is_cpu and not mode.device.marks(tensor),
    Tensor.get_device: lambda mode, tensor: 0 if mode.device.marks(tensor) else tensor.get_device(),
    Tensor.cuda: lambda mode, tensor, *_, **__: _move(mode, tensor, True),
    Tensor.cpu: lambda mode, tensor, *_, **__: _move(mode, tensor, False),
    Tensor.numpy: lambda mode, *args, **kwargs: _no_numpy(mode, Tensor.numpy, *args, **kwargs),
    Tensor.__array__: lambda mode, *args, **kwargs: _no_numpy(mode, Tensor.__array__, *args, **kwargs),
    Tensor.tolist: _to_list,
    Tensor.backward: _backward,
    Tensor.__deepcopy__: _deep_copy,
}
"""What is done instead of a function or a property's getter."""


# ------------------------------------------------------------------------------------- what isn't a function of tensors


class _Generator(torch._C.Generator):
    """A generator that says where it is."""

    def __new__(cls, device: Any = "cpu") -> "_Generator":
        made = super().__new__(cls, device="cpu")
        made.is_second = is_second(device)
        return made

    @property
    def device(self) -> torch.device:
        return CUDA if self.is_second else CPU


class _Autocast(torch.autocast):
    """autocast for CUDA acts on the marked tensors, which are the CPU's."""

    def __init__(self, device_type: str, *args: Any, **kwargs: Any) -> None:
        super().__init__(device_type, *args, **kwargs)
        self._under = torch.amp.autocast("cpu", *args, **kwargs) if device_type == "cuda" else contextlib.nullcontext()

    def __enter__(self) -> "_Autocast":
        self._under.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> Any:
        super().__exit__(*error)
        return self._under.__exit__(*error)


def _patches(device: SecondDevice) -> List[Any]:
    from torch.utils import _foreach_utils
    from torch.utils import checkpoint as checkpointing

    group, run = _foreach_utils._group_tensors_by_device_and_dtype, threading.Thread.run
    engine = torch.autograd._engine_run_backward

    def grouped(lists: List[List[Optional[Tensor]]], *args: Any) -> Dict:
        found = group(lists, *args)
        first = {key: next(each for each in parts[0][0] if each is not None) for key, parts in found.items()}
        return {(first[key].device, key[1]): parts for key, parts in found.items()}

    def described(tensor: Tensor) -> Dict[str, Any]:
        return {"shape": tensor.shape, "dtype": tensor.dtype, "device": device.marks(tensor)}

    def run_backward(outputs: Any, *args: Any, **kwargs: Any) -> Any:
        with device.backward(any(map(device.marks, _tensors(outputs)))):
            return engine(outputs, *args, **kwargs)

    def run_within(thread: threading.Thread) -> None:
        with device.modes():
            run(thread)

    cuda = {
        "is_available": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "set_device": lambda _: None,
        "synchronize": lambda *_: device.wait("synchronize"),
        "mem_get_info": lambda *_: (8 * 2**30, 16 * 2**30),
        "get_device_capability": lambda *_: (8, 0),
        "get_device_name": lambda *_: "a second device",
        "is_bf16_supported": lambda *_, **__: True,
        "max_memory_allocated": lambda *_: 0,
        "reset_peak_memory_stats": lambda *_: None,
        "empty_cache": lambda: None,
        "is_current_stream_capturing": lambda: False,
        "get_rng_state": lambda *_: torch.zeros(0),
        "set_rng_state": lambda *_: None,
    }
    return [
        *(mock.patch.object(torch.cuda, name, value) for name, value in cuda.items()),
        mock.patch.object(torch, "Generator", _Generator),
        mock.patch.object(torch, "autocast", _Autocast),
        mock.patch.object(threading.Thread, "run", run_within),
        # Checkpointing compares what is saved, once beneath the modes and once above.
        mock.patch.dict(checkpointing._allowed_determinism_checks_to_fns, default=described),
        mock.patch.object(torch.autograd, "has_torch_function", lambda _: False),
        mock.patch.object(torch.autograd, "_engine_run_backward", run_backward),
        mock.patch.object(_foreach_utils, "_group_tensors_by_device_and_dtype", grouped),
        mock.patch.object(sys.modules[torch.optim.Optimizer.__module__], "_group_tensors_by_device_and_dtype", grouped),
        mock.patch.object(sys.modules["torch.nn.utils.clip_grad"], "_group_tensors_by_device_and_dtype", grouped),
    ]


def _tag(storage: torch.UntypedStorage) -> Optional[str]:
    active = SecondDevice.active
    return "cuda:0" if active is not None and storage._cdata in active.marks._known else None


def _restore(storage: torch.UntypedStorage, location: str) -> Optional[torch.UntypedStorage]:
    active = SecondDevice.active
    if active is None or not location.startswith("cuda"):
        return None
    active.marks.storage(storage, True)
    return storage


# Files say of each tensor where it was, as they do on a GPU; loading puts it there unless it is told otherwise.
torch.serialization.register_package(5, _tag, _restore)
