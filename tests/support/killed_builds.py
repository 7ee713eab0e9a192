"""Repeats a build in processes that are killed, until the scene is finished.

test_killed_builds.py runs this module in a fork, where torch has one thread. By each method it builds the scene once
undisturbed, and every further attempt is a fork: no module is imported and no kernel is loaded again. No thread is
left at the forks. The first kill of a scene strikes inside one of the stages, at a progress event; the others strike
at random moments.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from support.forks import outcome

KILLS_A_SCENE = 3
LONGEST_SECONDS = 0.3
"""Maximum delay in seconds of the kills at random moments."""


def kill_inside(stage: str, share: float) -> None:
    """Make this process kill itself when the named stage reports that it has done a share of its work, in 0..1."""
    from lexsplat.cli.progress import ProgressBars

    show = ProgressBars.__call__

    def show_or_die(self, event):
        if event.stage == stage and "kept" not in event.metrics and event.done >= share * event.total:
            os.kill(os.getpid(), signal.SIGKILL)
        show(self, event)

    ProgressBars.__call__ = show_or_die


def attempt(
    arguments: list[str], seconds: float | None = None, prepare: Callable[[], None] | None = None
) -> str:
    """Run the command line in a fork: "finished", "failed" or "killed".

    Args:
        arguments: Of the command line.
        seconds: Delay after which the fork is killed; None waits for its end.
        prepare: What the fork does first.
    """
    child = os.fork()
    if child == 0:
        status = 1
        try:
            from lexsplat import cli

            sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
            if prepare is not None:
                prepare()
            status = cli.main(arguments)
        finally:
            os._exit(status)
    return outcome(child, seconds)


def killed(folder: Path, method: str, stages: list[str], options: list[str]) -> dict:
    """Build a scene with a method, then as many as it has stages in forks that are killed; report what happened."""
    from lexsplat import cli

    rng, options = np.random.default_rng(3), [*options, "--method", method]
    undisturbed = str(folder / "undisturbed")
    report: dict = {"killed_inside": [], "kills": 0, "finished": [], "undisturbed": undisturbed}
    with contextlib.redirect_stdout(io.StringIO()):
        if cli.main([*options, "--output", undisturbed]):
            report["failed"] = undisturbed
    while report["kills"] < KILLS_A_SCENE * len(stages) and "failed" not in report:
        output = folder / f"scene_{len(report['finished'])}"
        arguments = [*options, "--output", str(output)]
        stage, share = stages[len(report["finished"]) % len(stages)], float(rng.uniform())
        result = attempt(arguments, prepare=lambda stage=stage, share=share: kill_inside(stage, share))
        if result == "killed":
            report["killed_inside"].append(stage)
        for _ in range(KILLS_A_SCENE - 1):
            if result != "killed":
                break
            report["kills"] += 1
            result = attempt(arguments, float(rng.uniform(0.0, LONGEST_SECONDS)))
        if result == "killed":
            report["kills"] += 1
            result = attempt(arguments)
        if result == "failed":
            report["failed"] = str(output)
        else:
            report["finished"].append(str(output))
    return report


def main() -> None:
    folder, methods, *options = sys.argv[1:]
    stages = json.loads(methods)
    print(json.dumps({m: killed(Path(folder) / m, m, names, options) for m, names in stages.items()}))
