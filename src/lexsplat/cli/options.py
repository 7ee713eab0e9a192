"""Code shared by several commands: placeholders, checks, opening a scene, asking on a terminal, printing.

Nothing here loads torch, so that help pages and wrong usage are answered at once.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from lexsplat.cli.waiting import LateProgress, command, loading, starting
from lexsplat.runtime.progress import uncounted

if TYPE_CHECKING:
    from lexsplat.scenes.folder import SceneFolder
    from lexsplat.scenes.scene import Scene

Device = Literal["auto", "cpu", "cuda"]
ProgressName = Literal["bars", "json"]
PromptListName = Literal["paper", "released"]
ProtocolName = Literal["strict", "official", "lerf-2d", "lerf-3d"]
ALL_PROTOCOLS: tuple[ProtocolName, ...] = ("strict", "official", "lerf-2d", "lerf-3d")


def named(placeholder: str, hint: str = "(required)") -> Any:
    """Placeholder of a positional argument, and what the help page says of its default."""
    return tyro.conf.arg(metavar=placeholder, help_behavior_hint=hint)


SceneArgument = Annotated[str, tyro.conf.Positional, named("SCENE")]
CaptureArgument = Annotated[str, tyro.conf.Positional, named("CAPTURE")]
OptionalCaptureArgument = Annotated[str, tyro.conf.Positional, named("[CAPTURE]", "(default: none)")]
MoreCapturesArgument = Annotated[
    tuple[str, ...], tyro.conf.Positional, named("[CAPTURE ...]", "(default: none)")
]
PhrasesArgument = Annotated[tuple[str, ...], tyro.conf.Positional, named("PHRASE ...")]
FileArgument = Annotated[Path, tyro.conf.Positional, named("FILE")]

PRESENCE = {"yes": "", "unsure": "; perhaps not in this scene", "no": "; probably not in this scene"}
"""Text printed after an answer, by its value of ``present``."""


def work_on(scene: str, *words: str) -> str:
    """What the time of some work on a scene depends on (`lexsplat.runtime.progress.uncounted`)."""
    return " ".join((*words, os.path.abspath(scene) if os.path.exists(scene) else scene))


def open_scene(path: str, device: str, clip: str | None, shows_steps: bool = False) -> Scene:
    """Open the scene of a command with its encoders; a command that shows no steps of an edit notes them."""
    note_hidden_demo(path)
    listener = LateProgress()
    with uncounted(listener, "scene", work_on(path, command.get())), loading():
        from lexsplat.scenes import scene as search

        scene = search.open_scene(path, device=device, clip=clip)
    scene.listener = listener
    if scene.folder is not None and not shows_steps:
        note_version(scene.folder, path)
    return scene


def open_folder(path: str, shows_steps: bool = False) -> SceneFolder:
    """Open the scene folder of a command that needs no encoder; see `open_scene`."""
    note_hidden_demo(path)
    with starting():
        from lexsplat.scenes.folder import SceneFolder
        from lexsplat.scenes.previous import version_that_answers

    folder = version_that_answers(SceneFolder.open(Path(path)))
    if not shows_steps:
        note_version(folder, path)
    return folder


def note_version(folder: SceneFolder, given: str) -> None:
    """State on standard error what the scene that a command reads does not hold: a rebuild, or steps of an edit."""
    from lexsplat.scenes.facts import version_notes

    for note in version_notes(folder, given):
        print(f"note: {note}", file=sys.stderr)


def note_hidden_demo(given: str) -> None:
    """State on standard error that a scene of the working directory hides the bundled one."""
    if (Path(given) / "scene.json").is_file():
        note_hidden("demo", given)


def note_hidden(word: str, given: str) -> None:
    """State on standard error that a folder of the working directory hides what is bundled under its name."""
    if given == word and Path(given).exists():
        print(f"note: {word} is the folder in the working directory, not what is bundled", file=sys.stderr)


def confirmed(question: str) -> bool:
    """Whether the user agrees; False where no terminal can be asked."""
    if not sys.stdin.isatty():
        return False
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def print_rests_on(scene: Scene, rests_on: str) -> None:
    """Print what an answer rests on, and how to get segments where they are asked for and there are none."""
    print(f"relative to {rests_on}")
    if note := without_segments(scene):
        print(note)


def without_segments(scene: Scene) -> str:
    """How to get segments where they are asked for and there are none; empty elsewhere."""
    if scene.query.form != "segment" or scene.field.segments is not None:
        return ""
    from lexsplat.scenes.facts import NO_SEGMENTS

    return f"no segments: {NO_SEGMENTS}"


def print_json(document: Any) -> None:
    """Print one JSON document on standard output."""
    print(json.dumps(document, indent=2, ensure_ascii=False))


def print_evaluation(result: dict, folder: Path) -> None:
    """Print the table of one evaluated scene and the path of its report."""
    from lexsplat.evaluation.report import format_table

    print(format_table(result))
    print(f"report: {folder / 'report.html'}")


def check_threshold(threshold: float | None) -> None:
    """Refuse a threshold of relevancy outside 0..1.

    Raises:
        ValueError: It is given and not in 0..1.
    """
    if threshold is not None and not 0 <= threshold <= 1:
        raise ValueError(f"threshold must be in 0..1, got {threshold:g}")


def check_phrases(phrases: tuple[str, ...]) -> None:
    """Refuse a command without phrases.

    Raises:
        ValueError: There is none.
    """
    if not phrases:
        raise ValueError('at least one PHRASE is needed, such as "red apple"')


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Refuse an empty list of seeds and invalid seeds.

    Raises:
        ValueError: There is none, or one is negative or too large.
    """
    from lexsplat.runtime.device import check_seed

    if not seeds:
        raise ValueError("at least one seed is needed")
    for seed in seeds:
        check_seed(seed)
