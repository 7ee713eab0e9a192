"""The environment of the Makefile: any fitting Python makes it, once, and one that is broken is mended.

Pythons are stand-ins of a few lines of shell: nothing is installed, no network is needed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

MAKEFILE = Path(__file__).parents[2] / "Makefile"
TOOLS = ("make", "sh", "touch", "rm", "mkdir", "ln", "chmod", "cat", "cp", "dirname")

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not shutil.which("make"), reason="make is not there")]

# Says its version, makes environments with itself as their Python, and notes what it was asked to do.
STAND_IN = """#!/bin/sh
echo "$*" >> "{log}"
case "$1 $2 $3" in
    "-c "*) echo {version} ;;
    "-m venv --clear")
        rm -rf "$4"; mkdir -p "$4/bin"; cp "$0" "$4/bin/python"
        {ensurepip} && cp "$0" "$4/bin/pip" && cp "$0" "$4/bin/lexsplat" ;;
    "-m ensurepip "*) bin=$(dirname "$0"); cp "$0" "$bin/pip"; cp "$0" "$bin/lexsplat" ;;
esac
"""


class Clone:
    """A folder with the Makefile, on a machine that has the pythons it is given and no others."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.programs, self.log = folder / "a clone", folder / "programs", folder / "log"
        self.folder.mkdir()
        self.programs.mkdir()
        shutil.copy(MAKEFILE, self.folder)
        for name in ("pyproject.toml", "constraints.txt"):
            (self.folder / name).touch()
        for tool in TOOLS:
            (self.programs / tool).symlink_to(shutil.which(tool))

    def give(self, name: str, version: str, *, ensurepip: bool = True) -> None:
        stand_in = self.programs / name
        stand_in.unlink(missing_ok=True)
        stand_in.write_text(
            STAND_IN.format(log=self.log, version=version, ensurepip="true" if ensurepip else "false")
        )
        stand_in.chmod(0o755)

    def make(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        self.log.write_text("")
        environment = {"PATH": str(self.programs), "HOME": os.environ.get("HOME", "/")}
        return subprocess.run(
            ["make", *arguments], cwd=self.folder, env=environment, capture_output=True, text=True, timeout=60
        )

    def asked(self) -> list[str]:
        """What pythons were asked to do, without the questions for their version."""
        return [line for line in self.log.read_text().splitlines() if not line.startswith("-c")]


@pytest.fixture
def clone(tmp_path):
    return Clone(tmp_path)


INSTALL = "-m pip install --quiet --disable-pip-version-check -c constraints.txt -e ."
DEMO = "demo --output output/demo"


def test_what_is_installed_is_not_installed_again(clone):
    clone.give("python3", "3.11")
    assert clone.make("demo").returncode == 0
    assert clone.asked() == ["-m venv --clear .venv", INSTALL, DEMO]
    assert clone.make("demo").returncode == 0
    assert clone.asked() == [DEMO]


@pytest.mark.parametrize("python3", [None, "3.9", "3.14", "2.7"])
def test_a_python_that_fits_is_found_under_its_own_name(clone, python3):
    if python3:
        clone.give("python3", python3)
    clone.give("python3.12", "3.12")
    done = clone.make("demo")
    assert done.returncode == 0, done.stderr
    assert "python3.12 -m venv" in done.stdout


def test_no_python_that_fits_is_told_in_one_line_with_what_was_found(clone):
    clone.give("python3", "3.9")
    done = clone.make("demo")
    assert done.returncode != 0
    told = [line for line in done.stderr.splitlines() if not line.startswith("make:")]
    assert told == [
        "lexsplat needs Python 3.10 to 3.13, found: python3 is 3.9; run: make PYTHON=/path/to/python3.12 demo"
    ]
    assert not (clone.folder / ".venv").exists()


def test_an_environment_without_pip_is_mended_when_make_runs_again(clone):
    """As on Debian before python3-venv is installed: the environment is left with a Python and no pip."""
    clone.give("python3", "3.11", ensurepip=False)
    assert clone.make("demo").returncode != 0
    assert (clone.folder / ".venv" / "bin" / "python").exists()
    done = clone.make("demo")
    assert done.returncode == 0, done.stderr
    assert clone.asked() == ["-m ensurepip --default-pip", INSTALL, DEMO]


def test_an_environment_whose_python_is_gone_is_made_anew(clone):
    clone.give("python3", "3.11")
    assert clone.make("demo").returncode == 0
    python = clone.folder / ".venv" / "bin" / "python"
    python.unlink()
    python.symlink_to(clone.folder / "removed" / "python3.11")
    assert clone.make("demo").returncode == 0
    assert clone.asked() == ["-m venv --clear .venv", INSTALL, DEMO]


def test_an_output_folder_may_have_a_space_in_its_name(clone):
    clone.give("python3", "3.11")
    assert clone.make("demo", "OUTPUT=my demo").returncode == 0
    assert clone.asked()[-1] == "demo --output my demo"
