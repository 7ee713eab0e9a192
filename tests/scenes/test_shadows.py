"""The light of a scene, from the shadows of two boxes on a floor and a wall, which are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import lexsplat
from lexsplat.geometry.boxes import Up
from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import SH_C0, gaussians_from_points
from lexsplat.geometry.world import World
from lexsplat.queries.selection import Selection
from lexsplat.scenes import shadows
from lexsplat.scenes.editing import Editor, Motion
from lexsplat.scenes.filling import fill_for
from lexsplat.scenes.materials import THING, UNLISTED
from lexsplat.scenes.shadows import Light, Shadows, find_light, shadows_of
from lexsplat.scenes.surfaces import Views

UP = np.array([0.0, 0.0, 1.0])
SUN = np.array([0.4, -0.7, 0.5]) / np.linalg.norm([0.4, -0.7, 0.5])
LOW, HIGH = np.array([[-0.7, -0.2, 0.0], [0.3, 0.3, 0.0]]), np.array([[-0.4, 0.1, 0.5], [0.6, 0.6, 0.9]])
SHARE = 0.4


def meets(places: np.ndarray, way: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which rays from places in a direction meet a box, by the slabs between its faces."""
    first, second = (low - places) / way, (high - places) / way
    enter, leave = np.minimum(first, second).max(1), np.maximum(first, second).min(1)
    return (leave > np.maximum(enter, 1e-3)) & (leave > 0.02)


