"""The MCP server: tools, resources and prompts over standard input and output or over HTTP."""

from __future__ import annotations

import contextlib
import functools
import hmac
import inspect
import json
import logging
import socket
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

from mcp.server import MCPServer
from mcp.server.mcpserver.exceptions import ResourceNotFoundError, ToolError, UnexpectedToolError
from mcp.server.stdio import stdio_server
from mcp.server.transport_security import TransportSecuritySettings
from mcp.shared.exceptions import MCPError
from mcp_types import INVALID_PARAMS, CallToolResult, ImageContent, TextContent, Tool, ToolAnnotations
from pydantic import ValidationError

from lexsplat import __version__
from lexsplat.mcp.arguments import check_names, nearest, wrong_value
from lexsplat.mcp.lines import messages
from lexsplat.mcp.tools import LibraryTools, Reply, Tools
from lexsplat.mcp.writing import WritingTools
from lexsplat.runtime.errors import LexsplatError, QueryError
from lexsplat.scenes.facts import version_notes
from lexsplat.scenes.library import Library
from lexsplat.scenes.serving import OpenScene, error_document

log = logging.getLogger("lexsplat")

MAX_BODY = 1 << 20
"""Size limit of an HTTP request in bytes."""
RESOURCES = ("lexsplat://scenes", "lexsplat://scene/{name}", "lexsplat://scene/{name}/view/{view}")
LOOPBACK = ("127.0.0.1", "localhost", "::1")

INSTRUCTIONS = (
    'Places that can be searched with words. Positions are in the axes of the scene: "center" in scene units, '
    '"center_meters" and sentences in meters where the scale is known. "present": "no" means that the scene does '
    'not hold it: say so, do not guess. "understood" is how a phrase was parsed.'
)


def make_server(
    scenes: Mapping[str, OpenScene], output: Path | None = None, library: Library | None = None
) -> MCPServer:
    """A server for scenes.

    Args:
        scenes: The scenes by name.
        output: Folder of the files that tools write; None offers no tools that write.
        library: A library that is searched, and whose scenes are served as well.
    """
    server = _Server("lexsplat", version=__version__, instructions=INSTRUCTIONS, log_level="WARNING")
    logging.getLogger("mcp").setLevel(logging.ERROR)
    scenes = dict(scenes)  # an edit adds another one
    tools = Tools(scenes) if library is None else LibraryTools(scenes, library)
    reading = ToolAnnotations(read_only_hint=True, open_world_hint=False)
    for name in _public(type(tools)):
        server.add_tool(_tool(tools, name), name=name, annotations=reading)
    if output is not None:
        writing = WritingTools(scenes, output, library)
        for name in sorted(set(_public(WritingTools)) - set(_public(Tools))):
            server.add_tool(
                _tool(writing, name), name=name, annotations=ToolAnnotations(read_only_hint=False)
            )
    _add_resources(server, tools)
    _add_prompts(server, tools)
    return server


class _Server(MCPServer):
    """A server that refuses every wrong call with one line and the keys of our other errors."""

    async def run_stdio_async(self) -> None:
        server = self._lowlevel_server  # as in the base class, except for `messages`
        async with stdio_server() as (received, sent):
            lines: Any = messages(received, sent)
            await server.run(lines, sent, server.create_initialization_options())

    async def list_tools(self) -> list[Tool]:
        tools = await super().list_tools()
        for tool in tools:
            tool.input_schema["additionalProperties"] = False
        return tools

    async def call_tool(self, name: str, arguments: dict[str, Any], context: Any = None) -> Any:
        schemas = {tool.name: tool.input_schema for tool in await self.list_tools()}
        try:
            check_names("tool", name, arguments, schemas)
            return await super().call_tool(name, arguments, context)
        except QueryError as error:
            return _refusal(error)
        except UnexpectedToolError as error:  # the next call is answered, whatever this one meets
            log.exception("a call was not answered")
            remedy = "please report it with the arguments"
            found = repr(error.__cause__)[:80]
            return _refusal(QueryError(name, expected="an answer", found=found, remedy=remedy))
        except ToolError as error:
            if not isinstance(error.__cause__, ValidationError):
                raise
            return _refusal(wrong_value(error.__cause__, schemas[name]))

    async def read_resource(self, uri: Any, context: Any = None) -> Any:
        try:
            return await super().read_resource(uri, context)
        except ResourceNotFoundError as error:
            with _protocol_errors():
                raise QueryError(
                    f"resource {str(uri)[:60]!r}",
                    expected=f"one of {', '.join(RESOURCES)}",
                    found="no such resource",
                    remedy=nearest(str(uri), RESOURCES[:1], "lexsplat://scenes has the names"),
                ) from error

    async def get_prompt(
        self, name: str, arguments: dict[str, Any] | None = None, context: Any = None
    ) -> Any:
        schemas = {}
        for prompt in await self.list_prompts():
            taken = prompt.arguments or []
            schemas[prompt.name] = {
                "properties": {each.name: {"type": "string"} for each in taken},
                "required": [each.name for each in taken if each.required],
            }
        with _protocol_errors():
            check_names("prompt", name, arguments or {}, schemas)
        return await super().get_prompt(name, arguments, context)


def _refusal(error: LexsplatError) -> CallToolResult:
    return CallToolResult(
        content=[TextContent(text=str(error))], structured_content=error_document(error), is_error=True
    )


@contextlib.contextmanager
def _protocol_errors() -> Iterator[None]:
    """Errors where the protocol has no place for an answer."""
    try:
        yield
    except LexsplatError as error:
        raise MCPError(INVALID_PARAMS, str(error), error_document(error)) from error


