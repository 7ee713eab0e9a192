"""The viewer as a server: where it listens, what it serves, and its errors at start."""

import http.client
import ipaddress
import socket

import pytest
from support.viewer_scene import WORDS, ball_scene

from lexsplat.geometry.cameras import look_at
from lexsplat.runtime.errors import BackendError
from lexsplat.viewer.guard import RequestGuard, restrict_messages
from lexsplat.viewer.history import History
from lexsplat.viewer.panels import title_of
from lexsplat.viewer.server import ViewerConfig, ViewerServer

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


def test_it_listens_on_loopback_by_default(viewer):
    sockets = viewer.viser._websock_server
    assert ViewerConfig().host == "127.0.0.1"
    assert viewer.url == f"http://127.0.0.1:{viewer.port}"
    assert sockets._host == "127.0.0.1"
    outside = socket.gethostbyname(socket.gethostname())
    if ipaddress.ip_address(outside).is_loopback:
        pytest.skip("this machine has no other address")
    with socket.socket() as probe:
        probe.settimeout(2)
        assert probe.connect_ex((outside, viewer.port)) != 0


def test_it_serves_one_page_and_no_other_path(viewer):
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
def test_a_foreign_address_is_refused_at_once(host):
    with pytest.raises(BackendError, match="--host"):
        ViewerServer(ball_scene(per_ball=60)[0], ViewerConfig(host=host, port=0))


def test_it_does_not_start_if_requests_cannot_be_guarded(monkeypatch):
    monkeypatch.setattr(
        RequestGuard, "in_place", property(lambda self: False, lambda self, value: None), raising=False
    )
    with pytest.raises(BackendError, match="viser"):
        ViewerServer(ball_scene(per_ball=60)[0], ViewerConfig(port=0))


def test_it_does_not_start_if_messages_cannot_be_restricted(monkeypatch):
    def twice(server) -> None:
        restrict_messages(server)
        restrict_messages(server)  # finds no handlers

    monkeypatch.setattr("lexsplat.viewer.server.restrict_messages", twice)
    with pytest.raises(BackendError, match="viser"):
        ViewerServer(ball_scene(per_ball=60)[0], ViewerConfig(port=0))


@pytest.mark.parametrize("options", [{"port": -1}, {"port": 70_000}, {"splats": 0}])
def test_invalid_settings_are_refused(options):
    with pytest.raises(ValueError, match="must be"):
        ViewerConfig(**options)


def test_asking_reaches_session_and_panels(viewer):
    viewer.panels.ask(WORDS[1])
    viewer.panels.wait()
    assert viewer.session.selection is not None
    assert len(viewer.session.selection) == 60
    assert viewer.panels.seconds["ask"] > 0
    viewer.panels.prompt.remove_all()
    assert viewer.session.all_questions() == []


def test_the_search_box_is_emptied_by_an_answer_and_by_remove_all_but_not_by_an_error(viewer):
    box = viewer.panels.search._text
    box.value = "ball 2"
    viewer.panels.ask(box.value)
    assert box.value == ""
    box.value = " "
    viewer.panels.events.run(lambda: viewer.panels.ask(box.value))
    assert box.value == " "
    viewer.panels.prompt.remove_all()
    assert box.value == ""


def test_the_page_is_named_after_the_scene(tmp_path, built):
    import lexsplat

    assert title_of(lexsplat.open_scene(built)) == f"lexsplat: {built.name}"
    assert title_of(lexsplat.open_scene("demo")) == "lexsplat: demo"
    assert title_of(ball_scene(per_ball=20)[0]) == "lexsplat"


def test_clicks_are_answered_from_the_vocabulary_of_the_user(viewer):
    before = viewer.session.history.vocabulary
    viewer.panels.click._vocabulary.value = "ball 3,  a spoon\nball 3, ball 1"
    viewer.panels.click.change_vocabulary()
    assert viewer.session.history.vocabulary == ["ball 3", "a spoon", "ball 1"]
    assert viewer.panels.click._vocabulary.value == "ball 3, a spoon, ball 1"
    view = viewer.session.scene.views["view0"].camera
    labels = viewer.ground_truth.labels
    place = view.K @ (view.viewmat[:3, :3] @ viewer.ground_truth.gaussians.means[labels == 3].numpy().mean(0)
                      + view.viewmat[:3, 3])  # fmt: skip
    viewer.panels.click.what_is(view, *(place[:2] / place[2]))
    found = viewer.panels.click._answer.content
    assert "ball 3" in found or "ball 1" in found  # another ball may occlude it
    assert "ball 0" not in found, "only phrases of the vocabulary are answers"
    viewer.session.history.set_vocabulary(before)
    viewer.panels.prompt.remove_all()


def test_errors_are_shown_on_the_page_until_the_next_success(viewer):
    viewer.panels.events.run(lambda: viewer.panels.ask(" "))
    assert viewer.panels.search._message.visible
    assert "prompt" in viewer.panels.search._message.content
    viewer.panels.events.run(lambda: None)
    assert not viewer.panels.search._message.visible


def test_unchanged_colors_are_not_sent_again(viewer):
    viewer.panels.redraw()
    assert viewer.display.draw(viewer.session.colors()) == 0


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
        raise KeyboardInterrupt

    monkeypatch.setattr("lexsplat.cli.view.wait_for_interrupt", visit)
    assert cli.main(["view", str(built), "--port", "0"]) == 0
    assert served == [200]


def test_earlier_prompts_are_offered_at_start(monkeypatch):
    monkeypatch.setattr(History, "load", lambda *_: History(prompts=["red mug", "apple"]))
    running = ViewerServer(ball_scene(per_ball=20)[0], ViewerConfig(port=0))
    try:
        assert running.panels.search._recent.options[1:] == ("red mug", "apple")
    finally:
        running.stop()


def test_left_and_right_are_those_of_the_page_that_asks(viewer, monkeypatch):
    """Even if another page moved last."""
    asked = []
    pages = {"mine": FRONT, "another": BACK}
    monkeypatch.setattr("lexsplat.viewer.panels.page_camera", pages.__getitem__)
    monkeypatch.setattr(viewer.session, "refine", lambda question, viewpoint: asked.append(viewpoint))
    monkeypatch.setattr(viewer.panels, "_viewpoint", BACK)
    viewer.panels.ask("ball 1 left of ball 2", "mine")
    viewer.panels.wait()
    viewer.panels.prompt.change_threshold("mine")
    viewer.panels.wait()
    viewer.panels.ask("ball 3")
    viewer.panels.wait()
    viewer.panels.prompt.remove_all()
    assert [camera is FRONT for camera in asked] == [True, True, False]
