"""Checks of the command line."""

from __future__ import annotations

import io
from pathlib import Path

from lexsplat import cli


class Terminal(io.StringIO):
    """Standard input that reports to be a terminal."""

    def isatty(self) -> bool:
        return True


def modified(folder: Path) -> dict[str, int]:
    """Modification time of each file in a folder."""
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


def fails_in_one_line(capsys, arguments: list[str], *words: str) -> None:
    """Assert that a command ends with status 1 and one line that contains the given words."""
    assert cli.main(arguments) == 1
    captured = capsys.readouterr()
    lines = [line for line in captured.err.replace("[y/N] ", "\n").splitlines() if line.startswith("error:")]
    assert len(lines) == 1, captured.err
    assert "Traceback" not in captured.err
    for word in words:
        assert word in lines[0], lines[0]
