"""Wrong calls over every transport: each ends in one line that tells what to do."""

import asyncio
import json
import os

import pytest

pytest.importorskip("mcp")
from mcp import Client, MCPError
from mcp.client.stdio import StdioServerParameters
from mcp.server import MCPServer
from support.forked_commands import Command, startable
from support.mcp_clients import ask, served, talk

from lexsplat.mcp.server import http_app, make_server
from lexsplat.mcp.tools import Tools
from lexsplat.scenes.serving import OpenScene, open_scenes


@pytest.fixture(scope="module")
def scenes() -> dict[str, OpenScene]:
    return open_scenes(["demo"])


@pytest.fixture(scope="module")
def server(scenes, tmp_path_factory) -> MCPServer:
    return make_server(scenes, tmp_path_factory.mktemp("output"))


DEEP = {"a": [[[[[[[[["mug"]]]]]]]]]}
HOSTILE = [  # tool, arguments, subject of the error, what its line tells
    ("find", {"phrase": "mug", "scene": "../../etc/passwd"}, "scene '../../etc/passwd'", "no such name"),
    ("find", {"phrase": "mug", "scene": "dmo"}, "scene 'dmo'", "did you mean 'demo'?"),
    ("find", {"phrase": "mug", "view": "../view"}, "view '../view'", "the name of a view"),
    ("find", {"phrase": "mug", "view": "x" * 100_000}, f"view '{'x' * 60}'", "the name of a view"),
    ("find", {"phrase": "mug", "threshold": -1e308}, "threshold", "0..1"),
    ("find", {"phrase": "mug", "threshold": "high"}, "threshold", "expected a number or null, found 'high'"),
    ("find", {"phrase": "mug", "threshold": True}, "threshold", "found true"),
    ("find", {"phrase": "mug", "threshold": 10**400}, "threshold", "expected a number or null"),
    ("find", {"phrase": ""}, "phrase", "expected a word or phrase, found an empty text"),
    ("find", {"phrase": "\u2003\n"}, "phrase", "expected a word or phrase, found an empty text"),
    ("find", {"phrase": '"mug'}, None, "quotation"),
    ("find", {"phrase": 5}, "phrase", "expected a word or phrase, found 5"),
    ("find", {"phrase": None}, "phrase", "found null"),
    ("find", {"phrase": ["mug"]}, "phrase", "found ['mug']"),
    ("find", {"phrase": DEEP}, "phrase", "found {'a': [[["),
    ("find", {"phrase": "x" * (1 << 21)}, "phrase", "expected at most 1048576 characters, found 2097152"),
    ("find", {}, "phrase", "expected a value in find(phrase, scene, view, threshold), found none"),
    ("measure", {}, "first, second", "found none"),
    ("find", {"phrse": "mug"}, "argument 'phrse'", "did you mean 'phrase'?"),
    ("find", {"phrase": "mug", "treshold": 0.5}, "argument 'treshold'", "did you mean 'threshold'?"),
    ("find", {"phrase": "mug", "\u2028zzz\n" * 50: 1}, None, "leave it out"),
    ("list_scenes", {"scene": "demo"}, "argument 'scene'", "expected no arguments"),
    ("fnid", {"phrase": "mug"}, "tool 'fnid'", "did you mean 'find'?"),
    ("x" * 10_000, {}, f"tool '{'x' * 60}'", "no tool of this name"),
    ("what_is_at", {"view": "view_000", "x": 1e300, "y": -1e300}, None, "outside"),
    ("what_is_at", {"view": "view_000", "x": float("nan"), "y": 0}, "x", "expected a number"),
    ("what_is_at", {"view": "view_000", "x": "1e400", "y": 0}, "pixel (inf, 0)", "outside"),
    ("nearest", {"target": "mug"}, "to and point", "expected one of the two, found neither"),
    ("nearest", {"target": "mug", "to": "lamp", "point": [0, 0, 0]}, "to and point", "found both"),
    ("nearest", {"target": "mug", "to": "mug"}, "mug", "name another target"),
    (
        "nearest",
        {"target": "mug", "point": "1 2 3"},
        "point",
        "expected a list, each a number, found '1 2 3'",
    ),
    ("nearest", {"target": "mug", "point": [1, 2]}, "point", "three finite numbers"),
    ("nearest", {"target": "mug", "point": [1e200, 0, 0]}, "point", "three finite numbers"),
    ("nearest", {"target": "mug", "point": [1e400, 0, 0]}, "point[0]", "expected a number"),
    ("measure", {"first": "unicorn", "second": "mug"}, "unicorn", "not here"),
    (
        "relate",
        {"first": "mug", "relation": "besides", "second": "mug"},
        "relation",
        "expected one of left of, ",
    ),
    ("relate", {"first": "mug", "relation": "behnd", "second": "mug"}, "relation", "did you mean 'behind'?"),
    (
        "relate",
        {"first": "mug", "relation": "beside", "second": "mug"},
        "relation",
        "did you mean 'next to'?",
    ),
    (
        "render",
        {"phrases": "mug"},
        "phrases",
        "expected a list of at most 4, each a word or phrase, found 'mug'",
    ),
    ("render", {"phrases": ["a"] * 50}, "phrases", "a list of at most 4"),
    ("render", {"phrases": ["mug", 5]}, "phrases[1]", "expected a word or phrase, found 5"),
    ("render", {"phrases": [""]}, "phrases[0]", "found an empty text"),
    ("render", {"view": "view_000", "look_at": "mug"}, "view and look_at", "found both"),
    ("edit", {"action": "burn", "phrase": "mug", "folder": "x"}, "action", "one of delete, keep, recolor"),
    ("edit", {"action": "keep", "phrase": "mug", "folder": "../x"}, "folder", "expected a plain name"),
    (
        "edit",
        {"action": "keep", "phrase": "mug", "folder": "x", "confirm": "maybe"},
        "confirm",
        "true or false",
    ),
    ("export", {"phrase": "mug", "file": 5}, "file", "expected text, found 5"),
]


