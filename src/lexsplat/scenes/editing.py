"""Editing a scene: delete, keep, recolor, move, duplicate; undo, redo.

The built scene is never changed. An `Editor` holds the steps since then and keeps them in a journal
(`lexsplat.scenes.journal`), so that an edit can be continued, replayed on a copy or discarded. `Editor.save` makes a
new scene folder. The rows of the language field follow their Gaussians, and view-dependent colors rotate with them.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.language.segments import Segments
from lexsplat.queries.selection import Selection
from lexsplat.queries.visibility import whole_things, with_remains
from lexsplat.runtime.errors import FileFormatError, LexsplatError, QueryError, SceneFolderError
from lexsplat.runtime.files import atomic_path
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.scenes.colors import parse_color
from lexsplat.scenes.filling import fill_for
from lexsplat.scenes.fills import Fill
from lexsplat.scenes.folder import SceneFolder, refuse_within_scene
from lexsplat.scenes.formats.language import write_field
from lexsplat.scenes.gone import gone_nouns
from lexsplat.scenes.journal import CHANGES, Journal, Kind, Step, packed, unpacked
from lexsplat.scenes.kept import keep_for
from lexsplat.scenes.materials import UNLISTED, kinds_of_segments
from lexsplat.scenes.recoloring import recolored
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.shadows import Light, light_of, shadows_of
from lexsplat.scenes.transforms import Motion, transformed
from lexsplat.scenes.views import training_cameras

_STILL = Motion()
MAX_GROWTH = 16
"""Largest number of Gaussians after edits, as a multiple of the original: copies of copies would fill the memory."""
FEWEST = 2
"""Smallest number of Gaussians after an edit; pages draw no fewer."""


def apply(step: Step, gaussians: Gaussians, language: LanguageField) -> tuple[Gaussians, LanguageField]:
    """The scene after one step.

    Raises:
        ValueError: If the step is for another number of Gaussians, or its numbers are invalid.
    """
    if len(step.mask) != len(gaussians):
        raise ValueError(f"a step for {len(step.mask)} Gaussians does not fit {len(gaussians)}")
    mask = step.mask.to(gaussians.device)
    if step.kind in ("delete", "keep"):
        return _without(gaussians, language, mask if step.kind == "keep" else ~mask, step)
    if step.kind == "duplicate":
        everything = torch.arange(len(gaussians), device=gaussians.device)
        index = torch.cat([everything, everything[mask]])
        segments = language.segments and language.segments.with_copy(mask.to(language.segments.labels.device))
        gaussians, language = gaussians.select(index), _with_segments(language.select(index), segments)
        mask = torch.arange(len(index), device=mask.device) >= len(everything)
    changed = gaussians.select(mask)
    if step.kind == "recolor":
        changed = recolored(changed, step.values["color"], step.values["strength"])
    else:
        numbers = {name: step.values.get(name) for name in ("rotation", "translation", "center")}
        arrays = {name: np.array(value, float) for name, value in numbers.items() if value is not None}
        changed = transformed(changed, scale=float(step.values.get("scale", 1.0)), **arrays)
        if changed.find_invalid():
            raise ValueError(f"the transformed Gaussians have {changed.find_invalid()}")
    tensors: dict[str, Any] = {}
    for name, tensor in gaussians.tensors().items():
        tensors[name] = tensor.clone()
        tensors[name][mask] = getattr(changed, name)
    changed = replace(gaussians, **tensors)
    if "remains" not in step.values:
        return changed, language
    remains = unpacked(step.values["remains"], len(gaussians)).to(mask.device)
    return _without(changed, language, ~remains, step)


def _without(
    gaussians: Gaussians, language: LanguageField, kept: Tensor, step: Step
) -> tuple[Gaussians, LanguageField]:
    """Some Gaussians of a scene and those of the fill of a step, which take the language of their sources.

    What the fill brightens of the former loses the shadow of what was there.
    """
    if "fill" not in step.values:
        return gaussians.select(kept), language.select(kept)
    fill = Fill.from_json(step.values["fill"])
    remain, added = fill.relit(gaussians).select(kept), fill.gaussians(gaussians)
    sources = torch.from_numpy(fill.sources.astype(np.int64)).to(kept.device)
    tensors: dict[str, Any] = {
        name: torch.cat([tensor, getattr(added, name)]) for name, tensor in remain.tensors().items()
    }
    language = language.select(torch.cat([kept.nonzero()[:, 0], sources]))
    if language.segments is not None:
        language = _with_segments(language, language.segments.with_fill(len(remain)))
    return replace(remain, **tensors), language


def _with_hidden(scene: Scene) -> LanguageField:
    """The language of a scene with the Gaussians that its photos hide, which no edit shows or hides.

    By their masses, a thing would be hidden once it is enlarged, and where no photo was taken.
    """
    segments = scene.field.segments
    if segments is None or segments.hidden is not None:
        return scene.field
    return _with_segments(scene.field, replace(segments, hidden=scene.hidden.to(segments.labels.device)))


def _with_segments(language: LanguageField, segments: Segments | None) -> LanguageField:
    changed = copy.copy(language)
    changed.segments = segments
    return changed


class Editor:
    """A scene under edit.

    Args:
        scene: The scene as it was built.
        journal: File of the steps, whose steps are replayed if it exists; None keeps steps in memory only.
        accept: Called after each change, before it is kept; if it raises, nothing has changed.

    Raises:
        FileFormatError: If the journal is damaged.
        SceneFolderError: If it belongs to another reconstruction.
    """

    def __init__(
        self, scene: Scene, journal: Path | None = None, accept: Callable[[], None] = lambda: None
    ) -> None:
        self.original, self._accept = scene, accept
        self.journal = None if journal is None else Journal(journal, scene)
        self.steps: list[Step] = []
        self.undone: list[Step] = []
        self.scene = scene
        if self.journal is not None and self.journal.path.exists():
            self.steps, self.undone = self.journal.read()
            with self._replayable():
                self._replay()

    # -- steps

    def change(
        self,
        action: str,
        chosen: Selection,
        motion: Motion = _STILL,
        color: Sequence[float] = (),
        strength: float = 1.0,
        fill: bool = True,
    ) -> None:
        """Do one of `CHANGES` by its name, as `delete`, `keep`, `recolor`, `move` or `duplicate` with these values.

        Raises:
            QueryError: If there is no such action, nothing is selected, or the values have no meaning for the
                selection.
        """
        try:
            if action == "delete":
                self.delete(chosen, fill)
            elif action == "keep":
                self.keep(chosen)
            elif action == "recolor":
                self.recolor(chosen, color, strength)
            elif action == "move":
                self.move(chosen, motion, fill)
            elif action == "duplicate":
                self.duplicate(chosen, motion)
            else:
                raise QueryError("action", expected=", ".join(CHANGES), found=action[:40])
        except ValueError as error:  # values that are only invalid together or for these Gaussians
            raise QueryError(
                action, expected="Gaussians that can be drawn after the edit", found=str(error)
            ) from error

    def delete(self, chosen: Selection, fill: bool = True) -> None:
        """Remove a selection.

        Args:
            chosen: The selection.
            fill: Close the surface under its things, which no photo shows, and take their shadows off the surfaces
                around (`lexsplat.scenes.filling`).
        """
        self._do("delete", chosen, fill)

    def keep(self, chosen: Selection) -> None:
        """Remove everything but a selection."""
        self._do("keep", chosen)

    def recolor(self, chosen: Selection, color: Sequence[float] | str, strength: float = 1.0) -> None:
        """Give a selection another color with its old shading (`recolored`).

        Args:
            chosen: The selection.
            color: RGB in 0..1, "#ff8800" or a name such as "orange".
            strength: See `recolored`.
        """
        color = parse_color([color]) if isinstance(color, str) else color
        self._do("recolor", chosen, color=[float(c) for c in color], strength=float(strength))

    def move(self, chosen: Selection, motion: Motion, fill: bool = True) -> None:
        """Translate, rotate and scale a selection.

        Args:
            chosen: The selection.
            motion: The transform.
            fill: Close the surface under its things at their old places, as `delete` does.

        Raises:
            QueryError: If nothing would move.
            ValueError: If the motion is invalid (see `lexsplat.scenes.transforms.transformed`).
        """
        self._do("move", chosen, fill, motion)

    def duplicate(self, chosen: Selection, motion: Motion) -> None:
        """Add a copy of a selection, transformed as by `move`.

        Raises:
            QueryError: If the copy would not be moved.
            ValueError: If the motion is invalid (see `lexsplat.scenes.transforms.transformed`).
        """
        self._do("duplicate", chosen, False, motion)

    def undo(self) -> bool:
        """Undo the last step; False if there is none."""
        if not self.steps:
            return False
        with self._change({"undo": True}):
            self.undone.append(self.steps.pop())
            self._replay()
        return True

    def redo(self) -> bool:
        """Redo the last undone step; False if there is none."""
        if not self.undone:
            return False
        with self._change({"redo": True}), self._replayable():
            self._advance(self.undone.pop())
        return True

    def save(self, output: str | Path) -> SceneFolder:
        """Write the edited scene into a new folder; its ``scene.json`` lists the steps.

        Raises:
            SceneFolderError: If the folder exists or lies in a scene, or the scene was not opened from one.
        """
        source, output = self.original.folder, Path(output)
        if source is None:
            raise SceneFolderError(
                output,
                expected="a scene that was opened from a folder",
                found="a scene in memory",
                remedy="open it with open_scene",
            )
        if output.exists():
            found = f"a {'folder' if output.is_dir() else 'file'} that exists"
            raise SceneFolderError(
                output, expected="a new folder", found=found, remedy="give another --output"
            )
        refuse_within_scene(output)
        folder = SceneFolder(output)
        record = json.loads(json.dumps(source.record))
        record["edits"] = [*record.get("edits", ()), *map(str, self.steps)]
        record["edits_fingerprint"] = fingerprint(
            record.get("edits_fingerprint"), [step.to_json() for step in self.steps]
        )
        record["gone"] = sorted(gone_nouns(self.scene))
        record["stages"].get("reconstruct", {})["gaussians"] = len(self.scene.gaussians)
        record["stages"].get("language", {}).update(self.scene.field.facts())
        stages, record["stages"] = record["stages"], {}
        folder.record = record
        output.mkdir(parents=True)
        views = self.scene.views
        folder.write_cameras(
            {name: (view.camera, view.split) for name, view in views.items()},
            {name: view.photo for name, view in views.items() if view.photo},
        )
        folder.write_gaussians(self.scene.gaussians)
        reconstruction = stages.get("reconstruct", {}).get("fingerprint")
        with atomic_path(folder.language_path) as temporary:
            write_field(self.scene.field, {"reconstruction": str(reconstruction)}, temporary)
        folder.record["stages"] = stages
        folder.save()  # last: a folder without finished stages is not a scene
        keep_for(folder, self.scene.gaussians.device.type, self.original.listener)
        return folder

    # -- inside

    def planned_mask(self, kind: Kind, chosen: Selection) -> Tensor:
        """The Gaussians that a step would apply to ``[N]`` bool; it changes nothing.

        A deletion also takes what hides under the thing (`lexsplat.queries.visibility.with_remains`).
        """
        extend = with_remains if kind == "delete" else whole_things
        return extend(chosen, self.scene.hidden, self.scene.field.segments).mask

    def _do(
        self, kind: Kind, chosen: Selection, fill: bool = False, motion: Motion | None = None, **values: Any
    ) -> None:
        if not isinstance(chosen, Selection):
            raise TypeError(f"expected a Selection, such as editor.scene.find(...), got {chosen!r}"[:200])
        if kind in ("move", "duplicate") and not isinstance(motion, Motion):
            raise TypeError(f"expected a Motion, such as Motion(translation=(1, 0, 0)), got {motion!r}"[:200])
        if not chosen.is_of(self.scene.gaussians):
            raise ValueError(
                "the selection is of another scene, or was made before the last edit: select again in the scene"
                " of the editor"
            )
        if not chosen:
            raise QueryError(
                chosen.phrase or "selection",
                expected="something to edit",
                found="nothing",
                remedy="try other words or a lower threshold",
            )
        if motion is not None:
            values = motion.values(chosen)
        mask = self.planned_mask(kind, chosen)
        gone = self.planned_mask("delete", chosen) if kind in ("delete", "move") else mask
        if fill:
            things = replace(chosen, mask=gone, parts=())
            scene, before, kinds = self.scene, self.original, self._kinds()
            shadows = None
            if self._light is not None and kinds is not None:
                shadows = shadows_of(self._light, before.gaussians, things, kinds)
            cameras = training_cameras(before.views)
            segments = scene.field.segments
            found, gone = fill_for(things, cameras, before.listener, scene.hidden, segments, kinds, shadows)
            if found is not None:
                values["fill"] = found.to_json()
        if kind == "move":
            values["remains"] = packed(gone & ~mask)
        else:
            mask = gone
        step = Step(kind, mask.clone().cpu(), values, chosen.phrase)
        with self._change(step.to_json()):
            self._advance(step)
            self.undone.clear()
            if (left := len(self.scene.gaussians)) < FEWEST:
                raise QueryError(
                    kind,
                    expected=f"at least {FEWEST} Gaussians after the edit",
                    found=str(left),
                    remedy="select less" if kind == "delete" else "select more",
                )

    @cached_property
    def _listed(self) -> NDArray[np.intp] | None:
        """What each segment of the original is (`lexsplat.scenes.materials.kinds_of_segments`), as its list says.

        None without a list: of a scene in memory, or if its encoder is not at hand.
        """
        segments = self.original.field.segments
        if segments is None or self.original.folder is None:
            return None
        try:
            return kinds_of_segments(self.original.objects, segments)
        except LexsplatError:
            return None

    def _kinds(self) -> NDArray[np.intp] | None:
        """What each Gaussian is of ``[N]``; None without a list. What is copied is unlisted."""
        now = self.scene.field.segments
        if self._listed is None or now is None:
            return None
        more = np.full(now.levels.shape[1] - len(self._listed), UNLISTED)
        return np.concatenate([self._listed, more])[now.labels.cpu().numpy()]

    @cached_property
    def _light(self) -> Light | None:
        """The light of the original; None without a list, or if its shadows do not tell."""
        segments = self.original.field.segments
        if self._listed is None or segments is None:
            return None
        return light_of(self.original, self._listed[segments.labels.cpu().numpy()])

    @contextmanager
    def _change(self, entry: dict[str, Any]) -> Iterator[None]:
        """A change that is journaled as a whole or not made."""
        before = self.scene, [*self.steps], [*self.undone]
        try:
            yield
            self._accept()
            if self.journal is not None:
                self.journal.append(entry)
        except BaseException:
            self.scene, self.steps, self.undone = before
            raise

    @contextmanager
    def _replayable(self) -> Iterator[None]:
        """Errors of steps that come from the journal."""
        try:
            yield
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise FileFormatError(
                self.journal.path if self.journal else "edit",
                expected="steps that can be replayed",
                found=str(error)[:200],
                remedy="discard the edit",
            ) from error

    def _advance(self, step: Step) -> None:
        if len(self.scene.gaussians) > MAX_GROWTH * max(len(self.original.gaussians), 1):
            raise ValueError(f"edits may grow a scene to at most {MAX_GROWTH} times its Gaussians")
        self.scene = self.scene.with_content(*apply(step, self.scene.gaussians, _with_hidden(self.scene)))
        self.steps.append(step)

    def _replay(self) -> None:
        steps, self.steps, self.scene = self.steps, [], self.original
        for step in steps:
            self._advance(step)
