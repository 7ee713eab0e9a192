"""``lexsplat measure``: how far two things are from each other."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from shlex import quote
from typing import Annotated, Any

import tyro

from lexsplat.cli.options import (
    PRESENCE,
    Device,
    SceneArgument,
    named,
    open_scene,
    print_json,
    without_segments,
)
from lexsplat.cli.waiting import starting

FirstArgument = Annotated[str, tyro.conf.Positional, named("FIRST")]
SecondArgument = Annotated[str, tyro.conf.Positional, named("SECOND")]


@dataclasses.dataclass
class Measure:
    """Measure how far two things are from each other: between their centers, and between their surfaces.

        lexsplat measure SCENE "mug" "banana"
        lexsplat measure SCENE "red apple" "the largest toy" --json

    Lengths are in scene units, and in meters, too, once the scale is known (see lexsplat scale). If a phrase fits
    several things, the nearest pair is measured and named.

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        first: A phrase for one thing, as for lexsplat find.
        second: A phrase for another thing.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
        json: Print one JSON document on standard output (docs/schemas/measure.json).
    """

    scene: SceneArgument
    first: FirstArgument
    second: SecondArgument
    clip: str | None = None
    device: Device = "auto"
    json: bool = False

    def run(self) -> None:
        """Measure and print."""
        with starting():
            from lexsplat.scenes.measuring import measure

        scene = open_scene(self.scene, self.device, self.clip)
        document = measure(scene, self.first, self.second)
        if self.json:
            print_json(document)
            return
        _print_lengths(document)
        if note := without_segments(scene):
            print(note)
        # The bundled scene is never written, so nobody can give it a scale.
        bundled = scene.folder is not None and scene.folder.is_bundled
        if document["meters_per_unit"] is None and not bundled:
            told = f"one known distance gives meters; see lexsplat scale {quote(self.scene)} --help"
            print(f"note: {told}", file=sys.stderr)


def _print_lengths(document: Mapping[str, Any]) -> None:
    note = f"; {document['note']}" if document["note"] else ""
    print(f"{document['understood']}{PRESENCE[document['present']]}{note}")
    print(f"  between their centers: {_both_units(document['centers'])}")
    print(f"  between their surfaces: {_both_units(document['gap'])}")
    rise = document["height"]
    amount = {name: value and abs(value) for name, value in rise.items()}
    print(f"  height: the second is {_both_units(amount)} {'higher' if rise['units'] >= 0 else 'lower'}")


def _both_units(length: Mapping[str, float | None]) -> str:
    units = f"{length['units']:.3f} scene units"
    return units if length["meters"] is None else f"{length['meters']:.3f} m ({units})"
