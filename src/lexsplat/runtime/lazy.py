"""Loading modules quickly: packages import their public names at first use, without garbage collection."""

from __future__ import annotations

import gc
import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any


def at_first_use(package: str, modules: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """A function for a package's ``__getattr__``.

    Args:
        package: Name of the package.
        modules: Public names by the module, relative to the package, that defines them.
    """
    homes = {name: f"{package}.{module}" for module, names in modules.items() for name in names}

    def attribute(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(homes[name]), name)

    return attribute


def at_first_call(module: str, name: str) -> Callable[..., Any]:
    """A function that imports the one it stands for when it is called, such as a method that few programs call."""

    def call(*arguments: Any) -> Any:
        return getattr(importlib.import_module(module), name)(*arguments)

    return call


@contextmanager
def without_collection() -> Iterator[None]:
    """Pause the collection of cyclic garbage while modules load, and exempt what they leave from later ones.

    Modules live as long as the process, and the collector would walk through torch's several times: 15% of the time
    of its import.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.freeze()
            gc.enable()
