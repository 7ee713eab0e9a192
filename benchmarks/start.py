"""Time until a command has answered, as a multiple of the time to import torch in the same run.

    python benchmarks/start.py [--repeats 9] [--json FILE]

The commands alternate, each in a process of its own, and the median over the repeats counts: wall time and processor
time. "first" asks for words that nobody has asked before, "again" for the same words once more. One round before the
measured ones fills the caches of compiled kernels and of files.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

from records import argument_parser, write_record

from lexsplat.queries.vocabulary import COLORS

THINGS = ("shoe", "hat", "glove", "bench", "piano", "drum", "fence", "statue", "carpet", "mirror")
LIMITS = {"--help": 0.5, "info": 1.3, "query": 2.2, "find": 2.2}
"""Multiples of the import of torch that are wanted, by command."""
TORCH = "import torch"
CASES = {
    TORCH: ["-c", "import torch"],
    "--help": ["-m", "lexsplat", "--help"],
    "query --help": ["-m", "lexsplat", "query", "--help"],
    "info": ["-m", "lexsplat", "info", "demo"],
    "query": ["-m", "lexsplat", "query", "demo", "red apple"],
    "query --no-images": ["-m", "lexsplat", "query", "demo", "red apple", "--no-images"],
    "find": ["-m", "lexsplat", "find", "demo", "red apple"],
    "find, first": ["-m", "lexsplat", "find", "demo", "{word}"],
    "find, again": ["-m", "lexsplat", "find", "demo", "{word}"],
}


def run(arguments: list[str], folder: str) -> tuple[float, float]:
    """Wall and processor seconds of a Python process."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = {**os.environ, "XDG_CACHE_HOME": folder}
    subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL
    )
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def phrase(number: int) -> str:
    """A thing with a color that no scene and no cache knows yet."""
    colors = sorted(COLORS)
    return f"{colors[number // len(THINGS) % len(colors)]} {THINGS[number % len(THINGS)]}"


def measure(repeats: int) -> list[dict[str, object]]:
    """A row for each command."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in CASES}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(repeats + 1):
            for name, arguments in CASES.items():
                words = [word.format(word=phrase(number)) for word in arguments]
                found = run(words, folder)
                if number:
                    times[name].append(found)
    rows: list[dict[str, object]] = []
    base = {part: statistics.median(t[part] for t in times[TORCH]) for part in (0, 1)}
    for name, measured in times.items():
        wall, processor = (statistics.median(t[part] for t in measured) for part in (0, 1))
        rows.append({
            "command": name, "wall_seconds": wall, "cpu_seconds": processor, "ratio": wall / base[0],
            "cpu_ratio": processor / base[1], "wanted": LIMITS.get(name.partition(",")[0]),
        })  # fmt: skip
    return rows


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    rows = measure(options.repeats)
    print(f"{'command':<17} {'wall':>7} {'cpu':>7} {'ratio':>6} {'of cpu':>7} {'wanted':>7}")
    for row in rows:
        print(
            f"{row['command']:<17} {row['wall_seconds']:6.2f}s {row['cpu_seconds']:6.2f}s {row['ratio']:6.2f} "
            f"{row['cpu_ratio']:7.2f} {row['wanted'] or '-':>7}"
        )
    write_record(options.json, rows, repeats=options.repeats)


if __name__ == "__main__":
    main()
