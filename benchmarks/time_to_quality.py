"""Seconds until held-out views reach a PSNR, beside another commit or other settings, in one run.

    python benchmarks/time_to_quality.py demo second ../data/bonsai=4 --base d4e65b3 --seeds 0 1 2

Both trainings run in slices that take turns, so that other work on the machine slows both. The time between
two slices is interpolated. PSNR is measured outside the clock, on test views; ``--on validation`` takes every
sixth training view instead, to choose settings by.

Schedules are scaled to the length of a training, so a training that is cut off is worse than one that is planned to
end there. ``--lengths .3 .4 .6 1`` therefore runs a whole training of each share of the usual steps, and interpolates
between their ends: the seconds of the shortest training that reaches the PSNR, at most those of the shortest length.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from records import REPOSITORY, argument_parser, write_record

GOALS = {"demo": 31.0, "second": 35.0, "bonsai": 27.5}
"""PSNR in dB to reach, by name of the capture."""


class Training:
    """A training in another process that runs a slice at a time."""

    def __init__(self, source: Path, settings: Mapping[str, Any], arguments: list[str]) -> None:
        script = REPOSITORY / "benchmarks" / "training_slices.py"
        self.process = subprocess.Popen(
            [sys.executable, str(script), *arguments, "--settings", json.dumps(dict(settings))],
            env={
                **os.environ,
                "PYTHONPATH": str(source),
                "OMP_WAIT_POLICY": "PASSIVE",
            },  # as lexsplat sets it
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.total = self._answer()["total"]
        self.rows: list[dict[str, float]] = [{"steps": 0, "wall": 0.0, "processor": 0.0, "psnr": 0.0}]

    def run(self, steps: int) -> None:
        """Train so many steps and keep the summed seconds with the PSNR."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{steps}\n")
        self.process.stdin.flush()
        row, last = self._answer(), self.rows[-1]
        self.rows.append({**row, **{clock: last[clock] + row[clock] for clock in ("wall", "processor")}})

    @property
    def done(self) -> bool:
        """Whether all steps have run."""
        return self.rows[-1]["steps"] >= self.total

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"a training ended early with status {self.process.wait()}")
        return json.loads(line)


def seconds_to(goal: float, rows: Sequence[Mapping[str, float]], clock: str) -> float | None:
    """Seconds of a clock ("wall" or "processor") until the PSNR reaches ``goal`` and stays; None if never."""
    above = [row["psnr"] >= goal for row in rows]
    if not above[-1]:
        return None
    if all(above):
        return rows[0][clock]
    first = len(above) - above[::-1].index(False)
    before, after = rows[first - 1], rows[first]
    share = (goal - before["psnr"]) / (after["psnr"] - before["psnr"])
    return before[clock] + share * (after[clock] - before[clock])


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", nargs="+", metavar="CAPTURE[=DOWNSCALE]")
    parser.add_argument("--base", metavar="COMMIT", help="commit to compare with; default: today's code")
    parser.add_argument("--base-settings", type=json.loads, default={}, metavar="JSON")
    parser.add_argument(
        "--settings", type=json.loads, default={}, metavar="JSON", help="changed fields of ours"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--on", choices=("validation", "test"), default="test")
    parser.add_argument("--goal", type=float, help="PSNR in dB; default: that of the capture")
    parser.add_argument("--slices", type=int, default=30)
    parser.add_argument(
        "--lengths",
        type=float,
        nargs="+",
        metavar="SHARE",
        help="whole trainings of these shares of the steps",
    )
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    rows = []
    with base_source(options.base) as base:
        for capture in options.captures:
            for seed in options.seeds:
                rows.append(compared(capture, seed, base, options))
    write_record(options.json, rows, base=options.base, on=options.on, threads=options.threads)


@contextmanager
def base_source(commit: str | None) -> Iterator[Path]:
    """The folder of packages at a commit, in a worktree of its own; today's without one."""
    if commit is None:
        yield REPOSITORY / "src"
        return
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "base"
        git = ["git", "-C", str(REPOSITORY), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(place), commit], check=True)
        try:
            yield place / "src"
        finally:
            subprocess.run([*git, "remove", "--force", str(place)], check=True)


def compared(capture: str, seed: int, base: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Train both versions in turns; print and return one row."""
    name = Path(capture.partition("=")[0]).name
    goal = options.goal or GOALS[name]
    if options.lengths:
        ends = [trained(capture, seed, base, options, share) for share in sorted(options.lengths)]
        curves = {version: [end[version][-1] for end in ends] for version in ("base", "ours")}
    else:
        curves = trained(capture, seed, base, options, 1.0)
    row: dict[str, Any] = {"capture": name, "seed": seed, "goal": goal}
    for version, curve in curves.items():
        row[version] = {
            "psnr": curve[-1]["psnr"],
            "gaussians": curve[-1]["gaussians"],
            **{clock: curve[-1][clock] for clock in ("wall", "processor")},
            **{f"{clock}_to_goal": seconds_to(goal, curve, clock) for clock in ("wall", "processor")},
            "curve": curve,
        }
    print_row(row)
    return row


def trained(
    capture: str, seed: int, base: Path, options: argparse.Namespace, share: float
) -> dict[str, list[dict[str, float]]]:
    """The curves of both versions, trained in turns for a share of their usual steps."""
    arguments = [capture, "--seed", str(seed), "--on", options.on, "--threads", str(options.threads)]
    with ExitStack() as stack:

        def started(source: Path, settings: Mapping[str, Any]) -> Training:
            training = Training(source, settings, [*arguments, "--length", str(share)])
            stack.callback(training.close)
            return training

        pair = {
            "base": started(base, options.base_settings),
            "ours": started(REPOSITORY / "src", options.settings),
        }
        while not all(training.done for training in pair.values()):
            for training in pair.values():
                if not training.done:
                    training.run(-(-training.total // options.slices))
        return {version: training.rows for version, training in pair.items()}


def print_row(row: Mapping[str, Any]) -> None:
    """Print the row as three lines: both versions, and their ratios."""
    print(f"{row['capture']} seed {row['seed']}, seconds to {row['goal']:.1f} dB (all):")
    for version in ("base", "ours"):
        facts = row[version]
        clocks = ", ".join(
            f"{clock} {'never' if (to := facts[f'{clock}_to_goal']) is None else f'{to:.1f}'} ({facts[clock]:.1f})"
            for clock in ("wall", "processor")
        )
        print(f"  {version}: {clocks}, final {facts['psnr']:.2f} dB, {facts['gaussians']:,} Gaussians")
    for key in ("wall_to_goal", "processor_to_goal", "wall", "processor"):
        if row["base"][key] and row["ours"][key]:
            print(f"  {key} base / ours: {row['base'][key] / row['ours'][key]:.2f}", flush=True)


if __name__ == "__main__":
    main()
