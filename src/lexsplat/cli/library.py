"""``lexsplat library``: many scenes, searched at once."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from lexsplat.cli.options import Device, check_phrases, named, note_version, print_json
from lexsplat.cli.waiting import LateProgress, starting
from lexsplat.runtime.errors import FileFormatError, LibraryError, ModelError, SceneFolderError
from lexsplat.runtime.progress import Event

if TYPE_CHECKING:
    from lexsplat.scenes.library import Found, Library

log = logging.getLogger("lexsplat")

_FOR = {"repair": ("verify",), "confirm": ("search",), "thumbnails": ("search",)}
"""Options that belong to some actions only."""
Action = Annotated[
    Literal["add", "search", "list", "remove", "verify"],
    tyro.conf.Positional,
    tyro.conf.arg(help_behavior_hint="(required)"),
]
LibraryArgument = Annotated[Path, tyro.conf.Positional, named("LIB")]
Words = Annotated[tuple[str, ...], tyro.conf.Positional, named("SCENE|PHRASE ...", "")]


@dataclasses.dataclass
class LibraryCommand:
    """Search many scenes at once: which of them holds a thing, where, how many and how large.

        lexsplat library add rooms kitchen/ office/
        lexsplat library search rooms "fire extinguisher"
        lexsplat library list rooms
        lexsplat library remove rooms office
        lexsplat library verify rooms --repair

    The library is a folder of its own. It keeps the codes, segments and images of each scene; the scenes stay where
    they are. Add a scene again after it was rebuilt or moved (docs/library.md).

    Args:
        action: Action to take.
        library: The folder of the library; the first "add" makes it.
        words: Scene folders or the word "demo" for add, names or folders for remove, phrases for search.
        limit: Scenes of an answer, at most.
        thumbnails: Folder of the thumbnails that search writes; "none" writes none.
        confirm: Search the scenes themselves, even where the index suffices.
        repair: Repair what verify finds.
        index: Address of a Chroma server that proposes scenes, such as http://localhost:8000.
        device: "auto" takes CUDA where there is a GPU.
        json: Print one JSON document on standard output (docs/schemas/library.json).
    """

    action: Action
    library: LibraryArgument
    words: Words = ()
    limit: int = 10
    thumbnails: Path | None = None
    confirm: bool = False
    repair: bool = False
    index: Annotated[str | None, tyro.conf.arg(metavar="URL")] = None
    device: Device = "auto"
    json: bool = False

    defaults: ClassVar[dict[str, str]] = {"thumbnails": "LIB/thumbnails", "index": "compare with all scenes"}

    def check(self) -> None:
        """Refuse invalid options."""
        if self.action == "search":
            check_phrases(self.words)
            for number, word in enumerate(self.words, start=1):
                if not word.strip():
                    raise ValueError(
                        f"PHRASE {number} of {len(self.words)}: expected a word or phrase, found an empty text; "
                        'name something, such as "red apple"'
                    )
        if self.action in ("add", "remove") and not self.words:
            raise ValueError("at least one SCENE is needed")
        if self.action in ("list", "verify") and self.words:
            raise ValueError(f"{self.action} takes no SCENE, got {self.words[0]}")
        for option, actions in _FOR.items():
            if getattr(self, option) not in (False, None) and self.action not in actions:
                raise ValueError(f"--{option} is for {' and '.join(actions)}, not for {self.action}")
        if self.limit < 1:
            raise ValueError(f"limit must be at least 1, got {self.limit}")

    def run(self) -> None:
        """Do it and print."""
        with starting():
            from lexsplat.scenes.library import Library

        mends = self.repair and (self.library / "scenes").is_dir()
        make = Library.create if self.action == "add" or mends else Library
        library = make(self.library, self.device, self.index)
        library.listener = LateProgress()
        document = getattr(self, f"_{self.action}")(library)
        if self.json:
            print_json({"library": str(self.library), **document})
        if document.get("problems"):
            count = len(document["problems"])
            raise LibraryError(
                self.library,
                expected="sound entries",
                found=f"{count} of {len(library.names())} with a problem",
                remedy="see above" if self.repair else "see above; --repair repairs damaged entries",
            )
        if document.get("failed"):
            raise LibraryError(
                self.library,
                expected="scenes that can be added",
                found=f"{len(document['failed'])} of {len(self.words)} that cannot",
                remedy="see above",
            )

    def _say(self, text: str) -> None:
        if not self.json:
            print(text)

    def _add(self, library: Library) -> dict[str, Any]:
        from lexsplat.scenes.folder import SceneFolder

        records, failed = [], []
        for done, path in enumerate(self.words):
            library.listener(Event("scenes", done, len(self.words)))
            try:
                record = library.add(path)
            except (SceneFolderError, FileFormatError, ModelError) as error:
                if len(self.words) == 1:
                    raise
                failed.append({"scene": path, "problem": str(error)})
                self._say(f"not added: {error}")
                continue
            records.append(dataclasses.asdict(record))
            self._say(f"{record.name}: added from {record.path}, {record.codes} codes of {record.clip}")
            note_version(SceneFolder.open(Path(path)), path)
        library.listener(Event("scenes", len(self.words), len(self.words)))
        return {"scenes": records, "failed": failed}

    def _remove(self, library: Library) -> dict[str, Any]:
        names = [library.name_of(scene) for scene in self.words]  # all are known before one is removed
        removed = [library.remove(name) for name in dict.fromkeys(names)]
        self._say(f"removed: {', '.join(removed)}")
        return {"removed": removed}

    def _list(self, library: Library) -> dict[str, Any]:
        from lexsplat.scenes.library.mending import orphans
        from lexsplat.scenes.serving import counted

        records = library.records()
        gone = {record.name for record in records if not (library.folder(record) / "scene.json").is_file()}
        for record in records:
            told = f"{record.path}, {record.gaussians:,} Gaussians, encoder {record.clip}"
            self._say(f"{record.name}: {told}{', no such folder' if record.name in gone else ''}")
        problems = {**orphans(library), **{name: str(error) for name, error in library.damaged.items()}}
        for problem in problems.values():
            self._say(f"damaged: {problem}")
        encoders = counted(len({record.group for record in records}), "encoder")
        self._say(f"{counted(len(records), 'scene')}, {encoders}")
        damaged = [{"scene": name, "problem": problem} for name, problem in problems.items()]
        return {"scenes": [dataclasses.asdict(record) for record in records], "skipped": damaged}

    def _verify(self, library: Library) -> dict[str, Any]:
        from lexsplat.scenes.serving import counted

        problems = library.verify(self.repair)
        for name, problem in problems.items():
            self._say(problem if problem.startswith(f"{name}: ") else f"{name}: {problem}")
        if not problems:
            count = len(library.names())
            self._say(f"{counted(count, 'scene')} {'is' if count == 1 else 'are'} sound")
        return {"problems": [{"scene": name, "problem": problem} for name, problem in problems.items()]}

    def _search(self, library: Library) -> dict[str, Any]:
        from lexsplat.scenes.folder import SceneFolder

        answers: list[dict[str, Any]] = []
        noted: set[str] = set()
        for phrase in self.words:
            found = library.search(phrase, self.limit, confirm=self.confirm)
            answers.append(found.to_dict())
            self._say(repr(found))
            for hit in found.hits:
                if hit.scene not in noted:
                    noted.add(hit.scene)
                    with contextlib.suppress(
                        SceneFolderError, FileFormatError
                    ):  # the index answers without it
                        note_version(SceneFolder.open(Path(hit.path)), hit.path)
            if str(self.thumbnails) != "none":
                self._write_thumbnails(found, answers[-1]["hits"])
        return {"phrases": answers}

    def _write_thumbnails(self, found: Found, entries: list[dict[str, Any]]) -> None:
        folder = self.thumbnails or self.library / "thumbnails"
        for number, (hit, entry) in enumerate(zip(found.hits, entries), start=1):
            try:
                entry["thumbnail"] = str(hit.write_picture(folder))
            except OSError as error:
                log.warning("%s: no thumbnails, %s; give --thumbnails FOLDER or none", folder, error.strerror)
                return
            self._say(f"  thumbnail {number}: {entry['thumbnail']}")
