"""The paths of the viewer (Starlette): the page and its files, and what the page asks."""

from __future__ import annotations

import contextlib
import functools
import io
import json
from collections.abc import Awaitable, Callable, Iterator
from typing import Any
from urllib.parse import quote

from PIL import Image
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from lexsplat.pipeline.inputs import reload_capture
from lexsplat.runtime.errors import BackendError, LexsplatError, QueryError, SceneFolderError
from lexsplat.scenes.publishing.index import PAGE_FILES, folder_index, page_file
from lexsplat.scenes.serving import error_document
from lexsplat.viewer.requests import ASKED, Asked, read_document, refuse_unknown
from lexsplat.viewer.session import Session

_TYPES = {"js": "text/javascript", "css": "text/css", "txt": "text/plain", "wasm": "application/wasm"}
_PHOTO_SIDE = 1600
"""Longer side of photos in pixels, at most."""

Work = Callable[[Session, dict[str, Any]], Response]


def make_app(session: Session) -> Starlette:
    """The application; put a `lexsplat.viewer.guard.Guard` in front of it."""
    return Starlette(
        routes=[
            Route("/", lambda _: HTMLResponse(folder_index(_manifest(session)))),
            Route("/manifest.json", lambda _: JSONResponse(_manifest(session))),
            Route("/photo/{number:int}", _photos(session)),
            _posted("/ask", session, lambda s, data: _bytes(s.ask(Asked.from_json(data)))),
            _posted("/click", session, lambda s, data: _bytes(s.what_is(Asked.from_json(data)))),
            _posted("/details", session, lambda s, data: JSONResponse(s.details(Asked.from_json(data)))),
            _posted("/download", session, _download),
            _posted("/edit", session, _edit),
            _posted(
                "/preview",
                session,
                lambda s, data: _bytes(s.preview(str(data.get("action")), Asked.from_json(data))),
            ),
            _posted("/colors", session, lambda s, data: _bytes(s.colors(str(data.get("mode"))))),
            _posted("/objects", session, lambda s, _: JSONResponse(s.objects())),
            _posted(
                "/vocabulary", session, lambda s, data: JSONResponse(s.set_vocabulary(data.get("phrases")))
            ),
            Route("/{name}", lambda request: _file(session, request.path_params["name"])),
        ]
    )


def _manifest(session: Session) -> dict[str, Any]:
    """The manifest of the scene as it is now."""
    with contextlib.suppress(LexsplatError, OSError):  # the first question reports it
        session.catch_up()
    return session.content.manifest


def _posted(path: str, session: Session, work: Work) -> Route:
    """A path that answers a JSON object; work for different pages waits for each other."""

    def answer(body: bytes) -> Response:
        try:
            data = read_document(body)
            with session.lock:
                session.catch_up()
                if data.get("version") != session.version:
                    return JSONResponse({"version": session.version}, 409)  # the page shows an earlier scene
                return work(session, data)
        except LexsplatError as error:
            return JSONResponse(error_document(error), 400)
        except (ValueError, OSError) as error:
            return JSONResponse({"error": {"message": " ".join(str(error).split())[:300]}}, 400)

    async def endpoint(request: Request) -> Response:
        return await run_in_threadpool(answer, await request.body())

    return Route(path, endpoint, methods=["POST"])


def _download(session: Session, data: dict[str, Any]) -> Response:
    name, content = session.export(Asked.from_json(data), str(data.get("format")))
    named = {"Content-Disposition": f"attachment; filename*=utf-8''{quote(name)}"}
    return Response(content, media_type="application/octet-stream", headers=named)


def _edit(session: Session, data: dict[str, Any]) -> Response:
    refuse_unknown(data, ("version", "action", *ASKED, "color", "strength", "by", "turn", "scale"))
    return JSONResponse(session.edit(str(data.get("action")), Asked.from_json(data), data))


def _file(session: Session, name: str) -> Response:
    files = session.content.files
    if name in files:
        return _bytes(files[name])
    if name in PAGE_FILES:
        return Response(page_file(name), media_type=_TYPES[name.rpartition(".")[2]])
    return PlainTextResponse("not found\n", 404)


def _bytes(content: bytes) -> Response:
    return Response(content, media_type="application/octet-stream")


@contextlib.contextmanager
def _without_options() -> Iterator[None]:
    """Errors of photos that are not found, without advice for commands that have --capture."""
    try:
        yield
    except SceneFolderError as error:
        raise error.with_remedy("put the photos back where the build found them") from error


def _photos(session: Session) -> Callable[[Request], Awaitable[Response]]:
    """The photos that the scene was built from, if they are still there, by their numbers in the manifest."""
    capture = functools.cache(reload_capture)

    def photo(number: int) -> Response:
        try:
            views = session.content.manifest["views"]
            folder = session.scene.folder
            if folder is None or number >= len(views):
                raise QueryError("photo", expected="a view of a scene folder", found="none")
            with session.lock, _without_options():
                view = capture(folder).views[views[number]["name"]]
            shrink = min(1.0, _PHOTO_SIDE / max(view.camera.width, view.camera.height))
            size = (max(1, round(view.camera.width * shrink)), max(1, round(view.camera.height * shrink)))
            pixels = (view.load_image(size) * 255).round().astype("uint8")
            content = io.BytesIO()
            Image.fromarray(pixels).save(content, format="JPEG", quality=88)
            return Response(content.getvalue(), media_type="image/jpeg")
        except (LexsplatError, OSError) as error:
            known = error if isinstance(error, LexsplatError) else BackendError("photo", found=str(error))
            return Response(json.dumps(error_document(known)), 404, media_type="application/json")

    async def answer(request: Request) -> Response:
        return await run_in_threadpool(photo, request.path_params["number"])

    return answer
