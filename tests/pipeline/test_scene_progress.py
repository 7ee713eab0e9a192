"""Progress of several scenes: every message begins with the name of its scene."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import lexsplat
from lexsplat.pipeline.scene_progress import named_messages
from lexsplat.scenes.formats.foreign import warn


def test_a_warning_about_a_file_of_another_program_begins_with_the_name_of_the_scene(caplog):
    with named_messages("kitchen"):
        warn("%s: %d Gaussians are ignored", Path("splats.ply"), 3)
    warn("%s: %d Gaussians are ignored", Path("splats.ply"), 4)
    assert caplog.messages == [
        "kitchen: splats.ply: 3 Gaussians are ignored",
        "splats.ply: 4 Gaussians are ignored",
    ]


@pytest.mark.slow
def test_every_module_logs_where_messages_get_the_name_of_their_scene():
    """The filter of a logger sees nothing that is logged to the loggers below it."""
    for path in sorted(Path(lexsplat.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("getLogger"):
                assert ast.unparse(node) in (
                    "logging.getLogger('lexsplat')",
                    "logging.getLogger('mcp')",
                ), f"{path}:{node.lineno}"
