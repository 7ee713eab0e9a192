"""Who may talk to the viewer: the rules alone, then a running server with a websocket client."""

import asyncio
import http.client

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lexsplat.viewer.guard import RequestGuard, host_name, origin_host, restrict_messages

GUARD = RequestGuard(names=("splats.example",))


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
    assert GUARD.refusal([host], [], websocket=False) is None
    assert GUARD.refusal([host], [f"http://{host}"], websocket=True) is None


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8080", "127.0.0.1.evil.example", "localhost.evil.example", "", "user@127.0.0.1",
     "127.0.0.1/path", "127.0.0.1:port", "[::1", "127.0.0.1#x", "sub.splats.example", "0x7f.1.evil"],
)  # fmt: skip
def test_names_that_could_be_rebound_are_refused(host):
    assert GUARD.refusal([host], [], websocket=False)
    assert GUARD.refusal([host], [f"http://{host}"], websocket=True)


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "https://evil.example:8080", "null", "file://", "http://127.0.0.1:8081",
     "http://localhost:8080",
     "http://127.0.0.1", "http://127.0.0.1:8080.evil.example", "http://127.0.0.1:8080/page",
     "chrome-extension://abc", ""],
)  # fmt: skip
def test_a_page_of_another_origin_cannot_connect(origin):
    assert GUARD.refusal(["127.0.0.1:8080"], [origin], websocket=True)


def test_a_websocket_without_or_with_two_origins_or_hosts_is_refused():
    own = "127.0.0.1:8080"
    assert GUARD.refusal([own], [], websocket=True)
    assert GUARD.refusal([own], [f"http://{own}"] * 2, websocket=True)
    assert GUARD.refusal([own, own], [f"http://{own}"], websocket=True)
    assert GUARD.refusal([], [f"http://{own}"], websocket=True)


@given(st.text(max_size=40), st.text(max_size=60))
def test_arbitrary_headers_pass_only_by_the_rules(host, origin):
    reason = GUARD.refusal([host], [origin], websocket=True)
    if reason is None:
        name = host_name(host)
        assert name in GUARD.names or name.replace(".", "").isdigit() or ":" in name
        assert origin_host(origin) == host.lower()


# -- a running server


@pytest.fixture(scope="module")
def server():
    """viser behind the guard, without a scene."""
    viser = pytest.importorskip("viser")
    guard = RequestGuard(max_message_bytes=100_000)
    with guard.wrap_server():
        running = viser.ViserServer("127.0.0.1", 0, verbose=False)
    assert guard.in_place
    restrict_messages(running)
    yield running
    running.stop()


def ask(port: int, **headers) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    response.body = response.read()
    connection.close()
    return response


def test_the_page_is_served_for_its_own_host_only_and_not_in_frames(server):
    port = server.get_port()
    page = ask(port, Host=f"127.0.0.1:{port}")
    assert page.status == 200
    assert b"<html" in page.body[:200]
    assert page.headers["X-Frame-Options"] == "DENY"
    assert "frame-ancestors 'none'" in page.headers["Content-Security-Policy"]
    assert ask(port, Host="evil.example").status == 403
    assert ask(port).status == 403
    assert ask(port, Host=f"127.0.0.1:{port}", Origin="http://evil.example").status == 403


async def connect(port: int, origin: str | None):
    import viser
    from websockets.asyncio.client import connect as dial

    protocols = [f"viser-v{viser.__version__}"]
    return await dial(f"ws://127.0.0.1:{port}", origin=origin, subprotocols=protocols, max_size=None)


def test_only_the_viewers_own_page_opens_a_websocket(server):
    from websockets.exceptions import InvalidStatus

    port = server.get_port()

    async def try_all() -> list[int]:
        statuses = []
        for origin in ("http://evil.example", None, "null", "http://localhost:1", f"http://127.0.0.1:{port}"):
            try:
                async with await connect(port, origin):
                    statuses.append(101)
            except InvalidStatus as refused:
                statuses.append(refused.response.status_code)
        return statuses

    assert asyncio.run(try_all()) == [403, 403, 403, 403, 101]


async def talk(port: int, messages: list[bytes | str]) -> int | None:
    """Sends messages, then reads for a second; the code with which the server closed, None if it did not."""
    from websockets.exceptions import ConnectionClosed

    async with await connect(port, f"http://127.0.0.1:{port}") as page:
        try:
            for message in messages:
                await page.send(message)
            end = asyncio.get_running_loop().time() + 1
            while (left := end - asyncio.get_running_loop().time()) > 0:
                await asyncio.wait_for(page.recv(), left)
        except ConnectionClosed as closed:
            return closed.rcvd.code if closed.rcvd else 1006
        except asyncio.TimeoutError:
            return None
    return None


def packed(**content) -> bytes:
    return msgspec.msgpack.encode(content)


def test_forged_messages_open_no_tunnel_and_store_no_file(server, monkeypatch):
    shared = []
    monkeypatch.setattr(server, "request_share_url", lambda *_: shared.append(1))
    monkeypatch.setattr(server, "disconnect_share_url", lambda *_: shared.append(1))
    control = server.gui.add_text("text", "")._impl.uuid
    upload = packed(type="FileTransferStartUpload", source_component_uuid=control, transfer_uuid="a", filename="f",
                    mime_type="text/plain", part_count=2, size_bytes=9)  # fmt: skip
    messages = [packed(type="ShareUrlRequest"), packed(type="ShareUrlDisconnect"), upload]
    assert asyncio.run(talk(server.get_port(), messages)) is None
    assert shared == []
    assert server.gui._current_file_upload_states == {}


def test_a_page_sets_the_value_of_a_control_and_no_other_attribute(server):
    control = server.gui.add_text("text", "before")
    uuid = control._impl.uuid
    callbacks = control._impl.update_cb
    forged = [
        packed(type="GuiUpdateMessage", uuid=uuid, updates={"update_cb": [], "value": "forged"}),
        packed(type="GuiUpdateMessage", uuid=uuid, updates={"uuid": "forged"}),
        packed(type="GuiUpdateMessage", uuid=uuid, updates={}),
    ]
    asyncio.run(talk(server.get_port(), forged))
    assert control.value == "before"
    assert control._impl.uuid == uuid
    assert control._impl.update_cb is callbacks
    asyncio.run(
        talk(server.get_port(), [packed(type="GuiUpdateMessage", uuid=uuid, updates={"value": "after"})])
    )
    assert control.value == "after"


@pytest.mark.parametrize(
    "message", [b"\xc1", b"", b"\x00" * 5000, "text", packed(kind="x"), packed(type=["ViewerCameraMessage"]),
                packed(type="GuiUpdateMessage", uuid="a", updates=7)],
)  # fmt: skip
def test_a_malformed_message_does_not_stop_the_server(server, message):
    port = server.get_port()
    asyncio.run(talk(port, [message]))
    assert ask(port, Host=f"127.0.0.1:{port}").status == 200


def test_a_message_over_the_size_limit_closes_the_connection(server):
    assert asyncio.run(talk(server.get_port(), [b"\x00" * 200_000])) == 1009
