"""The viewer as a server: where it listens, what it serves, and its errors at start."""

import http.client
import json
import socket
from collections.abc import Iterator

import pytest
from support.viewer_scene import ball_scene

from lexsplat.runtime.errors import BackendError, QueryError
from lexsplat.viewer.server import ViewerConfig, ViewerServer


@pytest.fixture(scope="module")
def viewer() -> Iterator[ViewerServer]:
    running = ViewerServer(ball_scene(per_ball=60)[0], ViewerConfig(port=0))
    yield running
    running.stop()


def get(port: int, path: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path)
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response.status, content


@pytest.mark.slow
def test_it_listens_on_loopback_by_default(viewer):
    assert ViewerConfig().host == "127.0.0.1"
    assert viewer.url == f"http://127.0.0.1:{viewer.port}"
    assert viewer.socket.getsockname()[0] == "127.0.0.1"


def test_it_serves_the_files_of_its_manifest_and_no_other_path(viewer):
    status, page = get(viewer.port, "/")
    assert status == 200
    assert b"<html" in page[:200]
    manifest = json.loads(get(viewer.port, "/manifest.json")[1])
    assert manifest["server"]["version"] == 1
    for name, entry in manifest["files"].items():
        status, content = get(viewer.port, f"/{name}")
        assert (status, len(content)) == (200, entry["bytes"])
    for path in ("/../../guard.py", "/%2e%2e/%2e%2e/guard.py", "/..%5c..%5cguard.py", "//etc/passwd", "/viewer.json",
                 "/index.html/../../../x.py", "/%00", "/photo/99", "/photo/-1", "/" + "a" * 3000):  # fmt: skip
        status, content = get(viewer.port, path)
        assert status in (400, 404), path[:40]
        assert b"import" not in content


def test_a_port_in_use_gives_the_next_one(viewer):
    second = ViewerServer(ball_scene(per_ball=60)[0], ViewerConfig(port=viewer.port))
    try:
        assert viewer.port < second.port < viewer.port + 50
    finally:
        second.stop()


@pytest.mark.slow
def test_stopping_frees_the_port():
    running = ViewerServer(ball_scene(per_ball=20)[0], ViewerConfig(port=0))
    port = running.port
    running.stop()
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0


@pytest.mark.parametrize("host", ["203.0.113.7", "no.such.name.invalid", "1.2.3.4.5"])
def test_a_foreign_address_is_refused_at_once(host):
    with pytest.raises(BackendError, match="--host"):
        ViewerServer(ball_scene(per_ball=20)[0], ViewerConfig(host=host, port=0))


@pytest.mark.parametrize("options", [{"port": -1}, {"port": 70_000}, {"splats": 1}])
def test_invalid_settings_are_refused(options):
    with pytest.raises(ValueError, match="must be"):
        ViewerConfig(**options)


@pytest.mark.parametrize("count", [0, 1])
def test_a_scene_of_no_or_one_gaussian_is_refused(count):
    import torch

    scene = ball_scene(per_ball=20)[0]
    few = scene.with_content(
        scene.gaussians.select(torch.arange(count)), scene.field.select(torch.arange(count))
    )
    with pytest.raises(QueryError, match="at least 2 finite Gaussians"):
        ViewerServer(few, ViewerConfig(port=0))


def test_the_command_line_refuses_a_missing_scene_and_an_invalid_port(tmp_path, capsys):
    from lexsplat import cli

    assert cli.main(["view", str(tmp_path / "nothing")]) == 1
    assert "expected a scene folder" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stopped:
        cli.main(["view", str(tmp_path), "--port", "99999"])
    assert stopped.value.code == 2


def test_the_command_line_serves_until_it_is_interrupted(built, monkeypatch, capsys):
    import urllib.request

    from lexsplat import cli

    served = []

    def visit() -> None:
        address = capsys.readouterr().out.split(" at ")[1].split()[0]
        served.append(urllib.request.urlopen(address, timeout=10).status)
        served.append(urllib.request.urlopen(f"{address}/photo/0", timeout=10).headers["Content-Type"])
        raise KeyboardInterrupt

    monkeypatch.setattr("lexsplat.cli.view.wait_for_interrupt", visit)
    assert cli.main(["view", str(built), "--port", "0"]) == 0
    assert served == [200, "image/jpeg"]
