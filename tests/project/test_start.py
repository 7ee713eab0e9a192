"""What a command loads: nothing that its answer does not need. `benchmarks/start.py` measures the time."""

import json
import os
import subprocess
import sys

import pytest

LIBRARIES = {
    "PIL", "gsplat", "huggingface_hub", "jinja2", "numba", "numpy", "pycolmap", "rich", "safetensors", "scipy",
    "simplemma", "skimage", "sklearn", "starlette", "tokenizers", "torch", "transformers", "tyro", "uvicorn",
}  # fmt: skip
"""Everything that takes more than a few milliseconds to import; a command may load what its row lists."""
HELP = {"rich", "tyro"}
FACTS = {*HELP, "PIL", "numpy", "torch"}
ANSWER = {*FACTS, "numba", "safetensors", "scipy"}

ALLOWED = {
    ("--help",): set(),
    ("--version",): set(),
    ("query", "--help"): HELP,
    ("find", "--help"): HELP,
    ("view", "--help"): HELP,
    ("query", "demo"): HELP,  # wrong usage
    ("info", "demo"): FACTS,
    ("query", "demo", "red apple", "--no-images"): ANSWER,
    ("find", "demo", "red apple"): {*ANSWER, "simplemma"},
    ("find", "demo", "a word that nobody asked before"): {*ANSWER, "simplemma", "tokenizers"},
}
"""Libraries that a command may load."""


def loaded(code: str, *arguments: str, **environment: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", f"import json, sys\n{code}\n"
         "print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})), file=sys.stderr)", *arguments],
        env={**os.environ, **environment}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return set(json.loads(done.stderr.splitlines()[-1])) & LIBRARIES


def command(*words: str) -> set[str]:
    return loaded(
        "from lexsplat.__main__ import main\ntry: main()\nexcept SystemExit: pass", *words, COLUMNS="80"
    )


@pytest.mark.parametrize("words", [w for w, libraries in ALLOWED.items() if libraries <= HELP], ids=" ".join)
def test_help_pages_and_wrong_usage_load_no_library_of_the_work(words):
    assert command(*words) <= ALLOWED[words]


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [w for w, libraries in ALLOWED.items() if not libraries <= HELP], ids=" ".join
)
def test_a_command_loads_what_its_answer_needs_and_no_more(words):
    assert command(*words) <= ALLOWED[words]


def test_importing_lexsplat_loads_no_library():
    assert loaded("import lexsplat") == set()


@pytest.mark.slow
def test_opening_a_scene_loads_no_structure_from_motion_and_no_transformers():
    assert loaded("import lexsplat; lexsplat.open_scene('demo', device='cpu')") <= ANSWER
