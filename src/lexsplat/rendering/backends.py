"""The one place that chooses the rasterizer: our CPU kernels or gsplat."""

from __future__ import annotations

import functools
import logging
from types import ModuleType
from typing import Literal

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.device import choose_device
from lexsplat.runtime.errors import BackendError
from lexsplat.runtime.progress import NOTE

log = logging.getLogger("lexsplat")


def backend_for(gaussians: Gaussians) -> ModuleType:
    """The rasterizer for the device of the Gaussians: `cpu_backend` or `gsplat_backend`.

    Raises:
        BackendError: If there is none for this device.
    """
    device = gaussians.device.type
    if device == "cpu":
        from lexsplat.rendering import cpu_backend

        return cpu_backend
    if device == "cuda":
        from lexsplat.rendering import gsplat_backend

        return gsplat_backend
    raise BackendError(
        "rasterizer",
        expected="Gaussians on the CPU or a CUDA device",
        found=f"Gaussians on {device}",
        remedy='move them with gaussians.to("cpu")',
    )


def choose_rasterizer(wanted: str) -> Literal["cpu", "cuda"]:
    """Resolve "auto", "cpu" or "cuda" to the device on which a finished scene is rendered.

    Where gsplat cannot render on the GPU, "auto" takes the CPU and logs why. A build refuses such a machine
    (`require_gsplat`), because Gaussians made on a CPU are others.

    Raises:
        BackendError: If CUDA is requested, and there is no GPU or gsplat cannot render on it.
        ValueError: If the name is not one of these.
    """
    device = choose_device(wanted)
    if wanted == "cuda":
        require_gsplat()
    return "cpu" if device == "cuda" and wanted == "auto" and missing_gsplat() else device


@functools.cache
def missing_gsplat() -> str:
    """Why gsplat cannot render, "" if it can; a process tries once, because a compiler may take minutes to fail."""
    try:
        require_gsplat()
    except BackendError as error:
        remedy = "rendering on the CPU (--device cuda states how to use the GPU)"
        log.log(NOTE, "%s", reason := str(error.with_remedy(remedy)))
        return reason
    return ""


def require_gsplat(instead: str = "--device cpu") -> None:
    """Load the CUDA rasterizer.

    Args:
        instead: Options of the command with which it runs without gsplat, for the error.

    Raises:
        BackendError: If it is not installed, or has no CUDA extension and no compiler to build it with.
    """
    from lexsplat.rendering import gsplat_backend

    gsplat_backend.require_gsplat(instead)
