"""Problems of a library and their repair."""

from __future__ import annotations

import contextlib
import logging
from typing import TYPE_CHECKING

from lexsplat.runtime.errors import LexsplatError, LibraryError
from lexsplat.runtime.progress import NOTE, Event
from lexsplat.scenes.library.contents import map_contents
from lexsplat.scenes.library.records import (
    Record,
    command,
    copy_of_record,
    damaged,
    recovered_record,
    scenes_without_record,
    write_record,
)
from lexsplat.scenes.reading import read_scene

if TYPE_CHECKING:
    from lexsplat.scenes.library.library import Library

log = logging.getLogger("lexsplat")


def problems_of(library: Library) -> dict[str, str]:
    """Problems of the entry or the folder of each scene, by name, each with its remedy.

    Raises:
        LibraryError: If nothing else is wrong, and the server fails or holds another state of the library.
    """
    found = {**orphans(library), **_entries(library)}
    if library.server:
        try:
            library.server.groups(library.stage, library.groups())
        except LibraryError as error:
            if not found:
                raise
            found[library.server.url] = str(error)
    return found


def mended(library: Library) -> dict[str, str]:
    """Repair what can be repaired; returns the remaining problems, as `problems_of`.

    Raises:
        LibraryError: If another process changes the library, the disk is full, or the server fails.
    """
    with library.changing():
        damaged = {**orphans(library), **_entries(library)}
        for name in damaged:
            _repair(library, name)
        library.bring_to_server()
    left = {**orphans(library), **_entries(library)}
    for name in damaged.keys() - left:
        log.log(NOTE, "%s: repaired", name)
    return left


def orphans(library: Library) -> dict[str, str]:
    """Scenes with codes and without a record, each with a remedy."""
    found = {}
    for name in sorted(scenes_without_record(library.stage)):
        problem = f"{library.stage / name}.json: expected the record of a scene, found files without one"
        if recovered_record(library.stage, name) is None:
            found[name] = f"{problem}; add the scene again, or: {command('remove', library.root, name)}"
        else:
            why = "of an addition that was killed or is under way, or of a lost record"
            found[name] = f"{problem}, {why}; {command('verify', library.root, '--repair')}"
    return found


def _entries(library: Library) -> dict[str, str]:
    found, names = {}, library.names()
    for done, name in enumerate(names):
        library.listener(Event("verify", done, len(names)))
        if problem := _problem(library, name):
            found[name] = problem
    library.listener(Event("verify", len(names), len(names)))
    return found


def _problem(library: Library, name: str) -> str:
    """The problem of a scene; "" if it has none."""
    record = library.record(name)
    if record is None and name in library.damaged and recovered_record(library.stage, name) is None:
        problem = (
            f"{library.stage / name}.json: expected the record of a scene, found it and its copy damaged"
        )
        return f"{problem}; {command('remove', library.root, name)}, and add the scene again"
    if record is None or library.codes(record, by_hash=True) is None:
        return str(library.damaged.get(name, ""))  # "" if it was removed in the meantime
    path = library.stage / record.codes_file
    try:
        if copy_of_record(path) != record:
            raise damaged(path, "the copy of the record", "another one")
        if record.contents:
            map_contents(library.stage / record.contents_file, record.contents)
        if library.is_rebuilt(record, thoroughly=True):
            return rebuilt(library, record)
        read_scene(library.folder(record), "cpu")
    except LexsplatError as error:
        return str(error)
    return ""


def rebuilt(library: Library, record: Record) -> str:
    """The remedy for a scene that was built again."""
    place = library.folder(record)
    return f"{place}: rebuilt since it was added; {command('add', library.root, place)}"


def _repair(library: Library, name: str) -> None:
    """Recover the record of a scene from its codes, or read the scene again; a scene that is gone stays."""
    record = library.record(name)
    if record is None and (record := recovered_record(library.stage, name)) is not None:
        write_record(record, library.stage / f"{name}.json")
    if record is None or not _problem(library, name):
        return
    place = library.folder(record)
    if (place / "scene.json").is_file():
        with contextlib.suppress(LexsplatError):  # `mended` reports what is still wrong
            library.enter(place, name)