def surface_of(low: np.ndarray, high: np.ndarray, step: float) -> np.ndarray:
    """Points on the faces of a box."""
    axes = [np.linspace(*ends, int(np.ceil((ends[1] - ends[0]) / step)) + 1) for ends in zip(low, high)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return grid[(np.isclose(grid, low) | np.isclose(grid, high)).any(1)]


def room(share: float = SHARE, checkers: float = 0.0):
    """A floor, a wall and two boxes: Gaussians, what each is of, which boxes hide the sun from it, and its part."""
    side, height = np.linspace(-1.5, 1.5, 61), np.linspace(0.05, 1.2, 24)
    floor = np.stack(np.meshgrid(side, side[side < 1.2]), -1).reshape(-1, 2)
    across, upward = (each.ravel() for each in np.meshgrid(side, height))
    wall = np.stack([across, np.full_like(across, 1.2), upward], 1)
    boxes = [surface_of(low, high, 0.04) for low, high in zip(LOW, HIGH)]
    points = np.concatenate([np.pad(floor, ((0, 0), (0, 1))), wall, *boxes])
    sizes = [len(floor), len(wall), *map(len, boxes)]
    of = np.repeat([0, 1, THING, THING], sizes)
    hidden = np.stack([meets(points, SUN, low, high) for low, high in zip(LOW, HIGH)]) & (of >= 0)
    light = 0.6 * (1 - share * hidden.any(0))
    light *= 1 + checkers * np.where(np.floor(points / 0.15).astype(int).sum(1) % 2, 1, -1)
    gaussians = gaussians_from_points(points, np.repeat(light[:, None], 3, 1), sh_degree=0, opacity=0.95)
    gaussians.log_scales.fill_(float(np.log(0.03)))
    return gaussians, of, hidden, np.repeat(np.arange(4), sizes)


def cameras(count: int = 6):
    angles = np.linspace(-2.6, -0.5, count)
    eyes = np.stack([2.6 * np.cos(angles), 2.6 * np.sin(angles), np.full(count, 1.8)], 1)
    return [look_at(eye, np.array([0, 0.2, 0.2]), UP, 160, 120, 1.1) for eye in eyes]


@pytest.fixture(scope="module")
def lit_room():
    gaussians, of, hidden, parts = room()
    things = gaussians.means.double().numpy()[of == THING]
    return gaussians, of, hidden, parts, find_light(Views(gaussians, cameras()), of, things, UP, 0.4)


def test_the_shadows_of_things_tell_where_the_light_comes_from_and_what_surfaces_get_from_it(lit_room):
    *_, light = lit_room
    assert np.degrees(np.arccos(light.toward @ SUN)) < 8
    assert light.direct == pytest.approx([SHARE, SHARE], abs=0.15)


def test_a_pattern_does_not_hide_the_light_and_without_shadows_there_is_none():
    gaussians, of, *_ = room(checkers=0.25)
    things = gaussians.means.double().numpy()[of == THING]
    light = find_light(Views(gaussians, cameras()), of, things, UP, 0.4)
    assert np.degrees(np.arccos(light.toward @ SUN)) < 12
    for checkers in (0.0, 0.25):
        flat = room(share=0.0, checkers=checkers)[0]
        assert find_light(Views(flat, cameras()), of, things, UP, 0.4) is None


def test_nothing_is_said_of_the_light_without_surfaces_things_or_views():
    gaussians, of, *_ = room()
    things, views = gaussians.means.double().numpy()[of == THING], Views(gaussians, cameras())
    assert find_light(views, np.full_like(of, UNLISTED), things, UP, 0.4) is None
    assert find_light(views, of, things[:0], UP, 0.4) is None
    assert find_light(Views(gaussians, []), of, things, UP, 0.4) is None
    far = np.where(of >= 0, of, UNLISTED)
    assert find_light(views, far, things + 100, UP, 0.4) is None, "no surface is near a thing"


@pytest.mark.parametrize("angle", [0.3, 2.0, 3.9, 5.5])
@pytest.mark.parametrize("tangent", [0.3, 0.8, 1.5])
def test_a_place_is_hidden_where_the_ray_to_the_light_meets_a_thing(angle, tangent):
    way = np.array([tangent * np.cos(angle), tangent * np.sin(angle), 1]) / np.hypot(1, tangent)
    low, high = LOW[0], HIGH[0]
    light = Light(way, np.zeros(3), 0.0, 0.0, np.zeros(1), 0.4)
    side = np.linspace(-2, 2, 80)
    places = np.pad(np.stack(np.meshgrid(side, side), -1).reshape(-1, 2), ((0, 0), (0, 1)))
    found = light.hidden(surface_of(low, high, 0.02), places)
    assert found.shape == (1, len(places)), "the sun is one ray"
    around = [meets(places, way, low - grown, high + grown) for grown in (-0.06, 0.06)]
    assert not (around[0] & ~found[0]).any()
    assert not (found[0] & ~around[1]).any()


def test_the_shadow_of_a_near_lamp_is_larger_than_the_thing_and_soft_if_the_lamp_is_wide():
    ball = 0.1 * np.random.default_rng(0).normal(size=(4000, 3))
    ball = 0.1 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0.3, 0, 0.5]
    places = np.stack([np.linspace(-1, 1, 401), np.zeros(401), np.zeros(401)], 1)

    def shadow(nearness, width):
        return Light(UP, np.zeros(3), nearness, width, np.zeros(1), 0.4).hidden(ball, places).mean(0)

    sharp = places[shadow(0.5, 0.0) > 0, 0]  # a lamp 2 above the floor: 0.3 and 0.1 by 2 / (2 - 0.5)
    assert (sharp.max() + sharp.min()) / 2 == pytest.approx(0.4, abs=0.02)
    assert (sharp.max() - sharp.min()) / 2 == pytest.approx(0.1333, abs=0.03)
    soft = shadow(0.0, 0.2)
    assert soft[300 - 40] == pytest.approx(1.0, abs=0.1), "the middle"
    partly = places[(soft > 0.05) & (soft < 0.95), 0]
    assert partly.min() < 0.2 - 0.05 < 0.4 + 0.05 < partly.max()


