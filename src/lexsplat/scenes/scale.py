"""Giving a scene its scale by one distance that is known, and its up direction, after it was built."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lexsplat.geometry.world import World, stored_world, world_of
from lexsplat.queries.selection import Selection
from lexsplat.runtime.errors import QueryError, SceneFolderError
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")


def length_between(scene: Scene, first: str, second: str) -> float:
    """Distance in world units between the middles of two things, found by phrases.

    Raises:
        QueryError: If one is not found, or they are the same.
    """
    things = [the_thing(scene, phrase) for phrase in (first, second)]
    return _positive(things[0].distance_to(things[1]), f"{first} and {second}")


def height_of(scene: Scene, phrase: str) -> float:
    """How high a thing is, found by a phrase, in world units.

    Raises:
        QueryError: If it is not found.
    """
    return _positive(float(the_thing(scene, phrase).size[2]), phrase)


def length_of_points(first: Sequence[float], second: Sequence[float]) -> float:
    """Distance in world units between two points ``[3]``.

    Raises:
        QueryError: If they are the same.
    """
    return _positive(float(np.linalg.norm(np.subtract(first, second))), "the two points")


def the_thing(scene: Scene, phrase: str) -> Selection:
    """The largest thing that answers to a phrase; a warning tells where there are several or perhaps none.

    Raises:
        QueryError: If nothing answers.
    """
    found = scene.find(phrase)
    if not found:
        raise QueryError(phrase, expected="something in the scene", found="nothing")
    if found.present != "yes":
        log.warning("%s: perhaps not in this scene; check with: lexsplat find", phrase)
    if len(found.instances) > 1:
        log.warning("%s: %d found, the largest is meant", phrase, len(found.instances))
    return found.largest()


def store_world(
    root: SceneFolder,
    *,
    up: Sequence[float] | None = None,
    meters_per_unit: float | None = None,
) -> World:
    """Write a new up direction or scale into ``scene.json``; what is left out stays.

    Args:
        root: The scene folder.
        up: World direction ``[3]`` away from the ground.
        meters_per_unit: Meters that one world unit is long.

    Raises:
        SceneFolderError: If the scene is the one that ships, or another process builds there.
        ValueError: If a number makes no sense.
    """
    if root.is_bundled:
        raise SceneFolderError(
            "demo",
            expected="a scene folder of your own",
            found="the scene that ships with lexsplat",
            remedy="make your own copy of it with: lexsplat demo",
        )
    with root.locked():
        folder = SceneFolder.open(root.root)
        cameras = {name: view.camera for name, view in folder.read_cameras().items()}
        world = world_of(folder.record, cameras)
        if up is not None:
            world = world.with_up(up)
        if meters_per_unit is not None:
            world = replace(world, meters_per_unit=meters_per_unit)
        folder.record["world"] = stored_world(world, cameras)
        folder.save()
    return world


def _positive(length: float, subject: str) -> float:
    if not length > 0:
        raise QueryError(subject, expected="a distance", found="none between them")
    return length
