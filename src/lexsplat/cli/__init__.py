"""The command line: ``lexsplat COMMAND``. Errors are one line with exit status 1; wrong usage has exit status 2.

Each command is a dataclass in a module of its own: fields are options, the docstring is the help page, `run` does the
work. Only the module of the given command is imported: ``lexsplat --version`` and ``lexsplat --help`` answer at once.
"""

from __future__ import annotations

import difflib
import errno
import importlib
import logging
import os
import sys
from collections.abc import Sequence
from typing import NamedTuple, NoReturn

from lexsplat import __version__
from lexsplat.runtime.errors import STOPPED, LexsplatError
from lexsplat.runtime.progress import NOTE


class CommandEntry(NamedTuple):
    """Where a command is defined, and what it does in a few words."""

    module: str
    name: str
    summary: str


COMMANDS = {
    "demo": CommandEntry("demo", "Demo", "build, query and evaluate a bundled capture"),
    "build": CommandEntry("build", "Build", "make a searchable scene from photos or a video"),
    "poses": CommandEntry("poses", "Poses", "estimate the cameras of photos or a video"),
    "reconstruct": CommandEntry("build", "Reconstruct", "only the first stage of build: 3D Gaussians"),
    "language": CommandEntry("build", "Language", "the later stages of build: language on the Gaussians"),
    "query": CommandEntry("query", "Query", "heatmaps, masks and scores for free text"),
    "find": CommandEntry("find", "Find", "where things are in 3D, how many and how large"),
    "list": CommandEntry("listing", "List", "everything in a scene: names, colors, places and sizes"),
    "ask": CommandEntry("ask", "Ask", "questions in your own words, many a second with --stdin"),
    "measure": CommandEntry("measure", "Measure", "how far two things are from each other"),
    "scale": CommandEntry("scale", "Scale", "set the length of a meter and the up direction of a scene"),
    "evaluate": CommandEntry("evaluate", "Evaluate", "measure a scene on its held-out views"),
    "ablate": CommandEntry("ablate", "Ablate", "measure the method without its parts"),
    "compare": CommandEntry("compare", "Compare", "measure several methods side by side"),
    "edit": CommandEntry("edit", "Edit", "delete, recolor, move or duplicate things by words"),
    "export": CommandEntry("export", "Export", "write a scene or a selection for other programs"),
    "publish": CommandEntry("publish", "Publish", "write a page that searches a scene with no server"),
    "library": CommandEntry("library", "LibraryCommand", "search many scenes at once"),
    "view": CommandEntry("view", "View", "show and search a scene in the browser"),
    "encoders": CommandEntry(
        "encoders", "EncodersCommand", "fetch, check and time encoders before a long build"
    ),
    "mcp": CommandEntry("mcp", "Mcp", "tools for language models"),
    "info": CommandEntry("info", "Info", "show what a scene folder contains"),
}
"""Commands by name, in the order of the help page."""

_REMEDIES = {
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "; allow it, or give another place"),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "; free some space and run the same command again"),
}
"""Remedies for errors of the system, by their numbers."""

_PRINTING = ("query", "find", "list", "ask", "measure", "library", "encoders", "info")
"""Commands that have nothing left to do but to print when they begin to."""

_UNSUITABLE = {
    **dict.fromkeys((errno.EEXIST, errno.ENOTDIR), "expected a folder, found a file; give another place"),
    errno.EISDIR: "expected a file, found a folder; give another name",
    errno.ENOENT: "expected a path that exists or can be made, found none; check it, or give another place",
}
"""What is wrong with a path, by the numbers of errors of the system."""

_OUT_OF_MEMORY = ("allocate memory", "not enough memory", "out of memory")
"""What torch says, in a RuntimeError, where Python raises MemoryError."""
_NO_PRIMITIVE = "could not create a primitive"
"""All that oneDNN says without memory for its code; it says more where an operation is not supported."""

