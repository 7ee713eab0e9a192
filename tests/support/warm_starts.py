"""Runs programs in forks of one process that has imported some libraries: a start of torch alone takes a second.

A program begins as a new interpreter does that has imported these libraries, and nothing of lexsplat.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType

NONE: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class Program:
    """Code to run.

    Args:
        code: Python.
        arguments: Its ``sys.argv[1:]``.
        folder: Its working directory; "" keeps that of the tests.
        environment: Variables to set.
    """

    code: str
    arguments: Sequence[str] = ()
    folder: str = ""
    environment: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Ended:
    """What a program has written, and its exit status, negative if a signal ended it."""

    status: int
    out: str
    err: str


@dataclass(frozen=True)
class Stage:
    """Programs that find some libraries imported.

    Args:
        libraries: Modules to import before the forks, beside those of the stages before; an import must start no
            thread.
        groups: Programs that run at the same time; the groups run one after the other.
    """

    libraries: Sequence[str]
    groups: Sequence[Sequence[Program]]


def run_warm(*stages: Stage, environment: Mapping[str, str] = NONE) -> list[Ended]:
    """Run programs in forks of one process; what a stage has imported stays for the next.

    Args:
        *stages: What to import, and what to run then.
        environment: Variables that are set before the imports.

    Returns:
        The ends of all programs, in the order given.
    """
    done = subprocess.run(
        [sys.executable, __file__],
        input=json.dumps([asdict(stage) for stage in stages]),
        capture_output=True,
        text=True,
        timeout=900,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return [Ended(**one) for one in json.loads(done.stdout)]


def _start(program: Program, outputs: tuple[str, str]) -> int:
    """Start a program in a fork; its output goes to two files."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        for number, path in enumerate(outputs, start=1):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
        if program.folder:
            os.chdir(program.folder)
        os.environ.update(program.environment)
        sys.argv = ["-c", *program.arguments]
        exec(compile(program.code, "<program>", "exec"), {"__name__": "__main__"})
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _run_together(group: list[dict], folder: str) -> list[Ended]:
    running, ended = [], []
    for number, one in enumerate(group):
        outputs = (f"{folder}/{number}.out", f"{folder}/{number}.err")
        running.append((_start(Program(**one), outputs), outputs))
    for child, outputs in running:
        _, status = os.waitpid(child, 0)
        texts = [Path(path).read_text(errors="replace") for path in outputs]
        ended.append(Ended(os.waitstatus_to_exitcode(status), *texts))
    return ended


def main() -> None:
    sys.path[0] = ""  # as of `python -c`; it was the folder of this file
    ended = []
    for stage in json.load(sys.stdin):
        for name in stage["libraries"]:
            importlib.import_module(name)
        for group in stage["groups"]:
            with tempfile.TemporaryDirectory() as folder:
                ended += map(asdict, _run_together(group, folder))
    print(json.dumps(ended))


if __name__ == "__main__":
    main()
