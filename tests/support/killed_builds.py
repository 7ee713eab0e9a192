"""Builds a scene in processes that are killed at random moments, again and again, until it is finished.

Run by test_killed_builds.py in a process of its own: everything is imported once, then every attempt is a fork,
so that fifty kills take a minute. No work with threads is done before the forks.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

KILLS_A_SCENE = 7
SHORTEST_STAGE = 0.2
"""Seconds of the codebook on a quick machine: a kill within them, after the stage before, is in it."""
LONGEST_SECONDS = 1.2
"""Until any other kill."""


def attempt(arguments: list[str], output: Path, seconds: float | None, after_stages: int = 0) -> str:
    """Runs the command line in a fork: "finished", "failed", or "killed" so many seconds after so many stages."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            from lexsplat import cli

            sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
            status = cli.main([*arguments, "--output", str(output)])
        finally:
            os._exit(status)
    deadline = None
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return "finished" if status == 0 else "failed"
        if seconds is not None and deadline is None and stages_done(output) >= after_stages:
            deadline = time.monotonic() + seconds
        if deadline is not None and time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "killed"
        time.sleep(0.002)


def stages_done(output: Path) -> int:
    """Finished stages, as scene.json says it."""
    try:
        return len(json.loads((output / "scene.json").read_text())["stages"])
    except FileNotFoundError:
        return 0


def main() -> None:
    folder, kills, seed, stages, *arguments = sys.argv[1:]
    import transformers.models.auto.tokenization_auto
    import transformers.models.clip.modeling_clip
    import transformers.models.vit.modeling_vit  # noqa: F401  (seconds of imports, once, before the first fork)

    rng = np.random.default_rng(int(seed))
    killed: list[int] = []
    finished: list[str] = []
    while len(killed) < int(kills):
        output = Path(folder) / f"scene_{len(finished)}"
        # The first kill of a scene waits for one of its stages, so that all stages are hit; the others come as they
        # come, most of them while the process starts or goes on with a training.
        wanted = len(finished) % int(stages)
        for number in range(KILLS_A_SCENE):
            if number:
                result = attempt(arguments, output, float(rng.uniform(0.0, LONGEST_SECONDS)))
            else:
                result = attempt(arguments, output, float(rng.uniform(0.0, SHORTEST_STAGE)), wanted)
            if result != "killed":
                break
            killed.append(stages_done(output))
        if result == "killed":
            result = attempt(arguments, output, None)
        if result == "failed":
            print(json.dumps({"failed": str(output)}))
            return
        finished.append(str(output))
    report = {"killed_after_stages": killed, "finished": finished}
    print(json.dumps(report))


if __name__ == "__main__":
    main()
