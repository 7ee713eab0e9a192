"""The facts that every answer has: units, up, threshold, presence, best view, and the view of left and right."""

import json
import shutil
from pathlib import Path

import pytest

pytest.importorskip("mcp")
from mcp.server import MCPServer
from support.mcp_clients import ask, talk

from lexsplat import open_scene
from lexsplat.mcp.server import make_server
from lexsplat.scenes.folder import BUNDLED_SCENE
from lexsplat.scenes.serving import open_scenes

CALLS = {
    "find": {"phrase": "mug"},
    "count": {"phrase": "toys"},
    "relate": {"first": "apple", "relation": "on", "second": "cloth"},
    "nearest": {"target": "thing", "to": "lamp"},
    "measure": {"first": "apple", "second": "mug"},
    "what_is_at": {"view": "view_033", "x": 200.5, "y": 150.5},
    "render": {"look_at": "duck", "phrases": ["mug"]},
    "export": {"phrase": "mug", "file": "mug.ply"},
    "edit": {"action": "keep", "phrase": "mug", "folder": "mug"},
}
FRAME = {"up", "meters_per_unit"}
ASKED = {"understood", "note", "present", "threshold", "best_view"}


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> MCPServer:
    return make_server(open_scenes(["demo"]), tmp_path_factory.mktemp("output"))


@pytest.mark.slow
@pytest.mark.parametrize("tool", CALLS)
def test_every_answer_has_the_frame_the_unit_the_threshold_the_presence_and_the_best_view(server, tool):
    reply, _ = ask(server, tool, **CALLS[tool])
    document = reply.structured_content
    assert not reply.is_error
    assert document.keys() >= FRAME
    parts = {"find": lambda d: d["phrases"], "render": lambda d: [d["look_at"], *d["legend"]]}
    for part in parts.get(tool, lambda d: [d])(document):
        assert part.keys() >= (ASKED if tool != "what_is_at" else {"present", "threshold", "best_view"})
        assert 0 < part["threshold"] <= 1
        assert part["best_view"].startswith("view_")
    tools = {each.name: each for each in talk(server, lambda client: client.list_tools()).tools}
    assert set(tools[tool].output_schema["required"]) >= FRAME


@pytest.mark.slow
def test_a_pixel_is_answered_with_the_place_of_the_thing(server):
    reply, text = ask(server, "what_is_at", **CALLS["what_is_at"])
    center = reply.structured_content["thing"]["center"]
    assert text.startswith("rubber duck is there, at ({:.2f}, {:.2f}, {:.2f}) scene units".format(*center))
    assert "best seen in view_" in text


@pytest.mark.parametrize("relation", ["left of", "right of", "in front of", "behind"])
def test_the_view_that_left_and_right_are_seen_from_is_named(server, relation):
    given = {"first": "bottle", "relation": relation, "second": "teddy bear"}
    reply, text = ask(server, "relate", **given)
    view = reply.structured_content["seen_from"]
    assert view in open_scene("demo").views
    assert view in text
    again, _ = ask(server, "relate", **given, view=view)
    names = [[each["name"] for each in r.structured_content["instances"]] for r in (reply, again)]
    assert names[0] == names[1]
    assert again.structured_content["seen_from"] == view


def test_a_relation_of_height_and_contact_has_no_view_and_one_to_the_viewer_has(server):
    assert ask(server, "relate", **CALLS["relate"])[0].structured_content["seen_from"] is None
    reply, text = ask(server, "relate", first="apple", relation="left of", second="me")
    assert reply.structured_content["seen_from"] in text


def test_yes_perhaps_and_no_begin_a_sentence_that_reads_well(server):
    assert ask(server, "relate", **CALLS["relate"])[1].startswith("Yes: 1 found for ")
    no = ask(server, "relate", first="lamp", relation="on", second="cloth")[1]
    assert no == 'No: nothing fits ("lamp" on "cloth").'
    perhaps = ask(server, "relate", first="🍎", relation="on", second="table")[1]
    assert perhaps.count("Perhaps") == 1 or perhaps.startswith("No: nothing fits")


def test_one_scene_is_not_called_one_scenes():
    assert ask(make_server(open_scenes(["demo"])), "list_scenes")[1] == "1 scene: demo."


@pytest.fixture
def edited_table(tmp_path) -> Path:
    """A copy of the bundled scene with a step of an edit that no scene holds."""
    scene = shutil.copytree(BUNDLED_SCENE, tmp_path / "table")
    made = json.loads((scene / "scene.json").read_text())["stages"]["reconstruct"]["fingerprint"]
    (scene / "edits.jsonl").write_text(json.dumps({"reconstruction": made}) + '\n{"kind": "recolor"}\n')
    return scene


@pytest.mark.slow
def test_every_answer_says_that_a_step_of_an_edit_is_not_in_the_scene(edited_table, tmp_path):
    server = make_server(open_scenes([str(edited_table)]), tmp_path / "output")
    told = f"Note: 1 step of lexsplat edit is not in this scene; lexsplat edit {edited_table} save --output SCENE2"
    for tool in ("find", "count", "describe_scene", "render", "export"):
        reply, text = ask(server, tool, **CALLS.get(tool, {}))
        assert text.count(told) == 1, tool
        if tool not in ("count", "render"):
            assert reply.structured_content["unsaved_steps"] == 1
    reply, text = ask(server, "list_scenes")
    assert text == "1 scene: table (1 unsaved step)."
    assert reply.structured_content["scenes"][0]["unsaved_steps"] == 1
    (edited_table / "edits.jsonl").unlink()
    reply, text = ask(server, "find", phrase="mug")
    assert (reply.structured_content["unsaved_steps"], "step" in text) == (0, False)
