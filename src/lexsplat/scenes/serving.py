"""Scenes that stay open and answer many questions, while their folders may be rebuilt, moved or deleted."""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import re
import reprlib
import threading
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from lexsplat.queries.places import position
from lexsplat.queries.spelling import corrected
from lexsplat.runtime.errors import LexsplatError, QueryError, SceneFolderError
from lexsplat.runtime.progress import Listener, silent, uncounted
from lexsplat.scenes.answers import find_phrase
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.scene import Scene, open_scene
from lexsplat.scenes.words import prepare_parts, things_with_parts

log = logging.getLogger("lexsplat")

MAX_LINE = 1 << 20
"""Characters of a line of `answer_line`, at most."""


class OpenScene:
    """A scene that is read again when its folder has changed.

    Args:
        path: The scene folder, or the word "demo".
        device: "auto", "cpu" or "cuda".
        clip: Text encoder, if it is not where the build found it.
        listener: Receives progress events of the scene.

    Raises:
        SceneFolderError: If there is no finished scene.
    """

    def __init__(
        self, path: str | Path, device: str = "auto", clip: str | None = None, listener: Listener = silent
    ) -> None:
        self.path, self._device, self._clip, self._listener = path, device, clip, listener
        self._lock = threading.Lock()
        self._root = SceneFolder.open(Path(path)).root
        self._state = self._stamp()  # before it is read: what changes meanwhile is read again
        self._scene = self._open()

    def _open(self) -> Scene:
        with uncounted(self._listener, "scene", f"serving {self._root.resolve()}"):
            scene = open_scene(self.path, device=self._device, clip=self._clip)
        scene.listener = self._listener
        return scene

    def warm(self) -> None:
        """Load and compute what the first questions would wait for: encoder, dictionary, objects and their graphs."""
        with contextlib.suppress(LexsplatError):  # the first question reports it
            scene = self.scene
            scene.preload()
            corrected("thing", ())
            scene.find("where is the thing?")
            for name in things_with_parts(scene):
                prepare_parts(scene, name)
            scene.find("where is the handle?")

    @property
    def scene(self) -> Scene:
        """The scene as it is now.

        Raises:
            SceneFolderError: If the folder is gone or holds no finished scene any more.
        """
        stamp = self._stamp()
        if stamp != self._state:
            with self._lock:
                if stamp != self._state:
                    self._scene = self._open()
                    self._state = stamp
        return self._scene

    def _stamp(self) -> tuple[int, int]:
        try:
            facts = (self._root / "scene.json").stat()
        except OSError as error:
            raise SceneFolderError(
                self._root,
                expected="the scene that was opened",
                found="no scene.json: it was moved or deleted",
                remedy="restore the folder, or open the scene at its new path",
            ) from error
        return (facts.st_mtime_ns, facts.st_size)


def open_scenes(
    paths: Sequence[str],
    device: str = "auto",
    clip: str | None = None,
    listener: Listener = silent,
    taken: Mapping[str, Path | None] | None = None,
) -> dict[str, OpenScene]:
    """Several scenes by the names of their folders, each folder once.

    Args:
        paths: The folders.
        device: "auto", "cpu" or "cuda".
        clip: Text encoder, if it is not where the builds found it.
        listener: Receives progress events of the scenes.
        taken: Names that are in use, and the folders that need no other name. A number is added to another scene's.

    Raises:
        SceneFolderError: If one of them is no finished scene.
    """
    known = {} if taken is None else dict(taken)
    found: dict[str, OpenScene] = {}
    for path in paths:
        root = SceneFolder.open(Path(path)).root.resolve()
        if root not in known.values():
            name = new_name("demo" if path == "demo" else root.name, known)
            known[name] = root
            found[name] = OpenScene(path, device, clip, listener)
    return found


def new_name(base: str, taken: Container[str]) -> str:
    """A name, with a number where it is taken."""
    names = itertools.chain([base], (f"{base}-{number}" for number in itertools.count(2)))
    return next(name for name in names if name not in taken)


def error_document(error: LexsplatError) -> dict[str, Any]:
    """An error as plain data for JSON."""
    parts = {name: getattr(error, name) for name in ("subject", "expected", "found", "remedy")}
    return {"error": {"message": str(error), **parts}}


def sentence(answer: Mapping[str, Any]) -> str:
    """An answer of `find_phrase` in one plain sentence."""
    understood = worded(answer["understood"])
    says_few = understood.startswith(("(no ", "(at most "))  # which may be so without instances
    if says_few and not answer["instances"] and answer["present"] != "unsure":
        text = f"It is {'' if answer['present'] == 'yes' else 'not '}so: {understood[1:-1]}."
    elif answer["present"] == "no":
        text = f"Not here: nothing fits {understood}."
    elif not answer["instances"] and answer["present"] == "unsure":
        text = f"Unsure: nothing certain is found for {understood}."
    elif not answer["instances"]:
        text = f"None found for {understood}."  # the note says why
    else:
        things = "; ".join(placed(thing) for thing in answer["instances"][:8])
        more = f"; and {answer['count'] - 8} more" if answer["count"] > 8 else ""
        text = f"{answer['count']} found for {understood}: {things}{more}."
        return qualified(text, answer)
    return qualified(text, {**answer, "present": "yes"})


