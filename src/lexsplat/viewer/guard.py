"""Access control in front of viser's server: only the viewer's own page may talk to it.

viser serves its page and its websocket on one port and does not authenticate anyone. Browsers do not apply the
same-origin policy to websockets, so any web page open in the same browser could connect, or reach the server under a
name of its own that resolves to 127.0.0.1 (DNS rebinding). Therefore:

- ``Host`` must be an IP address (an address cannot be rebound), ``localhost``, or an allowed name;
- a websocket needs an ``Origin`` header equal to ``Host``;
- only viser's page is served, with headers that forbid framing and foreign content;
- messages are limited in size;
- viser's handlers for public tunnels and file uploads are removed, and updates of a control may only set its value.
"""

from __future__ import annotations

import contextlib
import ipaddress
import threading
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    import viser

MAX_MESSAGE_BYTES = 24 << 20
"""Size limit of a message. The largest are images that the page renders for us."""

_PATHS = ("/", "/index.html")
"""viser's page is a single file."""

_HEADERS = {
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": (
        "default-src 'self' blob: data:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
        "style-src 'self' 'unsafe-inline'; connect-src 'self' ws: wss: blob: data:; frame-ancestors 'none'"
    ),
}

_PATCHING = threading.Lock()


class RequestGuard:
    """Decides which requests reach viser.

    Args:
        names: Allowed host names besides addresses and ``localhost``.
        max_message_bytes: Size limit of a websocket message.
    """

    def __init__(self, names: Iterable[str] = (), max_message_bytes: int = MAX_MESSAGE_BYTES) -> None:
        self.names = {name.lower().rstrip(".") for name in names} | {"localhost"}
        self.max_message_bytes = max_message_bytes
        self.in_place = False
        """Whether a websocket server has started inside `wrap_server`."""

    def refusal(self, hosts: Sequence[str], origins: Sequence[str], websocket: bool) -> str | None:
        """The reason to refuse a request, or None to let it pass.

        Args:
            hosts: All ``Host`` headers.
            origins: All ``Origin`` headers.
            websocket: Whether the request opens a websocket.
        """
        if len(hosts) != 1:
            return "exactly one Host header is required"
        host = host_name(hosts[0])
        if host is None or not (host in self.names or is_address(host)):
            return "this host name is not served here"
        if websocket and len(origins) != 1:
            return "only the viewer's own page may connect"
        if origins and origin_host(origins[0]) != hosts[0].lower():
            return "only the viewer's own page may connect"
        return None

    @contextlib.contextmanager
    def wrap_server(self) -> Iterator[None]:
        """Guard every websocket server that starts inside this context.

        viser has no hook for requests, so `websockets.asyncio.server.serve` is replaced while viser starts.
        """
        import websockets.asyncio.server as module

        original = module.serve

        def serve(*arguments: Any, **options: Any) -> Any:
            self.in_place = True
            return original(*arguments, **self._guarded(options))

        with _PATCHING:
            module.serve = serve  # type: ignore[assignment,misc]
            try:
                yield
            finally:
                module.serve = original  # type: ignore[misc]

    def _guarded(self, options: dict[str, Any]) -> dict[str, Any]:
        inner = options.get("process_request")

        def process_request(connection: Any, request: Any) -> Any:
            headers = request.headers
            websocket = "upgrade" in headers
            reason = self.refusal(headers.get_all("Host"), headers.get_all("Origin"), websocket)
            if reason is not None:
                return connection.respond(403, reason + "\n")
            if not websocket and request.path.partition("?")[0] not in _PATHS:
                return connection.respond(404, "not found\n")
            response = inner(connection, request) if inner else None
            if response is not None:
                for name, value in _HEADERS.items():
                    response.headers[name] = value
            return response

        limits = {"max_size": self.max_message_bytes, "max_queue": 32, "close_timeout": 3}
        return {**options, **limits, "process_request": process_request}


def restrict_messages(server: viser.ViserServer) -> None:
    """Remove what viser would do for any connected client but our page never asks for.

    That is opening a public tunnel ("share"), receiving files, and setting attributes of a control other than its
    value.

    Raises:
        ImportError, AttributeError, AssertionError, KeyError: If this version of viser handles messages in
            another way.
    """
    from viser import _messages as messages

    connections: Any = server._websock_server
    for kind in (
        messages.ShareUrlRequest,
        messages.ShareUrlDisconnect,
        messages.FileTransferStartUpload,
        messages.FileTransferPart,
        messages.GuiUpdateMessage,
    ):
        connections.unregister_handler(kind)
    update = server.gui._handle_gui_updates

    async def set_value(client_id: Any, message: Any) -> None:
        if isinstance(message.updates, dict) and set(message.updates) == {"value"}:
            await update(client_id, message)

    connections.register_handler(messages.GuiUpdateMessage, set_value)


def host_name(host: str) -> str | None:
    """The name or address in a ``Host`` header, without the port; None if the header is malformed."""
    try:
        parts = urlsplit(f"//{host}")
        if parts.path or parts.query or parts.fragment or "@" in parts.netloc:
            return None
        _ = parts.port  # raises if it is not a number
        return parts.hostname.rstrip(".") if parts.hostname else None
    except ValueError:
        return None


def origin_host(origin: str) -> str | None:
    """Host and port of an ``Origin`` header, as in a ``Host`` header; None for "null" and schemes other than HTTP."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return None
    if parts.scheme not in ("http", "https") or parts.path or parts.query or "@" in parts.netloc:
        return None
    return parts.netloc.lower() or None


def is_address(host: str) -> bool:
    """Whether a host is an IP address."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
