"""lexsplat writes into its output and its caches (and the system's folder for temporary files), and nowhere else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import lexsplat

pytestmark = pytest.mark.slow

WATCHED = """
import json, os, sys
written = set()
CHANGES = {"os.mkdir": (0,), "os.rename": (0, 1), "os.remove": (0,), "os.rmdir": (0,), "os.link": (1,),
           "os.symlink": (1,), "os.truncate": (0,), "os.utime": (0,), "os.chmod": (0,), "shutil.rmtree": (0,)}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND

def record(event, arguments):
    if event == "open":
        path, mode, flags = arguments
        if isinstance(path, int) or not (flags or 0) & WRITING and not set(str(mode or "")) & set("wax+"):
            return
        paths = [path]
    elif event in CHANGES:
        paths = [arguments[place] for place in CHANGES[event]]
    else:
        return
    written.update(os.path.abspath(os.fsdecode(path)) for path in paths if not isinstance(path, int))

from lexsplat import cli
sys.addaudithook(record)
status = [cli.main(arguments) for arguments in json.loads(sys.argv[1])]
print(json.dumps({"status": status, "written": sorted(written)}))
"""
"""Runs commands and lists every file that Python opened to write, made, renamed or removed."""

CACHES = ("__pycache__", ".nbi", ".nbc")
"""Compiled code: Python's and Numba's."""


def test_commands_write_into_their_output_and_nowhere_else(tiny_capture, tmp_path):
    place = tmp_path / "work"
    place.mkdir()
    scene, pictures, temporary = tmp_path / "scene", tmp_path / "pictures", tmp_path / "temporary"
    temporary.mkdir()
    commands = [
        [
            "build", str(tiny_capture), "--output", str(scene), "--clip", "bundled", "--dino", "none",
            "--device", "cpu", "--iterations", "4", "--downscale", "4", "--codebook.num-codes", "4",
            "--codebook.steps", "2", "--features.crop-sizes", "0.5", "--features.crop-strides", "0.5",
            "--features.map-cells", "8",
        ],
        ["query", str(scene), "red apple", "--output", str(pictures)],
        ["export", str(scene), str(tmp_path / "scene.ply")],
        ["info", str(scene)],
    ]  # fmt: skip
    cache = tmp_path / "cache"
    environment = {**os.environ, "TMPDIR": str(temporary), "XDG_CACHE_HOME": str(cache)}
    # torch writes its choice of a temporary folder into the environment of a process that has imported all of it.
    environment.pop("TORCHINDUCTOR_CACHE_DIR", None)
    command = [sys.executable, "-c", WATCHED, json.dumps(commands)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3000, cwd=place, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["status"] == [0, 0, 0, 0], done.stderr[-2000:]
    written = [Path(path) for path in report["written"]]
    assert scene / "scene.json" in written, "the hook records"
    caches = (cache / "lexsplat" / name for name in ("texts", "hashes", "waits"))
    allowed = (scene, pictures, temporary, *caches)
    strays = [
        path
        for path in written
        if not any(path == folder or folder in path.parents for folder in allowed)
        and not (path.parent == tmp_path and path.name.lstrip(".").startswith("scene.ply"))
        and not any(mark in str(path) for mark in CACHES)
        and path not in (tmp_path, cache, cache / "lexsplat", Path("/dev/null"))  # made if they are not there
    ]
    assert not strays, strays
    assert not list(place.iterdir()), "nothing in the folder where it was called"
    package = Path(lexsplat.__file__).parent
    assert not [path for path in written if package in path.parents and "__pycache__" not in path.parts]
