"""``lexsplat scale``: what a scene's unit is in meters, and which way is up."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import tyro

from lexsplat.cli.options import Device, open_scene, print_json
from lexsplat.geometry.world import World, parse_vector, world_of


@dataclasses.dataclass
class Scale:
    """Tell a scene how long something in it is, so that sizes are in meters from then on.

    Photos alone do not say how large things are; one distance that you know does:

        lexsplat scale SCENE --distance 0.35 --between "mug" "lamp"           # middle to middle
        lexsplat scale SCENE --distance 0.095 --height-of "mug"
        lexsplat scale SCENE --distance 1.2 --points 0.1,0.2,0 0.9,0.2,0.4    # as `lexsplat find` prints places
        lexsplat scale SCENE --up 0,0,1                                       # where the cameras misled

    Without options it says what is known. `find`, `info` and glTF exports then are in meters; what is stored keeps
    its units. Nothing is built again.

    Args:
        scene: A scene folder.
        distance: The distance in meters.
        between: Two phrases: it is that between the middles of these things.
        height_of: A phrase: it is the height of this thing.
        points: Two places as x,y,z: it is that between them.
        up: Direction away from the ground, as x,y,z in the scene's axes.
        clip: Text encoder, if it is not where the build found it.
        device: Where to compute.
        json: Print one JSON document on standard output.
    """

    scene: tyro.conf.Positional[str]
    distance: float | None = None
    between: tuple[str, str] | None = None
    height_of: str | None = None
    points: tuple[str, str] | None = None
    up: str | None = None
    clip: str | None = None
    device: Device = "auto"
    json: bool = False

    def __post_init__(self) -> None:
        ways = sum(way is not None for way in (self.between, self.height_of, self.points))
        if (self.distance is None) != (ways == 0) or ways > 1:
            raise ValueError(
                "--distance METERS goes with one of --between A B, --height-of A, --points X,Y,Z X,Y,Z"
            )
        if self.distance is not None and not 0 < self.distance < float("inf"):
            raise ValueError(f"distance must be positive, got {self.distance:g}")
        for text in self.points or ():
            parse_vector(text)
        if self.up is not None:
            World.of_cameras([]).with_up(parse_vector(self.up))  # refuses a direction that is none

    def run(self) -> None:
        """Measure, store, print."""
        from lexsplat.scenes.folder import SceneFolder
        from lexsplat.scenes.scale import store_world

        folder = SceneFolder.open(Path(self.scene))
        scale = None
        if self.distance is not None:
            length = self._length()
            scale = self.distance / length
            if not self.json:
                print(f"{self.distance:g} m are {length:.4g} units")
        up = parse_vector(self.up) if self.up else None
        changes = up is not None or scale is not None
        if changes:
            world = store_world(folder, up=up, meters_per_unit=scale)
        else:
            cameras = {name: view.camera for name, view in folder.read_cameras().items()}
            world = world_of(folder.record, cameras)
        if self.json:
            print_json(world.to_json())
            return
        direction = ", ".join(f"{v:.3f}" for v in world.up.direction)
        known = world.meters_per_unit
        print("scale: not known" if known is None else f"scale: one unit is {known:.4g} m")
        print(f"up: ({direction}) from the {world.source}{'' if world.up.reliable else ', unsure'}")

    def _length(self) -> float:
        """The given distance as it is in the scene, in world units."""
        from lexsplat.scenes.scale import height_of, length_between, positive_length

        if self.points is not None:
            return positive_length(math.dist(*map(parse_vector, self.points)), "the two points")
        scene = open_scene(self.scene, self.device, self.clip)
        if self.between is not None:
            return length_between(scene, *self.between)
        return height_of(scene, self.height_of or "")
