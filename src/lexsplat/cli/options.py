"""What several commands share: options, opening a scene, printing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from lexsplat.pipeline.config import BuildConfig
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.runtime.device import check_seed

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene

# tyro offers --iterations for this one; the settings of the reconstruction do not depend on tyro.
ReconstructionConfig.__annotations__["iterations"] = tyro.conf.Suppress[int]
Settings = Annotated[BuildConfig, tyro.conf.arg(name="")]
Device = Literal["auto", "cpu", "cuda"]
PromptListName = Literal["paper", "released"]
ProtocolName = Literal["strict", "official", "lerf-2d", "lerf-3d"]
ALL_PROTOCOLS: tuple[ProtocolName, ...] = ("strict", "official", "lerf-2d", "lerf-3d")

PRESENCE = {"yes": "", "unsure": "; perhaps not in this scene", "no": "; probably not in this scene"}
"""What is said behind an answer, for each verdict on whether the thing is in the scene at all."""


def open_scene(path: str, device: str, clip: str | None) -> Scene:
    """The scene a command was given, ready to be asked."""
    from lexsplat.scenes import scene as search

    return search.open_scene(path, device=device, clip=clip)


def print_json(document: Any) -> None:
    """One JSON document on standard output."""
    print(json.dumps(document, indent=2, ensure_ascii=False))


def print_evaluation(result: dict, folder: Path) -> None:
    """The table of one evaluated scene, and where its report lies."""
    from lexsplat.evaluation.report import format_table

    print(format_table(result))
    print(f"report: {folder / 'report.html'}")


def print_json_file(path: Path) -> None:
    """One JSON document that a command has written, on standard output."""
    print_json(json.loads(path.read_text(encoding="utf-8")))


def check_relevancy(threshold: float | None) -> None:
    """Refuse a threshold that no relevancy can be compared with.

    Raises:
        ValueError: It is given and not in 0..1.
    """
    if threshold is not None and not 0 <= threshold <= 1:
        raise ValueError(f"threshold must be in 0..1, got {threshold:g}")


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Refuse an empty list of seeds, and seeds that are none.

    Raises:
        ValueError: There is none, or it is negative or too large.
    """
    if not seeds:
        raise ValueError("at least one seed is needed")
    for seed in seeds:
        check_seed(seed)