def is_one_refusal(reply, subject, told):
    """Whether a reply is one line with the keys of our errors that names its subject and tells what is wrong."""
    (content,) = reply.content
    error = reply.structured_content["error"]
    assert reply.is_error
    assert set(error) == {"message", "subject", "expected", "found", "remedy"}
    assert error["message"] == content.text
    assert len(content.text.splitlines()) == 1
    assert len(content.text) < 500
    assert told in content.text
    assert subject in (None, error["subject"])
    return True


@pytest.mark.parametrize(("tool", "arguments", "subject", "told"), HOSTILE)
def test_a_wrong_call_is_refused_in_one_line_that_names_the_argument(server, tool, arguments, subject, told):
    assert is_one_refusal(ask(server, tool, **arguments)[0], subject, told)


async def _all_hostile(target):
    async with Client(target) as client:
        for tool, arguments, subject, told in HOSTILE:
            if len(str(arguments)) < 1 << 20:  # an HTTP request has a limit of its own
                assert is_one_refusal(await client.call_tool(tool, arguments), subject, told)
        assert not (await client.call_tool("find", {"phrase": "x" * 100_000})).is_error
        with pytest.raises(MCPError, match="expected one of inventory, where_is"):
            await client.get_prompt("where", {})


@pytest.mark.slow
def test_over_http_wrong_calls_are_refused_in_the_same_lines(scenes, tmp_path):
    for url in served(http_app(make_server(scenes, tmp_path), "127.0.0.1", None)):
        asyncio.run(_all_hostile(url))


@pytest.mark.slow
def test_over_standard_input_and_output_wrong_calls_are_refused_in_the_same_lines(tmp_path):
    with startable("mcp", "demo", "--allow-write", "--output", str(tmp_path)) as (program, *words):
        asyncio.run(_all_hostile(StdioServerParameters(command=program, args=words, env=dict(os.environ))))


@pytest.mark.slow
@pytest.mark.parametrize(
    "phrase", ["x" * 100_000, "where is the " * 8000, "\x07\x1b[31m", "🍎", "красное яблоко"]
)
def test_any_text_is_a_phrase(server, phrase):
    reply, _ = ask(server, "find", phrase=phrase)
    assert not reply.is_error
    assert len(reply.content[0].text) < 1000


