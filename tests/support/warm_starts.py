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


def run_warm(
    libraries: Sequence[str], *groups: Sequence[Program], environment: Mapping[str, str] = NONE
) -> list[Ended]:
    """Run programs that find some libraries imported.

    Args:
        libraries: Modules to import before the forks; an import must start no thread.
        *groups: Programs that run at the same time; the groups run one after the other.
        environment: Variables that are set before the imports.

    Returns:
        The ends of all programs, in the order given.
    """
    task = {"libraries": list(libraries), "groups": [[asdict(one) for one in group] for group in groups]}
    done = subprocess.run(
        [sys.executable, __file__],
        input=json.dumps(task),
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


def main() -> None:
    task = json.load(sys.stdin)
    sys.path[0] = ""  # as of `python -c`; it was the folder of this file
    for name in task["libraries"]:
        importlib.import_module(name)
    ended = []
    with tempfile.TemporaryDirectory() as folder:
        for group in task["groups"]:
            running = []
            for one in group:
                outputs = tuple(f"{folder}/{len(ended)}_{len(running)}.{name}" for name in ("out", "err"))
                running.append((_start(Program(**one), outputs), outputs))
            for child, outputs in running:
                _, status = os.waitpid(child, 0)
                texts = [Path(path).read_text(errors="replace") for path in outputs]
                ended.append(asdict(Ended(os.waitstatus_to_exitcode(status), *texts)))
    print(json.dumps(ended))


if __name__ == "__main__":
    main()
