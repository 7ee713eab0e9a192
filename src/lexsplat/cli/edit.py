"""``lexsplat edit``: change a scene by words."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from lexsplat.cli.options import Device, check_relevancy, open_scene
from lexsplat.runtime.errors import QueryError

if TYPE_CHECKING:
    from lexsplat.scenes.editing import Editor
    from lexsplat.scenes.scene import Scene


@dataclasses.dataclass
class Edit:
    """Change a scene by words: delete, keep, recolor, move or duplicate what is found; undo, redo; save as another.

    The scene itself stays as it was built. Steps are kept in SCENE/edits.jsonl until they are discarded (those of
    ``demo`` in demo_edits.jsonl here); other commands see them in what "save" writes:

        lexsplat edit SCENE delete --select "red mug"
        lexsplat edit SCENE duplicate --select "red apple" --by 0.5 0 0
        lexsplat edit SCENE undo
        lexsplat edit SCENE save --output SCENE2

    Args:
        scene: A scene folder, or ``demo`` for the scene that ships with lexsplat.
        action: What to do; "list" shows the steps.
        select: What to do it to; phrases may relate things (see `lexsplat find --help`).
        view: Whose left and right a phrase means; none takes the view that shows the other thing best.
        threshold: Relevancy from which a Gaussian is meant; none chooses one.
        grow: Widen the selection by this distance, world units.
        shrink: Narrow the selection by this distance, world units.
        largest: Only the largest thing found.
        color: Red, green and blue in 0..1, for recolor.
        strength: How much of the new color, in 0..1.
        by: Shift in world units, for move and duplicate.
        turn: Degrees about the up direction, anticlockwise from above.
        scale: Factor on its size.
        output: The new scene folder, for save.
        clip: Text encoder, if it is not where the build found it.
        device: Where to compute.
    """

    scene: tyro.conf.Positional[str]
    action: tyro.conf.Positional[
        Literal["delete", "keep", "recolor", "move", "duplicate", "undo", "redo", "list", "discard", "save"]
    ]
    select: str | None = None
    view: str | None = None
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
        needs = {"delete": "select", "keep": "select", "recolor": "color", "save": "output"}
        if self.action in ("delete", "keep", "recolor", "move", "duplicate") and not self.select:
            raise ValueError(f'{self.action} needs --select "what"')
        if self.action in needs and getattr(self, needs[self.action]) is None:
            raise ValueError(f"{self.action} needs --{needs[self.action]}")
        if self.action in ("move", "duplicate") and not any((*self.by, self.turn, self.scale - 1)):
            raise ValueError(f"{self.action} needs --by, --turn or --scale")
        check_relevancy(self.threshold)
        self._check_numbers()

    def _check_numbers(self) -> None:
        if not all(map(math.isfinite, (*self.by, self.turn, self.scale))):
            raise ValueError("--by, --turn and --scale must be finite")
        if self.scale <= 0:
            raise ValueError(f"scale must be positive, got {self.scale:g}")
        if not all(0 <= value <= 1 for value in (*(self.color or ()), self.strength)):
            raise ValueError("--color is three numbers in 0..1, and --strength one in 0..1")
        for name, value in (("grow", self.grow), ("shrink", self.shrink)):
            if value is not None and not 0 <= value < math.inf:
                raise ValueError(f"--{name} must not be negative or endless, got {value:g}")

    def run(self) -> None:
        """Do one thing and say what the scene is now."""
        from lexsplat.scenes.editing import Editor
        from lexsplat.scenes.previous import require_current

        scene = open_scene(self.scene, self.device, self.clip)
        if scene.folder is not None:
            require_current(scene.folder)
        journal = _journal_of(scene)
        if self.action == "discard":
            journal.unlink(missing_ok=True)
        editor = Editor(scene, journal)
        if self.action in ("undo", "redo") and not getattr(editor, self.action)():
            print(f"nothing to {self.action}")
        elif self.action == "save" and self.output:
            print(
                f"{editor.save(self.output).root}: written; the steps stay in {journal} until you discard them"
            )
        elif self.action in ("delete", "keep", "recolor", "move", "duplicate"):
            self._change(editor)
        for number, step in enumerate(editor.steps, start=1):
            print(f"{number}. {step}")
        print(f"{len(editor.scene.gaussians):,} Gaussians, {len(editor.undone)} steps undone")

    def _change(self, editor: Editor) -> None:
        from lexsplat.geometry.rotations import rotation_about
        from lexsplat.scenes.editing import Motion

        chosen = editor.scene.find(self.select or "", self.view, threshold=self.threshold)
        chosen = chosen.largest() if self.largest else chosen
        chosen = chosen.grow(self.grow) if self.grow is not None else chosen
        chosen = chosen.shrink(self.shrink) if self.shrink is not None else chosen
        try:
            if self.action == "recolor" and self.color:
                editor.recolor(chosen, self.color, self.strength)
            elif self.action in ("move", "duplicate"):
                turn = rotation_about(chosen.up.direction, self.turn)
                getattr(editor, self.action)(chosen, Motion(self.by, turn, self.scale))
            else:
                getattr(editor, self.action)(chosen)
        except ValueError as error:  # numbers that only together, or only for these Gaussians, lead too far
            raise QueryError(
                self.action, expected="Gaussians that can be drawn afterwards", found=str(error)
            ) from error


def _journal_of(scene: Scene) -> Path:
    """Where the steps are kept; the scene that ships is never written to."""
    if scene.folder is None or scene.folder.is_bundled:
        return Path("demo_edits.jsonl")
    return scene.folder.root / "edits.jsonl"