def serve_http(server: MCPServer, listening: socket.socket, host: str, token: str | None) -> None:
    """Serve over Streamable HTTP at ``/mcp`` until Ctrl-C.

    Host and Origin must be this machine's. Bound elsewhere, each request needs the token.

    Args:
        server: The server.
        listening: Listening socket (`lexsplat.runtime.listening.listen`).
        host: The address that was bound.
        token: Token that each request must send; None requires none.
    """
    import uvicorn

    port = listening.getsockname()[1]
    settings = uvicorn.Config(http_app(server, host, token), host=host, port=port, log_level="warning")
    uvicorn.Server(settings).run([listening])


def http_app(server: MCPServer, host: str, token: str | None) -> Callable[..., Any]:
    """The ASGI application of `serve_http`."""
    local = host in LOOPBACK
    if not (local or token):
        raise ValueError("a token is needed where the server does not listen on this machine alone")
    names = [*LOOPBACK[:2], "[::1]"]
    security = TransportSecuritySettings(
        enable_dns_rebinding_protection=local,
        allowed_hosts=[*names, *(f"{name}:*" for name in names)],
        allowed_origins=[*(f"http://{name}" for name in names), *(f"http://{name}:*" for name in names)],
    )
    app = server.streamable_http_app(transport_security=security, host=host, max_request_body_size=MAX_BODY)
    return app if token is None else _with_token(app, token)


def _with_token(app: Callable[..., Any], token: str) -> Callable[..., Any]:
    """The application for those who send ``Authorization: Bearer TOKEN``."""
    wanted = token.encode()

    async def checked(scope: Any, receive: Any, send: Any) -> None:
        scheme, _, given = dict(scope.get("headers", [])).get(b"authorization", b"").partition(b" ")
        allowed = scheme.lower() == b"bearer" and hmac.compare_digest(given.strip(), wanted)
        if scope["type"] == "http" and not allowed:
            await send(
                {"type": "http.response.start", "status": 401, "headers": [(b"www-authenticate", b"Bearer")]}
            )
            await send({"type": "http.response.body", "body": b"the token is missing or wrong\n"})
            return
        await app(scope, receive, send)

    return checked


def _public(kind: type) -> list[str]:
    return [name for name, _ in inspect.getmembers(kind, inspect.isfunction) if not name.startswith("_")]


def _tool(tools: Tools, name: str) -> Callable[..., CallToolResult]:
    """A tool of the protocol: structured content and one sentence; errors that have a remedy are answers.

    Its output schema is that of the document type in the function's return annotation. The sentence about a scene
    says if steps of an edit are not in it.
    """
    function: Callable[..., Reply] = getattr(tools, name)
    # The package reads names and types from the signature; its annotations are strings of the other module.
    hints = inspect.signature(function, eval_str=True)

    @functools.wraps(function)
    def call(**arguments: Any) -> CallToolResult:
        try:
            reply = function(**arguments)
            place = tools._scene(arguments.get("scene", "")) if "scene" in hints.parameters else None
        except LexsplatError as error:
            return _refusal(error)
        folder = place.folder if place is not None else None
        note = "; ".join(version_notes(folder)) if folder is not None else ""
        content: list[Any] = [TextContent(text=f"{reply.sentence} Note: {note}." if note else reply.sentence)]
        if reply.image is not None:
            import base64

            content.append(ImageContent(data=base64.b64encode(reply.image).decode(), mime_type="image/png"))
        return CallToolResult(content=content, structured_content=reply.document)

    document = get_args(hints.return_annotation)[1]  # Annotated[Reply, type of the document]
    answer = Annotated[CallToolResult, document]
    call.__signature__ = hints.replace(return_annotation=answer)  # type: ignore[attr-defined]
    call.__annotations__ = {name: each.annotation for name, each in hints.parameters.items()} | {
        "return": answer
    }
    del call.__wrapped__  # type: ignore[attr-defined]
    return call


def _add_resources(server: MCPServer, tools: Tools) -> None:
    @server.resource(RESOURCES[0], mime_type="application/json")
    def scenes() -> str:
        """The names and facts of all scenes."""
        with _protocol_errors():
            return json.dumps(tools.list_scenes().document)

    @server.resource(RESOURCES[1], mime_type="application/json")
    def facts(name: str) -> str:
        """The answer of describe_scene."""
        with _protocol_errors():
            return json.dumps(tools.describe_scene(name).document)

    @server.resource(RESOURCES[2], mime_type="image/png")
    def view(name: str, view: str) -> bytes:
        """A view as PNG."""
        with _protocol_errors():
            return tools.render(view, scene=name).image or b""


def _add_prompts(server: MCPServer, tools: Tools) -> None:
    def named(scene: str) -> str:
        if not scene:
            return "this place"
        with _protocol_errors():
            tools._scene(scene)
        return f"the place {scene}"

    @server.prompt(name="inventory", title="Inventory this room")
    def inventory(scene: str = "") -> str:
        """List what a place holds, with places and sizes."""
        return (
            f"Make an inventory of {named(scene)}. Call describe_scene and list_objects, then find for things "
            "that you expect in such a place but do not see in the list. Give a table of names, counts, places "
            "in words and sizes. Name what is unsure, and leave out what is not present."
        )

    @server.prompt(name="where_is", title="Where did I leave it?")
    def where_is(thing: str, scene: str = "") -> str:
        """Find a lost thing and describe in words where it is."""
        if not thing.strip():
            expected, found = "a word or phrase", "an empty text"
            with _protocol_errors():
                raise QueryError("thing", expected=expected, found=found, remedy="name what was lost")
        return (
            f"Find {thing} in {named(scene)} with find. If it is present, describe its place by what is near it "
            "(relate, nearest) and show it with render(look_at=...). If it is not, say so and name what is similar."
        )
