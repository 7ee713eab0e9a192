"""Result files of the benchmarks: rows with the command, the commit and the machine that made them."""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lexsplat.runtime.environment import machine_facts
from lexsplat.runtime.files import write_json

REPOSITORY = Path(__file__).parents[1]
RESULTS = REPOSITORY / "benchmarks" / "results"
"""Where `benchmarks/tables.py` reads result files."""


def argument_parser(description: str | None, *, json_option: bool = True) -> argparse.ArgumentParser:
    """A parser whose help keeps the lines of ``description``, with the option ``--json FILE``."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if json_option:
        parser.add_argument(
            "--json", type=Path, metavar="FILE", help="also write the results to FILE (benchmarks/results/)"
        )
    return parser


def write_record(path: Path | None, rows: Sequence[Mapping[str, Any]], **facts: Any) -> None:
    """Write rows with command, commit and machine; nothing if ``path`` is None.

    Args:
        path: The file.
        rows: One dictionary of plain data for each line of the table.
        facts: Further conditions, such as the number of threads.
    """
    if path is not None:
        made_by = {"command": command(), "commit": commit(), "machine": machine_facts()}
        write_json(path, {**made_by, **facts, "rows": list(rows)})
        print(f"written to {path}", file=sys.stderr)


def command() -> str:
    """The command line of this process, without the folder of the interpreter and of the script."""
    script = Path(sys.argv[0]).name
    return shlex.join(["python", f"benchmarks/{script}", *sys.argv[1:]])


def commit() -> str:
    """The last commit that changed ``src/``, with ``-dirty`` for uncommitted changes there.

    Commits that change documentation or result files only do not make results of another program.
    """
    last = _git("log", "-1", "--format=%H", "--", "src")
    if not last:
        return "unknown"
    dirty = "-dirty" if _git("status", "--porcelain", "--", "src") else ""
    return (_git("describe", "--always", "--abbrev=9", last) or last[:9]) + dirty


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(["git", *arguments], cwd=REPOSITORY, capture_output=True, text=True)
    except OSError:  # git is not installed
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
