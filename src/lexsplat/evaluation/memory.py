"""Peak memory of the process."""

from __future__ import annotations

import gc
import re
import sys
from contextlib import suppress
from pathlib import Path

import torch

from lexsplat.runtime.memory import give_back_freed

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_memory() -> int | None:
    """Peak resident size of this process in bytes since the last successful `forget_peak_memory`, or since its start.

    None if the system does not report it.
    """
    with suppress(OSError):
        found = re.search(r"^VmHWM:\s*(\d+) kB", _STATUS.read_text(), flags=re.MULTILINE)
        if found:
            return 1024 * int(found[1])
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def peak_gpu_memory(device: torch.device | str) -> int | None:
    """Peak bytes of tensors on a GPU since `forget_peak_memory`; None for other devices."""
    device = torch.device(device)
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None


def forget_peak_memory() -> bool:
    """Reset the peaks of host and GPU memory; False if the system does not support it (not Linux).

    Freed memory is returned to the system first. Otherwise the allocator would keep it, and it would count for the
    next measurement.
    """
    gc.collect()
    give_back_freed()
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    try:
        _CLEAR.write_text("5")
    except OSError:
        return False
    return True
