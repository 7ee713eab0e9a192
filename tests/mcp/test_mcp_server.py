# ruff: noqa: E501  (one question a line)
"""The MCP server, through the client of the official package."""

import asyncio
import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

pytest.importorskip("mcp")
import httpx2
from mcp import Client
from mcp.client.stdio import StdioServerParameters
from mcp.server import MCPServer
from support.forked_commands import Command, startable
from support.mcp_clients import ask, served, talk
from support.schemas import validated

from lexsplat import open_scene
from lexsplat.mcp.server import http_app, make_server
from lexsplat.runtime.files import read_json
from lexsplat.scenes.folder import BUNDLED_SCENE
from lexsplat.scenes.library import Library
from lexsplat.scenes.serving import OpenScene, open_scenes

SCHEMAS = Path(__file__).parents[2] / "docs" / "schemas"
TOKEN = "a token of sufficient length"
READING = {
    "list_scenes", "describe_scene", "list_objects", "find", "count", "relate", "nearest", "measure", "what_is_at",
    "render",
}  # fmt: skip


@pytest.fixture(scope="module")
def scenes() -> dict[str, OpenScene]:
    return open_scenes(["demo"])


@pytest.fixture(scope="module")
def server(scenes) -> MCPServer:
    return make_server(scenes)


@pytest.fixture(scope="module")
def writing_server(scenes, tmp_path_factory) -> tuple[MCPServer, Path]:
    """A server that writes, and its folder."""
    folder = tmp_path_factory.mktemp("writer")
    return make_server(scenes, folder), folder


@pytest.fixture(scope="module")
def writing(scenes, tmp_path_factory):
    """A server that writes, its folder, and its reply to an edit."""
    folder = tmp_path_factory.mktemp("writing") / "output"
    server = make_server(scenes, folder)
    return server, folder, ask(server, "edit", action="delete", phrase="toy car", folder="demo")


def place(thing):
    return thing["center"][:2]


@pytest.mark.slow
def test_the_tools_are_described_and_read_only(server):
    tools = talk(server, lambda client: client.list_tools()).tools
    assert {tool.name for tool in tools} == READING
    for tool in tools:
        assert tool.description
        assert tool.annotations.read_only_hint
        Draft202012Validator.check_schema(tool.input_schema)
        Draft202012Validator.check_schema(tool.output_schema)
        assert tool.output_schema["type"] == "object"
        assert tool.output_schema["required"]


@pytest.mark.parametrize(
    ("tool", "command"), [("find", "find"), ("list_objects", "list"), ("measure", "measure")]
)
def test_the_output_schema_of_a_tool_has_the_keys_of_the_command(server, tool, command):
    tools = {each.name: each for each in talk(server, lambda client: client.list_tools()).tools}
    assert _keys(tools[tool].output_schema) == _keys(read_json(SCHEMAS / f"{command}.json"))


def _keys(schema):
    """The keys of a document, and of those in its lists, with whether each is required."""

    def walk(part):
        while "$ref" in part:
            part = schema["$defs"][part["$ref"].split("/")[-1]]
        inner = {name: walk(each) for name, each in part.get("properties", {}).items()}
        if "items" in part:
            return walk(part["items"])
        return {(name, name in part.get("required", [])): each for name, each in inner.items()}

    return walk(schema)


@pytest.mark.slow
def test_a_library_is_searched_and_its_scenes_are_asked_by_name(demo_library_copy):
    server = make_server({}, library=Library(demo_library_copy))
    tools = talk(server, lambda client: client.list_tools()).tools
    assert {tool.name for tool in tools} == {*READING, "search_library"}
    reply, text = ask(server, "search_library", phrase="is there a red apple?")
    assert "In 1 of 1 scene: demo: present: yes. 1 found" in text
    document = reply.structured_content
    (hit,) = document["hits"]
    assert (hit["scene"], hit["present"], hit["count"]) == ("demo", "yes", 1)
    validated("library", {"library": "x", "phrases": [document]})
    assert ask(server, "count", phrase="red apple", scene=hit["scene"])[0].structured_content["count"] == 1
    assert ask(server, "search_library", phrase="unicorn")[1] == 'In no scene: nothing fits "unicorn".'
    assert "library of 1 scene: demo" in ask(server, "list_scenes")[1]
    for wrong in ({"phrase": ""}, {"phrase": "mug", "limit": 0}, {"phrase": "mug", "limit": 1e9}, {}):
        assert ask(server, "search_library", **wrong)[0].is_error


