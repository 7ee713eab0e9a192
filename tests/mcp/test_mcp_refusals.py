"""What is refused at start, in writing, and where the protocol has no place for an answer."""

import errno
import threading
from pathlib import Path

import anyio
import pytest

pytest.importorskip("mcp")
from mcp import MCPError
from mcp.server import MCPServer
from support.mcp_clients import ask, talk

from lexsplat.cli import main
from lexsplat.mcp import writing
from lexsplat.mcp.server import make_server
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.serving import OpenScene, open_scenes


@pytest.fixture(scope="module")
def scenes() -> dict[str, OpenScene]:
    return open_scenes(["demo"])


@pytest.fixture(scope="module")
def server(scenes) -> MCPServer:
    return make_server(scenes)


@pytest.fixture(scope="module")
def output(tmp_path_factory) -> Path:
    """The folder of `writer`, where nothing stays."""
    return tmp_path_factory.mktemp("output")


@pytest.fixture(scope="module")
def writer(scenes, output) -> MCPServer:
    return make_server(scenes, output)


def refused(server, request):
    async def dialogue(client):
        with pytest.raises(MCPError) as error:
            await request(client)
        return error.value.error

    return talk(server, dialogue)


@pytest.mark.parametrize("below", ["", "folder"])
def test_an_output_that_is_a_file_is_refused_at_start_in_one_line(tmp_path, capsys, below):
    file = tmp_path / "taken"
    file.write_text("mine")
    assert main(["mcp", "demo", "--allow-write", "--output", str(file / below)]) == 1
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1
    assert f"{file}: expected a folder, found a file" in said
    assert "--output" in said
    assert file.read_text() == "mine"


@pytest.mark.parametrize("tool", ["export", "edit"])
def test_a_disk_that_takes_no_more_ends_in_one_structured_error(writer, tmp_path, monkeypatch, tool):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "new"))

    monkeypatch.setattr(writing, "export_scene", full)
    monkeypatch.setattr(Editor, "save", full)
    given = {"export": {"file": "mug.ply"}, "edit": {"action": "keep", "folder": "mug"}}[tool]
    reply, text = ask(writer, tool, phrase="mug", **given)
    error = reply.structured_content["error"]
    assert reply.is_error
    assert error["subject"] == str(tmp_path / "new")
    assert error["found"] == "No space left on device"
    assert "--output" in error["remedy"]
    assert len(text.splitlines()) == 1
    assert "report" not in text


def test_an_output_that_becomes_a_file_ends_in_one_structured_error(scenes, tmp_path):
    server = make_server(scenes, tmp_path / "output")
    (tmp_path / "output").write_text("mine")
    reply, text = ask(server, "export", phrase="mug", file="mug.ply")
    assert reply.is_error
    assert str(tmp_path / "output") in reply.structured_content["error"]["subject"]
    assert "report" not in text


@pytest.mark.slow
@pytest.mark.parametrize("tool", ["export", "edit"])
def test_a_call_that_the_client_cancels_writes_nothing(scenes, tmp_path, monkeypatch, tool):
    writes = {"export": (writing, "export_scene"), "edit": (Editor, "save")}[tool]
    given = {"export": {"file": "mug.ply"}, "edit": {"action": "keep", "folder": "mug"}}[tool]
    write, begun, left = getattr(*writes), threading.Event(), threading.Event()

    def slow(*arguments, **options):
        begun.set()
        assert left.wait(60)
        return write(*arguments, **options)

    monkeypatch.setattr(*writes, slow)

    async def dialogue(client):
        async with anyio.create_task_group() as calls:
            calls.start_soon(client.call_tool, tool, {"phrase": "mug", **given})
            await anyio.to_thread.run_sync(begun.wait, 60)
            calls.cancel_scope.cancel()
            left.set()

    server = make_server(scenes, tmp_path / "output")
    talk(server, dialogue)  # in process it ends with the call
    assert begun.is_set()
    assert not list((tmp_path / "output").iterdir())
    named = ask(server, "list_scenes")[0].structured_content["scenes"]
    assert [scene["name"] for scene in named] == ["demo"]


