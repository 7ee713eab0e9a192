"""Tools that write files, offered with ``--allow-write``."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator, MutableMapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from anyio import from_thread
from pydantic import Field

from lexsplat.mcp import answers
from lexsplat.mcp.tools import PhraseText, Reply, SceneName, Tools
from lexsplat.runtime.errors import QueryError, SceneFolderError
from lexsplat.scenes.asked import asked_of
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.exporting import ending_of, export_scene, exported
from lexsplat.scenes.library import Library
from lexsplat.scenes.serving import OpenScene, counted, new_name, qualified, sentence, shortened
from lexsplat.scenes.unsaved import unsaved_steps

FileName = Annotated[str, Field(description='Name of a new file without a folder, such as "duck.ply".')]


class WritingTools(Tools):
    """The tools that write.

    Args:
        scenes: The served scenes by name; edited ones are added.
        output: The folder of all files; nothing is written elsewhere.
        library: A library whose scenes are served as well.
    """

    def __init__(
        self, scenes: MutableMapping[str, OpenScene], output: Path, library: Library | None = None
    ) -> None:
        super().__init__(scenes, library)
        self._served, self.output = scenes, output

    def export(
        self, phrase: PhraseText, file: FileName, scene: SceneName = ""
    ) -> Annotated[Reply, answers.ExportAnswer]:
        """Write the Gaussians of a thing to a new file for other programs; the ending selects the format."""
        place, path = self._scene(scene), self._new("file", file)
        ending_of(path)
        found, asked = asked_of(place, phrase)
        with _writing(path):
            files = export_scene(place, path, found=[replace(found, phrase=phrase)])
        written, count = [str(each) for each in files], len(exported(place, path, [found])[0])
        text = f"{counted(count, 'Gaussian')} of {shortened(asked['understood'])} written to {written[0]}."
        return Reply(
            qualified(text, asked),
            {
                **place.world.to_json(),
                **asked,
                "files": written,
                "gaussians": count,
                "unsaved_steps": unsaved_steps(place.folder) if place.folder else 0,
            },
        )

    def edit(
        self,
        action: Literal["delete", "keep", "recolor"],
        phrase: PhraseText,
        folder: Annotated[str, Field(description="Name of a new scene folder for the result.")],
        color: Annotated[list[float], Field(description="Red, green, blue in 0..1, for recolor.")] = [],  # noqa: B006
        scene: SceneName = "",
        confirm: Annotated[
            bool,
            Field(
                description='False, the default, refuses what the scene is "unsure" of; true edits that as well.'
            ),
        ] = False,
    ) -> Annotated[Reply, answers.EditAnswer]:
        """Make a new scene without a thing, with it alone or in another color, and serve it, too.

        What is "unsure" needs confirm=true.
        """
        place, path = self._scene(scene), self._new("folder", folder)
        if action != "recolor" and color:
            raise QueryError("color", expected="none", found=f"one for {action}", remedy="leave it out")
        if action == "recolor" and not (len(color) == 3 and all(0 <= value <= 1 for value in color)):
            raise QueryError(
                "color",
                expected="red, green and blue in 0..1",
                found=repr(color)[:60],
                remedy="such as [1, 0, 0]",
            )
        found, asked = asked_of(place, phrase)
        if found.present != "yes" and not confirm:
            raise QueryError(
                phrase[:60],
                expected="something that the scene holds for certain",
                found=sentence({**found.to_dict(), **asked}).rstrip("."),
                remedy="look at it with render, then edit with confirm=true, or name it in other words",
            )
        editor = Editor(place)
        editor.change(action, found, color=color)
        count = int(editor.steps[-1].mask.sum())
        with _writing(path):
            saved = editor.save(path)
        kept = self.library.names() if self.library is not None else []
        name = new_name(folder, {*self._served, *kept})
        self._served[name] = OpenScene(saved.root, place.gaussians.device.type, place.clip)
        document = {
            **place.world.to_json(),
            **asked,
            "scene": str(saved.root),
            "name": name,
            "action": action,
            "gaussians": count,
        }
        what = f"{shortened(asked['understood'])}{' (unsure)' if asked['present'] == 'unsure' else ''}"
        text = (
            f"{action} {what}: {counted(count, 'Gaussian')}; the result is the scene {name} in {saved.root}."
        )
        return Reply(text + (f" Note: {asked['note']}." if asked["note"] else ""), document)

    def _new(self, argument: str, name: str) -> Path:
        path = self.output / name
        if wrong := _wrong_with(name):
            raise QueryError(
                argument,
                expected="a plain name of at most 100 characters",
                found=f"{name[:60]!r}, {wrong}",
                remedy=f'give one such as "duck{".ply" if argument == "file" else ""}"; --output is its folder',
            )
        if path.exists() or path.is_symlink():
            found = f"a {'folder' if path.is_dir() else 'file'} that exists"
            raise SceneFolderError(path, expected="a new name", found=found, remedy="give another name")
        return path


def _wrong_with(name: str) -> str:
    """What keeps a text from being the name of a new file; empty if nothing does."""
    faults = {
        "which is empty": not name.strip(),
        "which has spaces at an end": name != name.strip(),
        "which has characters that cannot be printed": not name.isprintable(),
        "which is a path": Path(name).name != name,
        "which begins with a dot": name.startswith("."),
        f"which has {len(name)} characters": len(name) > 100,
    }
    return next((fault for fault, holds in faults.items() if holds), "")


def check_output(output: Path) -> None:
    """Refuse a folder of new files that cannot be one.

    Raises:
        SceneFolderError: If it, or what is to hold it, is a file, or nothing may be written there.
    """
    existing = next(path for path in (output, *output.parents) if path.exists())
    if not existing.is_dir():
        raise SceneFolderError(
            existing, expected="a folder", found="a file", remedy="give another folder to --output"
        )
    if not os.access(existing, os.W_OK | os.X_OK):
        raise SceneFolderError(
            existing,
            expected="a folder that can be written",
            found="no permission",
            remedy="give another folder to --output",
        )


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Make the folder of a new file or folder; errors of the disk in the block get a remedy.

    A call that its client has cancelled writes nothing: what was written meanwhile is removed.
    """
    try:
        _end_if_cancelled()
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
        try:
            _end_if_cancelled()
        except BaseException:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            raise
    except OSError as error:
        raise SceneFolderError(
            error.filename or path,
            expected="a place that can be written",
            found=error.strerror or repr(error)[:80],
            remedy="make room or change its permissions, or start the server with another --output",
        ) from error


def _end_if_cancelled() -> None:
    """End this thread's work, with the exception of its event loop, if the client has cancelled the call."""
    with contextlib.suppress(RuntimeError):  # called by a program, without an event loop
        from_thread.check_cancelled()