ALIASES = {"embed": "language"}
"""Other names of commands."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status.

    Raises:
        SystemExit: With status 2 after wrong usage, with status 0 after the help page of a command.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    logging.getLogger("lexsplat").setLevel(NOTE)
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        try:
            status = _run(words)
        except SystemExit:  # after a help page
            _flush()
            raise
        _flush()
        return status
    except LexsplatError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        if error.crashes_at_exit:
            sys.stdout.flush()
            os._exit(1)
    except KeyboardInterrupt:
        print(STOPPED, file=sys.stderr)
        return 130  # as shells report Ctrl-C
    except BrokenPipeError:
        # The reader of the output has ended, as in `lexsplat info SCENE | head`: nothing else was left to do.
        _discard_output()
        return 0
    except (MemoryError, RuntimeError) as error:
        said = str(error).strip()
        out_of_memory = said == _NO_PRIMITIVE or any(phrase in said for phrase in _OUT_OF_MEMORY)
        if not (isinstance(error, MemoryError) or out_of_memory):
            raise
        remedy = "give a smaller --memory, a larger --downscale or a smaller --reconstruction.max-gaussians"
        print(f"error: out of memory; {remedy}", file=sys.stderr)
    except UnicodeEncodeError as error:
        # File names may hold any bytes; camera files, JSON and reports hold text.
        subject = ascii(str(error.object))[1:100]
        if error.encoding.replace("_", "-") != "utf-8":
            expected = f"characters of the encoding {error.encoding}"
            told = f"expected {expected}, found others; set PYTHONIOENCODING=utf-8"
            print(f"error: {subject}: {told}", file=sys.stderr)
            return 1
        remedy = "rename the file or folder"
        print(f"error: {subject}: expected names in UTF-8, found other bytes; {remedy}", file=sys.stderr)
    except OSError as error:  # such as a full disk or a folder without permission
        number = error.errno or 0
        told = _UNSUITABLE.get(number, f"{error.strerror or error}{_REMEDIES.get(number, '')}")
        print(f"error: {error.filename or 'output'}: {told}", file=sys.stderr)
    return 1


def _run(words: list[str]) -> int:
    if not words:
        print(overview(), file=sys.stderr)
        return 2
    name, *rest = words
    if name in ("--version", "-V"):
        print(f"lexsplat {__version__}")
        return 0
    if name in ("--help", "-h", "--help-all"):
        print(overview())
        return 0
    name = ALIASES.get(name, name)
    if name not in COMMANDS:
        _refuse(name)
    from lexsplat.cli import waiting

    if os.environ.get("NO_COLOR"):  # see no-color.org; rich knows it, tyro does not
        os.environ["PYTHON_TYRO_ANSI_CODES"] = "False"
    entry = COMMANDS[name]
    with waiting.starting():
        from lexsplat.cli.arguments import parse

        kind = getattr(importlib.import_module(f"lexsplat.cli.{entry.module}"), entry.name)
        command = parse(kind, name, rest)
    waiting.command.set(name)
    try:
        command.run()
    except BrokenPipeError as error:
        if name in _PRINTING:
            raise
        _discard_output()
        raise LexsplatError(
            f"lexsplat {name}",
            expected="a reader of its output until it ends",
            found="a closed pipe",
            remedy="run the same command again, with its output read to the end or written to a file",
        ) from error
    return 0


def _flush() -> None:
    """Write what is left of the output, so that `main`, not the interpreter, notices a reader that has ended."""
    if sys.stdout is not None:  # None if it is closed, as in `lexsplat info SCENE >&-`
        sys.stdout.flush()


def _discard_output() -> None:
    """Write the rest of the output to nowhere: at its end Python would report the closed pipe once more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def overview() -> str:
    """The page of ``lexsplat --help``."""
    width = max(map(len, COMMANDS))
    commands = (f"  {name:<{width}}  {entry.summary}" for name, entry in COMMANDS.items())
    return "\n".join(
        (
            "usage: lexsplat COMMAND ...",
            "",
            "Search a place with words: photos in, 3D Gaussians that carry language out.",
            "",
            *commands,
            "",
            "lexsplat COMMAND --help       the options that people use",
            "lexsplat COMMAND --help-all   all options",
            "lexsplat --version            the version",
        )
    )


def _refuse(name: str) -> NoReturn:
    """State which commands there are, and end the program with the status of wrong usage."""
    if name.startswith("-"):
        message = f"{name}: expected a command before the options; see lexsplat --help"
    else:
        close = difflib.get_close_matches(name, [*COMMANDS, *ALIASES], n=1)
        hint = f"did you mean {close[0]}?" if close else "see lexsplat --help"
        message = f"{name}: no such command; {hint}"
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)
