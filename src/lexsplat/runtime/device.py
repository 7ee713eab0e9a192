"""The device, the number of threads, and the seeds that all libraries accept."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextvars import ContextVar
from functools import partial
from typing import Literal

import torch

from lexsplat.runtime.errors import BackendError


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run torch on ``count`` CPU threads inside the block; also usable as a decorator."""
    threads = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


one_thread = partial(torch_threads, 1)
"""The last bit of a floating-point sum depends on the order of addition, which depends on the number of threads and
on the load of the machine. One thread gives reproducible bits."""

if hasattr(os, "register_at_fork"):
    # The threads of torch do not survive a fork: an operation on several would wait for them without end.
    os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))

_kernel_threads: ContextVar[int | None] = ContextVar("kernel_threads", default=None)


@contextlib.contextmanager
def threads_for_kernels(count: int = 1) -> Iterator[None]:
    """Run torch on ``count`` threads inside the block at most, and compiled kernels on as many as torch used before.

    The threads of torch wait by spinning. Where its operations take less than a millisecond, as those between the
    kernels of a view do, that costs more processor time than they.
    """
    token = _kernel_threads.set(kernel_threads())
    try:
        with torch_threads(max(1, min(count, torch.get_num_threads()))):
            yield
    finally:
        _kernel_threads.reset(token)


def kernel_threads() -> int:
    """Number of threads on which a compiled kernel runs."""
    return _kernel_threads.get() or torch.get_num_threads()


def choose_device(wanted: str) -> Literal["cpu", "cuda"]:
    """Resolve "auto", "cpu" or "cuda" to "cpu" or "cuda".

    Raises:
        BackendError: If CUDA is requested but not available.
        ValueError: If the name is not one of these.
    """
    if wanted not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device must be auto, cpu or cuda, got {wanted!r}")
    if wanted == "cpu":
        return "cpu"
    available = torch.cuda.is_available()
    if wanted == "cuda" and not available:
        found = "none" if torch.version.cuda else "a PyTorch built for the CPU only"
        raise BackendError("--device cuda", expected="a CUDA GPU", found=found, remedy="use --device cpu")
    return "cuda" if available else "cpu"


def choose_encoder_device(wanted: str, device: str) -> str:
    """Resolve the device of the encoders to "cpu", "cuda" or "mps".

    Args:
        wanted: "auto" (that of the rasterizer), "cpu", "cuda" or "mps" (the GPU of a Mac).
        device: Device of the rasterizer: "cpu" or "cuda".

    Raises:
        BackendError: If the device is requested but not available.
        ValueError: If the name is not one of these.
    """
    if wanted not in ("auto", "cpu", "cuda", "mps"):
        raise ValueError(f"encoder_device must be auto, cpu, cuda or mps, got {wanted!r}")
    if wanted == "auto":
        return device
    there = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if not there[wanted]:
        raise BackendError(
            f"--encoder-device {wanted}",
            expected=f"a PyTorch with a GPU of this kind ({wanted})",
            found=", ".join(name for name, found in there.items() if found),
            remedy="use --encoder-device cpu",
        )
    return wanted


def check_seed(seed: int) -> None:
    """Refuse a seed that one of the libraries does not accept.

    Raises:
        ValueError: If it is negative or has more than 31 bits.
    """
    if not 0 <= seed < 2**31:
        raise ValueError(f"seed must be in 0..{2**31 - 1}, got {seed}")
