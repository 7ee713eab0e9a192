"""Repeats a build in processes that are killed at random moments, until the scene is finished.

test_killed_builds.py runs this module in a separate process. It imports everything once, and every attempt is a fork,
so that fifty kills take a minute. No threads are started before the forks.
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
"""Duration in seconds of the shortest stage, the codebook, on a fast machine: earlier kills hit the stage."""
LONGEST_SECONDS = 1.2
"""Maximum delay in seconds of the other kills."""


def attempt(arguments: list[str], output: Path, seconds: float | None, after_stages: int = 0) -> str:
    """Run the command line in a fork: "finished", "failed", or "killed" after stages and a delay."""
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
    """Number of finished stages according to scene.json."""
    try:
        return len(json.loads((output / "scene.json").read_text())["stages"])
    except FileNotFoundError:
        return 0


def main() -> None:
    folder, kills, seed, stages, *arguments = sys.argv[1:]
    import transformers.models.auto.tokenization_auto
    import transformers.models.clip.modeling_clip
    import transformers.models.vit.modeling_vit  # noqa: F401  (imported once, before the first fork)

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