def test_a_shadow_that_another_thing_throws_too_stays():
    gone, other = (surface_of(low, high, 0.02) for low, high in zip(LOW, HIGH))
    light = Light(UP, np.zeros(3), 0.0, 0.0, np.array([0.5, 0.2]), 0.4)
    above = gone + np.array([1.0, 0.5, 1.0])  # a copy over the other one
    places = np.array([[-0.55, -0.05, -1], [0.45, 0.45, -1], [0.0, 0.9, -1]])
    factors = Shadows(light, np.concatenate([gone, above]), other).factors(places, np.zeros(3, int))
    assert factors == pytest.approx([2, 1, 1])
    assert Shadows(light, gone, other).factors(places, np.ones(3, int)) == pytest.approx([1.25, 1, 1])
    assert Shadows(light, gone, other).factors(places, np.full(3, UNLISTED)) == pytest.approx([1, 1, 1])
    now, then = Shadows(light, gone, other).at(places, np.zeros(3, int))
    assert (now, then) == (pytest.approx([0.5, 0.5, 1]), pytest.approx([1, 0.5, 1]))


def test_a_deleted_thing_takes_its_shadow_along_from_the_wall_and_leaves_those_of_others(lit_room):
    gaussians, of, hidden, parts, light = lit_room
    mask = torch.from_numpy(parts == 3)
    chosen = Selection(gaussians, {}, mask, mask.float(), phrase="box", world=World(Up(UP, True)))
    fill, _ = fill_for(chosen, cameras(), kinds=of, shadows=shadows_of(light, gaussians, chosen, of))
    after = fill.relit(gaussians).sh0[:, 0, 0].double().numpy() * SH_C0 + 0.5
    wall, alone = of == 1, hidden[1] & ~hidden[0]
    assert (wall & alone).sum() > 30
    assert np.median(np.abs(after - 0.6)[wall & alone]) < 0.08, "it had 0.36"
    assert np.median(after[hidden[0] & ~hidden[1] & (of == 0)]) == pytest.approx(0.36, abs=0.02)
    assert np.abs(after - 0.6)[(of >= 0) & ~hidden.any(0)].mean() < 0.02, "what has no shadow stays"
    bare, _ = fill_for(chosen, cameras(), kinds=of)
    kept = bare.relit(gaussians).sh0[:, 0, 0].double().numpy() * SH_C0 + 0.5
    assert np.median(kept[wall & alone]) == pytest.approx(0.36, abs=0.01), "nobody knows without the light"
    shaded = np.abs(fill.disks[:, :2] - [0.45, 0.45]).max(1) < 0.1
    assert np.median(fill.disks[shaded, -1]) == pytest.approx(0.6, abs=0.06), (
        "nothing throws a shadow there now"
    )


def test_a_black_surface_and_a_few_places_tell_nothing_of_the_light():
    gaussians, of, *_ = room()
    things = gaussians.means.double().numpy()[of == THING]
    rug = (of == 0) & (gaussians.means.numpy()[:, 1] < -0.6)
    gaussians.sh0[torch.from_numpy(rug)] = (0.02 - 0.5) / SH_C0
    light = find_light(Views(gaussians, cameras()), np.where(rug, 2, of), things, UP, 0.4)
    assert np.degrees(np.arccos(light.toward @ SUN)) < 8
    for seed in range(4):
        noisy, of, *_ = room(share=0.0)
        noisy.sh0 += 0.12 * torch.from_numpy(np.random.default_rng(seed).normal(size=(len(of), 1, 3))).float()
        few = np.random.default_rng(seed).permutation(np.flatnonzero(of == 0))[:60]
        kinds = np.where(np.isin(np.arange(len(of)), few) | (of == THING), of, UNLISTED)
        assert find_light(Views(noisy, cameras()), kinds, things, UP, 0.4) is None


