import json

import numpy as np
import pytest
from support.tilted_cameras import UP
from support.tilted_cameras import cameras as tilted_cameras

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.world import World, parse_vector, stored_world, world_of
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import SceneFolderError


def by_name(cameras) -> dict:
    return {f"{number}.jpg": camera for number, camera in enumerate(cameras)}


def test_up_is_estimated_from_the_cameras_unless_the_user_sets_it():
    cameras = list(tilted_cameras(UP))
    world = World.of_cameras(cameras)
    assert world.up.direction == pytest.approx(UP, abs=0.05)
    assert (world.source, world.meters_per_unit) == ("cameras", None)
    changed = world.with_up([0, 0, -4])
    assert changed.up.direction.tolist() == [0, 0, -1]
    assert (changed.source, changed.up.reliable) == ("user", True)
    assert World.of_cameras([]).up.direction.tolist() == [0, 0, 1]


def test_the_world_survives_json():
    cameras = by_name(tilted_cameras(UP))
    world = World(World.of_cameras(cameras.values()).with_up([1, 2, 2]).up, "user", 0.25)
    record = {"world": json.loads(json.dumps(stored_world(world, cameras)))}
    again = world_of(record, cameras)
    assert again.up.direction == pytest.approx([1 / 3, 2 / 3, 2 / 3], abs=1e-5)
    assert (again.source, again.meters_per_unit, again.up.reliable) == ("user", 0.25, True)
    assert again.meters(8.0) == 2.0
    assert world.of_cameras([]).meters(8.0) is None


def test_settings_of_the_user_do_not_apply_to_other_cameras():
    cameras = by_name(tilted_cameras(UP))
    record = {"world": stored_world(World(World.of_cameras([]).up, "user", 0.25), cameras)}
    moved = {**cameras, "0.jpg": look_at([5, 5, 5], [0, 0, 0], [0, 0, 1], 8, 6, 0.8)}
    assert world_of(record, moved).meters_per_unit is None
    assert world_of(record, moved).source == "cameras"
    smaller = {name: camera.downscaled(2) for name, camera in cameras.items()}
    assert world_of(record, smaller).meters_per_unit == 0.25, "image sizes are irrelevant"
    assert world_of({}, cameras).source == "cameras"


@pytest.mark.parametrize(
    "damage",
    [
        {"up": None},
        {"up": {"direction": [0, 0, 0], "reliable": True, "from": "user"}},
        {"up": {"direction": ["x", 0, 1], "reliable": True, "from": "user"}},
        {"up": {"direction": [0, 1], "reliable": True, "from": "user"}},
        {"meters_per_unit": -1.0},
        {"meters_per_unit": float("inf")},
        {"meters_per_unit": "long"},
    ],
)
def test_invalid_records_are_refused(damage):
    cameras = by_name(tilted_cameras(UP))
    content = {**stored_world(World.of_cameras(cameras.values()), cameras), **damage}
    with pytest.raises(SceneFolderError, match=r"world in scene\.json"):
        world_of({"world": content}, cameras)


def test_a_vector_has_three_numbers():
    assert parse_vector("0,-1, 2.5") == (0.0, -1.0, 2.5)
    for text in ("", "1,2", "1,2,3,4", "a,b,c", "nan,0,1", "inf,0,0"):
        with pytest.raises(ValueError, match="three numbers"):
            parse_vector(text)
    assert BuildConfig(up="0,-1,0").up == "0,-1,0"
    for text in ("0,0,0", "up"):
        with pytest.raises(ValueError, match=r"up must be|three numbers"):
            BuildConfig(up=text)
    with pytest.raises(ValueError, match="meters_per_unit"):
        World(World.of_cameras([]).up, meters_per_unit=float(np.nan))
