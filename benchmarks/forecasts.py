"""Told and taken time of the stages of a build.

    python benchmarks/forecasts.py [demo] [second] [CAPTURE[=DOWNSCALE]] [--iterations N] [--method NAME] [--joint]
        [--blocks N] [--processor] [--json FILE]

Builds each capture in a folder of its own and compares what the build says before a stage with what the stage took
by the clock. "ratio" is taken / told; the goal is 0.67 to 1.5. "-" is a stage whose time nothing tells. Times of a
machine that does other work meanwhile differ by what that work takes: --processor compares processor seconds of one
thread (with OMP_NUM_THREADS=1) in place of the clock; then reading files costs nothing. SIFT features,
matching and mapping are told after their first units; they are timed from the first to the last event of progress,
the mapping from that of the last mapper that was tried.
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from records import argument_parser, write_record

from lexsplat.evaluation.demo import demo_capture
from lexsplat.features.encoders import DEFAULT_CLIP
from lexsplat.language.methods import METHODS
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.progress import NOTE, Event

LIMIT = 1.5
TOLD = re.compile(r"^(\w[\w ]*?)(?: on \w+)?: .*?(?:about|; )\s*((?:\d+:)?\d+:\d\d) (?:min|hours) for")


class Notes(logging.Handler):
    """Collects the told seconds by stage."""

    def __init__(self) -> None:
        super().__init__(NOTE)
        self.told: dict[str, float] = {}

    def emit(self, record: logging.LogRecord) -> None:
        if found := TOLD.match(record.getMessage()):
            self.told[found[1]] = seconds_of(found[2])


def seconds_of(text: str) -> float:
    """Seconds of "1:02" or "1:00:02"."""
    seconds = 0.0
    for part in text.split(":"):
        seconds = 60 * seconds + float(part)
    return seconds


class PosesClock:
    """A listener that times the parts of structure from motion whose time is told."""

    def __init__(self) -> None:
        self.taken: dict[str, float] = {}
        self._starts: dict[str, float] = {}

    def __call__(self, event: Event) -> None:
        now = time.perf_counter()
        if event.stage == "triangulate" and event.done == (event.total - 3) // 2:  # all images are written
            self._starts["poses"] = now  # where the features begin, as in `poses`
        elif not event.done:
            self._starts[event.stage] = now
            if event.stage == "matching" and "poses" in self._starts:
                self.taken.setdefault("SIFT features", now - self._starts["poses"])
        elif event.stage in ("matching", "mapping", "blocks") and event.done == event.total:
            self.taken[event.stage] = now - self._starts[event.stage]


def measure(name: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each stage of the build of a capture."""
    place, _, downscale = name.partition("=")
    bundled = {"demo": "tabletop", "second": "second"}
    source = demo_capture(bundled[place]) if place in bundled else Path(place)
    config = BuildConfig(
        iterations=options.iterations,
        downscale=float(downscale) if downscale else None,
        clip="bundled" if place in bundled else options.clip or DEFAULT_CLIP,
        dino="bundled",
        method=options.method,
        joint=options.joint,
        blocks=options.blocks,
    )
    clock = PosesClock()
    notes, log = Notes(), logging.getLogger("lexsplat")
    log.addHandler(notes)
    log.setLevel(NOTE)
    try:
        with tempfile.TemporaryDirectory() as folder:
            taken = build(source, Path(folder) / "scene", config, listener=clock).stage_seconds()
    finally:
        log.removeHandler(notes)
    rows = []
    for stage, seconds in (clock.taken | taken).items():
        told = notes.told.get(stage)
        rows.append({
            "capture": Path(place).name, "stage": stage, "told_seconds": told, "taken_seconds": seconds,
            "ratio": seconds / told if told else None,
        })  # fmt: skip
    return rows


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", nargs="*", default=["second", "demo"], metavar="CAPTURE[=DOWNSCALE]")
    parser.add_argument("--iterations", type=int, help="steps of the reconstruction; 1,000 or more are told")
    parser.add_argument("--clip", help="encoder of captures that are not bundled")
    parser.add_argument("--method", choices=tuple(METHODS), default="averaged")
    parser.add_argument("--joint", action="store_true", help="language is trained with the geometry")
    parser.add_argument("--blocks", default=BuildConfig.blocks, help="blocks of the reconstruction")
    parser.add_argument("--processor", action="store_true", help="processor seconds in place of the clock")
    options = parser.parse_args()
    if options.processor:
        time.perf_counter = time.process_time
    rows = []
    print(f"{'capture':12} {'stage':12} {'told':>8} {'taken':>8} {'ratio':>6}")
    for name in options.captures:
        for row in measure(name, options):
            rows.append(row)
            told, ratio = row["told_seconds"], row["ratio"]
            print(
                f"{row['capture']:12} {row['stage']:12} {'-' if told is None else f'{told:.0f} s':>8}"
                f" {row['taken_seconds']:6.1f} s {'-' if ratio is None else f'{ratio:.2f}':>6}",
                flush=True,
            )
    write_record(
        options.json,
        rows,
        iterations=options.iterations,
        method=options.method,
        blocks=options.blocks,
        processor=options.processor,
    )
    wrong = [row for row in rows if row["ratio"] and not 1 / LIMIT <= row["ratio"] <= LIMIT]
    if wrong:
        print(f"{len(wrong)} of {len(rows)} stages are outside {1 / LIMIT:.2f} to {LIMIT}", file=sys.stderr)


if __name__ == "__main__":
    main()
