"""How many threads share a sum."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch


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
