"""The command ``lexsplat mcp`` as clients start and leave it."""

import json
import signal
import socket
import subprocess
import sys

import pytest

from lexsplat import cli


def run(*arguments):
    command = [sys.executable, "-m", "lexsplat", "mcp", "demo", *arguments]
    return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_a_client_that_leaves_at_once_leaves_a_server_that_ends_in_order():
    for _ in range(2):  # the warm-up may be anywhere
        left = run()
        assert (left.returncode, left.stderr) == (0, "")


@pytest.mark.slow
def test_a_taken_port_and_a_foreign_address_end_in_one_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        refused = run("--http", "--port", str(port))
    assert refused.returncode == 1
    assert len(refused.stderr.splitlines()) == 1
    assert f"{port} is taken" in refused.stderr
    foreign = run("--http", "--host", "host.invalid", "--token", "0123456789abcdef")
    assert foreign.returncode == 1
    assert len(foreign.stderr.splitlines()) == 1
    assert "host.invalid" in foreign.stderr


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
def test_ctrl_c_ends_a_server_in_order_though_its_client_stays(over):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    words = ["mcp", "demo", *(["--http", "--port", port] if over == "http" else [])]
    # A job in the background is started with Ctrl-C ignored.
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"from lexsplat import cli; sys.exit(cli.main({words}))"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=pipe, stdout=pipe, stderr=pipe, text=True
    ) as server:
        try:
            if over == "stdio":
                server.stdin.write(json.dumps(INITIALIZE) + "\n")
                server.stdin.flush()
            assert server.stdout.readline()
            server.send_signal(signal.SIGINT)
            assert server.wait(30) == 0
            assert "stopped" not in server.stderr.read()
        finally:
            server.kill()


def test_a_server_over_http_states_its_address(monkeypatch, capsys):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    monkeypatch.setattr("lexsplat.mcp.server.serve_http", lambda *_: None)
    assert cli.main(["mcp", "demo", "--http", "--port", str(port)]) == 0
    assert (
        capsys.readouterr().out == f"demo served at http://127.0.0.1:{port}/mcp (Ctrl-C stops the server)\n"
    )
