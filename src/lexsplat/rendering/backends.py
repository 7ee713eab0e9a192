"""The one place that chooses the rasterizer: our CPU kernels or gsplat."""

from __future__ import annotations

from types import ModuleType

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.runtime.errors import BackendError


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


def require_gsplat() -> None:
    """Load the CUDA rasterizer.

    Raises:
        BackendError: If it is not installed, or has no CUDA extension and no compiler to build it with.
    """
    from lexsplat.rendering import gsplat_backend

    gsplat_backend.require_gsplat()
