"""The state behind all pages of one viewer: a scene, its edits, and what was asked of it."""

from __future__ import annotations

import json
import logging
import os
import struct
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.phrases import Thing
from lexsplat.queries.picking import Hit, surface_at
from lexsplat.queries.relevancy import probability_relevancy
from lexsplat.queries.selection import Selection
from lexsplat.runtime.errors import LexsplatError, QueryError, SceneFolderError
from lexsplat.scenes.answers import file_name
from lexsplat.scenes.editing import Editor, Motion
from lexsplat.scenes.exporting import export_scene
from lexsplat.scenes.folder import file_of
from lexsplat.scenes.journal import CHANGES
from lexsplat.scenes.publishing.manifest import MOST_OBJECTS, checksums, object_entries, scene_manifest
from lexsplat.scenes.publishing.splat_file import most_visible, write_splats
from lexsplat.scenes.publishing.vocabulary import NAME, page_phrases, words_file
from lexsplat.scenes.publishing.writing import MOST_SPLATS
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.words import prepare_parts, things_with_parts
from lexsplat.viewer.coloring import MODES, colors_in
from lexsplat.viewer.history import History
from lexsplat.viewer.requests import Asked, number, vector

EXPORT_ENDINGS = (".ply", ".glb", ".splat", ".spz", ".sog", ".points.ply")
_MOST_INSTANCES = 254
_NAMES = 6
"""Number of names that a click gets, at most."""


@dataclass(frozen=True)
class Content:
    """Files that pages load.

    Args:
        manifest: The content of ``manifest.json``.
        files: The other files by name.
        drawn: Indices ``[M]`` of the Gaussians that pages have, in the order of the file.
    """

    manifest: dict[str, Any]
    files: dict[str, bytes]
    drawn: Tensor


