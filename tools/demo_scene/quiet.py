"""Suppress Blender's messages on standard output."""

from __future__ import annotations

import os
from collections.abc import Callable


def quiet_output() -> Callable[[str], None]:
    """Redirect standard output to the null device; returns a function that still prints a line to the user."""
    user = os.fdopen(os.dup(1), "w")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)

    def say(line: str) -> None:
        user.write(line + "\n")
        user.flush()

    return say
