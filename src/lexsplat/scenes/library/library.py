"""A library of scenes in a folder: added to, removed from, verified and searched."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from lexsplat.features.text import TextCache, TextTower, load_text
from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.relevancy import CANONICAL_PHRASES, embed_prompts
from lexsplat.runtime.bounded import Bounded
from lexsplat.runtime.device import choose_device
from lexsplat.runtime.errors import FileFormatError, LexsplatError, LibraryError
from lexsplat.runtime.files import locked
from lexsplat.runtime.progress import Listener, silent
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.library import identity
from lexsplat.scenes.library.contents import Contents, map_contents
from lexsplat.scenes.library.entries import Codes, map_codes, record_of, write_entry
from lexsplat.scenes.library.found import Found
from lexsplat.scenes.library.mending import mended, problems_of
from lexsplat.scenes.library.records import (
    BUNDLED,
    OWN_FILE,
    REMOVED,
    Record,
    abandoned,
    command,
    read_record,
    recovered_record,
    removals,
    scenes_without_record,
    stamp_of,
    state_of,
)
from lexsplat.scenes.library.searching import search
from lexsplat.scenes.library.server import Server
from lexsplat.scenes.reading import read_scene
from lexsplat.scenes.scene import Scene, open_scene
from lexsplat.scenes.serving import counted

COMPARED = (*everyday_words(), *CANONICAL_PHRASES)
"""Texts that every question is compared with."""
_OPEN_SCENES, _KEPT_CONTENTS = 16, 512
"""Scenes that stay open, and scenes whose segments and objects stay mapped, at most."""


class Library:
    """Scenes that are searched together. One process at a time may change a library; any number may read it.

    Args:
        root: Its folder.
        device: Device of the opened scenes: "auto", "cpu" or "cuda".
        index: Address of an index server, such as "http://localhost:8000"; None compares with all scenes.

    Raises:
        LibraryError: If there is no library, or one of another format version.
        BackendError, ValueError: If the device is not there, or none of the three.
    """

    def __init__(self, root: str | Path, device: str = "auto", index: str | None = None) -> None:
        self.root, self._device, self._text_device = Path(root), device, choose_device(device)
        self.stage = self.root / "scenes"
        """The folder of the entries."""
        name = identity.library_name(self.root)
        self.server = Server(index, name, self.root) if index else None
        self._home, self._texts = self.root.resolve(), TextCache(self.root / "texts")
        self.listener: Listener = silent  # receives progress events of reading, adding and verifying scenes
        self._towers: dict[str, TextTower] = {}
        self._records: dict[str, tuple[tuple[int, int], Record]] = {}
        self._codes: dict[str, tuple[str, Codes]] = {}
        self._states: dict[str, tuple[str, str]] = {}
        self._scenes: Bounded[tuple[str, str, str], Scene] = Bounded(_OPEN_SCENES)
        self._contents: Bounded[str, Contents] = Bounded(_KEPT_CONTENTS)
        self._bad_records: dict[str, FileFormatError] = {}
        self._bad_codes: dict[str, tuple[tuple[int, int], FileFormatError]] = {}  # of which record

    @classmethod
    def create(cls, root: str | Path, device: str = "auto", index: str | None = None) -> Library:
        """Open a library; a new or empty folder becomes one, and a lost ``library.json`` is written again.

        Raises:
            LibraryError: If the folder has files of another program.
        """
        with identity.telling_errors(Path(root)):
            identity.make_library(Path(root))
        return cls(root, device, index)

    def __repr__(self) -> str:
        try:
            return f"Library({str(self.root)!r}, scenes={len(self.names())})"
        except LibraryError:
            return f"Library({str(self.root)!r}, gone)"

    def names(self) -> list[str]:
        """The names of all scenes, in order, even of those whose records cannot be read.

        Raises:
            LibraryError: If the library was moved or deleted since it was opened.
        """
        return [entry.name[:-5] for entry in identity.listed_records(self.root, new=not self._records)]

    @property
    def damaged(self) -> dict[str, FileFormatError]:
        """Scenes whose record or codes cannot be read, by name."""
        codes = {n: e for n, (of, e) in self._bad_codes.copy().items() if self._records[n][0] == of}
        return {**codes, **self._bad_records}

    def record(self, name: str) -> Record | None:
        """The record of a scene; None if it cannot be read (`damaged`)."""
        return self._record(name, self.stage / f"{name}.json")

    def _record(self, name: str, path: Path | os.DirEntry[str]) -> Record | None:
        try:
            facts = path.stat()
            stamp = (facts.st_mtime_ns, facts.st_size)
            known = self._records.get(name)
            if known is None or known[0] != stamp:
                known = self._records[name] = (stamp, read_record(Path(path)))
            self._bad_records.pop(name, None)
            return known[1]
        except FileNotFoundError:  # removed in the meantime
            self._bad_records.pop(name, None)
        except FileFormatError as error:
            self._bad_records[name] = error
        return None

    def records(self) -> list[Record]:
        """The records of all scenes that can be read; raises as `names`."""
        listed = identity.listed_records(self.root, new=not self._records)
        records = (self._record(each.name[:-5], each) for each in listed)
        return [record for record in records if record is not None]

    def groups(self) -> set[str]:
        """The groups of the scenes, each with one encoder."""
        return {record.group for record in self.records()}

    def codes(self, record: Record, by_hash: bool = False) -> Codes | None:
        """The codes of a scene, checked when first read, with ``by_hash`` again; None if damaged (`damaged`)."""
        known = self._codes.get(record.name)
        if known is None or known[0] != record.content or by_hash:
            self._codes.pop(record.name, None)
            try:
                known = (record.content, map_codes(self.stage / record.codes_file, record, by_hash))
            except FileFormatError as error:
                now = self.record(record.name)
                if now is None or now.content != record.content:  # replaced or removed in the meantime
                    return None if now is None else self.codes(now, by_hash)
                self._bad_codes[record.name] = (self._records[record.name][0], error)
                return None
            self._codes[record.name] = known
            self._bad_codes.pop(record.name, None)
        return known[1]

    def contents(self, record: Record) -> Contents:
        """The stored segments and objects of a scene, checked when they are first read.

        Raises:
            FileFormatError: If it is missing or damaged.
        """
        path = self.stage / record.contents_file
        return self._contents.get_or_make(str(path), lambda: map_contents(path, record.contents))

    def folder(self, record: Record) -> Path:
        """Where a scene is now."""
        return record.folder(self._home)

    def is_rebuilt(self, record: Record, thoroughly: bool = False) -> bool:
        """Whether a scene was built again since it was added.

        Args:
            record: Its record.
            thoroughly: Read its ``scene.json`` even if size and time of the file are unchanged.

        Raises:
            LexsplatError: If its folder is gone, or its ``scene.json`` is damaged or of another version.
        """
        path = self.folder(record)
        try:
            stamp = stamp_of(path)
        except (OSError, ValueError):  # a path that no file can have
            stamp = None
        if stamp and stamp == record.stamp and not thoroughly:
            return False
        key = f"{path} {stamp}"
        known = self._states.get(record.name)
        if stamp is None or thoroughly or known is None or known[0] != key:
            known = self._states[record.name] = (key, state_of(self._opened(record)))
        return known[1] != record.state

    def _opened(self, record: Record) -> SceneFolder:
        """The folder of a scene; if it cannot be read, the error has what can be done about its entry."""
        try:
            return SceneFolder.open(self.folder(record))
        except LexsplatError as error:
            remove = command("remove", self.root, record.name)
            remedy = f"if it was moved: {command('add', self.root, 'NEW_PLACE')}; if it is gone: {remove}"
            if (self.folder(record) / "scene.json").is_file():
                remedy = f"{error.remedy or 'build it again'}, or: {remove}"
            raise error.with_remedy(remedy) from error

    def scene(self, name: str) -> Scene:
        """A scene, as it is now.

        Raises:
            LibraryError: If the library has no such scene.
            SceneFolderError: If its folder is gone.
            FileFormatError: If its record or one of its files is damaged.
        """
        record = self.record(name)
        if record is None:
            raise self.damaged.get(name) or self._unknown(name)
        folder = self._opened(record)
        key = (name, str(folder.root), state_of(folder))
        return self._scenes.get_or_make(key, lambda: self._open(folder.root))

    def _open(self, path: Path) -> Scene:
        """A scene that shares text embeddings and encoders with the others."""
        found = read_scene(path, self._device)
        clip = found.encoder()
        known = found.folder.record["stages"].get("features", {}).get("clip_hash", "")
        encode = partial(self.encode, known, clip)
        content = (found.gaussians, found.field, found.views, clip, found.query, found.folder)
        return Scene(*content, encode_text=encode)

    # -- text

    def encode(self, content_hash: str, clip: str, texts: list[str]) -> Tensor:
        """Embeddings ``[T, D]`` of texts by one of the encoders; known texts need no model.

        Raises:
            ModelError: If the encoder cannot be loaded.
            LibraryError: If the encoder is not the one that the scenes were built with.
        """
        if not content_hash:
            return torch.cat([self._tower(clip).encode_text([text]) for text in texts])
        try:
            return self._texts.encode(content_hash, texts, lambda: self._tower(clip))
        except ValueError as error:
            raise LibraryError(
                clip,
                expected=f"the encoder of the scenes ({content_hash[:12]})",
                found="another one",
                remedy="put the right encoder there, or rebuild the scenes and add them again",
            ) from error

    def _tower(self, clip: str) -> TextTower:
        if clip not in self._towers:
            self._towers[clip] = load_text(clip, self._text_device)
        return self._towers[clip]

    def embed(self, content_hash: str, clip: str, texts: list[str]) -> Tensor:
        """Unit embeddings ``[T, D]`` of prompts, as `Scene.embed` of the scenes with this encoder."""
        return embed_prompts(texts, partial(self.encode, content_hash, clip))

    # -- changing it

    @contextlib.contextmanager
    def changing(self) -> Iterator[None]:
        """Lock the library for a change, and remove what killed writers left.

        Raises:
            LibraryError: If another process changes it, nothing can be written, or it was moved or deleted.
        """
        self.names()
        with identity.telling_errors(self.root), locked(self.root, partial(identity.in_use, self.root)):
            self._sweep()
            # Asked before anything is changed: whether the server holds what the library holds.
            self._served = self.server is None or self.server.is_current(self.stage, self.groups())
            yield

    def _sweep(self) -> None:
        """Finish removals, and delete files of earlier versions of scenes; codes without a record stay."""
        marks = removals(self.stage)
        leaving = {name for name, path in marks.items() if not path.with_suffix(".json").exists()}
        whole = (each for each in self.records() if all((self.stage / file).exists() for file in each.files))
        kept = {record.name: record.files for record in whole}
        for path in self.stage.glob("[!.]*.safetensors"):
            own = OWN_FILE.fullmatch(path.name)
            if own and (own[1] in leaving or path.name not in kept.get(own[1], {path.name})):
                path.unlink(missing_ok=True)
        for path in (*marks.values(), *abandoned(self.stage)):
            path.unlink(missing_ok=True)

    def add(self, path: str | Path) -> Record:
        """Add a scene, or bring its entry up to date after a build or a move.

        Returns:
            Its record. A new scene is named after its folder, with a number if the name is taken.

        Raises:
            SceneFolderError: If it is not a finished scene.
            FileFormatError: If one of its files is damaged.
            LibraryError: If another process changes the library, the disk is full, or the server fails.
        """
        with self.changing():
            return self.enter(path)

    def enter(self, path: str | Path, name: str | None = None) -> Record:
        """`add` under a name, while the library is locked (`changing`)."""
        scene = open_scene(path, device=self._device)
        scene.listener, folder = self.listener, scene.folder
        if folder is None:
            raise ValueError("a scene that was opened has a folder")
        place = BUNDLED if folder.is_bundled else str(folder.root.resolve())
        name = name or self._name_for(place, state_of(folder))
        before = self.record(name)
        scene.embed(COMPARED)  # in one call, so that the cache of the scene is written once
        codes, contents = Codes.of(scene), Contents.of(scene)
        record = record_of(self.root, name, place, scene, codes, contents)
        write_entry(self.root, record, codes, contents)
        if known := scene.encoder_identity().get("encoder_hash"):  # all of its scenes get these texts
            own: Any = SimpleNamespace(content_hash=known, encode_text=scene.encode_text)
            self._texts.encode(known, COMPARED, lambda: own)
        for file in before.files - record.files if before is not None else ():
            (self.stage / file).unlink(missing_ok=True)
        if self.server and self._served:
            self.server.put(record, codes, self.stage)
        elif self.server:  # it has missed other changes
            self.bring_to_server()
        return record

    def bring_to_server(self) -> None:
        """Bring the index server to the state of the library.

        Raises:
            LibraryError: If the server fails.
        """
        if self.server:
            entries = ((record, codes) for record in self.records() if (codes := self.codes(record)))
            self.server.repair(entries, self.stage)
            self._served = True

    def _name_for(self, place: str, state: str) -> str:
        """The name of a known or moved scene, or a new one after the folder."""
        lost = scenes_without_record(self.stage) | self.damaged.keys()
        copies = (recovered_record(self.stage, name) for name in sorted(lost))
        for record in filter(None, (*self.records(), *copies)):
            now = str(self.folder(record))
            if place in (record.path, now):
                return record.name
            if record.state == state and not (Path(now) / "scene.json").is_file():
                return record.name  # its folder is gone, and here is the same build
        base = re.sub(r"[^\w-]+", "_", Path(place).name).strip("_").encode()[:80].decode(errors="ignore")
        base = base or "scene"
        taken, name, number = {known.lower() for known in (*self.names(), *lost)}, base, 2
        while name.lower() in taken:
            name, number = f"{base}-{number}", number + 1
        return name

    def remove(self, scene: str) -> str:
        """Remove a scene by its name or folder; the scene itself stays.

        Raises:
            LibraryError: If there is no such scene, another process changes the library, or the server fails.
        """
        with self.changing():
            name = self.name_of(scene)
            record = self.record(name)
            path, mark = self.stage / f"{name}.json", self.stage / f"{name}{REMOVED}"
            # A removal that is killed from here on is finished later.
            path.replace(mark) if path.exists() else mark.touch()
            self._sweep()
            mark.unlink(missing_ok=True)
            if self.server and self._served and record is not None:
                self.server.drop(record, self.stage)
            else:
                self.bring_to_server()
        return name

    def name_of(self, scene: str) -> str:
        """The name of a scene, given its name or its folder.

        Raises:
            LibraryError: If there is no such scene.
        """
        if scene in self.names() or scene in scenes_without_record(self.stage):
            return scene
        place = BUNDLED if scene == BUNDLED else str(Path(scene).resolve())
        for record in self.records():
            if place in (record.path, str(self.folder(record))):
                return record.name
        raise self._unknown(scene)

    def _unknown(self, scene: str) -> LibraryError:
        names = self.names()
        known = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        return LibraryError(
            f"scene {scene[:80]!r}",
            expected="the name or folder of a scene in the library",
            found="no such scene",
            remedy=f"it has {counted(len(names), 'scene')}: {known}" if names else "the library is empty",
        )

    # -- asking it

    def search(self, phrase: str, limit: int = 10, *, confirm: bool = False) -> Found:
        """The scenes that hold what a phrase names, with its places in them.

        Args:
            phrase: Free-text phrase, with relations as in `Scene.find`.
            limit: Number of scenes, at most.
            confirm: Search the scenes themselves, even where the index suffices.

        Raises:
            QueryError: If the phrase is empty, or there are several.
            LibraryError: If the server cannot answer.
        """
        return search(self, phrase, limit, confirm)

    # -- repairing it

    def verify(self, repair: bool = False) -> dict[str, str]:
        """Check all scenes; returns the problems by name: of the record, of the codes, or of the scene's folder.

        Args:
            repair: Repair what can be repaired: read damaged entries and rebuilt scenes again, and bring the server
                to the state of the library. Scenes that are gone stay.

        Returns:
            The problems that are left, by name; empty if none.

        Raises:
            LibraryError: If another process changes the library, the disk is full, or the server fails.
        """
        return mended(self) if repair else problems_of(self)


def open_library(path: str | Path, *, device: str = "auto", index: str | None = None) -> Library:
    """Open a library of scenes.

    Args:
        path: A folder made by ``lexsplat library add``.
        device: "auto", "cpu" or "cuda".
        index: Address of an index server; None compares with all scenes.

    Raises:
        LibraryError: If there is no library.
    """
    return Library(path, device, index)
