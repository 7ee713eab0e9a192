"""Checks that an error names its subject and what was expected."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from lexsplat.captures import load_capture
from lexsplat.runtime.errors import CaptureError, FileFormatError, LexsplatError
from lexsplat.scenes.formats.reading import read_splats

if TYPE_CHECKING:
    from lexsplat.pipeline.config import BuildConfig


def assert_reports(error: LexsplatError, *parts: str) -> None:
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
    assert_reports(caught.value, *parts)


def build_refused(
    sources: Iterable[Path], output: Path, config: BuildConfig, *parts: str, kind: type[LexsplatError]
) -> None:
    """Assert that a build of each source is refused in one line, and leaves no folder."""
    from lexsplat.pipeline.build import build

    for source in sources:
        with pytest.raises(kind) as caught:
            build(source, output, config)
        assert_reports(caught.value, *parts)
        assert not output.exists(), "nothing half-written"


def refused(path: Path, content: bytes, *parts: str) -> str:
    """Assert that splats with this content are refused in one line; returns it."""
    path.write_bytes(content)
    with pytest.raises(FileFormatError) as caught:
        read_splats(path)
    assert_reports(caught.value, *parts)
    return str(caught.value)
