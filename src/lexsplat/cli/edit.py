"""``lexsplat edit``: change a scene by words."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from lexsplat.cli.options import Device, check_threshold, open_scene
from lexsplat.errors import QueryError

if TYPE_CHECKING:
    from lexsplat.editing import Editor


@dataclasses.dataclass
class Edit:
    """Change a scene by words: delete, keep, recolour, move or duplicate what is found; undo, redo; save as another.

    The scene itself stays as it was built. Steps are kept in SCENE/edits.jsonl until they are saved or discarded:

        lexsplat edit SCENE delete --select "red mug"
        lexsplat edit SCENE duplicate --select "red apple" --by 0.5 0 0
        lexsplat edit SCENE undo
        lexsplat edit SCENE save --output SCENE2

    Args:
        scene: A scene folder.
        action: What to do; "list" shows the steps.
        select: What to do it to; phrases may relate things (see `lexsplat find --help`).
        threshold: Relevancy from which a Gaussian is meant; none chooses one.
        grow: Widen the selection by this distance, world units.
        shrink: Narrow the selection by this distance, world units.
        largest: Only the largest thing found.
        color: Red, green and blue in 0..1, for recolour.
        strength: How much of the new colour, in 0..1.
        by: Shift in world units, for move and duplicate.
        turn: Degrees about the up direction, anticlockwise from above.
        scale: Factor on its size.
        output: The new scene folder, for save.
        clip: Text encoder, if it is not where the build found it.
        device: Where to compute.
    """

    scene: tyro.conf.Positional[str]
    action: tyro.conf.Positional[
        Literal["delete", "keep", "recolour", "move", "duplicate", "undo", "redo", "list", "discard", "save"]
    ]
    select: str | None = None
    threshold: float | None = None
    grow: float | None = None
    shrink: float | None = None
    largest: bool = False
    color: tuple[float, float, float] | None = None
    strength: float = 1.0
    by: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: float = 0.0
    scale: float = 1.0
    output: Path | None = None
    clip: str | None = None
    device: Device = "auto"

    def __post_init__(self) -> None:
        needs = {"delete": "select", "keep": "select", "recolour": "color", "save": "output"}
        if self.action in ("delete", "keep", "recolour", "move", "duplicate") and not self.select:
            raise ValueError(f'{self.action} needs --select "what"')
        if self.action in needs and getattr(self, needs[self.action]) is None:
            raise ValueError(f"{self.action} needs --{needs[self.action]}")
        check_threshold(self.threshold)
        for name in ("grow", "shrink"):
            distance = getattr(self, name)
            if distance is not None and not 0 <= distance < math.inf:
                raise ValueError(f"{name} must be a distance, got {distance:g}")
        if not all(0 <= value <= 1 for value in (*(self.color or ()), self.strength)):
            raise ValueError(f"color and strength must be in 0..1, got {self.color} and {self.strength:g}")
        if not all(map(math.isfinite, (*self.by, self.turn))) or not 0 < self.scale < math.inf:
            raise ValueError("by, turn and scale must be finite numbers, and scale positive")

    def run(self) -> None:
        """Do one thing and say what the scene is now."""
        from lexsplat.editing import Editor
        from lexsplat.previous_scene import require_current

        scene = open_scene(self.scene, self.device, self.clip)
        if scene.folder is not None:
            require_current(scene.folder)
        journal = (scene.folder.root if scene.folder else Path(self.scene)) / "edits.jsonl"
        if self.action == "discard":
            journal.unlink(missing_ok=True)
        editor = Editor(scene, journal)
        if self.action in ("undo", "redo") and not getattr(editor, self.action)():
            print(f"nothing to {self.action}")
        elif self.action == "save" and self.output:
            print(f"{editor.save(self.output).root}: written")
        elif self.action in ("delete", "keep", "recolour", "move", "duplicate"):
            self._change(editor)
        for number, step in enumerate(editor.steps, start=1):
            print(f"{number}. {step}")
        print(f"{len(editor.scene.gaussians):,} Gaussians, {len(editor.undone)} steps undone")

    def _change(self, editor: Editor) -> None:
        from lexsplat.boxes import rotation_about
        from lexsplat.editing import Motion

        chosen = editor.scene.find(self.select or "", threshold=self.threshold)
        chosen = chosen.largest() if self.largest else chosen
        chosen = chosen.grow(self.grow) if self.grow is not None else chosen
        chosen = chosen.shrink(self.shrink) if self.shrink is not None else chosen
        try:
            if self.action == "recolour" and self.color:
                editor.recolour(chosen, self.color, self.strength)
            elif self.action in ("move", "duplicate"):
                turn = rotation_about(chosen.up.direction, self.turn)
                getattr(editor, self.action)(chosen, Motion(self.by, turn, self.scale))
            else:
                getattr(editor, self.action)(chosen)
        except ValueError as error:  # numbers that only together, or only for these Gaussians, lead too far
            raise QueryError(
                self.action, expected="Gaussians that can be drawn afterwards", found=str(error)
            ) from error
