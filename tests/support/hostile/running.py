"""Runs hostile readers in a process of its own; its arguments are WORK_FOLDER REPORT.json CLAIMS_FOLDER.

Several processes share the readers: each takes the next one that no other has claimed. Once everything is imported
and a reader has read its valid input, the process may take one more gigabyte of memory (RLIMIT_DATA), and each input
may take `SECONDS`. Every exception must be a typed error of lexsplat, and every result must pass the reader's check.
Before each input, its content and its name are written to disk, so that a crash can be traced.
"""

from __future__ import annotations

import contextlib
import json
import re
import resource
import shutil
import signal
import sys
import time
import warnings
from collections import Counter
from dataclasses import dataclass, field
from io import RawIOBase
from pathlib import Path
from typing import Any

import numpy as np

from support.hostile import READERS, Reader

SECONDS = 5.0
GIGABYTE = 1 << 30
BASE_BYTES = 3 << 28
"""Memory of the process before any input: torch, Numba's kernels and other libraries."""
NAME_BYTES = 120
"""Names are padded: a file that is emptied and written again waits for the disk each time."""


PYTHON = re.compile(
    r"requires a buffer|Expecting|object is not|has no attribute|index out of range|could not|codec|invalid literal|"
    r"unsupported operand|not supported between|must be|too many values|not enough values|Errno|Traceback"
)
"""Parts of the texts of Python's own errors."""


class Hang(BaseException):
    """An input took longer than `SECONDS`."""


def interrupt(number: int, frame: Any) -> None:
    raise Hang


@dataclass
class Report:
    """Results of all inputs of a reader."""

    inputs: int = 0
    errors: Counter = field(default_factory=Counter)
    kinds: Counter = field(default_factory=Counter)
    right: int = 0
    failures: list[str] = field(default_factory=list)
    peak: int = 0
    seconds: float = 0.0

    def data(self) -> dict[str, Any]:
        return {**vars(self), "errors": dict(self.errors), "kinds": dict(self.kinds)}


def summary(result: Any) -> bytes:
    """Bytes that are equal for equal results."""
    import torch

    if hasattr(result, "gaussians"):
        return summary([result.gaussians, list(result.field.tensors().values()), repr(result.views)])
    if hasattr(result, "tensors"):
        return summary(list(result.tensors().values()))
    if isinstance(result, (torch.Tensor, np.ndarray)):
        return np.asarray(result).tobytes()
    if isinstance(result, (list, tuple)):
        return b"|".join(map(summary, result))
    return repr(result).encode("utf-8", "replace")


def attempt(target: Reader, folder: Path, report: Report, about: str, whole: bytes | None) -> None:
    """Read once and check the result; ``whole`` is the summary that it must yield, if it is read."""
    from lexsplat.runtime.errors import LexsplatError

    allowed = (LexsplatError, ValueError) if target.value_errors else (LexsplatError,)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        result = target.read(folder)
        target.check(result)
        assert whole is None or summary(result) == whole, "a part of the file was read as the whole"
        report.right += 1
    except allowed as error:
        report.errors[type(error).__name__] += 1
        if "\n" in str(error) or not str(error):
            report.failures.append(f"{about}: not one line: {error!r}")
        if target.told and (not getattr(error, "remedy", "") or PYTHON.search(str(error))):
            report.failures.append(f"{about}: no remedy, or a text of Python: {error!r}")
    except Hang:
        report.failures.append(f"{about}: not finished after {SECONDS:g} s")
    except (Exception, MemoryError) as error:
        where = error.__traceback__
        while where is not None and where.tb_next is not None:
            where = where.tb_next
        place = f"{Path(where.tb_frame.f_code.co_filename).name}:{where.tb_lineno}" if where else ""
        report.failures.append(f"{about}: {type(error).__name__} at {place}: {str(error)[:300]}")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def run_reader(name: str, work: Path, tried: RawIOBase) -> Report:
    """Run the mutations of one reader; the file ``tried`` begins with the name of the one in progress."""
    target, report = READERS[name](), Report()
    folder = work / name
    folder.mkdir(parents=True)
    target.make(folder)
    good = target.read(folder)
    target.check(good)
    # All inputs are a few kilobytes: one more gigabyte is ample.
    limit = _data_bytes() + GIGABYTE
    resource.setrlimit(resource.RLIMIT_DATA, (limit, resource.RLIM_INFINITY))
    whole = summary(good)
    for number, (file, mutations) in enumerate(target.mutations.items()):
        path = folder / file
        content = path.read_bytes()
        for index, (kind, changed) in enumerate(mutations(content, np.random.default_rng(number))):
            about = f"{name} {file} {kind} {index}"
            tried.seek(0)
            tried.write(about.ljust(NAME_BYTES).encode())
            path.write_bytes(changed)
            report.inputs += 1
            report.kinds[kind] += 1
            complete = kind == "recounted" or (kind == "truncated" and file in target.exact)
            attempt(target, folder, report, about, whole if complete else None)
            if len(report.failures) >= 200:
                break
        path.write_bytes(content)
    resource.setrlimit(resource.RLIMIT_DATA, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    shutil.rmtree(folder)
    return report


def _data_bytes() -> int:
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData"))


def _claim(path: Path) -> bool:
    """Whether this process is the first to ask for a reader."""
    try:
        path.touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def main() -> None:
    """Run the readers that no other process has claimed."""
    work, output, claims = map(Path, sys.argv[1:])
    import logging

    import torch

    torch.set_num_threads(1)
    logging.getLogger("lexsplat").setLevel(logging.CRITICAL)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, interrupt)
    reports: dict[str, Any] = {}
    for name in READERS:
        if not _claim(claims / name):
            continue
        start = time.process_time()
        with contextlib.redirect_stdout(sys.stderr), open(output.with_suffix(".current"), "wb", 0) as tried:
            report = run_reader(name, work, tried)
        report.peak = _peak()
        report.seconds = round(time.process_time() - start, 2)
        reports[name] = report.data()
        output.write_text(json.dumps(reports, indent=1))


def _peak() -> int:
    """Largest memory of this process in bytes. (Linux hands ``ru_maxrss`` on from the process that started it.)"""
    return int(re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[1]) * 1024