THINGS = {
    "apple", "banana", "mug", "vase", "pumpkin", "rubber duck", "teddy bear", "toy car", "table lamp", "bottle",
    "stack of books", "ring", "traffic cone", "potted plant",
}  # fmt: skip
DIALOGUE = [  # from the layout of the bundled scene
    ("find", {"phrase": "where can I find the lamp?"}, lambda a: place(a["phrases"][0]["instances"][0]) == pytest.approx([1.5, 0.95], abs=0.25)),
    ("find", {"phrase": "is there a dog?"}, lambda a: a["phrases"][0]["present"] == "no" and not a["phrases"][0]["instances"]),
    ("find", {"phrase": "rubber dukc"}, lambda a: "dukc" in a["phrases"][0]["note"]),
    ("find", {"phrase": "what is between the mug and the books?"}, lambda a: [i["name"] for i in a["phrases"][0]["instances"]] == ["pumpkin"]),
    ("find", {"phrase": "why is the sky blue"}, lambda a: "not understood" in a["phrases"][0]["note"]),
    ("count", {"phrase": "how many fruits are there?"}, lambda a: a["count"] == 2),
    ("count", {"phrase": "how many toys are there?"}, lambda a: (a["count"], a["present"]) == (3, "yes")),
    ("count", {"phrase": "unicorns"}, lambda a: (a["count"], a["present"]) == (0, "no")),
    ("list_objects", {}, lambda a: {thing["name"] for thing in a["objects"] if not thing["surface"]} == THINGS),
    ("list_scenes", {}, lambda a: [s["name"] for s in a["scenes"]] == ["demo"]),
    ("describe_scene", {"scene": "demo"}, lambda a: {"banana", "toy car"} <= set(a["things"]) and len(a["view_names"]) == 72),
    ("relate", {"first": "apple", "relation": "on", "second": "cloth"}, lambda a: a["holds"] == "yes"),
    ("relate", {"first": "lamp", "relation": "on", "second": "cloth"}, lambda a: a["holds"] == "no" and not a["instances"]),
    ("relate", {"first": "bottle", "relation": "left of", "second": "teddy bear"}, lambda a: a["holds"] == "yes"),
    ("nearest", {"target": "thing", "to": "lamp"}, lambda a: a["nearest"]["name"] == "stack of books"),
    ("nearest", {"target": "fruit", "point": [-0.5, -1.3, 0.2]}, lambda a: place(a["nearest"]) == pytest.approx([-0.55, -1.25], abs=0.2)),
    ("measure", {"first": "apple", "second": "duck"}, lambda a: a["centers"]["units"] == pytest.approx(0.9, abs=0.15)),
    ("measure", {"first": "table", "second": "lamp"}, lambda a: a["height"]["units"] > 0.3 and a["gap"]["meters"] is None),
    ("what_is_at", {"view": "view_033", "x": 200.5, "y": 150.5}, lambda a: a["name"] == "rubber duck"),
    ("render", {"look_at": "duck", "phrases": ["duck"]}, lambda a: a["legend"][0]["peak"] > 0.7),
    ("render", {"view": "view_000"}, lambda a: a["legend"] == []),
]  # fmt: skip


@pytest.mark.slow
def test_a_dialogue_of_more_than_twenty_questions_is_answered_rightly(server):
    async def dialogue(client):
        return [await client.call_tool(tool, arguments) for tool, arguments, _ in DIALOGUE]

    assert len(DIALOGUE) > 20
    wrong = []
    for (tool, arguments, holds), reply in zip(DIALOGUE, talk(server, dialogue)):
        assert not reply.is_error, reply
        if not holds(reply.structured_content):
            wrong.append((tool, arguments, reply.structured_content))
        assert reply.content[0].text.endswith((".", ")"))
        if tool == "find":
            validator = Draft202012Validator(read_json(SCHEMAS / "find.json"))
            assert not list(validator.iter_errors(reply.structured_content))
        if tool == "render":
            assert reply.content[1].mime_type == "image/png"
    assert not wrong


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("count", {"phrase": "🍎"}),
        ("nearest", {"target": "🍎", "to": "mug"}),
        ("nearest", {"target": "mug", "to": "🍎"}),
        ("measure", {"first": "mug", "second": "🍎"}),
        ("render", {"look_at": "🍎"}),
        ("export", {"phrase": "🍎", "file": "apple.ply"}),
        ("edit", {"action": "keep", "phrase": "🍎", "folder": "apple", "confirm": True}),
    ],
)
def test_every_answer_reports_what_is_unsure_and_why(writing_server, tool, arguments):
    reply, text = ask(writing_server[0], tool, **arguments)
    asked = reply.structured_content["look_at"] if tool == "render" else reply.structured_content
    assert asked["present"] == "unsure"
    assert '"🍎"' in asked["understood"]
    assert 'not "🍎"' in asked["note"]
    assert asked["note"] in text
    assert "Perhaps" in text or tool == "edit"
    assert asked["understood"] in text or tool == "nearest"


