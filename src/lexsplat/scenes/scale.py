"""The scale of a built scene, from one known distance, and its up direction."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from lexsplat.geometry.boxes import Up
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.world import Measure, Measured, World, angle_between, stored_world, world_of
from lexsplat.queries.selection import Selection
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.facts import is_of_chosen_views
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")

_SCALES = (1e-9, 1e9)
"""Meters in a unit, at least and at most. Beyond, a distance or its unit is mistyped."""
_SPANS = (0.01, 1000.0)
"""Meters that the cameras of one place span, at least and at most."""
_CONTRADICTION = 20.0
"""Degrees between a given up direction and a certain estimate that are no refinement of it."""
_TILTED = 0.5
"""Degrees that change a height: by 0.9 % of the width of a thing."""


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
    measured: Measure = "distance",
) -> World:
    """Write a new up direction or scale into ``scene.json``; None keeps the stored value.

    Logs a warning about an up direction that contradicts the cameras, about a scale that was measured as a height
    along another up direction, and about an absurd scale.

    Args:
        root: The scene folder.
        up: World direction ``[3]`` away from the ground.
        meters_per_unit: Length of a world unit in meters.
        measured: Whether the scale comes from a height, along the up direction, or from another distance.

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
        world = before = world_of(folder.record, cameras)
        if up is not None:
            world = world.with_up(up)
            if not is_of_chosen_views(folder.record):
                _warn_of_contradiction(world.up, World.of_cameras(cameras.values()).up)
        if meters_per_unit is not None:
            then = Measured(measured, tuple(world.up.direction.tolist()))
            world = replace(world, meters_per_unit=meters_per_unit, measured=then)
            _warn_of_absurd_scale(camera_span(cameras.values()) * meters_per_unit)
        elif up is not None:
            warn_of_stale_scale(before, world)
        folder.record["world"] = stored_world(world, cameras)
        folder.save()
    return world


def camera_span(cameras: Iterable[Camera]) -> float:
    """Diagonal of the box along the axes of the scene around all cameras, world units; 0 for one camera."""
    places = np.array([camera.position for camera in cameras]).reshape(-1, 3)
    return float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) else 0.0


def _warn_of_absurd_scale(span: float) -> None:
    """Warn where the cameras span more or less meters than photos of one place do."""
    if span and not _SPANS[0] <= span <= _SPANS[1]:
        told = "the cameras span %s m with this scale; check the distance, its unit and what it is the distance of"
        log.warning(told, f"{span:,.0f}" if span > 1 else f"{span:.2g}")


def _warn_of_contradiction(up: Up, estimate: Up) -> None:
    angle = angle_between(up.direction, estimate.direction)
    if estimate.reliable and angle > _CONTRADICTION:
        told = "up is %.0f degrees from what the cameras agree on; if that is wrong, give: --up=%s"
        log.warning(told, angle, ",".join(f"{round(float(v), 3) + 0.0:g}" for v in estimate.direction))


def warn_of_stale_scale(before: World, world: World) -> None:
    """Warn where the scale was measured as a height along another up direction, or may have been.

    Args:
        before: The world before its up direction was set.
        world: The world with its new up direction.
    """
    if world.meters_per_unit is None:
        return
    again = "lexsplat scale SCENE --distance LENGTH --height-of PHRASE"
    measured = world.measured
    if measured is None:
        if angle_between(before.up.direction, world.up.direction) > _TILTED:
            told = "if the scale was measured as a height, that was along another up direction; measure again: %s"
            log.warning(told, again)
    elif measured.kind == "height" and measured.tilt(world.up) > _TILTED:
        told = "the scale was measured as a height along another up direction, (%s); measure again: %s"
        log.warning(told, ", ".join(f"{v:.3f}" for v in measured.up), again)


def positive_length(length: float, subject: str) -> float:
    """The length itself.

    Raises:
        QueryError: If it is not positive.
    """
    if not length > 0:
        remedy = "measure something with an extent, or between two different places"
        raise QueryError(subject, expected="a positive distance", found=f"{length:g}", remedy=remedy)
    return length
