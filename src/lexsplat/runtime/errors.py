"""Errors a person can act on: one line that names the thing, what was expected, what was found, what to do.

Only the command line catches these; library code raises them for files, captures, models and backends.
Bad arguments of Python functions raise ``ValueError`` as usual.
"""

from __future__ import annotations

STOPPED = "stopped; run the same command again to go on"
"""What Ctrl-C ends in, at any moment."""


class LexsplatError(Exception):
    """Base of every error that has a remedy.

    Args:
        subject: The file, value or option the error is about.
        expected: What would have been right.
        found: What was there instead.
        remedy: What the person can do now.
    """

    def __init__(self, subject: object, *, expected: str = "", found: str = "", remedy: str = "") -> None:
        self.subject = str(subject)
        self.expected = expected
        self.found = found
        self.remedy = remedy
        super().__init__(str(self))

    def __str__(self) -> str:
        clauses = []
        if self.expected:
            clauses.append(f"expected {self.expected}")
        if self.found:
            clauses.append(f"found {self.found}")
        message = ": ".join(part for part in (self.subject, ", ".join(clauses)) if part)
        if self.remedy:
            message = f"{message}; {self.remedy}"
        return " ".join(message.split())

    def __reduce__(self) -> tuple:
        fields = {"expected": self.expected, "found": self.found, "remedy": self.remedy}
        return (_rebuild, (type(self), self.subject, fields))


def _rebuild(kind: type[LexsplatError], subject: str, fields: dict[str, str]) -> LexsplatError:
    return kind(subject, **fields)


class CaptureError(LexsplatError):
    """Photos, cameras or masks that cannot be used."""


class FileFormatError(LexsplatError):
    """A file whose content is not what its format promises."""


class SceneFolderError(LexsplatError):
    """A scene folder that is missing, unfinished or of another version."""


class ModelError(LexsplatError):
    """An encoder that cannot be found or loaded."""


class BackendError(LexsplatError):
    """A device or rasterizer that is not available here."""


class MemoryBudgetError(LexsplatError):
    """A stage that cannot be done within the memory that it is given."""


class QueryError(LexsplatError):
    """A question that cannot be asked, such as an empty prompt."""


class TrainingError(LexsplatError):
    """Optimization that diverged or has nothing to optimize."""