@pytest.mark.parametrize("name", [" ", "   ", "\t", " mug", "mug "])
def test_a_name_of_spaces_is_refused(writer, output, name):
    for tool, given in (("edit", {"action": "keep", "folder": name}), ("export", {"file": name})):
        reply, text = ask(writer, tool, phrase="mug", **given)
        assert reply.is_error
        assert "expected a plain name" in text
    assert not list(output.iterdir())


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("", "which is empty"),
        ("mug.ply ", "which has spaces at an end"),
        ("mug\n.ply", "which has characters that cannot be printed"),
        ("../mug.ply", "which is a path"),
        (".ply", "which begins with a dot"),
        ("m" * 97 + ".ply", "which has 101 characters"),
    ],
)
def test_a_name_that_is_refused_is_told_what_is_wrong_with_it(writer, name, told):
    _, text = ask(writer, "export", phrase="mug", file=name)
    assert f"expected a plain name of at most 100 characters, found {name[:60]!r}, {told}" in text
    assert 'give one such as "duck.ply"' in text


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_what_is_in_the_way_of_a_new_scene_is_called_what_it_is(writer, output, kind):
    taken = output / "mug"
    taken.mkdir() if kind == "folder" else taken.touch()
    _, text = ask(writer, "edit", phrase="mug", action="keep", folder="mug")
    taken.rmdir() if kind == "folder" else taken.unlink()
    assert f"expected a new name, found a {kind} that exists" in text


@pytest.mark.parametrize("point", [[True, 0, 0], [0.5, 0, False]])
def test_a_boolean_is_no_coordinate(server, point):
    reply, text = ask(server, "nearest", target="mug", point=point)
    assert reply.is_error
    place = next(number for number, value in enumerate(point) if isinstance(value, bool))
    assert reply.structured_content["error"]["subject"] == f"point[{place}]"
    assert f"expected a number, found {str(point[place]).lower()}" in text


@pytest.mark.parametrize(
    ("uri", "shown"),
    [
        ("lexsplat://nope", "resource 'lexsplat://nope'"),
        ("lexsplat://scnes", "resource 'lexsplat://scnes'"),
        ("lexsplat://" + "x" * 100_000, None),
        ("lexsplat://scene/" + "x" * 100_000, None),
        ("lexsplat://scene/demo/view/" + "x" * 100_000, None),
        ("file:///etc/passwd", "resource 'file:///etc/passwd'"),
    ],
)
def test_an_unknown_resource_is_one_short_line_with_our_keys(server, uri, shown):
    error = refused(server, lambda client: client.read_resource(uri))
    assert set(error.data["error"]) == {"message", "subject", "expected", "found", "remedy"}
    assert shown in (None, error.data["error"]["subject"])
    assert len(error.message) < 400
    assert len(str(error.data)) < 1200
    assert len(error.message.splitlines()) == 1


@pytest.mark.parametrize(
    ("prompt", "given", "subject"),
    [
        ("where_is", {"thing": ""}, "thing"),
        ("where_is", {"thing": " \n"}, "thing"),
        ("where_is", {"thing": "ring", "scene": "nope"}, "scene 'nope'"),
        ("inventory", {"scene": "dmo"}, "scene 'dmo'"),
    ],
)
def test_a_prompt_about_nothing_or_an_unknown_scene_is_refused(server, prompt, given, subject):
    error = refused(server, lambda client: client.get_prompt(prompt, given))
    assert error.data["error"]["subject"] == subject
    assert len(error.message.splitlines()) == 1


def test_a_prompt_names_the_scene_only_where_one_is_given(server):
    async def dialogue(client):
        given = ({"thing": "ring"}, {"thing": "ring", "scene": "demo"})
        return [(await client.get_prompt("where_is", each)).messages[0].content.text for each in given]

    without, named = talk(server, dialogue)
    assert "  " not in without
    assert "the place demo" in named
