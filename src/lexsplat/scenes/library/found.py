"""The answer of a library, for people and for programs: what was understood, and which scenes hold it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from PIL import Image, ImageDraw

from lexsplat.geometry.world import World
from lexsplat.queries.selection import Presence
from lexsplat.rendering import render
from lexsplat.runtime.files import atomic_path
from lexsplat.scenes.answers import file_name
from lexsplat.scenes.library.indexed import Indexed
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.serving import counted, sentence

if TYPE_CHECKING:
    from lexsplat.scenes.library.library import Library

_COVERED = 0.3
"""Share of a pixel that a thing must cover to be shown by it."""
_TOLD = 5
"""Largest number of notes, and of skipped scenes, that an answer prints."""


@dataclass(frozen=True)
class Hit:
    """A scene that holds what was asked for.

    Args:
        scene: Its name in the library.
        path: Its folder.
        bound: Upper bound of the strength of presence, from its codes.
        answer: The answer, as of `lexsplat.scenes.answers.find_phrase`.
        clip: Name of its encoder.
        world: Its up direction and scale.
        library: The library.
        indexed: The answer from the index; None if the scene itself was asked.
    """

    scene: str
    path: str
    bound: float
    answer: dict[str, Any]
    clip: str
    world: World
    library: Library = field(repr=False)
    indexed: Indexed | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return f"{self.scene}: present: {self.present}. {self.sentence}{self._sizes()}"

    def without_note(self) -> str:
        """The answer as text without the note, which is part of the library's answer."""
        text = sentence({**self.answer, "note": ""})
        return f"{self.scene}: present: {self.present}. {text}{self._sizes()}"

    def _sizes(self) -> str:
        meters = self.world.meters_per_unit
        scale, unit = (meters, "m") if meters else (1.0, "scene units")
        sizes = [each["size"] for each in self.answer["instances"][:8]]
        listed = "; ".join(" x ".join(f"{side * scale:.2f}" for side in size) for size in sizes)
        return f" Size: {listed} {unit}." if listed else ""

    @property
    def opened(self) -> Scene:
        """The scene; opened where that was not necessary for the answer."""
        return self.library.scene(self.scene)

    @property
    def source(self) -> str:
        """Source of the answer: "index" or "scene"."""
        return "index" if self.indexed else "scene"

    @property
    def present(self) -> Presence:
        """Whether the scene holds it: "yes" or "unsure"."""
        return self.answer["present"]

    @property
    def count(self) -> int:
        """Number of things found."""
        return self.answer["count"]

    @property
    def sentence(self) -> str:
        """The answer in one plain sentence."""
        return sentence(self.answer)

    def picture(self, side: int = 320) -> Image.Image:
        """The view that shows the first thing best, with a frame around it; the longer side in pixels.

        From the index, it is the best of the eight views that the library keeps, of at most 320 pixels.
        """
        kept = self.indexed.picture(side) if self.indexed else None
        return self._rendered(side) if kept is None else kept

    def _rendered(self, side: int) -> Image.Image:
        scene = self.opened
        things = scene.find(self.answer["phrase"]).instances
        name = things[0].best_view if things else next(iter(scene.views))
        camera = scene.camera(name).within(side)
        carried = things[0].mask[:, None].float() if things else None
        with torch.no_grad():
            shown = render(scene.gaussians, camera, features=carried)
        image = Image.fromarray((shown.image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())
        if things and shown.features is not None and bool((seen := shown.features[..., 0] > _COVERED).any()):
            ys, xs = (each.cpu().numpy() for each in seen.nonzero(as_tuple=True))
            frame = (xs.min() - 2, ys.min() - 2, xs.max() + 2, ys.max() + 2)
            ImageDraw.Draw(image).rectangle([int(side) for side in frame], outline="red", width=2)
        return image

    def write_picture(self, folder: Path) -> Path:
        """Write `picture` to ``FOLDER/SCENE/PHRASE.jpg``."""
        path = folder / self.scene / f"{file_name(self.answer['phrase'])}.jpg"
        with atomic_path(path) as temporary:
            self.picture().save(temporary, format="JPEG", quality=85)
        return path

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        answer = {key: value for key, value in self.answer.items() if key != "phrase"}
        return {
            "scene": self.scene,
            "path": self.path,
            "encoder": self.clip,
            "bound": round(self.bound, 4),
            "source": self.source,
            **self.world.to_json(),
            **answer,
        }


@dataclass(frozen=True)
class Found:
    """The answer of a library.

    Args:
        phrase: Phrase that was asked for.
        understood: Phrase that was searched: as it was parsed, with typing errors corrected as for the first hit.
        note: Remark on words corrected, not understood or not found; with the scenes if not all hits share it.
        hits: The scenes that hold it: "yes" before "unsure", then by their bounds.
        scenes: Number of scenes in the library.
        opened: Number of scenes that were asked themselves.
        unopened: Number of scenes that may hold it as well and were not looked at.
        skipped: Scenes that could not be asked, and why.
        rebuilt: Scenes that were built again since they were added, and what to do.
        encoders: Names of the encoders of the scenes, one for each encoder.
        unread: Whether the phrase was not understood, so that nothing is certain.
    """

    phrase: str
    understood: str
    note: str
    hits: tuple[Hit, ...]
    scenes: int
    opened: int
    unopened: int
    skipped: dict[str, str]
    rebuilt: dict[str, str] = field(default_factory=dict)
    encoders: tuple[str, ...] = ()
    unread: bool = False

    @property
    def present(self) -> Presence:
        """Whether a scene holds it; "no" only if it was understood and each scene was asked or ruled out."""
        if self.hits:
            return self.hits[0].present
        return "unsure" if self.unopened or self.skipped or self.unread else "no"

    def __repr__(self) -> str:
        more = f"; {self.unopened} more may hold it" if self.unopened else ""
        several = f" of {len(self.encoders)} encoders" if len(self.encoders) > 1 else ""
        place = f"in {len(self.hits)} of {counted(self.scenes, 'scene')}{several}{more}"
        understood = f"(understood as {self.understood})" + (f"; {self.note}" if self.note else "")
        lines = [f"{self.phrase}: present: {self.present}, {place} {understood}"]
        for number, hit in enumerate(self.hits, start=1):
            lines.append(f"  {number}. {hit.without_note()}" + (f" (encoder {hit.clip})" if several else ""))
        return "\n".join([*lines, *_told("note", self.rebuilt), *_told("skipped", self.skipped)])

    def rows(self) -> list[dict[str, Any]]:
        """One row for each thing, as for a table: `pandas.DataFrame(found.rows())`."""
        return [
            {
                "phrase": self.phrase,
                "scene": hit.scene,
                "present": hit.present,
                "count": hit.count,
                **dict(zip(("x", "y", "z"), thing["center"])),
                **dict(zip(("width", "depth", "height"), thing["size"])),
                "view": thing["best_view"],
            }
            for hit in self.hits
            for thing in hit.answer["instances"]
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "phrase": self.phrase,
            "understood": self.understood,
            "note": self.note,
            "present": self.present,
            "scenes": self.scenes,
            "opened": self.opened,
            "unopened": self.unopened,
            "hits": [hit.to_dict() for hit in self.hits],
            "skipped": [{"scene": name, "problem": problem} for name, problem in self.skipped.items()],
            "rebuilt": [{"scene": name, "problem": problem} for name, problem in self.rebuilt.items()],
            "encoders": list(self.encoders),
        }


def _told(kind: str, problems: dict[str, str]) -> list[str]:
    """Lines for people: the first few problems, and how many more there are."""
    lines = [f"  {kind}: {problem}" for problem in list(problems.values())[:_TOLD]]
    more = len(problems) - _TOLD
    return [*lines, f"  {kind}: {more} more; lexsplat library verify LIB names them"] if more > 0 else lines
