"""The commands ``ask`` and ``mcp``."""

import importlib.util
import io
import json
import sys

import pytest
from support.forked_commands import Command

from lexsplat import cli


@pytest.mark.slow
def test_each_line_of_the_input_is_answered_with_a_line(monkeypatch, capsys):
    lines = 'where is the mug?\n\n{"ask": "unicorn", "id": 5}\n{"ask": 1}\n\xff\n'.encode("latin-1")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(lines), encoding="latin-1"))
    assert cli.main(["ask", "demo", "--stdin", "--device", "cpu"]) == 0
    answers = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [answer.get("present", "error") for answer in answers[:3]] == ["yes", "no", "error"]
    assert "error" not in answers[3], "bytes that are not UTF-8 are replaced"
    assert answers[1]["id"] == 5


@pytest.mark.slow
def test_an_output_that_is_not_utf_8_gets_every_answer():
    lines = '{"ask": "mug", "id": "\\ud800"}\n{"ask": "mug", "threshold": [1]}\n🍎\nduck\n'
    with Command("ask", "demo", "--stdin", "--device", "cpu", encoding="cp1252") as asked:
        done = asked.ended(lines)
    assert done.status == 0, done.err
    answers = [json.loads(line) for line in done.out.splitlines()]
    assert [answer.get("present", "error") for answer in answers] == ["yes", "error", "unsure", "yes"]
    assert (answers[0]["id"], answers[2]["phrase"]) == ("\ud800", "🍎")


def test_a_question_on_the_command_line_is_answered_with_a_sentence(capsys):
    assert cli.main(["ask", "demo", "how many apples are there?", "--device", "cpu"]) == 0
    assert capsys.readouterr().out.startswith('1 found for "apple": apple at (')


@pytest.mark.parametrize("arguments", [["ask", "demo"], ["ask", "demo", "mug", "--stdin"], ["mcp"]])
def test_wrong_usage_is_reported(arguments):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2


@pytest.mark.parametrize(
    "options",
    [
        ["--http", "--host", "0.0.0.0"],
        ["--http", "--token", "short"],
        ["--http", "--port", "0"],
        ["--http", "--port", "70000"],
        ["--port", "8000"],
        ["--host", "0.0.0.0"],
        ["--token", "0123456789abcdef"],
    ],
)
def test_an_open_door_is_refused(options, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["mcp", "demo", *options])
    assert stop.value.code == 2


def test_without_the_extra_mcp_names_it_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert cli.main(["mcp", "demo"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert 'pip install "lexsplat[mcp]"' in error
