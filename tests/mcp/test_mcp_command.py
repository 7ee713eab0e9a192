"""The command ``lexsplat mcp`` as clients start and leave it."""

import json
import signal
import socket

import pytest
from support.forked_commands import Command
from support.warm_starts import Ended

from lexsplat import cli
from lexsplat.cli.waiting import LateProgress
from lexsplat.scenes.library import Library


@pytest.fixture
def free_port() -> str:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return str(free.getsockname()[1])


def run(*arguments: str, said: str = "", patience: float = 3600.0) -> Ended:
    """The end of a server whose client says something and leaves; it shows waits beyond the patience in seconds."""

    def wait() -> None:
        LateProgress.__init__.__defaults__ = (patience,)

    with Command("mcp", "demo", *arguments, prepare=wait) as server:
        return server.ended(said)


@pytest.mark.slow
def test_a_client_that_leaves_at_once_leaves_a_server_that_ends_in_order():
    left = run()
    assert (left.status, left.err) == (0, "")


@pytest.mark.slow
def test_progress_is_shown_on_standard_error_and_standard_output_is_the_protocol():
    left = run(said=json.dumps(INITIALIZE) + "\n", patience=0.0)
    assert left.status == 0
    assert "start: 0:00 so far" in left.err
    assert "scene: 0:00 so far" in left.err
    assert [json.loads(line)["id"] for line in left.out.splitlines()] == [1]


def test_opening_scenes_and_a_library_sends_events_of_progress(tmp_path, monkeypatch, free_port, capsys):
    Library.create(tmp_path / "rooms", device="cpu")
    events = []
    monkeypatch.setattr("lexsplat.cli.mcp.LateProgress", lambda: events.append)
    monkeypatch.setattr("lexsplat.mcp.server.serve_http", lambda *_: None)
    monkeypatch.setattr("lexsplat.scenes.serving.OpenScene.warm", lambda _: None)
    assert cli.main(["mcp", str(tmp_path / "rooms"), "demo", "--http", "--port", free_port]) == 0
    assert [(event.stage, event.done) for event in events] == [
        ("library", 0), ("library", 1), ("scene", 0), ("scene", 1),
    ]  # fmt: skip


@pytest.mark.slow
def test_a_taken_port_and_a_foreign_address_end_in_one_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        refused = run("--http", "--port", str(port))
    assert refused.status == 1
    assert len(refused.err.splitlines()) == 1
    assert f"{port} is taken" in refused.err
    foreign = run("--http", "--host", "host.invalid", "--token", "0123456789abcdef")
    assert foreign.status == 1
    assert len(foreign.err.splitlines()) == 1
    assert "host.invalid" in foreign.err


INITIALIZE = {
    "jsonrpc": "2.0",
    "id": 1,
    "method": "initialize",
    "params": {
        "protocolVersion": "2025-06-18",
        "capabilities": {},
        "clientInfo": {"name": "test", "version": "1"},
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("over", ["stdio", "http"])
def test_ctrl_c_ends_a_server_in_order_though_its_client_stays(over, free_port):
    words = ["mcp", "demo", *(["--http", "--port", free_port] if over == "http" else [])]
    with Command(*words) as server:
        if over == "stdio":
            server.say(json.dumps(INITIALIZE) + "\n")
        assert server.stdout.readline()
        server.send_signal(signal.SIGINT)
        assert server.wait(60) == 0
        assert "stopped" not in server.errors()


def test_a_server_over_http_states_its_address(monkeypatch, free_port, capsys):
    monkeypatch.setattr("lexsplat.mcp.server.serve_http", lambda *_: None)
    assert cli.main(["mcp", "demo", "--http", "--port", free_port]) == 0
    assert (
        capsys.readouterr().out
        == f"demo served at http://127.0.0.1:{free_port}/mcp (Ctrl-C stops the server)\n"
    )