def protocol_error(server, request):
    """The error of a request, caught while the client is open."""

    async def dialogue(client):
        with pytest.raises(MCPError) as refused:
            await request(client)
        return refused.value

    return talk(server, dialogue)


def test_a_schema_takes_no_arguments_beside_its_own(server):
    for tool in talk(server, lambda client: client.list_tools()).tools:
        assert tool.input_schema["additionalProperties"] is False
        for argument in tool.input_schema["properties"].values():
            assert argument.get("description") or "enum" in argument


@pytest.mark.parametrize(
    ("name", "given", "told"),
    [
        ("where", {}, "prompt 'where': expected one of inventory, where_is"),
        ("where_is", {}, "thing: expected a value"),
        ("where_is", {"thing": "ring", "scnee": "demo"}, "did you mean 'scene'?"),
    ],
)
def test_a_wrong_prompt_is_an_error_of_one_line(server, name, given, told):
    refused = protocol_error(server, lambda client: client.get_prompt(name, given))
    assert told in str(refused)
    assert len(str(refused).splitlines()) == 1
    assert refused.error.data["error"]["subject"]


def test_a_wrong_resource_is_an_error_of_one_line(server):
    for uri in ("lexsplat://scene/nope", "lexsplat://scene/demo/view/nope"):
        refused = protocol_error(server, lambda client, uri=uri: client.read_resource(uri))
        assert refused.error.data["error"]["subject"].endswith("'nope'")


def test_a_call_that_meets_a_mistake_of_ours_is_one_structured_error_and_the_next_is_answered(
    scenes, monkeypatch
):
    def broken(self, *arguments):
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(Tools, "_scene", broken)
    server = make_server(scenes)
    assert is_one_refusal(ask(server, "count", phrase="mug")[0], "count", "ZeroDivisionError('oh')")
    monkeypatch.undo()
    assert not ask(server, "count", phrase="mug")[0].is_error


INITIALIZE = {
    "jsonrpc": "2.0", "id": 0, "method": "initialize",
    "params": {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "x", "version": "1"}},
}  # fmt: skip
CALL = b'{"jsonrpc": "2.0", "id": %d, "method": "tools/call", "params": {"name": "count", "arguments": %s}}'
LINES = [  # what a client sends, and the id and a part of its answer
    (CALL % (1, b'{"phrase": "red \\ud83c"}'), 1, "the bundled encoder knows English words alone"),
    (CALL % (2, b'{"phrase": "mug\xff"}'), 2, "the bundled encoder knows English words alone"),
    (b"\xef\xbb\xbf" + CALL % (3, b'{"phrase": "mug"}'), 3, '1 found for \\"mug\\"'),
    (CALL % (4, b'{"phrase": "mug"}') + b"\r", 4, '1 found for \\"mug\\"'),
    (CALL % (5, '{"phrase": "mug\u2028"}'.encode()), 5, '1 found for \\"mug\\"'),
    (CALL % (6, b'{"phrase": "mug", "threshold": NaN}'), 6, "threshold"),
    (CALL % (7, b'{"a":' * 5000 + b"1" + b"}" * 5000), None, "expected one message of JSON-RPC 2.0"),
    (CALL % (8, b"[1]"), 8, "Invalid request parameters"),
    (b'{"id": 9}', 9, "expected one message of JSON-RPC 2.0"),
    (b"not json", None, "expected one message of JSON-RPC 2.0"),
    (b"[]", None, "expected one message of JSON-RPC 2.0"),
    (b"\xff\xfe", None, "expected one message of JSON-RPC 2.0"),
]  # fmt: skip


@pytest.mark.slow
def test_each_line_of_standard_input_gets_one_answer_whatever_it_holds():
    with Command("mcp", "demo") as started:
        started.say(json.dumps(INITIALIZE) + "\n")
        started.say('{"jsonrpc": "2.0", "method": "notifications/initialized"}\n\n \r\n')
        assert json.loads(started.stdout.readline())["id"] == 0
        for sent, identity, told in LINES:
            started.say(sent.decode("utf-8", "surrogateescape") + "\n")
            answer = started.stdout.readline().decode()
            assert json.loads(answer)["id"] == identity, sent[:100]
            assert told in answer
        left = started.ended(seconds=60)
    assert left.status == 0
    assert "Traceback" not in left.err