@pytest.mark.slow
def test_an_edit_of_what_is_unsure_or_not_here_is_refused_and_one_of_a_corrected_word_reports_it(
    scenes, tmp_path
):
    server = make_server(scenes, tmp_path)
    for phrase, told in (("🍎", "confirm=true"), ("unicorn", "not here")):
        reply, text = ask(server, "edit", action="delete", phrase=phrase, folder="without")
        assert reply.is_error
        assert told in text
        assert reply.structured_content["error"]["remedy"] or phrase == "unicorn"
    assert not (tmp_path / "without").exists()
    reply, text = ask(server, "edit", action="keep", phrase="bananna", folder="banana")
    assert not reply.is_error
    assert 'asked for "banana"' in text


@pytest.mark.parametrize("color", [[], [1, 0], [1e308, 0, 1], [-1, 0, 0]])
def test_a_color_that_is_none_is_refused_with_what_was_expected(writing_server, color):
    server, folder = writing_server
    reply, text = ask(server, "edit", action="recolor", phrase="mug", folder="new", color=color)
    assert reply.is_error
    assert reply.structured_content["error"]["subject"] == "color"
    assert "in 0..1" in text
    assert not (folder / "new").exists()


def test_a_scene_that_is_deleted_is_listed_with_its_problem_beside_the_others(tmp_path):
    shutil.copytree(BUNDLED_SCENE, tmp_path / "gone")
    server = make_server(open_scenes(["demo", str(tmp_path / "gone")]))
    shutil.rmtree(tmp_path / "gone")
    reply, text = ask(server, "list_scenes")
    assert not reply.is_error
    demo, gone = reply.structured_content["scenes"]
    assert (demo["name"], demo["views"]) == ("demo", 72)
    assert gone["name"] == "gone"
    assert "moved or deleted" in gone["problem"]
    assert "moved or deleted" in text
    resource = talk(server, lambda client: client.read_resource("lexsplat://scenes"))
    assert '"problem"' in resource.contents[0].text


def test_a_count_of_nothing_says_that_it_is_not_here(server):
    assert ask(server, "count", phrase="unicorns")[1] == 'Not here: nothing fits "unicorn".'


@pytest.mark.slow
def test_heat_is_drawn_for_what_a_question_asks_and_for_what_a_relation_finds(server):
    reply, text = ask(
        server, "render", view="view_033", phrases=["where is the mug?", "mug", "what is on the cloth?"]
    )
    question, word, relation = reply.structured_content["legend"]
    assert (question["understood"], question["present"]) == ('"mug"', "yes")
    assert {**question, "phrase": ""} == {**word, "phrase": ""}
    assert relation["understood"] == '(any object on "cloth")'
    assert (relation["present"], relation["peak"] > 0.5) == ("yes", True)
    assert 'Heat for "mug": present yes' in text


def test_resources_and_prompts_are_offered(server):
    async def dialogue(client):
        facts = await client.read_resource("lexsplat://scene/demo")
        view = await client.read_resource("lexsplat://scene/demo/view/view_000")
        prompt = await client.get_prompt("where_is", {"thing": "my ring"})
        return facts, view, prompt

    facts, view, prompt = talk(server, dialogue)
    assert '"things"' in facts.contents[0].text
    assert view.contents[0].mime_type == "image/png"
    assert "my ring" in prompt.messages[0].content.text


@pytest.mark.slow
def test_the_result_of_an_edit_can_be_asked_at_once(scenes, writing):
    server, _, (reply, text) = writing
    assert not reply.is_error
    assert (reply.structured_content["name"], "the scene demo-2 in" in text) == ("demo-2", True)
    assert (
        ask(server, "find", phrase="toy car", scene="demo-2")[0].structured_content["phrases"][0]["present"]
        == "no"
    )
    assert ask(server, "find", phrase="toy car")[0].structured_content["phrases"][0]["present"] == "yes"
    reply, text = ask(server, "edit", action="delete", phrase="mug", folder="other", color=[0, 0, 1])
    assert reply.is_error
    assert "color: expected none, found one for delete" in text
    assert list(scenes) == ["demo"], "other servers are not changed"


