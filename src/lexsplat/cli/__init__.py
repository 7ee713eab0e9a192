"""The command line: ``lexsplat COMMAND``. Errors are one line and exit status 1, wrong usage is 2.

Each command is a dataclass in a file of its name: fields are options, the docstring is the help, `run` does it.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from lexsplat import __version__
from lexsplat.cli.ablate import Ablate
from lexsplat.cli.build import Build, Language, Reconstruct
from lexsplat.cli.compare import Compare
from lexsplat.cli.demo import Demo
from lexsplat.cli.edit import Edit
from lexsplat.cli.evaluate import Evaluate
from lexsplat.cli.export import Export
from lexsplat.cli.find import Find
from lexsplat.cli.info import Info
from lexsplat.cli.poses import Poses
from lexsplat.cli.query import Query
from lexsplat.cli.scale import Scale
from lexsplat.cli.view import View
from lexsplat.runtime.errors import STOPPED, LexsplatError

Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Build, tyro.conf.subcommand("build")]
    | Annotated[Poses, tyro.conf.subcommand("poses")]
    | Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")]
    | Annotated[Language, tyro.conf.subcommand("language")]
    | Annotated[Query, tyro.conf.subcommand("query")]
    | Annotated[Find, tyro.conf.subcommand("find")]
    | Annotated[Scale, tyro.conf.subcommand("scale")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Ablate, tyro.conf.subcommand("ablate")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Edit, tyro.conf.subcommand("edit")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Info, tyro.conf.subcommand("info")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["embed"]:  # the name of the command before "language"
        arguments[0] = "language"
    if arguments[:1] in (["--version"], ["-V"]):
        print(f"lexsplat {__version__}")
        return 0
    try:
        command = tyro.cli(
            Command,  # type: ignore[arg-type]
            prog="lexsplat",
            description="Search a place with words: photos in, 3D Gaussians that carry language out.",
            args=arguments,
        )
    except KeyboardInterrupt:
        return _stopped()
    except BrokenPipeError:  # of a long --help, as below
        return _seen_enough()
    except ValueError as error:  # settings check themselves when they are made
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    try:
        command.run()
    except LexsplatError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return _stopped()
    except BrokenPipeError:
        return _seen_enough()
    except (MemoryError, RuntimeError) as error:
        # torch says with a RuntimeError what Python says with a MemoryError.
        wants_memory = any(
            words in str(error) for words in ("allocate memory", "not enough memory", "out of memory")
        )
        if not (isinstance(error, MemoryError) or wants_memory):
            raise
        remedy = "give a smaller --memory, a larger --downscale or a smaller --reconstruction.max-gaussians"
        print(f"error: memory: expected more of it, found the end of it; {remedy}", file=sys.stderr)
        return 1
    except UnicodeEncodeError as error:
        # The system has names of any bytes; camera files, JSON and reports have letters.
        subject = ascii(str(error.object))[1:100]
        remedy = "rename the file or folder"
        print(f"error: {subject}: expected names in UTF-8, found other bytes; {remedy}", file=sys.stderr)
        return 1
    except OSError as error:
        # A full disk or a folder without permission: the system's words and the file are the whole story.
        print(f"error: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0


def _seen_enough() -> int:
    """Whoever read our output has what they wanted, as in `lexsplat info SCENE | head`: the rest goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _stopped() -> int:
    """Say so, with the status that shells give to Ctrl-C."""
    print(STOPPED, file=sys.stderr)
    return 130
