"""What a command loads: nothing that its answer does not need. `benchmarks/start.py` measures the time."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lexsplat.cli import COMMANDS
from lexsplat.scenes.library import Library

LIBRARIES = {
    "PIL", "gsplat", "huggingface_hub", "jinja2", "numba", "numpy", "pycolmap", "rich", "safetensors", "scipy",
    "simplemma", "skimage", "sklearn", "starlette", "tokenizers", "torch", "transformers", "tyro", "uvicorn",
}  # fmt: skip
"""Everything that takes more than a few milliseconds to import; a command may load what its row lists."""
HELP = {"rich", "tyro"}
FACTS = {*HELP, "PIL", "numpy", "torch"}
ANSWER = {*FACTS, "numba", "safetensors", "scipy"}
KNOWN = ANSWER - {"numba"}
"""Of answers from what a scene or a library keeps: nothing is rendered."""
SETTINGS = {*FACTS, "scipy"}

HELP_PAGES: dict[str, set[str]] = {
    "encoders": {*HELP, "numpy", "torch"},
    **dict.fromkeys(("demo", "build", "poses", "reconstruct", "language", "ablate"), SETTINGS),
    "compare": {*SETTINGS, "jinja2", "numba"},  # its rows are those of the compared methods
}
"""Libraries that a help page may load beside `HELP`, for commands that list the settings of a build."""

ALLOWED = {
    ("--help",): set(),
    ("--version",): set(),
    ("query", "demo"): HELP,  # wrong usage
    ("info", "demo"): FACTS,
    ("query", "demo", "red apple", "--no-images"): ANSWER,
    ("find", "demo", "red apple"): {*ANSWER, "simplemma"},
    ("find", "demo", "a word that nobody asked before"): {*ANSWER, "simplemma", "tokenizers"},
    ("ask", "demo", "where is the mug?"): {*KNOWN, "simplemma"},
    ("list", "demo"): {*KNOWN, "skimage"},
    ("scale", "demo"): KNOWN,
    ("edit", "demo", "list"): ANSWER,
    ("export", "demo", "demo.ply"): ANSWER,
    ("export", "demo", "demo.sog"): ANSWER,
    ("library", "add", "rooms", "demo"): ANSWER,
    ("library", "search", "rooms", "red apple"): {*KNOWN, "simplemma", "tokenizers"},
    ("library", "list", "rooms"): KNOWN,
    ("library", "verify", "rooms"): KNOWN,
}
"""Libraries that a command may load."""


def loaded(code: str, *arguments: str, place: Path | None = None, **environment: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", f"import json, sys\n{code}\n"
         "print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})), file=sys.stderr)", *arguments],
        cwd=place, env={**os.environ, **environment}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return set(json.loads(done.stderr.splitlines()[-1])) & LIBRARIES


def command(*words: str, place: Path | None = None) -> set[str]:
    code = "from lexsplat.__main__ import main\ntry: assert main() == 0\nexcept SystemExit: pass"
    return loaded(code, *words, place=place, COLUMNS="80")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A working directory with a library of the bundled scene, "rooms"."""
    folder = tmp_path_factory.mktemp("place")
    Library.create(folder / "rooms", device="cpu").add("demo")
    return folder


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in HELP_PAGES])
def test_help_pages_without_settings_load_no_library_of_the_work(name):
    assert command(name, "--help") <= HELP


@pytest.mark.slow
@pytest.mark.parametrize("name", HELP_PAGES)
def test_help_pages_with_settings_load_what_the_settings_need(name):
    assert command(name, "--help") <= HELP_PAGES[name]


@pytest.mark.parametrize("words", [w for w, libraries in ALLOWED.items() if libraries <= HELP], ids=" ".join)
def test_the_overview_and_wrong_usage_load_no_library_of_the_work(words):
    assert command(*words) <= ALLOWED[words]


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [w for w, libraries in ALLOWED.items() if not libraries <= HELP], ids=" ".join
)
def test_a_command_loads_what_its_answer_needs_and_no_more(words, place):
    assert command(*words, place=place) <= ALLOWED[words]


def test_importing_lexsplat_loads_no_library():
    assert loaded("import lexsplat") == set()


@pytest.mark.slow
def test_opening_a_scene_loads_no_structure_from_motion_and_no_transformers():
    assert loaded("import lexsplat; lexsplat.open_scene('demo', device='cpu')") <= ANSWER