def test_a_speck_far_away_and_what_is_beyond_a_near_lamp_throw_no_shadow():
    box, side = surface_of(LOW[0], HIGH[0], 0.02), np.linspace(-1, 1, 40)
    places = np.pad(np.stack(np.meshgrid(side, side), -1).reshape(-1, 2), ((0, 0), (0, 1)))
    sun = Light(UP, np.zeros(3), 0.0, 0.0, np.zeros(1), 0.4)
    speck = np.concatenate([box, [[1e6, -1e6, 3.0]]])
    np.testing.assert_array_equal(sun.hidden(speck, places), sun.hidden(box, places))
    assert sun.hidden(box, places).any()
    lamp = sun._replace(nearness=0.5)  # 2 above the floor
    assert lamp.hidden(box, places).any()
    assert not lamp.hidden(box + 5 * UP, places).any()
    assert not lamp.hidden(box, places + 6 * UP).any()
    far = np.array([3e3, 3e3, 0])
    apart = sun.hidden(np.concatenate([box, box + far]), np.concatenate([places, places + far]))
    assert apart[:, : len(places)].any(), (
        "an image of them all is coarse: at full size it has 10 billion pixels"
    )


def test_the_floor_below_a_table_gets_no_light_when_a_thing_on_the_table_goes():
    light = Light(UP, np.zeros(3), 0.0, 0.0, np.array([0.5, 0.5]), 0.4)
    table = surface_of(np.array([-1, -1, 0.95]), np.array([1, 1, 1.0]), 0.02)
    box = surface_of(LOW[0], HIGH[0], 0.02) + UP
    places = np.array([[-0.55, -0.05, 1.0], [-0.55, -0.05, 0.0]])
    alone, below = (
        Shadows(light, box, box[:0], surfaces, np.zeros(len(surfaces), int))
        for surfaces in (table[:0], table)
    )
    assert alone.factors(places, np.array([0, 1])) == pytest.approx([2, 2])
    assert below.factors(places, np.array([0, 1])) == pytest.approx([2, 1])


def test_what_edits_copied_or_moved_threw_no_shadow_where_it_is_now(lit_room):
    gaussians, of, _, parts, light = lit_room
    box = torch.from_numpy(parts == 3)
    moved = gaussians.map(torch.clone)
    moved.means[box] += torch.tensor([0.0, 0.0, 1.0])
    chosen = Selection(moved, {}, box, box.float(), phrase="box", world=World(Up(UP, True)))
    found = shadows_of(light, gaussians, chosen, of)
    assert len(found.gone) == 0
    assert len(found.others) == (parts == 2).sum()
    assert (found.factors(moved.means.double().numpy(), of) == 1).all()
    back = shadows_of(light, gaussians, Selection(gaussians, {}, box, box.float()), of)
    assert len(back.gone) == (parts == 3).sum()


@pytest.mark.slow
def test_an_editor_finds_the_light_of_its_scene_and_a_copy_takes_no_shadow_along():
    scene = lexsplat.open_scene("demo", device="cpu")
    editor = Editor(scene)
    lamp = np.array([5 * np.cos(-2.2), 5 * np.sin(-2.2), 4.4])  # tools/demo_scene/layouts.py
    assert np.degrees(np.arccos(editor._light.toward @ lamp / np.linalg.norm(lamp))) < 5
    count = len(scene.gaussians)
    editor.duplicate(scene.find("blue mug"), Motion(translation=(0.0, -0.6, 0.0)))
    copy = torch.arange(len(editor.scene.gaussians)) >= count
    world = scene.find("blue mug").world
    editor.delete(Selection(editor.scene.gaussians, {}, copy, copy.float(), phrase="mug", world=world))
    fill = editor.steps[-1].values.get("fill", {"lit": 0})
    assert fill["lit"] == 0, "it threw no shadow"


def test_the_bar_of_the_light_ends_after_an_error(monkeypatch):
    events = []
    scene = lexsplat.open_scene("demo", device="cpu")
    scene.listener = events.append
    kinds = np.zeros(len(scene.gaussians), int)

    def fails(*_):
        raise MemoryError

    monkeypatch.setattr(shadows, "find_light", fails)
    with pytest.raises(MemoryError):
        shadows.light_of(scene, kinds)
    assert [(event.done, event.total) for event in events if event.stage == "light"] == [(0, 1), (1, 1)]
