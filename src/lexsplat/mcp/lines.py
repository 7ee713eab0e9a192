"""Lines of standard input that the official package drops: repaired, or answered with an error of JSON-RPC.

A client that cuts a text in the middle of an emoji sends half of it ("\\ud83c"), which JSON allows and the package
does not read; it would wait for its answer.
"""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from typing import Any

from mcp.shared.message import SessionMessage
from mcp_types import INVALID_REQUEST, PARSE_ERROR, ErrorData, JSONRPCError, jsonrpc_message_adapter
from pydantic import ValidationError

from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.serving import error_document


async def messages(received: Any, sent: Any) -> AsyncIterator[SessionMessage]:
    """The messages of a client.

    Args:
        received: Stream of `mcp.server.stdio.stdio_server`: messages, and an error for each line it cannot read.
        sent: Stream for the answers to these lines.
    """
    async with received:
        async for item in received:
            if isinstance(item, SessionMessage):
                yield item
                continue
            message = _mended(item)
            if isinstance(message, JSONRPCError):
                await sent.send(SessionMessage(message))
            elif message is not None:
                yield SessionMessage(message)


def _mended(error: Exception) -> Any:
    """The message that an unreadable line stands for, or else an answer to the line. None for an empty line."""
    line = error.errors()[0]["input"] if isinstance(error, ValidationError) else None
    identity = None
    try:
        found = json.loads(line.lstrip("\ufeff")) if isinstance(line, str) else line
        given = found.get("id") if isinstance(found, dict) else None
        identity = given if type(given) in (int, str) else None
        whole = json.dumps(found, ensure_ascii=False).encode("utf-16", "surrogatepass")
        text = whole.decode("utf-16", "replace")  # half of a letter becomes U+FFFD
        return jsonrpc_message_adapter.validate_json(text, by_name=False)
    except (ValueError, RecursionError) as refused:
        if isinstance(line, str) and not line.strip("\ufeff \t\r\n"):
            return None
        is_json = isinstance(refused, ValidationError)
        unread = QueryError(
            "line",
            expected="one message of JSON-RPC 2.0",
            found=f"{line!r:.60}" if is_json else str(refused)[:80],
            remedy="send each message as one line of UTF-8",
        )
        code = INVALID_REQUEST if is_json else PARSE_ERROR
        data = ErrorData(code=code, message=str(unread), data=error_document(unread))
        return JSONRPCError(jsonrpc="2.0", id=identity, error=data)
