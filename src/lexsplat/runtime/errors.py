"""Errors that a user can act on: one line with the subject, the expectation, the finding and the remedy.

Library code raises them for files, captures, models and backends; only the command line catches them. Invalid
arguments of Python functions raise ``ValueError``.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing_extensions import Self

STOPPED = "stopped; run the same command again to go on"
"""Message after Ctrl-C."""


class LexsplatError(Exception):
    """Base of every error that has a remedy.

    Args:
        subject: The file, value or option with the error.
        expected: A valid content or value.
        found: The actual content or value.
        remedy: Advice to the user.

    Attributes:
        crashes_at_exit: Whether what is left in the process would crash at its exit, so that the command line ends it
            at once.
    """

    crashes_at_exit = False

    def __init__(self, subject: object, *, expected: str = "", found: str = "", remedy: str = "") -> None:
        self.subject = str(subject)
        self.expected = expected
        self.found = found
        self.remedy = remedy
        super().__init__(str(self))

    def __str__(self) -> str:
        sides = (("expected", self.expected), ("found", self.found))
        clauses = [f"{word} {text}" for word, text in sides if text]
        message = ": ".join(part for part in (self.subject, ", ".join(clauses)) if part)
        if self.remedy:
            message = f"{message}; {self.remedy}"
        return " ".join(message.split())

    def with_remedy(self, remedy: str) -> Self:
        """The same error with other advice, from one who knows what the subject is used for."""
        return type(self)(self.subject, expected=self.expected, found=self.found, remedy=remedy)

    def __reduce__(self) -> tuple:
        fields = {"expected": self.expected, "found": self.found, "remedy": self.remedy}
        return (partial(type(self), self.subject, **fields), ())


class CaptureError(LexsplatError):
    """Photos, cameras or masks are unusable."""


class FileFormatError(LexsplatError):
    """The content of a file does not match its format."""


class SceneFolderError(LexsplatError):
    """A scene folder is missing, unfinished or of another version."""


class LibraryError(LexsplatError):
    """A library of scenes is missing, damaged or in use, or its index server cannot answer."""


class ModelError(LexsplatError):
    """An encoder cannot be found or loaded."""


class BackendError(LexsplatError):
    """A device or rasterizer is not available."""


class MemoryBudgetError(LexsplatError):
    """A stage does not fit into its memory budget."""


class QueryError(LexsplatError):
    """A query is invalid, such as an empty prompt."""


class TrainingError(LexsplatError):
    """A training diverged or has nothing to optimize."""


class WorkersError(LexsplatError):
    """A cluster cannot be used, has disappeared, or lost a task for good."""


class TaskError(LexsplatError):
    """A task failed by an error of the system or of the program."""
