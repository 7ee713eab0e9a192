"""``lexsplat edit``: change a scene by words."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from lexsplat.cli.options import (
    PRESENCE,
    Device,
    SceneArgument,
    check_threshold,
    confirmed,
    open_scene,
    without_segments,
    work_on,
)
from lexsplat.cli.values import Color, Lengths, Reach, Shift
from lexsplat.cli.waiting import starting
from lexsplat.runtime.errors import QueryError
from lexsplat.runtime.progress import uncounted

if TYPE_CHECKING:
    from lexsplat.scenes.editing import Editor

CHANGES = ("delete", "keep", "recolor", "move", "duplicate")
ACTIONS = (*CHANGES, "undo", "redo", "list", "discard", "save")
_CHOICE = ("select", "view", "threshold", "grow", "shrink", "largest")
"""Options that say what to change."""
_MOTION = ("by", "turn", "scale")
_STAYS = Lengths((0.0, 0.0, 0.0))
_OPTIONS = {
    "delete": ("fill",),
    "recolor": ("color", "strength"),
    "move": (*_MOTION, "fill"),
    "duplicate": _MOTION,
    "save": ("output",),
    "discard": ("yes",),
}
"""Options of single actions."""
Action = Annotated[
    str,
    tyro.conf.Positional,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(ACTIONS) + "}",
        instance_from_str=lambda words: words[0].replace("colour", "color"),
        is_instance=lambda value: value in ACTIONS,
        str_from_instance=lambda value: [value],
        choices=(*ACTIONS, "recolour"),
    ),
    tyro.conf.arg(help_behavior_hint="(required)"),
]


@dataclasses.dataclass
class Edit:
    """Change a scene by words: delete, keep, recolor, move or duplicate what is found; undo, redo; save a new scene.

    The scene stays as it was built. Steps are kept in SCENE/edits.jsonl (for "demo" in demo_edits.jsonl in the
    working directory) until they are discarded. Other commands see the steps in the scene that "save" writes:

        lexsplat edit SCENE delete --select "red mug"
        lexsplat edit SCENE duplicate --select "red apple" --by 0.5 0 0
        lexsplat edit SCENE undo
        lexsplat edit SCENE save --output SCENE2

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        action: Action to take; "list" shows the steps, "discard" deletes all of them.
        select: Phrase for the things to change; it may relate things (see lexsplat find --help).
        view: Name of the view that left and right refer to.
        threshold: Relevancy from which a Gaussian is selected.
        grow: Widen the selection by this distance, in units of the scene or with a unit, such as 5cm.
        shrink: Narrow the selection by this distance, in units of the scene or with a unit.
        largest: Change only the largest of the things found.
        fill: Close the surface under a thing that is deleted or moved, which no photo shows: the pattern around it
            goes on, and its shadow goes. --no-fill leaves the hole and the shadow.
        color: New color for recolor: three numbers in 0..1, "#ff8800" or a name such as orange.
        strength: Share of the new color, in 0..1.
        by: Shift along the axes of the scene, for move and duplicate: in units of the scene, or with units, such as
            20cm 0 0, once the scale is known (see lexsplat scale).
        turn: Degrees about the up direction, counterclockwise from above.
        scale: Factor on the size; the bottom stays at its height.
        output: The new scene folder, for save.
        yes: Discard all steps without asking, or change what may not be what the phrase names.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
    """

    scene: SceneArgument
    action: Action
    select: str | None = None
    view: str | None = None
    threshold: float | None = None
    grow: Reach = None
    shrink: Reach = None
    largest: bool = False
    fill: bool = True
    color: Color = None
    strength: float = 1.0
    by: Shift = _STAYS
    turn: float = 0.0
    scale: float = 1.0
    output: Path | None = None
    yes: bool = False
    clip: str | None = None
    device: Device = "auto"

    rare: ClassVar[tuple[str, ...]] = ("threshold", "grow", "shrink", "fill", "strength", "clip", "device")
    synonyms: ClassVar[dict[str, str]] = {"--colour": "--color"}

    def check(self) -> None:
        """Refuse options that are missing or have no meaning for the action."""
        needs = {"delete": "select", "keep": "select", "recolor": "color", "save": "output"}
        if self.action in CHANGES and not self.select:
            raise ValueError(f"{self.action} needs --select PHRASE")
        if self.action in needs and getattr(self, needs[self.action]) is None:
            raise ValueError(f"{self.action} needs --{needs[self.action]}")
        if self.action in ("move", "duplicate") and not any((*self.by.values, self.turn, self.scale - 1)):
            raise ValueError(f"{self.action} needs --by, --turn or --scale")
        check_threshold(self.threshold)
        self._check_meaning()
        self._check_numbers()

    def _check_meaning(self) -> None:
        used = {"scene", "action", "clip", "device", *_OPTIONS.get(self.action, ())}
        used.update((*_CHOICE, "yes") if self.action in CHANGES else ())
        for option in dataclasses.fields(self):
            if option.name not in used and getattr(self, option.name) != option.default:
                negation = "no-" if option.default is True else ""
                raise ValueError(f"{self.action} takes no --{negation}{option.name}")

    def _check_numbers(self) -> None:
        if not all(map(math.isfinite, (*self.by.values, self.turn, self.scale))):
            raise ValueError("--by, --turn and --scale must be finite")
        if self.scale <= 0:
            raise ValueError(f"scale must be positive, got {self.scale:g}")
        for name, values in (("color", self.color or ()), ("strength", (self.strength,))):
            if not all(0 <= value <= 1 for value in values):
                found = " ".join(f"{value:g}" for value in values)
                raise ValueError(f"--{name} must be in 0..1, got {found}")
        for name, value in (("grow", self.grow), ("shrink", self.shrink)):
            if value is not None and not 0 <= value.values[0] < math.inf:
                raise ValueError(f"--{name} must not be negative or infinite, got {value.values[0]:g}")

    def run(self) -> None:
        """Do one action and print the steps and the size of the edited scene."""
        with starting():
            from lexsplat.scenes.editing import Editor
            from lexsplat.scenes.folder import file_of
            from lexsplat.scenes.previous import require_current
            from lexsplat.scenes.serving import counted
            from lexsplat.scenes.unsaved import saving

        scene = open_scene(self.scene, self.device, self.clip, shows_steps=True)
        if scene.folder is not None:
            require_current(scene.folder)
        journal = file_of(scene.folder, "edits.jsonl")
        if self.action == "discard":
            self._discard(journal)
        with uncounted(scene.listener, "steps", work_on(self.scene)):
            editor = Editor(scene, journal)
            idle = self.action in ("undo", "redo") and not getattr(editor, self.action)()
        if idle:
            print(f"nothing to {self.action}")
        elif self.action == "save" and self.output:
            with uncounted(scene.listener, "save", work_on(self.scene)):
                saved = editor.save(self.output).root
            print(f"{saved}: written; the steps stay in {journal} until you discard them")
        elif self.action in CHANGES:
            self._change(editor)
        for number, step in enumerate(editor.steps, start=1):
            print(f"{number}. {step}")
        left = counted(len(editor.scene.gaussians), "Gaussian")
        print(f"{left}, {counted(len(editor.undone), 'step')} undone")
        if self.action in CHANGES:
            told = f"note: the scene stays as it is; {saving(self.scene, len(editor.steps))}"
            print(told, file=sys.stderr)

    def _discard(self, journal: Path) -> None:
        if not journal.exists():
            return
        if not (self.yes or confirmed(f"Discard all steps in {journal}?")):
            raise QueryError(
                journal, expected="confirmation", found="none", remedy="give --yes to discard all steps"
            )
        journal.unlink()

    def _change(self, editor: Editor) -> None:
        from lexsplat.scenes.editing import Motion
        from lexsplat.scenes.listed import refuse_doubtful

        world = editor.scene.world
        by, grow, shrink = (each and each.units(world) for each in (self.by, self.grow, self.shrink))
        chosen = editor.scene.find(self.select or "", self.view, threshold=self.threshold)
        if self.threshold is None and not self.yes:
            refuse_doubtful(editor.scene, self.select or "", chosen)
        chosen = chosen.largest() if self.largest else chosen
        chosen = chosen.grow(*grow) if grow else chosen
        chosen = chosen.shrink(*shrink) if shrink else chosen
        motion = Motion(by or (0, 0, 0), scale=self.scale, turn=self.turn)
        with uncounted(editor.original.listener, "steps", work_on(self.scene, self.action)):
            editor.change(self.action, chosen, motion, self.color or (), self.strength, self.fill)
        if chosen.present == "unsure" or chosen.note:
            why = "; ".join(filter(None, (PRESENCE[chosen.present or "yes"].lstrip("; "), chosen.note)))
            undo = f"lexsplat edit {quote(self.scene)} undo takes the step back"
            print(f"note: {self.select}: {why}; {undo}", file=sys.stderr)
        if note := without_segments(editor.original):
            print(f"note: borders of things may stay behind, {note}", file=sys.stderr)
