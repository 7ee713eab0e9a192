"""``library.json``: what makes a folder a library, with its own name on an index server."""

from __future__ import annotations

import re
import uuid
from pathlib import Path

from lexsplat.runtime.errors import FileFormatError, LibraryError
from lexsplat.runtime.files import locked, read_json, write_json

FORMAT_VERSION = 1


def library_name(root: Path) -> str:
    """The name of a library on a server.

    Raises:
        LibraryError: If there is no library, a damaged one, or one of another format version.
    """
    path = root / "library.json"
    if not path.is_file():
        whole = not _has_entries(root)
        raise LibraryError(
            root,
            expected="a library of scenes",
            found="no library.json in it" if root.exists() else "no such folder",
            remedy=f"make one with: lexsplat library add {root} SCENE" if whole else _mending(root),
        )
    try:
        facts = read_json(path)
    except FileFormatError as error:
        raise LibraryError(path, expected=error.expected, found=error.found, remedy=_mending(root)) from error
    version = facts.get("format_version") if isinstance(facts, dict) else None
    if version != FORMAT_VERSION or not re.fullmatch(r"\w{1,40}", str(facts.get("name"))):
        raise LibraryError(
            path,
            expected=f"format_version {FORMAT_VERSION} and a name",
            found=repr(version)[:40],
            remedy="add the scenes to a new library with this version of lexsplat",
        )
    return str(facts["name"])


def make_library(root: Path) -> None:
    """Make a library of a new or empty folder; a lost or unreadable ``library.json`` is written again.

    Files with a name that starts with a dot, such as those of killed commands, do not matter.

    Raises:
        LibraryError: If the folder has files of another program, or another process changes the library.
    """
    path = root / "library.json"
    foreign = root.exists() and (
        not root.is_dir()
        or (not _has_entries(root) and any(each.name[0] != "." for each in root.iterdir() if each != path))
    )
    if foreign and not path.is_file():
        raise LibraryError(
            root, expected="a library or a new folder", found="other files", remedy="give another folder"
        )
    if not _is_readable(path):
        with locked(root, lambda holder: in_use(root, holder)):
            if not _is_readable(path):  # another process may have made it in the meantime
                write_json(path, {"format_version": FORMAT_VERSION, "name": uuid.uuid4().hex})


def in_use(root: Path, holder: str) -> LibraryError:
    """The error where another process changes a library."""
    return LibraryError(
        root,
        expected="a library that no other process changes",
        found=f"process {holder} at work",
        remedy="run the command again when it is done",
    )


def _has_entries(root: Path) -> bool:
    return any((root / "scenes").glob("[!.]*.safetensors"))


def _is_readable(path: Path) -> bool:
    try:
        read_json(path)
    except FileFormatError:
        return False
    return True


def _mending(root: Path) -> str:
    return f"lexsplat library verify {root} --repair writes it again; an index server has to be filled again"
