"""A pretended GPU: tensors that report the device ``cuda:0`` and follow its rules, with their data in CPU memory.

Most machines that run the tests have no GPU, and on them a tensor left on the wrong device fails no other test.
torch's device "meta" refuses such a mixture too but holds no values, on which density control, selections and whole
commands depend.

`PretendedTensor` wraps a CPU tensor. Every operation is checked against the rules of CUDA, unwrapped, executed on the
CPU, and wrapped again. The rules: all tensors are on one device (except scalars in arithmetic, indices and explicit
copies), conversion to NumPy requires ``.cpu()``, and random numbers come from a generator of the same device. In the
`PretendedGPU` mode, ``device="cuda"`` creates such tensors. The fixture ``pretended_gpu`` (in conftest.py) enters it
and makes torch.cuda report a GPU; `gsplat_kernels` replaces gsplat's CUDA extension.

Tests on it check that tensors are on the right devices, how often the host waits for the device (`waits`: reading a
value, copying to the host, or copying from pageable host memory), and the arguments passed to gsplat's Python code.
They cannot check the results, summation order, speed and memory of CUDA kernels; whether an operation exists on CUDA;
asynchronous execution; the synchronizations inside gsplat's extension (one per projection); the restrictions of
inference mode; and libraries that depend on torch's C++ types (torch's optimizers take their per-tensor paths here).
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import torch
import torch.utils._device
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = torch.device("cuda", 0)
NAME = "Pretended GPU"
aten = torch.ops.aten

COPIES = {aten._to_copy.default, aten.copy_.default, aten.copy.default, aten._foreach_copy_.default}
"""Operations that accept tensors of two devices, because they copy between devices."""
INDEXING = {
    aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default,
    aten._unsafe_index.Tensor,
}  # fmt: skip
"""Operations in which CPU tensors can index GPU tensors, but not vice versa."""
TAKES_NUMBERS = {
    aten.where.self, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default,
    aten.masked_fill.Tensor, aten.masked_fill_.Tensor, aten.fill_.Tensor, aten.index_fill_.int_Tensor,
}  # fmt: skip
"""Operations other than arithmetic that accept a zero-dimensional CPU tensor as a scalar."""
IN_HALF = {
    aten.mm.default, aten.addmm.default, aten.bmm.default, aten.baddbmm.default, aten.convolution.default,
}  # fmt: skip
"""Operations that autocast runs in half precision."""
READS = {aten._local_scalar_dense.default, aten.equal.default, aten.is_nonzero.default}
DECIDES_SIZES = {
    aten.nonzero.default, aten.masked_select.default, aten._unique2.default, aten.unique_consecutive.default,
    aten.bincount.default, aten.unique_dim.default, aten.repeat_interleave.Tensor,
}  # fmt: skip
"""Operations whose result size depends on the data, so that the host waits for the device."""


class PretendedTensor(torch.Tensor):
    """A CPU tensor presented as a GPU tensor.

    Python code sees the device "cuda:0". torch's C++ code sees "meta", which has no memory that could be read by
    mistake; gradients on "cuda" would require CUDA's libraries.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> PretendedTensor:
        made = torch.Tensor._make_wrapper_subclass(
            cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(),
            dtype=inner.dtype, layout=inner.layout, device="meta",
        )  # fmt: skip
        made._inner = inner
        return made

    device = property(lambda self: DEVICE)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)
    is_meta = property(lambda self: False)

    def get_device(self) -> int:
        return 0

    def __getitem__(self, index: Any) -> torch.Tensor:
        return super().__getitem__(_listless(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        super().__setitem__(_listless(index), value)

    def to(self, *args: Any, **kwargs: Any) -> torch.Tensor:
        """Like `torch.Tensor.to`; returns the tensor itself if no conversion is required."""
        places = [getattr(a, "device", a) for a in (*args, kwargs.get("device"))]
        places = [a for a in places if isinstance(a, (str, torch.device))]
        dtypes = [
            a.dtype if isinstance(a, torch.Tensor) else a
            for a in args
            if isinstance(a, (torch.dtype, torch.Tensor))
        ]
        there = not places or _is_cuda(places[0])
        options: dict[str, Any] = {} if there else {"device": places[0]}
        options["dtype"] = dtypes[0] if dtypes else kwargs.get("dtype")
        options["copy"] = kwargs.get("copy", False) or [a for a in args if isinstance(a, bool)][1:] == [True]
        if "memory_format" in kwargs:
            options["memory_format"] = kwargs["memory_format"]
        return _torch_to(self, **options)

    def cuda(self, *_: Any, **__: Any) -> torch.Tensor:
        return self

    def numpy(self, **_: Any) -> Any:
        raise TypeError(
            "can't convert cuda:0 device type tensor to numpy. "
            "Use Tensor.cpu() to copy the tensor to host memory first."
        )

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def __deepcopy__(self, memo: Any) -> torch.Tensor:
        return self.detach().clone().requires_grad_(self.requires_grad)

    def data_ptr(self) -> int:
        raise RuntimeError("a pretended tensor has no address")

    def __repr__(self, **_: Any) -> str:
        return f"pretended({self._inner})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return execute(func, args, kwargs or {})


def _listless(index: Any) -> Any:
    """An index whose lists are tensors; torch's C++ code would put them on "meta", where they have no values."""
    if isinstance(index, list):
        return torch.tensor(index)
    return tuple(map(_listless, index)) if isinstance(index, tuple) else index


def _is_cuda(device: Any) -> bool:
    device = torch.device(device)
    if device.type == "cuda" and device.index not in (None, 0):
        raise RuntimeError(f"CUDA error: invalid device ordinal ({device})")
    return device.type == "cuda"


class PretendedGenerator(torch.Generator):
    """A random generator for either device; without CUDA, torch's own generator always reports the CPU."""

    def __new__(cls, device: Any = "cpu") -> PretendedGenerator:
        made = super().__new__(cls)
        if torch.device(device).type == "cuda":
            _generators[made._cdata] = made
        return made

    @property
    def device(self) -> torch.device:
        """Device of the generator."""
        return DEVICE if self._cdata in _generators else torch.device("cpu")


_generators: dict[int, PretendedGenerator] = {}
"""Generators of the GPU, by a key that is unchanged when torch passes them on."""


class PretendedGPU(TorchDispatchMode):
    """Mode in which tensors can be created on the pretended GPU."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # otherwise torch imports its compiler, which takes seconds

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return execute(func, args, kwargs or {})


waits: Counter[str] = Counter()
"""Number of times the host waited for the device, by operation."""
_own_random_state = torch.Generator().manual_seed(7).get_state()
_random_lock = threading.RLock()
_thread = threading.local()


def inner(value: Any) -> Any:
    """The CPU tensor inside a pretended tensor; other values are returned unchanged."""
    return value._inner if isinstance(value, PretendedTensor) else value


def wrapped(value: Any) -> Any:
    """A CPU tensor wrapped as a GPU tensor; other values are returned unchanged."""
    if isinstance(value, torch.Tensor) and not isinstance(value, PretendedTensor):
        return PretendedTensor(value)
    return value


def execute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run one operation under the rules of CUDA."""
    if (
        torch.is_inference_mode_enabled()
    ):  # in which torch neither decomposes operations nor tracks views of this class
        with torch.inference_mode(False), torch.no_grad(), PretendedGPU():
            return func(*args, **kwargs)
    if _decomposes(func):  # for tensors created in inference mode
        with PretendedGPU():
            return func.decompose(*args, **kwargs)
    flat = list(_leaves((args, kwargs)))
    on_gpu = any(isinstance(value, PretendedTensor) for value in flat)
    wanted = kwargs.get("device")
    # torch's C++ code uses "meta" for this device; transformers uses it to create models before loading weights.
    meant = str(torch.utils._device.CURRENT_DEVICE) != "meta"
    to_gpu = wanted is not None and (_is_cuda(wanted) or (meant and wanted.type == "meta"))
    if not on_gpu and not to_gpu:
        _check_generator(kwargs, False)
        return func(*args, **kwargs)
    lands_on_gpu = on_gpu if wanted is None else to_gpu
    _check_devices(func, args, flat)
    _count_waits(func, args, kwargs, lands_on_gpu)
    if func is aten._fused_sdp_choice.default:
        return 0  # the plain implementation; the fast ones are specific to CUDA
    known = {id(value._inner): value for value in flat if isinstance(value, PretendedTensor)}
    outer = args
    args, kwargs = _each(inner, args), _each(inner, kwargs)
    if wanted is not None:
        kwargs["device"] = torch.device("cpu")
    if func in IN_HALF and getattr(_thread, "half", False):
        args, kwargs = _each(_halved, args), _each(_halved, kwargs)
    _check_generator(kwargs, lands_on_gpu)
    if lands_on_gpu and _draws(func) and kwargs.get("generator") is None:
        with _own_randomness():
            found = func(*args, **kwargs)
    else:
        found = func(*args, **kwargs)
    if torch.Tag.inplace_view in func.tags:
        with no_dispatch():  # so that torch's C++ code sees the same shape of the outer tensor
            func(*outer)
    if func is aten._to_copy.default and any(found is arg for arg in args):
        found = found.clone()
    return _each(lambda value: _dressed(value, known, func), found) if lands_on_gpu else found


def _leaves(value: Any) -> Iterator[Any]:
    """All values within tuples, lists and dictionaries."""
    if isinstance(value, (tuple, list, dict)):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _leaves(part)
    else:
        yield value


def _each(change: Callable[[Any], Any], value: Any) -> Any:
    """The same tuples, lists and dictionaries of changed values; torch's own `tree_map` takes three times as long."""
    if isinstance(value, (tuple, list)):
        return (list if isinstance(value, list) else tuple)(_each(change, part) for part in value)
    if isinstance(value, dict):
        return {name: _each(change, part) for name, part in value.items()}
    return change(value)


@functools.cache
def _decomposes(func: Any) -> bool:
    return bool(func._can_decompose())


@functools.cache
def _draws(func: Any) -> bool:
    """Whether an operation draws random numbers."""
    return torch.Tag.nondeterministic_seeded in func.tags


def _halved(value: Any) -> Any:
    """Autocast before products and convolutions; torch's own does not support pretended tensors."""
    is_single = isinstance(value, torch.Tensor) and value.dtype == torch.float32
    return value.half() if is_single else value


def _dressed(value: Any, known: dict[int, PretendedTensor], func: Any) -> Any:
    """Wrap a result; operations in place return the same object."""
    before = known.get(id(value))
    if before is None:
        return wrapped(value)
    if before.shape != value.shape or before.stride() != value.stride():
        raise NotImplementedError(f"{func} changes the shape of a pretended tensor in place")
    return before


def _check_devices(func: Any, args: Any, flat: list[Any]) -> None:
    """Refuse tensors of two devices where CUDA does."""
    plain = [v for v in flat if isinstance(v, torch.Tensor) and not isinstance(v, PretendedTensor)]
    if not plain or func in COPIES:
        return
    indices: list[Any] = []
    if func in INDEXING:
        if not isinstance(args[0], PretendedTensor):
            raise RuntimeError(
                "indices should be either on cpu or on the same device as the indexed tensor (cpu)"
            )
        indices = [index for index in args[1] if index is not None]
    takes_numbers = func in TAKES_NUMBERS or torch.Tag.pointwise in func.tags
    changed = [
        value for value, argument in zip(args, func._schema.arguments)
        if argument.alias_info is not None and argument.alias_info.is_write
    ]  # fmt: skip
    for value in plain:
        number = takes_numbers and value.ndim == 0 and not any(value is one for one in changed)
        if not number and not any(value is index for index in indices):
            raise RuntimeError(
                "Expected all tensors to be on the same device, "
                f"but found at least two devices, cuda:0 and cpu! ({func})"
            )


def _count_waits(func: Any, args: Any, kwargs: dict[str, Any], lands_on_gpu: bool) -> None:
    """Count the operations at which the host would wait for the device."""
    if func in READS or func in DECIDES_SIZES:
        waits[str(func)] += 1
    elif func in INDEXING and any(i is not None and i.dtype in (torch.bool, torch.uint8) for i in args[1]):
        waits["index by a mask"] += 1
    elif func in INDEXING and any(i is not None and not isinstance(i, PretendedTensor) for i in args[1]):
        waits["index by a CPU tensor"] += 1
    elif func in (aten._to_copy.default, aten.copy_.default):
        source = args[1] if func is aten.copy_.default else args[0]
        from_gpu = isinstance(source, PretendedTensor)
        asynchronous = kwargs.get("non_blocking") or (func is aten.copy_.default and args[2:3] == (True,))
        if from_gpu != lands_on_gpu and not (asynchronous and not from_gpu):
            waits["copy to the host" if from_gpu else "copy from the host"] += 1


def _check_generator(kwargs: dict[str, Any], lands_on_gpu: bool) -> None:
    """Refuse a generator of the CPU for random numbers on the GPU, and the other way round."""
    given = kwargs.get("generator")
    if given is not None and (given._cdata in _generators) != lands_on_gpu:
        raise RuntimeError("Expected a generator of the tensors' own device, but found one of the other")


@contextlib.contextmanager
def _own_randomness() -> Iterator[None]:
    """Random numbers of the GPU are not those of the CPU."""
    global _own_random_state
    with _random_lock:
        outside = torch.get_rng_state()
        torch.set_rng_state(_own_random_state)
        try:
            yield
        finally:
            _own_random_state = torch.get_rng_state()
            torch.set_rng_state(outside)


def _set_state(state: torch.Tensor, device: Any = "cuda") -> None:
    global _own_random_state
    _own_random_state = state.clone()


_torch_autocast = torch.autocast


@contextlib.contextmanager
def _autocast(device_type: str, *args: Any, enabled: bool = True, **kwargs: Any) -> Iterator[None]:
    if device_type != "cuda":
        with _torch_autocast(device_type, *args, enabled=enabled, **kwargs):
            yield
        return
    before = getattr(_thread, "half", False)
    _thread.half = enabled
    try:
        yield
    finally:
        _thread.half = before


_torch_to = torch.Tensor.to


def _to(self: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
    """`torch.Tensor.to`; for "cuda" without an index, torch's C++ code would query CUDA for the current device."""
    args = tuple(DEVICE if isinstance(a, (str, torch.device)) and _is_cuda(a) else a for a in args)
    if kwargs.get("device") is not None and _is_cuda(kwargs["device"]):
        kwargs["device"] = DEVICE
    return _torch_to(self, *args, **kwargs)


def _pinned(self: torch.Tensor) -> torch.Tensor:
    """A copy in pinned memory; only ``non_blocking`` determines whether a wait is counted."""
    if isinstance(self, PretendedTensor):
        raise RuntimeError("cannot pin 'torch.cuda.FloatTensor' only dense CPU tensors can be pinned")
    return self.clone()


def _made_on_the_host(make: Any) -> Any:
    """Creates the tensor on the CPU and copies it; torch's C++ code would require CUDA for the copy."""

    def made(data: Any, *, device: Any = None, requires_grad: bool = False, **options: Any) -> torch.Tensor:
        found = make(data, **options)
        if device is not None:
            found = found.to(device)
        return found.requires_grad_() if requires_grad else found

    return made


_CUDA = {
    "_lazy_init": lambda: None,
    "is_available": lambda: True,
    "is_initialized": lambda: True,
    "device_count": lambda: 1,
    "current_device": lambda: 0,
    "get_device_name": lambda device=None: NAME,
    "get_device_capability": lambda device=None: (9, 0),
    "is_bf16_supported": lambda including_emulation=True: True,
    "is_current_stream_capturing": lambda: False,
    "empty_cache": lambda: None,
    "synchronize": lambda device=None: waits.update(["synchronize"]),
    "reset_peak_memory_stats": lambda device=None: None,
    "max_memory_allocated": lambda device=None: 1 << 20,
    "memory_allocated": lambda device=None: 1 << 20,
    "mem_get_info": lambda device=None: (1 << 34, 1 << 35),
    "get_rng_state": lambda device="cuda": _own_random_state.clone(),
    "set_rng_state": _set_state,
}


@contextlib.contextmanager
def pretending(monkeypatch: Any) -> Iterator[Counter[str]]:
    """A pretended GPU in this thread and in threads started inside the block; yields `waits`."""
    for name, stand_in in _CUDA.items():
        monkeypatch.setattr(torch.cuda, name, stand_in)
    monkeypatch.setattr(torch.accelerator, "current_accelerator", lambda **_: None)  # it asks a driver
    monkeypatch.setattr(torch, "Generator", PretendedGenerator)
    run = threading.Thread.run

    def run_on_gpu(self: threading.Thread) -> None:
        with PretendedGPU():
            run(self)

    monkeypatch.setattr(threading.Thread, "run", run_on_gpu)
    waits.clear()
    _generators.clear()
    monkeypatch.setattr(torch, "autocast", _autocast)
    monkeypatch.setattr(torch.Tensor, "to", _to)
    monkeypatch.setattr(torch.Tensor, "pin_memory", _pinned)
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self, *_, **__: self.to(DEVICE))
    torch.utils._device._device_constructors()  # caches the constructors before they are replaced
    for name in ("tensor", "as_tensor"):
        monkeypatch.setattr(torch, name, _made_on_the_host(getattr(torch, name)))
    with PretendedGPU():
        yield waits
