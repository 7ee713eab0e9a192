"""The Makefile's environment: created once with any supported Python, and repaired if it is broken.

Short shell scripts replace Python: nothing is installed, and no network is required.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

MAKEFILE = Path(__file__).parents[2] / "Makefile"
TOOLS = ("make", "sh", "touch", "rm", "mkdir", "ln", "chmod", "cat", "cp", "dirname")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not shutil.which("make"), reason="make is not installed"),
]

# Prints its version, creates environments that contain itself as Python, and logs its arguments.
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
    """A folder with the Makefile and a PATH that contains only the given versions of Python."""

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
        """Logged arguments of the Python scripts, without version queries."""
        return [line for line in self.log.read_text().splitlines() if not line.startswith("-c")]


@pytest.fixture
def clone(tmp_path):
    return Clone(tmp_path)


INSTALL = "-m pip install --quiet --disable-pip-version-check -c constraints.txt -e ."
DEMO = "demo --output output/demo"


def test_an_installed_environment_is_not_installed_again(clone):
    clone.give("python3", "3.11")
    assert clone.make("demo").returncode == 0
    assert clone.asked() == ["-m venv --clear .venv", INSTALL, DEMO]
    assert clone.make("demo").returncode == 0
    assert clone.asked() == [DEMO]


@pytest.mark.parametrize("python3", [None, "3.9", "3.14", "2.7"])
def test_a_supported_python_is_found_by_its_versioned_name(clone, python3):
    if python3:
        clone.give("python3", python3)
    clone.give("python3.12", "3.12")
    done = clone.make("demo")
    assert done.returncode == 0, done.stderr
    assert "python3.12 -m venv" in done.stdout


def test_a_missing_supported_python_is_reported_in_one_line(clone):
    clone.give("python3", "3.9")
    done = clone.make("demo")
    assert done.returncode != 0
    messages = [line for line in done.stderr.splitlines() if not line.startswith("make:")]
    assert messages == [
        "lexsplat needs Python 3.10 to 3.13, found: python3 is 3.9; run: make PYTHON=/path/to/python3.12 demo"
    ]
    assert not (clone.folder / ".venv").exists()


def test_an_environment_without_pip_is_repaired_on_the_next_run(clone):
    """As on Debian without python3-venv: the environment contains Python but no pip."""
    clone.give("python3", "3.11", ensurepip=False)
    assert clone.make("demo").returncode != 0
    assert (clone.folder / ".venv" / "bin" / "python").exists()
    done = clone.make("demo")
    assert done.returncode == 0, done.stderr
    assert clone.asked() == ["-m ensurepip --default-pip", INSTALL, DEMO]


def test_an_environment_whose_python_was_removed_is_recreated(clone):
    clone.give("python3", "3.11")
    assert clone.make("demo").returncode == 0
    python = clone.folder / ".venv" / "bin" / "python"
    python.unlink()
    python.symlink_to(clone.folder / "removed" / "python3.11")
    assert clone.make("demo").returncode == 0
    assert clone.asked() == ["-m venv --clear .venv", INSTALL, DEMO]


def test_the_name_of_the_output_folder_may_contain_a_space(clone):
    clone.give("python3", "3.11")
    assert clone.make("demo", "OUTPUT=my demo").returncode == 0
    assert clone.asked()[-1] == "demo --output my demo"