def qualified(text: str, answer: Mapping[str, Any]) -> str:
    """A sentence with "Perhaps" where the "present" of an answer is "unsure", and with its "note"."""
    text = f"Perhaps {text}" if answer["present"] == "unsure" else text
    return f"{text} Note: {answer['note']}." if answer.get("note") else text


def placed(thing: Mapping[str, Any], link: str = " at ") -> str:
    """A thing (`Selection.geometry`) with its place and best view, for a sentence."""
    return f"{shortened(thing['name'], 60)}{link}{position(thing)}, {seen_in(thing)}"


def seen_in(thing: Mapping[str, Any]) -> str:
    """Where a thing is seen best, for a sentence."""
    return f"best seen in {thing['best_view']}" if thing["best_view"] else "in no photo"


def shortened(text: str, length: int = 200) -> str:
    """A text for a sentence."""
    return text if len(text) <= length else f"{text[:length]}..."


def worded(understood: str) -> str:
    """How a phrase was understood, for a sentence: "(red any object)" as "anything red"."""
    return shortened(re.sub(r"\(([^()\"]+) any object\)", r"anything \1", understood))


def counted(count: int, what: str) -> str:
    """A number of things for a sentence: "1 scene", "2 scenes"."""
    return f"{count:,} {what}" + ("" if count == 1 else "s")


def lines_of(stream: TextIO) -> Iterator[str]:
    """The lines of a stream. A line longer than `MAX_LINE` is cut there, which bounds memory."""
    while line := stream.readline(MAX_LINE + 1):
        yield line
        while line and not line.endswith("\n"):
            line = stream.readline(MAX_LINE)


def json_line(document: Mapping[str, Any]) -> str:
    """JSON in one line for every reader: some take U+0085, U+2028 and U+2029 for ends of lines."""
    text = json.dumps(document, ensure_ascii=False)
    return re.sub("[\x85\u2028\u2029]", lambda found: f"\\u{ord(found[0]):04x}", text)


def answer_line(served: OpenScene, line: str) -> dict[str, Any]:
    """The answer to a line of ``lexsplat ask --stdin`` (docs/schemas/ask.json).

    A line is a phrase, or a JSON object with "ask" and optionally "view", "threshold" and "id". Errors are answers
    as well: one line with "error". No line raises.
    """
    identity: dict[str, Any] = {}
    try:
        request = _parsed(line)
        if "id" in request:
            identity = {"id": _checked_id(request["id"])}
        _check(request)
        scene = served.scene
        answer = find_phrase(scene, request["ask"], request.get("view"), request.get("threshold"))
        return {**identity, **answer, "sentence": sentence(answer)}
    except LexsplatError as error:
        return {**identity, **error_document(error)}
    except Exception as error:  # the next line is answered, whatever this one meets
        log.exception("a line was not answered")
        unforeseen = QueryError(
            "line", expected="an answer", found=repr(error)[:80], remedy="please report it with the line"
        )
        return {**identity, **error_document(unforeseen)}


_KEYS = ("ask", "view", "threshold", "id")
_REMEDY = '{"ask": "red apple", "view": "view_033", "threshold": 0.5, "id": 1}; all but "ask" may be left out'


def _parsed(line: str) -> dict[str, Any]:
    """The object of a line; a phrase alone is asked."""
    if len(line) > MAX_LINE:
        raise QueryError("line", expected=f"at most {MAX_LINE} characters", found="more")
    text = line.strip().removeprefix("\ufeff").strip()
    if not text.startswith(("{", "[")):
        return {"ask": text}
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise QueryError("line", expected="one JSON object", found=str(error)[:80], remedy=_REMEDY) from error
    if not isinstance(found, dict):
        raise QueryError("line", expected="one JSON object", found=text[:60], remedy=_REMEDY)
    return found


def _checked_id(value: Any) -> Any:
    try:
        json.dumps(value, allow_nan=False)
    except (ValueError, RecursionError) as error:
        raise QueryError("id", expected="a value of JSON", found=str(error)[:80], remedy=_REMEDY) from error
    return value


def _check(request: Mapping[str, Any]) -> None:
    unknown = sorted(set(request) - set(_KEYS))
    if unknown:
        listed = ", ".join(repr(key[:60]) for key in unknown)[:120]
        raise QueryError("line", expected=f"the keys {', '.join(_KEYS)}", found=listed, remedy=_REMEDY)
    for key, needed in (("ask", True), ("view", False)):
        value = request.get(key)
        if not isinstance(value, str) and (needed or value is not None):
            found = reprlib.repr(value) if key in request else "nothing"
            raise QueryError(key, expected="text", found=found, remedy=_REMEDY)
