"""Where work runs: the device, how many threads share a sum, which seeds are taken."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch

from lexsplat.runtime.errors import BackendError


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread of the CPU inside, also as a decorator.

    Floating-point sums depend on their order in the last bit, and several threads order them by how many they are and
    by how busy the machine is. What has to come out the same everywhere is computed by one.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def choose_device(wanted: str) -> str:
    """ "cpu" or "cuda" from "auto", "cpu" or "cuda".

    Raises:
        BackendError: If CUDA is asked for and there is none.
        ValueError: If the name is another one.
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


def check_seed(seed: int) -> None:
    """Refuse a seed that one of the libraries does not take.

    Raises:
        ValueError: If it is negative or has more than 31 bits.
    """
    if not 0 <= seed < 2**31:
        raise ValueError(f"seed must be in 0..{2**31 - 1}, got {seed}")
