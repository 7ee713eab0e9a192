"""Adds scenes to a library and removes them in processes that are killed at random moments.

test_killed_libraries.py runs this module in a fork, in which every attempt is a fork: nothing is imported again. No
threads are started before the forks. After each kill the library is checked: every scene that was in it and
was not being changed is there with the same bytes, and the next attempt begins where this one ended.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
import traceback
from pathlib import Path

import numpy as np
import pytest

from support.forks import outcome
from support.library_scenes import OTHERS, THINGS, install, write_scene


def attempt(library: Path, action: str, scene: Path, seconds: float | None) -> str:
    """Run a change in a fork: "finished", "failed" or "killed" after so many seconds."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            from lexsplat.scenes.library import Library

            opened = Library.create(library)
            opened.add(scene) if action == "add" else opened.remove(scene.name)
            status = 0
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(status)
    return outcome(child, seconds)


def entry(library: Path, name: str) -> dict[str, bytes]:
    """The files of a scene that its record names."""
    record = json.loads((library / "scenes" / f"{name}.json").read_text())
    codes = f"{name}.{record['content']}.safetensors"
    objects = f"{name}.{record['contents']}.objects.safetensors" if record["contents"] else codes
    return {each: (library / "scenes" / each).read_bytes() for each in (f"{name}.json", codes, objects)}


def check(library: Path, expected: set[str], known: dict[str, dict[str, bytes]]) -> list[str]:
    """What is wrong with a library after a kill."""
    there = {path.stem for path in (library / "scenes").glob("[!.]*.json")}
    wrong = [f"expected {sorted(expected)}, found {sorted(there)}"] if there != expected else []
    return wrong + [
        f"{name} has changed" for name in there & known.keys() if entry(library, name) != known[name]
    ]


def main() -> None:
    folder, kills, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    patch, rng = pytest.MonkeyPatch(), np.random.default_rng(seed)
    install(patch)
    library, places = folder / "library", [folder / name for name in ("kitchen", "office", "lab")]
    for place, things in zip(places, (THINGS, OTHERS, THINGS[::-1])):
        write_scene(place, things, segments=place.name == "kitchen")
    report: dict = {"kills": 0, "in_time": 0, "wrong": [], "failed": []}
    longest = {}
    for action in ("add", "remove"):  # how long a change takes here; the last one leaves nothing
        for place in places:
            start = time.monotonic()
            if attempt(library, action, place, None) != "finished":
                report["failed"].append(f"{action} {place.name} without a kill")
            longest[action] = time.monotonic() - start
    inside: set[str] = set()
    known: dict[str, dict[str, bytes]] = {}
    while report["kills"] < kills and not report["failed"]:
        place = places[rng.integers(len(places))]
        if not inside:
            shutil.rmtree(library, ignore_errors=True)  # so that making a library is killed too
        action = "remove" if place.name in inside else "add"
        result = attempt(library, action, place, float(rng.uniform(0, 1.1 * longest[action])))
        after = inside | {place.name} if action == "add" else inside - {place.name}
        exists = (library / "scenes" / f"{place.name}.json").exists()
        if result == "failed" or (result == "finished" and exists != (action == "add")):
            report["failed"].append(f"{action} {place.name} after {report['kills']} kills: {result}")
        report["kills" if result == "killed" else "in_time"] += 1
        inside = after if exists == (action == "add") else inside  # all or nothing
        report["wrong"] += check(library, inside, known)
        known.update((name, entry(library, name)) for name in inside)
    for place in places:  # what was killed is finished by the same command
        if attempt(library, "add", place, None) != "finished":
            report["failed"].append(f"add {place.name} at the end")
    report["files"] = sorted(path.name.split(".")[0] for path in (library / "scenes").iterdir())
    print(json.dumps(report))
