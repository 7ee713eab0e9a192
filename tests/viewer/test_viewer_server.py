"""The viewer as a server: where it listens, what it serves, what it says when it cannot start."""

import http.client
import socket

import pytest
from support.viewer_scene import WORDS, ball_scene

from lexsplat.geometry.cameras import look_at
from lexsplat.runtime.errors import BackendError
from lexsplat.viewer.guard import Guard
from lexsplat.viewer.history import Memory
from lexsplat.viewer.server import ViewerConfig, ViewerServer, is_loopback

pytest.importorskip("viser")

FRONT = look_at([0.0, -5.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 64, 48, 0.8)
BACK = look_at([0.0, 5.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 64, 48, 0.8)


@pytest.fixture(scope="module")
def viewer():
    scene, ground_truth = ball_scene(per_ball=60)
    running = ViewerServer(scene, ViewerConfig(port=0))
    running.ground_truth = ground_truth
    yield running
    running.stop()


def get(port: int, path: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path)
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response.status, content


def test_it_listens_on_this_machine_alone(viewer):
    sockets = viewer.viser._websock_server
    assert ViewerConfig().host == "127.0.0.1"
    assert viewer.url == f"http://127.0.0.1:{viewer.port}"
    assert sockets._host == "127.0.0.1"
    outside = socket.gethostbyname(socket.gethostname())
    if is_loopback(outside):
        pytest.skip("this machine has no other address")
    with socket.socket() as probe:
        probe.settimeout(2)
        assert probe.connect_ex((outside, viewer.port)) != 0


def test_it_serves_its_page_and_no_file_beside_it(viewer):
    status, page = get(viewer.port, "/")
    assert status == 200
    assert b"<html" in page[:200]
    for path in ("/../../_viser.py", "/%2e%2e/%2e%2e/_viser.py", "/..%5c..%5c_viser.py", "//etc/passwd",
                 "/viewer.json", "/index.html/../../../infra/_infra.py", "/%00", "/" + "a" * 3000):  # fmt: skip
        status, content = get(viewer.port, path)
        assert status in (400, 404), path[:40]
        assert b"import" not in content


def test_a_port_in_use_gives_the_next_one(viewer):
    second = ViewerServer(ball_scene(per_ball=60)[0], ViewerConfig(port=viewer.port))
    try:
        assert second.port != viewer.port
    finally:
        second.stop()


@pytest.mark.parametrize("host", ["203.0.113.7", "no.such.name.invalid", "1.2.3.4.5"])
def test_an_address_that_is_not_ours_is_told_at_once(host):
    with pytest.raises(BackendError, match="--host"):
        ViewerServer(ball_scene(per_ball=60)[0], ViewerConfig(host=host, port=0))


def test_it_does_not_start_unguarded(monkeypatch):
    monkeypatch.setattr(Guard, "_guarded", lambda self, options: options)
    monkeypatch.setattr(
        Guard, "in_place", property(lambda self: False, lambda self, value: None), raising=False
    )
    with pytest.raises(BackendError, match="viser"):
        ViewerServer(ball_scene(per_ball=60)[0], ViewerConfig(port=0))


@pytest.mark.parametrize(
    ("host", "local"),
    [
        ("127.0.0.1", True),
        ("127.9.9.9", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("", False),
    ],
)
def test_loopback_addresses_are_known(host, local):
    assert is_loopback(host) is local


@pytest.mark.parametrize("options", [{"port": -1}, {"port": 70_000}, {"splats": 0}])
def test_nonsense_settings_are_refused(options):
    with pytest.raises(ValueError, match="must be"):
        ViewerConfig(**options)


def test_asking_reaches_session_and_panels(viewer):
    viewer.panels.ask(WORDS[1])
    viewer.panels.wait()
    assert viewer.session.selection is not None
    assert len(viewer.session.selection) == 60
    assert viewer.panels.seconds["ask"] > 0
    viewer.panels._remove("Remove all")
    assert viewer.session.all_questions() == []


def test_words_that_a_user_writes_are_what_a_click_is_answered_with(viewer):
    before = viewer.session.memory.vocabulary
    viewer.panels._vocabulary.value = "ball 3,  a spoon\nball 3, ball 1"
    viewer.panels._change_vocabulary()
    assert viewer.session.memory.vocabulary == ["ball 3", "a spoon", "ball 1"]
    assert viewer.panels._vocabulary.value == "ball 3, a spoon, ball 1"
    view = viewer.session.scene.views["view0"].camera
    labels = viewer.ground_truth.labels
    place = view.K @ (view.viewmat[:3, :3] @ viewer.ground_truth.gaussians.means[labels == 3].numpy().mean(0)
                      + view.viewmat[:3, 3])  # fmt: skip
    viewer.panels._what_is(view, *(place[:2] / place[2]))
    found = viewer.panels._answer.content
    assert "ball 3" in found or "ball 1" in found  # a ball may stand before it
    assert "ball 0" not in found, "what is not in the list is not an answer"
    viewer.session.memory.set_vocabulary(before)
    viewer.panels._remove("Remove all")


def test_what_goes_wrong_is_told_on_the_page(viewer):
    viewer.panels._guarded(lambda: viewer.panels.ask(" "))
    assert viewer.panels._message.visible
    assert "prompt" in viewer.panels._message.content
    viewer.panels._guarded(lambda: None)
    assert not viewer.panels._message.visible


def test_only_what_changes_is_sent_again(viewer):
    viewer.panels._redraw()
    assert viewer.display.draw(viewer.session.colors()) == 0


def test_the_command_line_tells_a_scene_that_is_not_there_and_wrong_settings(tmp_path, capsys):
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
        raise KeyboardInterrupt

    monkeypatch.setattr("lexsplat.cli.view.wait_for_interrupt", visit)
    assert cli.main(["view", str(built), "--port", "0"]) == 0
    assert served == [200]


def test_what_was_asked_before_can_be_asked_again_from_the_first_moment(monkeypatch):
    monkeypatch.setattr(Memory, "load", lambda *_: Memory(history=["red mug", "apple"]))
    running = ViewerServer(ball_scene(per_ball=20)[0], ViewerConfig(port=0))
    try:
        assert running.panels._history.options[1:] == ("red mug", "apple")
    finally:
        running.stop()


def test_left_and_right_are_those_of_the_page_that_asks(viewer, monkeypatch):
    """Another page that moved last does not turn them round."""
    asked = []
    pages = {"mine": FRONT, "another": BACK}
    monkeypatch.setattr("lexsplat.viewer.panels.page_camera", pages.__getitem__)
    monkeypatch.setattr(viewer.session, "refine", lambda question, viewpoint: asked.append(viewpoint))
    monkeypatch.setattr(viewer.panels, "_viewpoint", BACK)
    viewer.panels.ask("ball 1 left of ball 2", "mine")
    viewer.panels.wait()
    viewer.panels._change_threshold("mine")
    viewer.panels.wait()
    viewer.panels.ask("ball 3")
    viewer.panels.wait()
    viewer.panels._remove("Remove all")
    assert [camera is FRONT for camera in asked] == [True, True, False]
