"""``lexsplat scale``: the length of a meter and the up direction of a scene."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

from lexsplat.cli.options import Device, SceneArgument, open_folder, open_scene, print_json
from lexsplat.cli.values import Length
from lexsplat.cli.waiting import starting

if TYPE_CHECKING:
    from lexsplat.geometry.world import Measure

_LONGEST = 1e9
"""Longest distance in meters: nobody measures a million kilometers in a scene."""


@dataclasses.dataclass
class Scale:
    """Set the length of a meter and the up direction of a scene; without options, show both.

    Photos alone do not determine how large things are. One distance that you know does:

        lexsplat scale SCENE --distance 35cm --between "mug" "lamp"           # center to center
        lexsplat scale SCENE --distance 9.5cm --height-of "mug"
        lexsplat scale SCENE --distance 1.2 --points 0.1,0.2,0 0.9,0.2,0.4    # in units of the scene
        lexsplat scale SCENE --up 0,0,1                                       # if the estimate is wrong

    find, list, measure, info and exports to glTF then use meters. The stored scene keeps its units, and nothing is
    built again. How many meters the cameras span is printed: check that it makes sense. A height depends on the up
    direction: correct that first, or in the same command. lexsplat measure tells the distance between two things.

    Args:
        scene: A scene folder.
        distance: The known distance: a number in meters, or with a unit, such as 9.5cm.
        between: Two phrases: the distance between the centers of these things.
        height_of: A phrase: the height of this thing.
        points: Two positions as x,y,z in units of the scene ("center" of find --json): the distance between them.
        up: Direction away from the ground, as x,y,z in the axes of the scene.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
        json: Print one JSON document on standard output (docs/schemas/scale.json).
    """

    scene: SceneArgument
    distance: Length = None
    between: tuple[str, str] | None = None
    height_of: str | None = None
    points: tuple[str, str] | None = None
    up: str | None = None
    clip: str | None = None
    device: Device = "auto"
    json: bool = False

    def check(self) -> None:
        """Refuse invalid options."""
        ways = sum(way is not None for way in (self.between, self.height_of, self.points))
        if (self.distance is None) != (ways == 0) or ways > 1:
            raise ValueError(
                "--distance LENGTH goes with one of --between A B, --height-of A, --points X,Y,Z X,Y,Z"
            )
        if self.distance is not None and not 0 < self.distance <= _LONGEST:
            raise ValueError(f"distance must be positive and at most {_LONGEST:g} m, got {self.distance:g}")
        if self.points is None and self.up is None:
            return
        from lexsplat.geometry.world import World, parse_vector

        for text in self.points or ():
            parse_vector(text, "points")
        if self.up is not None:
            World.of_cameras([]).with_up(parse_vector(self.up))  # raises for an invalid direction

    def run(self) -> None:
        """Measure, store and print."""
        with starting():
            from lexsplat.geometry.world import parse_vector, world_of
            from lexsplat.scenes.scale import camera_span, store_world

        folder = open_folder(self.scene)
        length, scale = None, None
        if self.distance is not None:
            length = self._length(str(folder.root.resolve()))
            scale = self.distance / length
        up = parse_vector(self.up) if self.up else None
        cameras = {name: view.camera for name, view in folder.read_cameras().items()}
        if up is not None or scale is not None:
            measured: Measure = "distance" if self.height_of is None else "height"
            world = store_world(folder, up=up, meters_per_unit=scale, measured=measured)
        else:
            world = world_of(folder.record, cameras)
        if self.json:
            print_json(world.to_json())
            return
        if length is not None:
            print(f"{self.distance:g} m is {length:.4g} units")
        direction = ", ".join(f"{v:.3f}" for v in world.up.direction)
        known = world.meters_per_unit
        span = camera_span(cameras.values()) * (known or 0)
        spread = f"; the {len(cameras)} cameras span {_about(span)} m" if span else ""
        print("scale: not known" if known is None else f"scale: one unit is {known:.4g} m{spread}")
        print(f"up: ({direction}) from the {world.source}{'' if world.up.reliable else ', uncertain'}")

    def _length(self, folder: str) -> float:
        """The given distance as measured in the scene, in world units."""
        from lexsplat.geometry.world import parse_vector
        from lexsplat.scenes.scale import height_of, length_between, positive_length

        if self.points is not None:
            return positive_length(math.dist(*map(parse_vector, self.points)), "the two points")
        scene = open_scene(folder, self.device, self.clip, shows_steps=True)
        if self.up is not None:
            scene.world = scene.world.with_up(
                parse_vector(self.up)
            )  # a height is one along the new direction
        if self.between is not None:
            return length_between(scene, *self.between)
        return height_of(scene, self.height_of or "")


def _about(length: float) -> str:
    return f"{length:,.0f}" if length >= 10 else f"{length:.2g}"
