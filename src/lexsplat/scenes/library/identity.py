"""``library.json``, which marks a folder as a library and holds its name on an index server."""

from __future__ import annotations

import contextlib
import os
import re
import uuid
from collections.abc import Iterator
from pathlib import Path

from lexsplat.runtime.errors import FileFormatError, LibraryError
from lexsplat.runtime.files import locked, read_json, write_json
from lexsplat.scenes.library.records import command, has_entries, hash_of

FORMAT_VERSION = 1
_OWN = {"library.json", "scenes", "texts", "thumbnails"}


class _DamagedError(LibraryError):
    """``library.json`` is not what was written."""


def library_name(root: Path) -> str:
    """The name of a library on a server.

    Raises:
        LibraryError: If there is no library, a damaged one, or one of another format version.
    """
    path = root / "library.json"
    if not path.is_file():
        raise LibraryError(
            root,
            expected="a library of scenes",
            found="no library.json in it" if root.exists() else "no such folder",
            remedy=_mending(root, f"make one with: {command('add', root, 'SCENE')}"),
        )
    expected = f"format_version {FORMAT_VERSION} and a name"
    try:
        facts = read_json(path)
    except FileFormatError as error:
        raise _damaged(root, error.expected, error.found) from error
    if not isinstance(facts, dict) or not _is_intact(facts):
        raise _damaged(root, expected, "another content than was written")
    version, name = facts.get("format_version"), facts.get("name")
    if type(version) is int and version > FORMAT_VERSION:
        remedy = "add the scenes to a new library with this version of lexsplat"
        raise LibraryError(path, expected=expected, found=f"version {version}", remedy=remedy)
    if version != FORMAT_VERSION or not isinstance(name, str) or not re.fullmatch(r"\w{1,40}", name):
        raise _damaged(root, expected, f"{version!r:.20} and {name!r:.40}")
    return name


def make_library(root: Path) -> None:
    """Make a library of a new or empty folder; a lost or damaged ``library.json`` beside entries is written again.

    Files with a name that starts with a dot, such as those of killed commands, do not matter.

    Raises:
        LibraryError: If the folder has files of another program, the library is of another format version, or another
            process changes it.
    """
    path, entries = root / "library.json", has_entries(root)
    if path.is_file():
        try:
            library_name(root)
            return
        except _DamagedError:
            if not entries:  # it may be a file of another program
                raise
    elif root.exists() and not entries:
        other = not root.is_dir() or any(
            each.name[0] != "." for each in root.iterdir() if each.name not in _OWN
        )
        if other or any((root / "scenes").glob("[!.]*")):
            raise LibraryError(
                root, expected="a library or a new folder", found="other files", remedy="give another folder"
            )
    with locked(root, lambda holder: in_use(root, holder)):
        try:
            library_name(root)  # another process may have made it in the meantime
        except LibraryError:
            facts = {"format_version": FORMAT_VERSION, "name": uuid.uuid4().hex}
            write_json(path, {**facts, "hash": hash_of(facts)})


def in_use(root: Path, holder: str) -> LibraryError:
    """The error if another process changes a library."""
    return LibraryError(
        root,
        expected="a library that no other process changes",
        found=f"process {holder} at work",
        remedy="run the command again when it is done",
    )


def listed_records(root: Path, new: bool) -> list[os.DirEntry[str]]:
    """The files of the records of an open library, in order.

    Args:
        root: The folder of the library.
        new: Whether no record has been read yet: a new library has no folder of them.

    Raises:
        LibraryError: If the folder was moved or deleted.
    """
    stage = root / "scenes"
    try:
        with os.scandir(stage) as listed:
            found = [each for each in listed if each.name.endswith(".json") and each.name[0] != "."]
    except (FileNotFoundError, NotADirectoryError) as error:
        if new and (root / "library.json").is_file():
            return []
        raise LibraryError(
            (stage if root.is_dir() else root).absolute(),
            expected="the library that was opened",
            found="no such folder: it was moved or deleted",
            remedy="restore the folder, or open the library at its new path",
        ) from error
    return sorted(found, key=lambda each: each.name[:-5])


@contextlib.contextmanager
def telling_errors(root: Path) -> Iterator[None]:
    """Errors of the file system as one line with a remedy."""
    try:
        yield
    except OSError as error:
        temporary = str(error.filename or "").endswith(".tmp")
        raise LibraryError(
            root if temporary else error.filename or root,
            expected="files that can be written",
            found=str(error.strerror or error),
            remedy="run the command again when that is fixed; the library is as it was before",
        ) from error


def _damaged(root: Path, expected: str, found: str) -> _DamagedError:
    remedy = _mending(root, "delete it if it is that of an empty library, or give another folder")
    return _DamagedError(root / "library.json", expected=expected, found=found, remedy=remedy)


def _mending(root: Path, otherwise: str) -> str:
    """The remedy for a lost or damaged ``library.json``: repair if there are entries, else ``otherwise``."""
    repair = command("verify", root, "--repair")
    mending = f"{repair} writes it again; an index server has to be filled again"
    return mending if has_entries(root) else otherwise


def _is_intact(facts: dict) -> bool:
    try:
        return bool(facts.get("hash") == hash_of(facts))
    except (ValueError, RecursionError):  # text that no file can hold, or brackets nested too deeply
        return False
