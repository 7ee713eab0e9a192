"""Told and taken time of the stages of a build.

    python benchmarks/forecasts.py [demo] [second] [CAPTURE[=DOWNSCALE]] [--iterations N] [--json FILE]

Builds each capture in a folder of its own and compares what the build says before a stage with what the stage took
by the clock. "ratio" is taken / told; the goal is 0.67 to 1.5. "-" is a stage whose time nothing tells. Times of a
machine that does other work meanwhile differ by what that work takes. Structure from motion is not timed.
"""

from __future__ import annotations

import logging
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

from records import argument_parser, write_record

from lexsplat.evaluation.demo import demo_capture
from lexsplat.features.encoders import DEFAULT_CLIP
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.progress import NOTE

LIMIT = 1.5
TOLD = re.compile(r"^(reconstruct|features).*?(?:about|; )\s*((?:\d+:)?\d+:\d\d) (?:min|hours) for")


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


def measure(name: str, iterations: int | None, clip: str | None) -> list[dict[str, Any]]:
    """A row for each stage of the build of a capture."""
    place, _, downscale = name.partition("=")
    bundled = {"demo": "tabletop", "second": "second"}
    source = demo_capture(bundled[place]) if place in bundled else Path(place)
    encoders = {"clip": "bundled" if place in bundled else clip or DEFAULT_CLIP, "dino": "bundled"}
    config = BuildConfig(iterations=iterations, downscale=float(downscale) if downscale else None, **encoders)
    notes, log = Notes(), logging.getLogger("lexsplat")
    log.addHandler(notes)
    log.setLevel(NOTE)
    try:
        with tempfile.TemporaryDirectory() as folder:
            taken = build(source, Path(folder) / "scene", config).stage_seconds()
    finally:
        log.removeHandler(notes)
    rows = []
    for stage, seconds in taken.items():
        told = notes.told.get(stage)
        rows.append({
            "capture": Path(place).name, "stage": stage, "told_seconds": told, "taken_seconds": seconds,
            "ratio": seconds / told if told else None,
        })  # fmt: skip
    return rows


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", nargs="*", default=["second", "demo"], metavar="CAPTURE[=DOWNSCALE]")
    parser.add_argument("--iterations", type=int, help="steps of the reconstruction; 500 or more are told")
    parser.add_argument("--clip", help="encoder of captures that are not bundled")
    options = parser.parse_args()
    rows = []
    print(f"{'capture':12} {'stage':12} {'told':>8} {'taken':>8} {'ratio':>6}")
    for name in options.captures:
        for row in measure(name, options.iterations, options.clip):
            rows.append(row)
            told, ratio = row["told_seconds"], row["ratio"]
            print(
                f"{row['capture']:12} {row['stage']:12} {'-' if told is None else f'{told:.0f} s':>8}"
                f" {row['taken_seconds']:6.1f} s {'-' if ratio is None else f'{ratio:.2f}':>6}",
                flush=True,
            )
    write_record(options.json, rows, iterations=options.iterations)
    wrong = [row for row in rows if row["ratio"] and not 1 / LIMIT <= row["ratio"] <= LIMIT]
    if wrong:
        print(f"{len(wrong)} of {len(rows)} stages are outside {1 / LIMIT:.2f} to {LIMIT}", file=sys.stderr)


if __name__ == "__main__":
    main()
