"""A library over MCP: what its search does not understand, one scene without its name, and a folder that is gone."""

import shutil
from pathlib import Path

import pytest

pytest.importorskip("mcp")
from mcp import MCPError
from mcp.server import MCPServer
from support.library_scenes import OTHERS, install, write_scene
from support.mcp_clients import ask, talk
from support.schemas import validated

from lexsplat.mcp.server import make_server
from lexsplat.runtime.files import read_json
from lexsplat.scenes.library import Library
from lexsplat.scenes.serving import open_scenes

pytestmark = pytest.mark.slow

SCHEMA = Path(__file__).parents[2] / "docs" / "schemas" / "library.json"


@pytest.fixture(autouse=True)
def _encoders(monkeypatch) -> None:
    install(monkeypatch)


@pytest.fixture
def library(tmp_path):
    """A library of a kitchen."""
    found = Library.create(tmp_path / "library")
    found.add(write_scene(tmp_path / "kitchen"))
    return found


@pytest.fixture
def server(library) -> MCPServer:
    return make_server({}, library=library)


def test_the_search_of_a_library_has_the_keys_of_the_command(server):
    tools = {each.name: each for each in talk(server, lambda client: client.list_tools()).tools}
    declared, described = tools["search_library"].output_schema, read_json(SCHEMA)["$defs"]
    for part, name in ((declared, "answer"), (declared["$defs"]["Hit"], "hit")):
        assert part["properties"].keys() == described[name]["properties"].keys() - {"thumbnail"}
        assert set(part["required"]) == set(described[name]["required"])


def test_a_search_reports_what_it_did_not_understand_or_corrected(server):
    reply, text = ask(server, "search_library", phrase="why is the sky blue")
    document = reply.structured_content
    validated("library", {"library": "x", "phrases": [document]})
    assert (document["present"], document["hits"]) == ("unsure", [])
    assert "not understood" in document["note"]
    assert text == f'In no scene: nothing fits "why is the sky blue". Note: {document["note"]}.'
    reply, text = ask(server, "search_library", phrase="bananna")
    document = reply.structured_content
    validated("library", {"library": "x", "phrases": [document]})
    assert (document["present"], document["understood"]) == ("yes", '"banana"')
    assert 'asked for "banana"' in document["note"]
    assert text.startswith('In 1 of 1 scene: kitchen: present: yes. 1 found for "banana"')
    assert text.count(document["note"]) == 1
    either = ask(server, "search_library", phrase="mug or dog")[0].structured_content
    assert (either["present"], either["note"]) == ("yes", 'nothing fits "dog"')


def test_the_scene_of_a_library_of_one_needs_no_name_and_those_of_two_do(server, library, tmp_path):
    answer = ask(server, "find", phrase="mug")[0].structured_content
    assert answer["phrases"][0]["present"] == "yes"
    assert ask(server, "describe_scene")[0].structured_content["views"] > 0
    assert "A library of 1 scene: kitchen." in ask(server, "list_scenes")[1]
    library.add(write_scene(tmp_path / "office", OTHERS))
    reply, _ = ask(server, "find", phrase="mug")
    assert reply.is_error
    assert reply.structured_content["error"]["expected"] == "one of kitchen, office"
    assert "A library of 2 scenes: kitchen, office." in ask(server, "list_scenes")[1]


def test_a_scene_that_cannot_be_asked_leaves_the_search_unsure(server, tmp_path):
    shutil.rmtree(tmp_path / "kitchen")
    reply, text = ask(server, "search_library", phrase="mug")
    assert reply.structured_content["present"] == "unsure"
    assert text == 'In no scene that could be asked: nothing fits "mug". 1 scene could not be asked.'


def test_a_scene_that_was_moved_is_added_from_its_new_place(server, library, tmp_path):
    (tmp_path / "kitchen").rename(tmp_path / "elsewhere")
    reply, text = ask(server, "find", phrase="mug", scene="kitchen")
    assert reply.is_error
    assert f"if it was moved: lexsplat library add {library.root} NEW_PLACE" in text
    assert "lexsplat build" not in text


def test_a_library_that_is_gone_is_an_error_with_its_place_and_a_remedy(server, library):
    ask(server, "search_library", phrase="mug")
    library.root.rename(library.root.with_name("elsewhere"))
    calls = (
        ("search_library", {"phrase": "mug"}),
        ("list_scenes", {}),
        ("find", {"phrase": "mug", "scene": "kitchen"}),
        ("find", {"phrase": "mug"}),
    )
    for tool, arguments in calls:
        reply, text = ask(server, tool, **arguments)
        assert reply.is_error, tool
        error = reply.structured_content["error"]
        assert error["subject"] == str(library.root)
        assert "moved or deleted" in error["found"]
        assert "restore the folder" in error["remedy"]
        assert str(library.root) in text
    with pytest.RaisesGroup(pytest.RaisesExc(MCPError, match="moved or deleted"), flatten_subgroups=True):
        talk(server, lambda client: client.read_resource("lexsplat://scenes"))
    library.root.with_name("elsewhere").rename(library.root)
    assert ask(server, "search_library", phrase="mug")[0].structured_content["present"] == "yes"


def test_scenes_beside_a_library_that_is_gone_are_listed_with_its_problem(library):
    server = make_server(open_scenes(["demo"]), library=library)
    shutil.rmtree(library.root)
    reply, text = ask(server, "list_scenes")
    assert not reply.is_error
    assert reply.structured_content["scenes"][0]["name"] == "demo"
    assert "moved or deleted" in reply.structured_content["library"]["problem"]
    assert "moved or deleted" in text
    assert ask(server, "find", phrase="mug", scene="demo")[0].structured_content["phrases"][0]["count"] == 1
