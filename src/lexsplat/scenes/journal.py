"""The journal of an edit: its steps in a file, one line of JSON each, the newest last."""

from __future__ import annotations

import base64
import binascii
import json
import logging
import os
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from lexsplat.runtime.errors import FileFormatError, SceneFolderError
from lexsplat.runtime.files import naming
from lexsplat.scenes.fills import Fill
from lexsplat.scenes.scene import Scene

Kind = Literal["delete", "keep", "recolor", "move", "duplicate"]
CHANGES: tuple[Kind, ...] = get_args(Kind)
"""The kinds of steps."""
JOURNAL_VERSION = 1
_DEFLATE = 1032
"""Largest compression ratio of DEFLATE."""
_MOTION = ("rotation", "scale", "translation", "center")
_VALUES: dict[Kind, tuple[str, ...]] = {
    "delete": ("fill",),
    "keep": (),
    "recolor": ("color", "strength"),
    "move": (*_MOTION, "fill", "remains"),
    "duplicate": _MOTION,
}
"""The numbers of each kind of step."""
_RENAMED_KINDS = {"recolour": "recolor"}
"""Steps of journals that were written before the renames, and their present names."""


@dataclass(frozen=True)
class Step:
    """One edit.

    Args:
        kind: The operation.
        mask: The Gaussians it applies to ``[N]`` bool, of those that exist before the step.
        values: Its numbers: "color" and "strength", or "rotation" ``[3, 3]``, "scale", "translation", "center"; or
            "fill", the Gaussians that close the hole (`lexsplat.scenes.fills.Fill.to_json`), and "remains", those
            that are deleted where a thing is moved away (`packed`).
        phrase: Phrase that was asked for, for display.
    """

    kind: Kind
    mask: Tensor
    values: dict[str, Any] = field(default_factory=dict)
    phrase: str = ""

    def __str__(self) -> str:
        fill = self.values.get("fill")
        filled = f", filled with {fill['gaussians']}" if fill and fill["gaussians"] else ""
        return f"{self.kind} {self.phrase or 'a selection'} ({int(self.mask.sum())} Gaussians{filled})"

    def to_json(self) -> dict[str, Any]:
        """Plain data; the mask as compressed bits."""
        return {
            "step": self.kind,
            "phrase": self.phrase,
            "gaussians": len(self.mask),
            "mask": packed(self.mask),
            **self.values,
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Step:
        """The inverse of `to_json`.

        Raises:
            ValueError: If the data are not a step.
        """
        try:
            kind = _RENAMED_KINDS.get(data["step"], data["step"])
            mask = unpacked(data["mask"], data["gaussians"])
            if kind not in _VALUES:
                raise ValueError(f"not a step: {kind!r}"[:100])
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a step: {error!r}"[:100]) from error
        values = {name: data[name] for name in _VALUES[kind] if name in data}
        if "fill" in values:
            Fill.from_json(values["fill"])
        if "remains" in values and bool((unpacked(values["remains"], len(mask)) & mask).any()):
            raise ValueError("not a step: what is moved remains")
        phrase = "".join(c if c.isprintable() else " " for c in str(data.get("phrase", "")))
        return cls(kind, mask, values, phrase)


def packed(mask: Tensor) -> str:
    """A mask ``[N]`` bool as text: compressed bits."""
    bits = zlib.compress(np.packbits(mask.cpu().numpy()).tobytes(), 6)
    return base64.b64encode(bits).decode("ascii")


def unpacked(text: Any, count: Any) -> Tensor:
    """The inverse of `packed` for ``count`` Gaussians.

    Raises:
        ValueError: If the text is not a mask of so many Gaussians.
    """
    try:
        raw = base64.b64decode(text)
        if type(count) is not int or not 0 <= count <= 8 * _DEFLATE * max(len(raw), 1):
            raise ValueError(f"not a step: {len(raw)} bytes cannot hold a mask of {count!r} Gaussians"[:100])
        content = zlib.decompressobj().decompress(raw, count // 8 + 1)
    except (TypeError, binascii.Error, zlib.error) as error:
        raise ValueError(f"not a step: {error!r}") from error
    bits = np.unpackbits(np.frombuffer(content, np.uint8))[:count]
    if len(bits) != count:
        raise ValueError(f"not a step: a mask of {len(bits)} Gaussians, not of {count}")
    return torch.from_numpy(bits.astype(bool))


class Journal:
    """A file of steps.

    Args:
        path: The file.
        scene: The scene as it was built; the file belongs to its reconstruction.
    """

    def __init__(self, path: Path, scene: Scene) -> None:
        self.path, self._scene = path, scene
        self._size = self._whole = 0
        """Bytes of the file, and of its complete lines."""

    def append(self, entry: dict[str, Any]) -> None:
        """Append a line and wait until it is on the disk, so that a later crash does not lose it.

        Raises:
            OSError: If it cannot be written; the file then has no part of it.
            SceneFolderError: If another program has changed the file since it was read.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        lines = [entry] if self._whole else [self._header(), entry]
        content = "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines).encode()
        # Without a buffer: what a full disk refuses must not be written again when the file is closed.
        with naming(self.path), open(self.path, "ab", buffering=0) as file:
            _lock(file)
            before = os.fstat(file.fileno()).st_size
            try:
                self.check_unchanged()
                before = self._size = file.truncate(self._whole)  # ends a last line that is cut off
                rest = memoryview(content)
                while rest:
                    rest = rest[file.write(rest) :]
                os.fsync(file.fileno())
                self._size = self._whole = before + len(content)
            except BaseException:
                file.truncate(before)
                if not before:
                    self.path.unlink(missing_ok=True)
                raise

    @property
    def is_unchanged(self) -> bool:
        """Whether the file is as it was read or written here."""
        return (self.path.stat().st_size if self.path.exists() else 0) == self._size

    def check_unchanged(self) -> None:
        """Refuse to go on after the steps of another program.

        Raises:
            SceneFolderError: If the file is not as it was read or written here.
        """
        if not self.is_unchanged:
            raise SceneFolderError(
                self.path,
                expected="the steps as they were read",
                found="steps of another program",
                remedy="run the command again; in a page, try again",
            )

    def read(self) -> tuple[list[Step], list[Step]]:
        """The steps, and those that were undone, the latest undone last.

        Raises:
            FileFormatError: If the file is damaged. A last line that is cut off is ignored, with a warning.
            SceneFolderError: If it belongs to another reconstruction.
        """
        steps: list[Step] = []
        undone: list[Step] = []
        for number, line in enumerate(self._lines(), start=1):
            try:
                entry = json.loads(line)
                if number == 1:
                    self._check(entry)
                elif entry.get("undo"):
                    undone.append(steps.pop())
                elif entry.get("redo"):
                    steps.append(undone.pop())
                else:
                    steps.append(Step.from_json(entry))
                    undone.clear()
            except (ValueError, IndexError, AttributeError, RecursionError) as error:
                raise FileFormatError(
                    self.path,
                    expected="steps of an edit",
                    found=f"line {number}: {error}"[:200],
                    remedy="discard the edit",
                ) from error
        return steps, undone

    def _lines(self) -> list[str]:
        try:
            with open(self.path, "rb") as file:
                _lock(file, shared=True)  # of another program's step, all is there or nothing
                content = file.read()
            lines = content.decode("utf-8").split("\n")
        except (OSError, UnicodeDecodeError) as error:
            raise FileFormatError(
                self.path, expected="a readable journal", found=str(error), remedy="discard the edit"
            ) from error
        self._size, self._whole = len(content), content.rfind(b"\n") + 1
        if lines[-1]:
            logging.getLogger("lexsplat").warning("%s: the last line is cut off and ignored", self.path)
        return lines[:-1]

    def _header(self) -> dict[str, Any]:
        folder = self._scene.folder
        reconstruction = folder.record["stages"].get("reconstruct", {}).get("fingerprint") if folder else None
        return {
            "journal": JOURNAL_VERSION,
            "gaussians": len(self._scene.gaussians),
            "reconstruction": reconstruction,
        }

    def _check(self, header: dict[str, Any]) -> None:
        if header != self._header():
            raise SceneFolderError(
                self.path,
                expected="edits of this reconstruction",
                found="edits of another one",
                remedy="the scene was built again: discard the edits",
            )


def _lock(file: IO[Any], shared: bool = False) -> None:
    """Wait until no other program writes to a file, or reads it if not shared; the lock ends when it is closed."""
    try:
        import fcntl
    except ImportError:  # Windows has no flock: two writers at the same moment are not detected
        return
    fcntl.flock(file, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
