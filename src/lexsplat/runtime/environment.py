"""The machine and the versions of the packages that results depend on."""

from __future__ import annotations

import functools
import os
import platform
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from lexsplat.runtime.fingerprints import digest


def machine_facts() -> dict[str, Any]:
    """The machine as JSON data: platform, CPU, cores, GPU and package versions."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "platform": platform.platform(),
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "gpu": gpu,
        "versions": {"lexsplat": version_of_lexsplat(), **versions()},
    }


def version_of_lexsplat() -> str:
    """Version of the installed package."""
    return version("lexsplat")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that affect results."""
    found = {"python": platform.python_version()}
    for package in ("torch", "numpy", "numba", "gsplat", "pycolmap", "transformers"):
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


@functools.cache
def code_identity() -> str:
    """Hash of lexsplat's source code; stored measurements are valid for one version of it."""
    package = Path(__file__).parents[1]
    files = sorted(package.rglob("*.py"))
    return digest(f.relative_to(package).as_posix().encode() + b"\0" + f.read_bytes() + b"\0" for f in files)


def _cpu_name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
