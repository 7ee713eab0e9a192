"""What is wrong with a library, and how it is mended."""

from __future__ import annotations

import contextlib
import logging
from typing import TYPE_CHECKING

from lexsplat.runtime.errors import LexsplatError
from lexsplat.runtime.progress import NOTE
from lexsplat.scenes.library.contents import map_contents
from lexsplat.scenes.library.records import Record, recovered_record, write_record

if TYPE_CHECKING:
    from lexsplat.scenes.library.library import Library

log = logging.getLogger("lexsplat")


def problems_of(library: Library) -> dict[str, str]:
    """What is wrong with the entry of each scene or with its folder, by name, each with its remedy.

    Raises:
        LibraryError: If the server fails or holds another state of the library.
    """
    if library.server:
        library.server.groups(library.stage, library.groups())
    return {**_orphans(library), **_entries(library)}


def mended(library: Library) -> dict[str, str]:
    """Mend what can be mended; what is still wrong, as `problems_of`.

    Raises:
        LibraryError: If another process changes the library, the disk is full, or the server fails.
    """
    orphans = _orphans(library)
    with library.changing():
        for name, problem in orphans.items():  # removed with the lock
            log.log(NOTE, "%s: %s", name, problem)
        for name in _entries(library):
            _repair(library, name)
        library.bring_to_server()
    return _entries(library)


def _orphans(library: Library) -> dict[str, str]:
    """Scenes whose codes are there without a record."""
    files = library.stage.glob("[!.]*.safetensors") if library.stage.is_dir() else ()
    found = {}
    for name in sorted({file.name.split(".")[0] for file in files} - set(library.names())):
        record = recovered_record(library.stage, name)
        place = library.folder(record) if record else "SCENE"
        found[name] = (
            f"{library.stage / name}.json: codes without a record, left by a killed command or of a lost record;"
            f" --repair removes them; if the scene is wanted: lexsplat library add {library.root} {place}"
        )
    return found


def _entries(library: Library) -> dict[str, str]:
    problems = ((name, _problem(library, name)) for name in library.names())
    return {name: problem for name, problem in problems if problem}


def _problem(library: Library, name: str) -> str:
    """What is wrong with a scene; "" if nothing is."""
    record = library.record(name)
    if record is None or library.codes(record, by_hash=True) is None:
        return str(library.damaged.get(name, ""))  # "" if it was removed in the meantime
    try:
        if record.contents:
            map_contents(library.stage / record.contents_file, record.contents)
        return rebuilt(library, record) if library.is_rebuilt(record) else ""
    except LexsplatError as error:
        return str(error)


def rebuilt(library: Library, record: Record) -> str:
    """What to do about a scene that was built again."""
    place = library.folder(record)
    return f"{place}: rebuilt since it was added; lexsplat library add {library.root} {place}"


def _repair(library: Library, name: str) -> None:
    """Recover the record of a scene from its codes, or read the scene again; a scene that is gone stays."""
    record = library.record(name)
    if record is None and (record := recovered_record(library.stage, name)) is not None:
        write_record(record, library.stage / f"{name}.json")
    if record is None or not _problem(library, name):
        return
    place = library.folder(record)
    if (place / "scene.json").is_file():
        with contextlib.suppress(LexsplatError):  # what is still wrong is told
            library.enter(place, name)
