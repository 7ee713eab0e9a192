"""The scale of a built scene, from one known distance, and its up direction."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

from lexsplat.geometry.world import World, stored_world, world_of
from lexsplat.queries.selection import Selection
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")

_SCALES = (1e-9, 1e9)
"""Meters in a unit, at least and at most. Beyond, a distance or its unit is mistyped."""


def length_between(scene: Scene, first: str, second: str) -> float:
    """Distance in world units between the centers of two objects, found by phrases.

    Raises:
        QueryError: If one is not found, or they are the same.
    """
    things = [_the_thing(scene, phrase) for phrase in (first, second)]
    return positive_length(things[0].distance_to(things[1]), f"{first} and {second}")


def height_of(scene: Scene, phrase: str) -> float:
    """Height in world units of an object, found by a phrase.

    Raises:
        QueryError: If it is not found.
    """
    return positive_length(float(_the_thing(scene, phrase).size[2]), phrase)


def _the_thing(scene: Scene, phrase: str) -> Selection:
    """The largest instance that matches a phrase; logs a warning if there are several or perhaps none."""
    found = scene.find(phrase)
    if not found:
        remedy = "try other words; lexsplat list names what is in the scene"
        raise QueryError(phrase, expected="something in the scene", found="nothing", remedy=remedy)
    if found.present != "yes":
        log.warning("%s: perhaps not in this scene; check with: lexsplat find", phrase)
    if len(found.instances) > 1:
        log.warning("%s: %d found, taking the largest", phrase, len(found.instances))
    return found.largest()


def store_world(
    root: SceneFolder,
    *,
    up: Sequence[float] | None = None,
    meters_per_unit: float | None = None,
) -> World:
    """Write a new up direction or scale into ``scene.json``; None keeps the stored value.

    Args:
        root: The scene folder.
        up: World direction ``[3]`` away from the ground.
        meters_per_unit: Length of a world unit in meters.

    Raises:
        SceneFolderError: If the scene is the bundled one, or another process builds there.
        QueryError: If the scale is out of all bounds.
        ValueError: If a number is invalid.
    """
    root.refuse_bundled()
    if meters_per_unit is not None and not _SCALES[0] <= meters_per_unit <= _SCALES[1]:
        raise QueryError(
            "scale",
            expected=f"a unit of {_SCALES[0]:g} to {_SCALES[1]:g} m",
            found=f"{meters_per_unit:g} m",
            remedy="check the distance, its unit and what it is the distance of",
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


def positive_length(length: float, subject: str) -> float:
    """The length itself.

    Raises:
        QueryError: If it is not positive.
    """
    if not length > 0:
        remedy = "measure something with an extent, or between two different places"
        raise QueryError(subject, expected="a positive distance", found=f"{length:g}", remedy=remedy)
    return length