@pytest.mark.slow
def test_tools_that_write_are_offered_on_demand_and_write_new_files_in_one_folder_alone(writing):
    server, output, (reply, _) = writing
    assert not reply.is_error
    reply, _ = ask(server, "export", phrase="rubber duck", file="duck.ply")
    assert not reply.is_error
    assert (output / "duck.ply").stat().st_size > 1000
    for name in (
        "../duck.ply",
        "/tmp/duck.ply",
        "duck.ply",
        "",
        ".duck.ply",
        "a\0.ply",
        "a" * 300 + ".ply",
        "duck.exe",
    ):
        reply, _ = ask(server, "export", phrase="rubber duck", file=name)
        assert reply.is_error, name
    assert set(output.parent.rglob("*.ply")) == {output / "duck.ply", output / "demo" / "gaussians.ply"}
    answers = open_scene(output / "demo").ask(["toy car", "red apple"])
    assert [answer["present"] for answer in answers.to_dict()["answers"]] == ["no", "yes"]


@pytest.mark.slow
def test_ten_clients_at_once_get_the_answers_of_one(server):
    async def one(phrase):
        async with Client(server) as client:
            return (await client.call_tool("find", {"phrase": phrase})).structured_content

    async def all_at_once():
        phrases = ["red apple", "what is on the cloth?", "fruit", "mug", "vase"] * 2
        return await asyncio.gather(*(one(phrase) for phrase in phrases))

    answers = asyncio.run(all_at_once())
    assert answers[:5] == answers[5:]
    assert all(answer["phrases"][0]["present"] == "yes" for answer in answers)


@pytest.mark.slow
def test_over_http_clients_are_served_and_one_that_leaves_in_the_middle_disturbs_nobody(scenes):
    server = make_server(scenes)  # an HTTP application runs once
    for url in served(http_app(server, "127.0.0.1", None)):
        with socket.create_connection(("127.0.0.1", httpx2.URL(url).port)) as rude:
            rude.sendall(b"POST /mcp HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 500\r\n\r\n{")
        reply, _ = ask(url, "find", phrase="red apple")
        assert reply.structured_content["phrases"][0]["present"] == "yes"
        initialize = {"Accept": "application/json, text/event-stream", "Content-Type": "application/json"}
        for header in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
            assert httpx2.post(url, headers={**initialize, **header}, content="{}").status_code in (403, 421)
        assert httpx2.post(url, headers=initialize, content=b" " * (2 << 20)).status_code == 413


@pytest.mark.slow
def test_elsewhere_a_token_is_needed(scenes):
    server = make_server(scenes)
    with pytest.raises(ValueError, match="token"):
        http_app(server, "0.0.0.0", None)
    for url in served(http_app(server, "0.0.0.0", TOKEN)):
        for given in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": TOKEN}):
            assert httpx2.post(url, headers=given, content="{}").status_code == 401
        for scheme in ("Bearer", "bearer"):  # names of schemes ignore case
            given = {"Authorization": f"{scheme} {TOKEN}"}
            assert httpx2.post(url, headers=given, content="{}").status_code != 401


@pytest.mark.slow
def test_over_standard_input_and_output_and_a_killed_server_is_noticed():
    async def run(program, *words):
        started = StdioServerParameters(command=program, args=words, env=dict(os.environ))
        async with Client(started) as client:
            reply = await client.call_tool("find", {"phrase": "where is the vase?"})
            assert reply.structured_content["phrases"][0]["present"] == "yes"

    with startable("mcp", "demo") as words:
        asyncio.run(run(*words))
    command = [sys.executable, "-m", "lexsplat", "mcp", "demo"]
    killed = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    killed.kill()
    _, errors = killed.communicate(timeout=30)
    assert killed.returncode != 0
    assert b"Traceback" not in errors


@pytest.mark.slow
def test_a_server_that_is_killed_while_it_is_asked_is_an_error_for_its_client_and_can_be_started_again():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    url = f"http://127.0.0.1:{port}/mcp"

    def started():
        server = Command("mcp", "demo", "--http", "--port", str(port))
        assert b"served at" in server.stdout.readline()
        return server

    async def ask_and_kill(server):
        async with Client(url) as client:
            assert not (await client.call_tool("count", {"phrase": "mug"})).is_error
            server.send_signal(signal.SIGKILL)
            server.wait(30)
            await asyncio.wait_for(client.call_tool("count", {"phrase": "vase"}), 60)

    with started() as server, pytest.raises(BaseException):  # noqa: B017  (any error, but no answer and no hanging)
        asyncio.run(ask_and_kill(server))
    with started():
        assert ask(url, "count", phrase="vase")[0].structured_content["count"] == 1
