"""SIGTERM ends a build at once: pycolmap's handler, which prints a trace and may hang, is removed."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.forked_commands import Command

PACKAGE = Path(__file__).parents[2] / "src" / "lexsplat"

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="no signals like these")]


def test_only_one_module_imports_pycolmap():
    """Other modules import it from there; type-checking imports may be anywhere."""
    for path in PACKAGE.rglob("*.py"):
        if path.name == "pycolmap_import.py":
            continue
        lines = [line.strip() for line in path.read_text().splitlines()]
        assert "import pycolmap" not in lines, path
        assert not any(line.startswith("from pycolmap") for line in lines), path


def test_the_import_restores_the_sigterm_handler():
    script = """
import os, signal, sys
if sys.argv[1] == "own":
    signal.signal(signal.SIGTERM, lambda number, frame: (print("handled", flush=True), sys.exit(7)))
from lexsplat.captures.sfm.pycolmap_import import pycolmap
pycolmap.Camera(model="PINHOLE", width=4, height=4, params=[4, 4, 2, 2])
os.kill(os.getpid(), signal.SIGTERM)
import time
time.sleep(20)
"""
    for kind, code, said in (("none", -signal.SIGTERM, ""), ("own", 7, "handled\n")):
        done = subprocess.run(
            [sys.executable, "-c", script, kind], capture_output=True, text=True, timeout=120, check=False
        )
        assert (done.returncode, done.stdout) == (code, said)
        assert "***" not in done.stderr, "no stack trace"


def test_ctrl_c_during_the_import_is_deferred_until_it_is_complete():
    script = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs start with it ignored
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "pycolmap._core":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
try:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap
except KeyboardInterrupt:
    print("stopped")
from lexsplat.captures.sfm.pycolmap_import import pycolmap
print(len(pycolmap.Camera(model="PINHOLE", width=4, height=4, params=[4, 4, 2, 2]).params))
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout == "stopped\n4\n"


def import_pycolmap() -> None:
    from lexsplat.captures.sfm.pycolmap_import import pycolmap

    assert pycolmap.Camera(model="PINHOLE", width=4, height=4, params=[4, 4, 2, 2])


def test_sigterm_ends_a_build_at_once_and_keeps_its_checkpoints(tiny_capture, tmp_path):
    from lexsplat.runtime.files import read_tensors

    words = ["reconstruct", str(tiny_capture), "--output", str(tmp_path)]
    words += ["--device", "cpu", "--iterations", "100000", "--checkpoint-seconds", "0.2"]
    saved = tmp_path / "checkpoints" / "reconstruct.training.safetensors"
    with Command(*words, prepare=import_pycolmap) as process:
        started = time.monotonic()
        while not saved.exists() and time.monotonic() - started < 300:
            time.sleep(0.05)
        assert saved.exists(), process.errors()
        asked = time.monotonic()
        process.send_signal(signal.SIGTERM)
        status = process.wait(60)
        errors = process.errors()
    assert status == -signal.SIGTERM
    assert time.monotonic() - asked < 20, "the machine may be busy; undisturbed it is a tenth of a second"
    assert "***" not in errors
    state, _ = read_tensors(saved)
    assert int(state["steps_done"]) > 0
