"""Access control in front of the viewer: only the viewer's own page may talk to it.

A foreign web page in the same browser can send requests to 127.0.0.1, and can reach the server under its own name if
that resolves to 127.0.0.1 (DNS rebinding). Therefore:

- ``Host`` must be an IP address (an address cannot be rebound), ``localhost``, or an allowed name;
- a request that is not GET or HEAD needs an ``Origin`` equal to ``Host``; a foreign one is refused in any request;
- on other addresses than loopback, a token of the printed address is required, and kept in a cookie;
- bodies are limited in size, and responses forbid framing and foreign content.
"""

from __future__ import annotations

import ipaddress
import secrets
from collections.abc import Iterable, Sequence
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MAX_BODY_BYTES = 64 << 10
"""Size limit of what a page sends: a prompt and a camera."""
COOKIE = "lexsplat"

_HEADERS = {
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",  # the page itself has the rest
    "Cache-Control": "no-store",
}


class Guard:
    """Refuses requests before the application sees them (ASGI).

    Args:
        app: The application.
        names: Allowed host names besides addresses and ``localhost``.
        token: Token that a visitor has to know; "" admits everyone.
    """

    def __init__(self, app: ASGIApp, names: Iterable[str] = (), token: str = "") -> None:
        self.app, self.token = app, token
        self.names = {name.lower().rstrip(".") for name in names} | {"localhost"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] != "http":  # no websockets; uvicorn closes what is not accepted
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        headers = Headers(scope=scope)
        reason = self.refusal(headers.getlist("host"), headers.getlist("origin"), scope["method"])
        if reason is not None:
            await PlainTextResponse(f"{reason}\n", 403)(scope, receive, guarded)
        elif self.token and self._is_token(
            parse_qs(scope["query_string"].decode("latin-1")).get("token", [])
        ):
            response = RedirectResponse("/", 303)
            response.set_cookie(COOKIE, self.token, httponly=True, samesite="lax")
            await response(scope, receive, guarded)
        elif self.token and not self._is_token(_cookies(headers)):
            text = "open the address that lexsplat view has printed, with its token\n"
            await PlainTextResponse(text, 403)(scope, receive, guarded)
        elif (size := body_size(headers)) is None or size > MAX_BODY_BYTES:
            await PlainTextResponse(f"at most {MAX_BODY_BYTES} bytes\n", 413)(scope, receive, guarded)
        else:
            await self.app(scope, receive, guarded)

    def refusal(self, hosts: Sequence[str], origins: Sequence[str], method: str) -> str | None:
        """The reason to refuse a request, or None to let it pass.

        Args:
            hosts: All ``Host`` headers.
            origins: All ``Origin`` headers.
            method: Such as "GET".
        """
        if len(hosts) != 1:
            return "exactly one Host header is required"
        host = host_name(hosts[0])
        if host is None or not (host in self.names or is_address(host)):
            return "this host name is not served here"
        if len(origins) > 1 or (method not in ("GET", "HEAD") and not origins):
            return "only the viewer's own page may connect"
        if origins and origin_host(origins[0]) != hosts[0].lower():
            return "only the viewer's own page may connect"
        return None

    def _is_token(self, given: Sequence[str]) -> bool:
        return any(secrets.compare_digest(value.encode(), self.token.encode()) for value in given)


def _cookies(headers: Headers) -> list[str]:
    found = []
    for line in headers.getlist("cookie"):
        try:
            found += [morsel.value for name, morsel in SimpleCookie(line).items() if name == COOKIE]
        except CookieError:
            continue
    return found


def body_size(headers: Headers) -> int | None:
    """The length of a request's body; None if the request does not state it."""
    length = headers.get("content-length", "0")
    chunked = "transfer-encoding" in headers
    return int(length) if length.isascii() and length.isdigit() and len(length) < 12 and not chunked else None


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
