"""The demo beside that of another commit: wall and processor seconds, peak memory and quality, in one run.

    python benchmarks/demo_time.py --base d4e65b3 [--repeats 9] [--seeds 0 1 2] [--json FILE]

Whole runs of `lexsplat demo` alternate, each in a fresh folder, and so does which version runs first. One short run
of each before the measured ones compiles the kernels. Repeats take turns with the seeds: the table has the spread of
each quality over them.
"""

from __future__ import annotations

import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from records import REPOSITORY, argument_parser, write_record
from time_to_quality import base_source

CLOCKS = ("wall", "processor", "peak_gb")


def run(source: Path, seed: int, steps: int | None = None) -> dict[str, Any]:
    """One run of the demo from the packages in ``source``: its clocks, and its quality by name."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["-m", "lexsplat", "demo", "--output", folder, "--seed", str(seed)]
        words += ["--iterations", str(steps)] if steps else []
        start = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, *words],
            env={**os.environ, "PYTHONPATH": str(source)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - start
        if process.returncode:
            raise SystemExit(f"the demo of {source} ended with status {process.returncode}")
        content = json.loads(next(Path(folder).rglob("metrics.json")).read_text())
    return {
        "wall": wall,
        "processor": usage.ru_utime + usage.ru_stime,
        "peak_gb": usage.ru_maxrss * 1024 / 1e9,
        "quality": numbers({"quality": content["quality"], "language": content["language"]}),
    }


def numbers(content: Mapping[str, Any], within: str = "", depth: int = 3) -> dict[str, float]:
    """The numbers of nested sections by their path, without those of single views and prompts."""
    found: dict[str, float] = {}
    for name, value in content.items():
        if isinstance(value, Mapping):
            if depth and not name.startswith("per_"):
                found |= numbers(value, f"{within}{name}.", depth - 1)
        elif isinstance(value, (int, float)):
            found[f"{within}{name}"] = value
    return found


def summary(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Median of each clock, and mean and deviation over the seeds of each quality; runs of a seed are equal."""
    by_seed: dict[int, Mapping[str, float]] = {}
    for each in runs:
        if by_seed.setdefault(each["seed"], each["quality"]) != each["quality"]:
            print(f"seed {each['seed']}: two runs differ; the first counts", file=sys.stderr)
    quality = {}
    for name in next(iter(by_seed.values())):
        values = [each[name] for each in by_seed.values() if name in each]
        quality[name] = [statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else math.nan]
    return {
        **{clock: statistics.median(each[clock] for each in runs) for clock in CLOCKS},
        "quality": quality,
        "runs": [{key: each[key] for key in ("seed", *CLOCKS)} for each in runs],
    }


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--base", required=True, metavar="COMMIT", help="commit to compare with")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    with base_source(options.base) as base:
        sources = {"base": base, "ours": REPOSITORY / "src"}
        found: dict[str, list[dict[str, Any]]] = {version: [] for version in sources}
        for source in sources.values():
            run(source, 0, steps=20)
        for repeat in range(options.repeats):
            seed = options.seeds[repeat % len(options.seeds)]
            for version, source in list(sources.items())[:: 1 if repeat % 2 == 0 else -1]:
                row = {"seed": seed, **run(source, seed)}
                found[version].append(row)
                clocks = ", ".join(f"{clock} {row[clock]:.2f}" for clock in CLOCKS)
                print(f"repeat {repeat} seed {seed} {version}: {clocks}", flush=True)
    rows = [{"version": version, **summary(runs)} for version, runs in found.items()]
    for clock in CLOCKS:
        before, today = (row[clock] for row in rows)
        print(f"{clock}: {before:.2f} and {today:.2f}, ours / base {today / before:.2f}")
    for name in sorted(rows[0]["quality"].keys() & rows[1]["quality"].keys()):
        (before, spread), (today, spread_today) = (row["quality"][name] for row in rows)
        print(f"{name}: {before:.4f} ± {spread:.4f} and {today:.4f} ± {spread_today:.4f}")
    write_record(options.json, rows, base=options.base)


if __name__ == "__main__":
    main()