class Session:
    """Answers all pages of a viewer; calls wait for each other.

    Args:
        scene: The scene as it was built. Steps of ``lexsplat edit`` are replayed.
        splats: Maximum number of Gaussians that a browser draws at once.
        history: Earlier prompts and the vocabulary.

    Raises:
        QueryError: If the scene has fewer than two Gaussians, or invalid ones.
        FileFormatError: If the journal of its edits is damaged.
    """

    def __init__(self, scene: Scene, splats: int, history: History) -> None:
        self.lock = threading.RLock()
        self.history, self._splats = history, splats
        writable = scene.folder is not None and os.access(
            file_of(scene.folder, "edits.jsonl").absolute().parent, os.W_OK
        )
        self.editor = Editor(scene, file_of(scene.folder, "edits.jsonl") if writable else None, self._prepare)
        self.version = 1
        self.closed = False
        """Ends `warm_up`."""
        self.content = self._make_content(self.version)
        self._prepared = self.content

    @property
    def scene(self) -> Scene:
        """The scene after its edits."""
        return self.editor.scene

    def warm_up(self) -> None:
        """Load the text encoder and make what every answer needs, so that the first one is fast."""
        try:
            for phrase in [*self.scene.query.compared, *self.history.vocabulary, *everyday_words()]:
                if self.closed:
                    return
                with self.lock:  # one phrase at a time, so that a prompt waits for one phrase at most
                    self.scene.preload()
                    self.scene.embed([phrase])
            for name in things_with_parts(self.scene):
                if self.closed:
                    return
                with self.lock:
                    prepare_parts(self.scene, name)
        except LexsplatError as error:  # the first question reports it to the page
            logging.getLogger("lexsplat").warning("%s", error)

    # -- answers

    def ask(self, asked: Asked) -> bytes:
        """The answer to a prompt: a header, a score in 255ths and an instance for each drawn Gaussian.

        The header is JSON, after its length as four bytes, little-endian. Instances count from 1; 0 is none.

        Raises:
            QueryError: If the prompt is empty.
            ModelError: If the text encoder cannot be loaded.
        """
        selection = self._select(asked)
        understood = self.scene.understand(asked.prompt)
        plain = understood.phrase == Thing(asked.prompt)
        if asked.threshold is None:
            self.history.add(asked.prompt)
        notes = {
            "understood": "" if plain else str(understood.phrase),
            "note": selection.note,
            "unknown": understood.unknown,
        }
        return self._reply(selection, notes)

    def what_is(self, asked: Asked) -> bytes:
        """The thing at a pixel, as `ask` answers, with "names" of the vocabulary and the "point" in the header.

        Raises:
            QueryError: If nothing is there.
        """
        hit = self._hit(asked)
        field, vocabulary = self.scene.field, self.history.vocabulary
        shares = hit.weights.float() / hit.weights.sum().clamp_min(1e-12)
        probabilities = shares @ field.select(hit.indices).code_probabilities()
        question = self.scene.question(vocabulary)
        relevancy = probability_relevancy(probabilities[None], field.codebook.clip, question)[0]
        best = relevancy.argsort(descending=True)[:_NAMES].tolist()
        names = [{"phrase": vocabulary[place], "score": round(float(relevancy[place]), 4)} for place in best]
        return self._reply(self._select(asked), {"names": names, "point": hit.point.round(5).tolist()})

    def details(self, asked: Asked) -> dict[str, Any]:
        """Where a selection is, how large, and which photos show most of it."""
        chosen = self._chosen(asked)
        views = [{"name": name, "share": round(share, 4)} for name, share in chosen.view_shares[:3] if share]
        return {**chosen.geometry(), "pieces": chosen.count, "views": views}

    def objects(self) -> list[dict[str, Any]]:
        """The objects of the scene for its list."""
        return object_entries(self.scene.objects[:MOST_OBJECTS])

    def colors(self, mode: str) -> bytes:
        """RGB of each drawn Gaussian; see `lexsplat.viewer.coloring`."""
        return colors_in(mode, self.scene.field)[self.content.drawn.numpy()].tobytes()

    def export(self, asked: Asked, ending: str) -> tuple[str, bytes]:
        """File name and content of an export of the selected Gaussians.

        Raises:
            QueryError: If the selection is empty or the ending is none of `EXPORT_ENDINGS`.
            BackendError: If the format needs a library that is not installed.
        """
        if ending not in EXPORT_ENDINGS:
            raise QueryError("format", expected=", ".join(EXPORT_ENDINGS), found=repr(ending)[:40])
        chosen = self._chosen(asked)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"selection{ending}"
            export_scene(self.scene, path, found=[chosen])
            return f"{file_name(chosen.phrase)}{ending}", path.read_bytes()

    def _select(self, asked: Asked) -> Selection:
        scene = self.scene
        if asked.click is not None:
            return scene.select_hit(self._hit(asked))
        plain = isinstance(scene.understand(asked.prompt).phrase, Thing)  # the scene keeps those answers
        return scene.find(asked.prompt, None if plain else asked.camera, threshold=asked.threshold)

    def _chosen(self, asked: Asked) -> Selection:
        """The selection, or the instance that was meant; never an empty one."""
        selection = self._select(asked)
        if not selection:
            raise QueryError(
                asked.prompt or "selection",
                expected="at least one Gaussian",
                found="none",
                remedy="lower the threshold",
            )
        if asked.instance is None:
            return selection
        if asked.instance >= selection.count:
            raise QueryError("instance", expected=f"one of {selection.count}", found=str(asked.instance))
        return selection.instances[asked.instance]

    def _name(self, asked: Asked) -> str:
        """Name of a step: "all fruits", or "1 of 2 of all fruits"."""
        count = self._select(asked).count if asked.instance is not None else 0
        one = f"{(asked.instance or 0) + 1} of {count} of " if count > 1 else ""
        return one + asked.prompt

    def _hit(self, asked: Asked) -> Hit:
        if asked.click is None or asked.camera is None:
            raise QueryError("click", expected="a pixel and a camera", found="none")
        return surface_at(self.scene.gaussians, asked.camera, *asked.click)

    def _reply(self, selection: Selection, further: Mapping[str, Any]) -> bytes:
        instances = selection.instances[:_MOST_INSTANCES] if selection else []
        labels = torch.zeros(len(selection.mask), dtype=torch.uint8)
        for place, instance in enumerate(instances, start=1):
            labels[instance.mask.cpu()] = place
        header = {
            "presence": selection.present,
            "threshold": round(float(selection.threshold), 4),
            "gaussians": selection.num_gaussians,
            "instances": [
                {"center": one.center.round(5).tolist(), "size": one.size.round(5).tolist()}
                for one in instances
            ],
            **further,
        }
        text = json.dumps(header).encode()
        scores = (selection.scores.detach().cpu().float().clamp(0, 1) * 255).round().to(torch.uint8)
        drawn = self.content.drawn
        values = (scores[drawn].numpy().tobytes(), labels[drawn].numpy().tobytes())
        return b"".join([struct.pack("<I", len(text)), text, *values])

    # -- editing

    def edit(self, action: str, asked: Asked, values: Mapping[str, Any]) -> dict[str, Any]:
        """Do a step, undo or redo one, as ``lexsplat edit`` does; returns the new manifest.

        Raises:
            QueryError: If nothing is selected, or the result could not be drawn.
            SceneFolderError: If another program has changed the steps, or a file could not be written. Whatever is
                raised, nothing has changed.
        """
        if action not in (*CHANGES, "undo", "redo"):
            raise QueryError("action", expected=", ".join((*CHANGES, "undo", "redo")), found=action[:40])
        if self.editor.journal is not None:
            self.editor.journal.check_unchanged()
        try:
            if action in ("undo", "redo"):
                getattr(self.editor, action)()
            else:
                chosen = self._chosen(asked)
                named = chosen.described(phrase=self._name(asked)) if asked.prompt else chosen
                motion = Motion(
                    vector(values, "by"), scale=number(values, "scale", 1.0), turn=number(values, "turn", 0.0)
                )
                color, strength = vector(values, "color"), number(values, "strength", 1.0)
                self.editor.change(action, named, motion, color, strength)
        except OSError as error:
            raise SceneFolderError(
                error.filename
                or (self.editor.journal.path if self.editor.journal else tempfile.gettempdir()),
                expected="a file that can be written",
                found=error.strerror or str(error),
                remedy="nothing was changed: make room and try again",
            ) from error
        return self._show_prepared()

    def catch_up(self) -> None:
        """Show the steps that another program has kept or discarded meanwhile.

        Raises:
            FileFormatError: If they are damaged.
            SceneFolderError: If they belong to another reconstruction.
            QueryError: If the scene with them cannot be drawn.
        """
        if self._is_current:
            return  # a page that loads does not wait for the work of another
        with self.lock:
            before = self.editor
            if self._is_current or before.journal is None:
                return
            self.editor = Editor(before.original, before.journal.path, self._prepare)
            try:
                self._prepare()
            except BaseException:
                self.editor = before
                raise
            self._show_prepared()

    @property
    def _is_current(self) -> bool:
        return self.editor.journal is None or self.editor.journal.is_unchanged

    def _show_prepared(self) -> dict[str, Any]:
        self.content = self._prepared
        self.version = self.content.manifest["server"]["version"]
        return self.content.manifest

    def _prepare(self) -> None:
        """Make the files that pages load after a change, before the change is kept."""
        self._prepared = self._make_content(self.version + 1)

    def preview(self, action: str, asked: Asked) -> bytes:
        """Preview of `edit`: the number of Gaussians as four bytes, then 1 or 0 for each drawn Gaussian.

        Raises:
            QueryError: If nothing is selected, or the action is none of `CHANGES`.
        """
        if action not in CHANGES:
            raise QueryError("action", expected=", ".join(CHANGES), found=action[:40])
        mask = self.editor.planned_mask(action, self._chosen(asked)).cpu()  # type: ignore[arg-type]
        drawn = mask[self.content.drawn].to(torch.uint8).numpy()
        return struct.pack("<I", int(mask.sum())) + drawn.tobytes()

    # -- content

    def _make_content(self, version: int) -> Content:
        scene = self.scene
        if len(scene.gaussians) < 2 or (damage := scene.gaussians.find_invalid()):
            found = str(len(scene.gaussians)) if len(scene.gaussians) < 2 else damage
            remedy = 'undo the last edit with "lexsplat edit SCENE undo"' if self.editor.steps else ""
            raise QueryError("scene", expected="at least 2 finite Gaussians", found=found, remedy=remedy)
        drawn = most_visible(scene.gaussians, max(MOST_SPLATS, self._splats))
        gaussians = scene.gaussians.select(drawn.to(scene.gaussians.device)).to("cpu")
        with tempfile.TemporaryDirectory() as folder:
            path, rotation = write_splats(gaussians, Path(folder))
            files = {path.name: path.read_bytes(), "words.txt": self._words()}
        manifest = scene_manifest(scene, gaussians, path.name, rotation, "", self._splats)
        manifest["words"]["count"] = files["words.txt"].count(b"\n")
        manifest["server"] = {
            "version": version,
            "steps": [str(step) for step in self.editor.steps],
            "undone": len(self.editor.undone),
            "examples": list(dict.fromkeys([*self.history.prompts[:4], *self.history.vocabulary]))[:4],
            "vocabulary": self.history.vocabulary,
            "formats": EXPORT_ENDINGS,
            "modes": MODES,
        }
        manifest["files"] = {name: checksums(content) for name, content in files.items()}
        return Content(manifest, files, drawn)

    def _words(self) -> bytes:
        """Completions: what was asked, the vocabulary, everyday phrases."""
        phrases = page_phrases(self.history.prompts, bundled=self.scene.clip == "bundled")
        phrases |= {name.lower(): NAME for name in self.history.vocabulary if name.lower() not in phrases}
        known = {*self.history.prompts, *self.history.vocabulary}
        return words_file(phrases, ["y" if phrase in known else "u" for phrase in phrases])

    def set_vocabulary(self, phrases: Any) -> list[str]:
        """Replace the names that clicks choose from; an empty list restores the default.

        Raises:
            QueryError: If they are no texts.
        """
        if not isinstance(phrases, list) or not all(isinstance(phrase, str) for phrase in phrases):
            raise QueryError("vocabulary", expected="a list of phrases", found=type(phrases).__name__)
        self.history.set_vocabulary(phrases)
        self.content.manifest["server"]["vocabulary"] = self.history.vocabulary
        return self.history.vocabulary
