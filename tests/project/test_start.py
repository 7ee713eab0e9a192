"""What a command loads: nothing that its answer does not need. `benchmarks/start.py` measures the time."""

import functools
import json
from collections.abc import Callable

import pytest
from support.warm_starts import Ended, Program, Stage, run_warm

from lexsplat.cli import COMMANDS
from lexsplat.scenes.library import Library

LIBRARIES = {
    "PIL", "gsplat", "huggingface_hub", "jinja2", "numba", "numpy", "pycolmap", "rich", "safetensors", "scipy",
    "simplemma", "skimage", "sklearn", "starlette", "sympy", "tokenizers", "torch", "transformers", "tyro", "uvicorn",
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

WARMER = (
    (), ("tyro", "tyro._backends._tyro_backend", "typeguard", "rich.progress", "rich.table"),
    ("torch", "numpy"), ("PIL.ImageFont",),
    ("scipy.cluster.hierarchy", "scipy.ndimage", "scipy.sparse.csgraph", "scipy.spatial"),
    ("safetensors.torch",), ("numba",),
)  # fmt: skip
"""Libraries in the order in which the process imports them whose forks the programs are.

A program may find imported what it may load: then its own imports of that prove nothing.
"""
QUICK = 2
"""Stages that import nothing large."""

REPORT = """
import json, sys
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})), file=sys.stderr)
"""
COMMAND = """
from lexsplat.__main__ import main
try:
    assert main() == 0
except SystemExit:
    pass
"""
LOAD = """
from lexsplat.features.encoders import load_clip, load_dino
load_clip("bundled").encode_text(["apple"])
load_dino("bundled")
"""
IMPORT, OPEN = "import lexsplat", "import lexsplat; lexsplat.open_scene('demo', device='cpu')"

EXPECTED: dict[tuple[str, ...], tuple[str, set[str]]] = {
    **{(name, "--help"): (COMMAND, HELP_PAGES.get(name, set()) | HELP) for name in COMMANDS},
    **{words: (COMMAND, libraries) for words, libraries in ALLOWED.items()},
    (IMPORT,): (IMPORT, set()),
    (OPEN,): (OPEN, ANSWER),
    (LOAD,): (LOAD, {"numpy", "safetensors", "tokenizers", "torch"}),
}
"""Programs, their code, and the libraries that they may load."""


def stage_of(words: tuple[str, ...]) -> int:
    """The last stage before which only libraries are imported that a program may load."""
    allowed = EXPECTED[words][1]
    fits = [{name.partition(".")[0] for name in names} & LIBRARIES <= allowed for names in WARMER]
    return (*fits, False).index(False) - 1


@pytest.fixture(scope="module")
def surplus(tmp_path_factory) -> Callable[..., set[str]]:
    """The libraries that a program loads beyond what it may.

    Programs share a working directory with a library of the bundled scene, "rooms".
    """
    place = tmp_path_factory.mktemp("place")
    Library.create(place / "rooms", device="cpu").add("demo")

    @functools.cache
    def ended(quick: bool) -> dict[tuple[str, ...], Ended]:
        names, stages = [], []
        for number in range(QUICK) if quick else range(len(WARMER)):
            here = [words for words in EXPECTED if stage_of(words) == number and (number < QUICK) is quick]
            programs = [Program(EXPECTED[w][0] + REPORT, w, str(place), {"COLUMNS": "80"}) for w in here]
            names += here
            stages.append(Stage(WARMER[number], [[program] for program in programs]))
        return dict(zip(names, run_warm(*stages), strict=True))

    def of(*words: str) -> set[str]:
        done = ended(stage_of(words) < QUICK)[words]
        assert done.status == 0, done.err
        return set(json.loads(done.err.splitlines()[-1])) & LIBRARIES - EXPECTED[words][1]

    return of


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in HELP_PAGES])
def test_help_pages_without_settings_load_no_library_of_the_work(surplus, name):
    assert surplus(name, "--help") == set()


@pytest.mark.slow
@pytest.mark.parametrize("name", HELP_PAGES)
def test_help_pages_with_settings_load_what_the_settings_need(surplus, name):
    assert surplus(name, "--help") == set()


@pytest.mark.slow
@pytest.mark.parametrize("words", [w for w, libraries in ALLOWED.items() if libraries <= HELP], ids=" ".join)
def test_the_overview_and_wrong_usage_load_no_library_of_the_work(surplus, words):
    assert surplus(*words) == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [w for w, libraries in ALLOWED.items() if not libraries <= HELP], ids=" ".join
)
def test_a_command_loads_what_its_answer_needs_and_no_more(surplus, words):
    assert surplus(*words) == set()


def test_importing_lexsplat_loads_no_library(surplus):
    assert surplus(IMPORT) == set()


@pytest.mark.slow
def test_opening_a_scene_loads_no_structure_from_motion_and_no_transformers(surplus):
    assert surplus(OPEN) == set()


@pytest.mark.slow
def test_loading_the_bundled_encoders_loads_neither_transformers_nor_the_compiler_of_torch(surplus):
    assert surplus(LOAD) == set()
