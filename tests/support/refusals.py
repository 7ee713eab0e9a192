"""Checks that an error names its subject and what was expected."""

from __future__ import annotations

import pytest

from lexsplat.captures import load_capture
from lexsplat.runtime.errors import CaptureError, LexsplatError


def assert_tells(error: LexsplatError, *parts: str) -> None:
    """Assert that the message states subject, expected, found and remedy in one line, and contains ``parts``."""
    message = str(error)
    assert error.subject
    assert error.expected
    assert error.found
    assert error.remedy
    assert all(text in message for text in ("expected", "found", "; "))
    assert "\n" not in message
    for part in parts:
        assert part in message, message


def fails(path, *parts, kind=CaptureError, **options):
    with pytest.raises(kind) as caught:
        load_capture(path, **options)
    assert_tells(caught.value, *parts)
