"""No command imports torch or numba without a stage of progress: both take seconds on a slow machine."""

import json
import shutil
from collections.abc import Callable

import pytest
from support.warm_starts import Program, Stage, run_warm

from lexsplat.cli import COMMANDS
from lexsplat.scenes.folder import BUNDLED_SCENE

WORDS = {
    "demo": ["--iterations", "1"],
    "build": ["demo", "--output", "new", "--iterations", "1"],
    "poses": ["nowhere", "--output", "new"],
    "reconstruct": ["demo", "--output", "new", "--iterations", "1"],
    "language": ["demo", "--output", "new", "--iterations", "1"],
    "query": ["demo", "red apple", "--no-images"],
    "find": ["demo", "red apple"],
    "list": ["demo"],
    "ask": ["demo", "where is the mug?"],
    "measure": ["demo", "mug", "banana"],
    "scale": ["scene", "--distance", "1", "--height-of", "mug"],
    "evaluate": ["scene", "--capture", "demo"],
    "ablate": ["demo", "--output", "new", "--iterations", "1"],
    "compare": ["demo", "--output", "new", "--iterations", "1"],
    "edit": ["demo", "delete", "--select", "red apple"],
    "export": ["demo", "demo.ply"],
    "publish": ["demo", "page"],
    "library": ["add", "rooms", "demo"],
    "view": ["demo", "--port", "8123"],
    "encoders": ["--clip", "scene"],
    "mcp": ["demo"],
    "info": ["demo"],
}
"""What each command is given."""

LIBRARIES = (
    "tyro", "tyro._backends._tyro_backend", "typeguard", "rich.progress", "rich.table", "torch",
    "PIL.ImageFont", "scipy.cluster.hierarchy", "scipy.ndimage", "scipy.sparse.csgraph", "scipy.spatial",
    "safetensors", "numba",
)  # fmt: skip
"""What is imported before the commands; an import of it by lexsplat is still noticed."""

TRACED = """
import builtins, json, os, sys, threading
from lexsplat.cli import main, progress, waiting

HEAVY = ("torch", "numba")
load, show, stages, found = builtins.__import__, builtins.print, set(), {}

def end():
    sys.stdout.flush()
    os.write(2, ("\\n" + json.dumps(found)).encode())
    os._exit(0)

def traced_import(name, names=None, *rest, **named):
    top, by = name.partition(".")[0], (names or {}).get("__name__", "").partition(".")[0]
    waited_for = threading.current_thread() is threading.main_thread() and by != "tyro"
    if top in HEAVY and top not in found and waited_for:
        found[top] = sorted(stages)
        if len(found) == len(HEAVY):
            end()
    return load(name, names, *rest, **named)

def traced_print(*words, file=None, **named):
    if file is None:  # an answer
        end()
    show(*words, file=file, **named)

for kind in (waiting.LateProgress, progress.ProgressBars):
    def listen(self, event, receive=kind.__call__):
        (stages.discard if event.done >= event.total else stages.add)(event.stage)
        receive(self, event)
    kind.__call__ = listen
builtins.__import__, builtins.print = traced_import, traced_print
try:
    main()
finally:
    end()
"""
"""A command that ends with its first line of output, or with its last import of what is heavy.

Threads are not waited for, and tyro imports torch only where it is imported.
"""


@pytest.fixture(scope="module")
def stages(tmp_path_factory) -> Callable[[str], dict[str, list[str]]]:
    """The stages of progress under way while a command imports what is heavy."""
    programs = []
    for name, words in WORDS.items():
        place = tmp_path_factory.mktemp(name)
        if "scene" in words:
            shutil.copytree(BUNDLED_SCENE, place / "scene")
        programs.append(Program(TRACED, [name, *words], str(place)))
    ended = dict(zip(WORDS, run_warm(Stage(LIBRARIES, [[program] for program in programs])), strict=True))
    return lambda name: json.loads(ended[name].err.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_shows_progress_while_it_imports_what_takes_seconds(name, stages):
    found = stages(name)
    assert found, "nothing was imported: the test has no meaning"
    assert all(found.values()), found
