"""What docs/mcp.md shows: its transcript is replayed over standard input and output, its set-up is read as JSON."""

import asyncio
import json
import os
import re
from pathlib import Path

import pytest

pytest.importorskip("mcp")
from mcp import Client
from mcp.client.stdio import StdioServerParameters
from support.forked_commands import startable

from lexsplat.cli import main

PAGE = (Path(__file__).parents[2] / "docs" / "mcp.md").read_text()
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def transcript():
    """Tool, arguments and the sentence that the page shows, of each call."""
    section = PAGE.split("### Transcript")[1].split("\n## ")[0]
    calls = re.findall(r"^    (\w+) (\{.*\})\n((?:      .+\n)+)", section, re.MULTILINE)
    return [(tool, json.loads(given), " ".join(said.split())) for tool, given, said in calls]


@pytest.mark.slow
def test_the_transcript_of_the_page_is_what_a_client_gets_over_standard_input_and_output():
    async def replay(command):
        server = StdioServerParameters(command=command[0], args=command[1:], env=dict(os.environ))
        async with Client(server) as client:
            return [await client.call_tool(tool, given) for tool, given, _ in transcript()]

    assert len(transcript()) >= 7
    with startable("mcp", "demo") as command:
        replies = asyncio.run(replay(command))
    for (tool, given, shown), reply in zip(transcript(), replies, strict=True):
        said = reply.content[0].text
        assert NUMBER.sub("#", said) == NUMBER.sub("#", shown), (tool, given)
        figures = [float(number) for number in NUMBER.findall(said)]
        assert figures == pytest.approx([float(n) for n in NUMBER.findall(shown)], abs=0.01), (tool, given)
        assert not reply.is_error
        assert reply.structured_content


def test_the_set_up_of_each_client_is_json_and_starts_a_command_that_exists(capsys):
    set_up = [
        json.loads(block) for block in re.findall(r"^    (\{\"\w*[sS]ervers\".*?\}\}\})$", PAGE, re.M | re.S)
    ]
    assert [list(each) for each in set_up] == [["mcpServers"], ["servers"]]
    for each in set_up:
        ((server,),) = [list(servers.values()) for servers in each.values()]
        assert server["command"].endswith("/lexsplat")
        with pytest.raises(SystemExit) as stopped:
            main([server["args"][0], "--help"])
        assert stopped.value.code == 0
    assert capsys.readouterr().out.count("usage: lexsplat mcp") == 2
