"""Who may talk to the viewer: rules by themselves, then a running server asked by a websocket client."""

import asyncio
import http.client

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lexsplat.viewer.guard import Guard, Limits, Meter, host_name, origin_host

GUARD = Guard(names=("splats.example",))


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
    assert GUARD.refuses([host], [], websocket=False) is None
    assert GUARD.refuses([host], [f"http://{host}"], websocket=True) is None


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8080", "127.0.0.1.evil.example", "localhost.evil.example", "", "user@127.0.0.1",
     "127.0.0.1/path", "127.0.0.1:port", "[::1", "127.0.0.1#x", "sub.splats.example", "0x7f.1.evil"],
)  # fmt: skip
def test_names_that_could_be_rebound_are_refused(host):
    assert GUARD.refuses([host], [], websocket=False)
    assert GUARD.refuses([host], [f"http://{host}"], websocket=True)


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "https://evil.example:8080", "null", "file://", "http://127.0.0.1:8081",
     "http://localhost:8080",
     "http://127.0.0.1", "http://127.0.0.1:8080.evil.example", "http://127.0.0.1:8080/page",
     "chrome-extension://abc", ""],
)  # fmt: skip
def test_a_page_of_another_origin_may_not_connect(origin):
    assert GUARD.refuses(["127.0.0.1:8080"], [origin], websocket=True)


def test_a_websocket_without_or_with_two_origins_or_hosts_is_refused():
    own = "127.0.0.1:8080"
    assert GUARD.refuses([own], [], websocket=True)
    assert GUARD.refuses([own], [f"http://{own}"] * 2, websocket=True)
    assert GUARD.refuses([own, own], [f"http://{own}"], websocket=True)
    assert GUARD.refuses([], [f"http://{own}"], websocket=True)


@given(st.text(max_size=40), st.text(max_size=60))
def test_no_header_breaks_the_rules(host, origin):
    reason = GUARD.refuses([host], [origin], websocket=True)
    if reason is None:
        name = host_name(host)
        assert name in GUARD.names or name.replace(".", "").isdigit() or ":" in name
        assert origin_host(origin) == host.lower()


# -- messages


def packed(**content) -> bytes:
    return msgspec.msgpack.encode(content)


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def test_only_messages_of_the_page_pass():
    meter = Meter(Limits())
    assert meter.refuses(packed(type="ViewerCameraMessage", fov=1.0)) is None
    assert meter.refuses(packed(type="GuiUpdateMessage", uuid="a", updates={"value": "red apple"})) is None
    for message in (
        packed(type="ShareUrlRequest"),  # would open a public tunnel
        packed(type="FileTransferStartUpload"),
        packed(type="RunJavascriptMessage"),
        packed(type=["ViewerCameraMessage"]),
        packed(kind="ViewerCameraMessage"),
        packed(type="GuiUpdateMessage", uuid="a", updates={"update_cb": [], "value": 1}),
        packed(type="GuiUpdateMessage", uuid="a", updates=7),
        msgspec.msgpack.encode(["type"]),
        b"\xc1",
        b"",
        "text",
    ):
        assert meter.refuses(message), message


@given(st.binary(max_size=64))
def test_no_bytes_break_the_meter(message):
    assert Meter(Limits()).refuses(message) == "not a message of the viewer"


def test_long_messages_pass_only_as_pictures():
    meter = Meter(Limits(small_bytes=1000))
    assert meter.refuses(packed(type="GuiUpdateMessage", updates={"value": "x" * 1000})) == "message too long"
    assert meter.refuses(packed(type="GetRenderResponseMessage", payload=b"x" * 5000)) is None


def test_the_rate_of_messages_and_bytes_is_bounded_and_recovers():
    clock = Clock()
    meter = Meter(Limits(messages_per_second=10, bytes_per_second=1e9), clock)
    message = packed(type="ViewerCameraMessage")
    passed = sum(meter.refuses(message) is None for _ in range(100))
    assert passed == 20  # a burst of two seconds
    clock.now = 1.0
    assert meter.refuses(message) is None
    clock = Clock()
    meter = Meter(Limits(bytes_per_second=1000, small_bytes=10_000), clock)
    big = packed(type="ViewerCameraMessage", filler="x" * 1500)
    assert meter.refuses(big) is None
    assert meter.refuses(big) == "too much at once"
    clock.now = 10.0
    assert meter.refuses(big) is None


# -- a running server


@pytest.fixture(scope="module")
def server():
    """viser behind the guard, without a scene."""
    viser = pytest.importorskip("viser")
    guard = Guard(
        limits=Limits(messages_per_second=50, small_bytes=2000, message_bytes=100_000, connections=3)
    )
    with guard.before_viser():
        running = viser.ViserServer("127.0.0.1", 0, verbose=False)
    assert guard.in_place
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


def test_the_page_is_served_to_its_own_host_only_and_not_in_frames(server):
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


def test_only_the_own_page_opens_a_websocket(server):
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


async def close_reason(port: int, messages: list[bytes]) -> tuple[int, str]:
    """Sends messages and reads until the server closes; code and reason."""
    from websockets.exceptions import ConnectionClosed

    async with await connect(port, f"http://127.0.0.1:{port}") as page:
        try:
            for message in messages:
                await page.send(message)
            while True:
                await asyncio.wait_for(page.recv(), 10)
        except ConnectionClosed as closed:
            return closed.rcvd.code, closed.rcvd.reason


def test_a_page_that_misbehaves_is_cut_off_and_the_server_lives(server):
    port = server.get_port()
    camera = packed(type="ViewerCameraMessage", wxyz=[1, 0, 0, 0], position=[0, 0, 0], fov=1.0, near=0.1, far=9.0,
                    look_at=[0, 0, 1], up_direction=[0, 1, 0], image_height=4, image_width=4)  # fmt: skip
    assert asyncio.run(close_reason(port, [packed(type="ShareUrlRequest")])) == (
        1008, "not a message of the viewer",
    )  # fmt: skip
    assert asyncio.run(close_reason(port, [b"\x00" * 50_000]))[0] == 1008
    assert asyncio.run(close_reason(port, [b"\x00" * 200_000]))[0] == 1009  # larger than any message may be
    assert asyncio.run(close_reason(port, [camera] * 300)) == (1008, "too much at once")
    assert ask(port, Host=f"127.0.0.1:{port}").status == 200


def test_only_so_many_pages_are_open_at_once(server):
    from websockets.exceptions import InvalidStatus

    port = server.get_port()

    async def open_many() -> int:
        pages = [await connect(port, f"http://127.0.0.1:{port}") for _ in range(3)]
        with pytest.raises(InvalidStatus) as refused:
            await connect(port, f"http://127.0.0.1:{port}")
        for page in pages:
            await page.close()
        async with await connect(port, f"http://127.0.0.1:{port}"):  # there is room again
            return refused.value.response.status_code

    assert asyncio.run(open_many()) == 503
