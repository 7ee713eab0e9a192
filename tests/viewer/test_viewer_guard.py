"""Who may talk to the viewer: the rules alone, then a running server."""

import http.client
import json
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.viewer_scene import ball_scene

from lexsplat.viewer import server as serving
from lexsplat.viewer.guard import MAX_BODY_BYTES, Guard, host_name, origin_host
from lexsplat.viewer.server import ViewerConfig, ViewerServer

GUARD = Guard(None, names=("splats.example",))


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1:8080",
        "localhost:8080",
        "LOCALHOST",
        "[::1]:8080",
        "192.168.1.7:80",
        "splats.example:9",
        "localhost.",
    ],
)
def test_addresses_localhost_and_allowed_names_are_served(host):
    assert GUARD.refusal([host], [], "GET") is None
    assert GUARD.refusal([host], [f"http://{host}"], "POST") is None


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8080", "127.0.0.1.evil.example", "localhost.evil.example", "", "user@127.0.0.1",
     "127.0.0.1/path", "127.0.0.1:port", "[::1", "127.0.0.1#x", "sub.splats.example", "0x7f.1.evil"],
)  # fmt: skip
def test_names_that_could_be_rebound_are_refused(host):
    assert GUARD.refusal([host], [], "GET")
    assert GUARD.refusal([host], [f"http://{host}"], "POST")


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "https://evil.example:8080", "null", "file://", "http://127.0.0.1:8081",
     "http://localhost:8080",
     "http://127.0.0.1", "http://127.0.0.1:8080.evil.example", "http://127.0.0.1:8080/page",
     "chrome-extension://abc", ""],
)  # fmt: skip
def test_a_page_of_another_origin_is_refused(origin):
    assert GUARD.refusal(["127.0.0.1:8080"], [origin], "GET")
    assert GUARD.refusal(["127.0.0.1:8080"], [origin], "POST")


def test_a_post_without_or_with_two_origins_or_hosts_is_refused():
    own = "127.0.0.1:8080"
    assert GUARD.refusal([own], [], "POST")
    assert GUARD.refusal([own], [f"http://{own}"] * 2, "POST")
    assert GUARD.refusal([own, own], [f"http://{own}"], "POST")
    assert GUARD.refusal([], [f"http://{own}"], "POST")


@given(st.text(max_size=40), st.text(max_size=60))
def test_arbitrary_headers_pass_only_by_the_rules(host, origin):
    reason = GUARD.refusal([host], [origin], "POST")
    if reason is None:
        name = host_name(host)
        assert name in GUARD.names or name.replace(".", "").isdigit() or ":" in name
        assert origin_host(origin) == host.lower()


# -- a running server


@pytest.fixture(scope="module")
def viewer() -> Iterator[ViewerServer]:
    running = ViewerServer(ball_scene(per_ball=20)[0], ViewerConfig(port=0))
    yield running
    running.stop()


def send(port: int, method: str = "GET", path: str = "/", body: bytes = b"", **headers):
    """A request with exactly these headers; the response has ``status``, ``headers`` and ``body``."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest(method, path, skip_host=True)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders(body or None)
    response = connection.getresponse()
    response.body = response.read()
    connection.close()
    return response


def ask(port: int, body: bytes, **headers):
    return send(port, "POST", "/ask", body, **{"Content_Length": str(len(body)), **headers})


@pytest.mark.slow
def test_the_page_is_served_for_its_own_host_only_and_not_in_frames(viewer):
    own = f"127.0.0.1:{viewer.port}"
    page = send(viewer.port, Host=own)
    assert page.status == 200
    assert b"<html" in page.body[:200]
    assert page.headers["X-Frame-Options"] == "DENY"
    assert "frame-ancestors 'none'" in page.headers["Content-Security-Policy"]
    assert page.headers["X-Content-Type-Options"] == "nosniff"
    assert send(viewer.port, Host="evil.example").status == 403
    assert send(viewer.port).status in (400, 403)
    assert send(viewer.port, Host=own, Origin="http://evil.example").status == 403


@pytest.mark.slow
def test_only_the_viewers_own_page_may_ask(viewer):
    own = f"127.0.0.1:{viewer.port}"
    body = json.dumps({"prompt": "ball 1", "version": 1}).encode()
    for origin in ("http://evil.example", "null", "http://localhost:1", "http://127.0.0.1"):
        assert ask(viewer.port, body, Host=own, Origin=origin).status == 403
    assert ask(viewer.port, body, Host=own).status == 403
    assert ask(viewer.port, body, Host=own, Origin=f"http://{own}").status == 200
    assert send(viewer.port, "GET", "/ask", Host=own).status in (404, 405)


def test_large_bodies_and_bodies_of_unknown_length_are_refused_unread(viewer):
    own = f"127.0.0.1:{viewer.port}"
    headers = {"Host": own, "Origin": f"http://{own}"}
    assert ask(viewer.port, b" ", **headers, Content_Length=str(MAX_BODY_BYTES + 1)).status == 413
    assert ask(viewer.port, b"0", **headers, Transfer_Encoding="chunked", Content_Length="1").status in (
        400,
        413,
    )


@pytest.mark.parametrize(
    "body", [b"", b"\xff\xfe", b"[]", b"7", b"{", b'{"version": 1}', b'{"version": 1, "prompt": 3}',
             b"[" * 60_000, b'{"version": 1, "prompt": "x", "threshold": NaN}',
             b'{"version": 1, "prompt": "x", "camera": {"viewmat": [1], "lens": []}}',
             b'{"version": 1, "prompt": "x", "instance": -1}', b'{"version": 1, "click": [1, 2]}'],
)  # fmt: skip
def test_a_malformed_question_is_answered_with_one_line_and_does_not_stop_the_server(viewer, body):
    own = f"127.0.0.1:{viewer.port}"
    answer = ask(viewer.port, body, Host=own, Origin=f"http://{own}")
    assert answer.status == 400
    assert "\n" not in json.loads(answer.body)["error"]["message"]
    assert send(viewer.port, Host=own).status == 200


def test_the_server_upgrades_no_connection(viewer):
    own = f"127.0.0.1:{viewer.port}"
    asked = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec_WebSocket_Key": "x",
        "Sec_WebSocket_Version": "13",
    }
    assert send(viewer.port, Host=own, Origin=f"http://{own}", **asked).status != 101


@pytest.mark.slow
def test_elsewhere_than_on_loopback_a_visitor_needs_the_token_of_the_printed_address(monkeypatch):
    monkeypatch.setattr(serving, "_is_loopback", lambda _: False)
    running = ViewerServer(ball_scene(per_ball=20)[0], ViewerConfig(port=0))
    try:
        own = {"Host": f"127.0.0.1:{running.port}"}
        assert len(running.token) >= 20
        assert running.url.endswith(f"/?token={running.token}")
        assert send(running.port, **own).status == 403
        assert send(running.port, path="/?token=wrong", **own).status == 403
        assert send(running.port, **own, Cookie="lexsplat=wrong").status == 403
        entered = send(running.port, path=f"/?token={running.token}", **own)
        assert (entered.status, entered.headers["Location"]) == (303, "/")
        cookie = entered.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert send(running.port, **own, Cookie=cookie.split(";")[0]).status == 200
        assert send(running.port, path=f"/?token={running.token}", Host="evil.example").status == 403
    finally:
        running.stop()
