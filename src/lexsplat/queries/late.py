"""Regular expressions that are compiled when they are first used.

The grammar has two hundred. To compile them all takes a quarter of a second, which a command that is asked nothing,
such as ``lexsplat info``, need not wait for.
"""

from __future__ import annotations

import re
from functools import cached_property
from typing import Any, cast


class _Late:
    def __init__(self, pattern: str, flags: int) -> None:
        self.pattern, self._flags = pattern, flags

    @cached_property
    def _compiled(self) -> re.Pattern[str]:
        return re.compile(self.pattern, self._flags)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        found = getattr(self._compiled, name)
        self.__dict__[name] = found  # the next access is as fast as that of a compiled pattern
        return found


def late(pattern: str, flags: int = 0) -> re.Pattern[str]:
    """What ``re.compile`` returns, for all that asks it for methods and attributes.

    An error in the pattern is raised at its first use.
    """
    return cast("re.Pattern[str]", _Late(pattern, flags))
