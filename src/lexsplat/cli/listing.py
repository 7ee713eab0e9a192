"""``lexsplat list``: everything in a scene."""

from __future__ import annotations

import csv
import dataclasses
import sys
from pathlib import Path
from typing import Any, ClassVar

from lexsplat.cli.options import Device, SceneArgument, open_scene, print_json
from lexsplat.cli.waiting import starting


@dataclasses.dataclass
class List:
    """List everything in a scene: names, colors, places and sizes of its objects.

    Objects come from the segments that a build stores with the language. Names come from a vocabulary: a text file
    with one name a line, such as "teapot". Positions and sizes are in meters once the scale is known
    (see lexsplat scale), and in units of the scene until then; --json and --csv have both.

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        vocabulary: Text file of the names that objects may have, one a line, at most 2,000.
        images: Write a sheet of thumbnails.
        output: PNG file of the sheet.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
        csv: Print a table with one object a line.
        json: Print one JSON document on standard output (docs/schemas/list.json).
    """

    scene: SceneArgument
    vocabulary: Path | None = None
    images: bool = False
    output: Path | None = None
    clip: str | None = None
    device: Device = "auto"
    csv: bool = False
    json: bool = False

    synonyms: ClassVar[dict[str, str]] = {"--pictures": "--images", "--no-pictures": "--no-images"}
    defaults: ClassVar[dict[str, str]] = {
        "vocabulary": "everyday names",
        "output": 'SCENE/objects.png; demo_objects.png for "demo"',
    }

    def check(self) -> None:
        """Refuse options that exclude each other."""
        if self.csv and self.json:
            raise ValueError("give --csv or --json, not both")
        if self.output is not None and not self.images:
            raise ValueError("--output needs --images")
        if self.output is not None and self.output.suffix.lower() != ".png":
            raise ValueError(f"--output must be a .png file, got {self.output}")

    def run(self) -> None:
        """List and print."""
        with starting():
            from lexsplat.scenes.folder import file_of
            from lexsplat.scenes.objects import list_document, read_vocabulary

        names = read_vocabulary(self.vocabulary) if self.vocabulary else []
        scene = open_scene(self.scene, self.device, self.clip)
        picture = (self.output or file_of(scene.folder, "objects.png")) if self.images else None
        document = list_document(scene, names, picture)
        if self.json:
            print_json(document)
        elif self.csv:
            _print_table(document["objects"])
            for line in filter(None, (document["note"], document["picture"])):
                print(line, file=sys.stderr)  # standard output is the table
        else:
            _print_objects(document)


def _print_objects(document: dict[str, Any]) -> None:
    from lexsplat.queries.places import extent, position
    from lexsplat.scenes.serving import seen_in

    for number, thing in enumerate(document["objects"], start=1):
        names = ", ".join(f"{each['name']} {each['probability']:.2f}" for each in thing["names"])
        print(
            f"{number}. {names}; {' and '.join(thing['colors'])}; at {position(thing)}, "
            f"size {extent(thing)}, {thing['gaussians']} Gaussians, {seen_in(thing)}"
        )
    print(f"{len(document['objects'])} objects, named with {document['words']} words")
    for line in filter(None, (document["note"], document["picture"])):
        print(line)


def _print_table(things: list[dict[str, Any]]) -> None:
    from lexsplat.queries.places import angle_of_box

    columns = ("center", "size", "size_meters", "center_meters")
    writer = csv.writer(sys.stdout, lineterminator="\n")
    places = [f"{column}_{axis}" for column in columns for axis in "xyz"]
    last = ["gaussians", "best_view", "names", "probabilities", "box_angle_degrees"]
    writer.writerow(["name", "probability", "colors", *places, *last])
    for thing in things:
        names, shares = ([each[key] for each in thing["names"]] for key in ("name", "probability"))
        numbers = [value for column in columns for value in thing.get(column, [""] * 3)]
        writer.writerow(
            [
                *(thing["name"], shares[0], " ".join(thing["colors"]), *numbers),
                *(thing["gaussians"], thing["best_view"]),
                *(";".join(names), ";".join(map(str, shares)), angle_of_box(thing["axes"])),
            ]
        )
