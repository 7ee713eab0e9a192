"""Claims about views chosen from splats alone, on scenes whose surfaces are known."""

from __future__ import annotations

import functools
import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from support.splats import joined, solid
from support.surfaces import furnished, on_sphere, on_table, sides_of_box

from lexsplat.captures import load_capture
from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points
from lexsplat.geometry.rotations import rotation_about
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.inputs import reload_capture
from lexsplat.pipeline.viewpoints import candidates, choosing
from lexsplat.pipeline.viewpoints.choosing import choose_views
from lexsplat.pipeline.viewpoints.floaters import find_floaters
from lexsplat.pipeline.viewpoints.looking import look, surface_share
from lexsplat.pipeline.viewpoints.writing import write_chosen_capture
from lexsplat.runtime.errors import CaptureError
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.ply import write_ply

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(autouse=True)
def _few_candidates(monkeypatch) -> None:
    """Choices of a test take seconds."""
    monkeypatch.setattr(choosing, "SIZE", (240, 180))
    monkeypatch.setattr(choosing, "_MOST_CANDIDATES", 30)
    monkeypatch.setattr(candidates, "_MOST_PLACES", 6)
    monkeypatch.setattr(candidates, "_AZIMUTHS", 4)


def in_room(seed: int = 0) -> np.ndarray:
    """The walls, floor and ceiling of a closed room of 4 x 4 x 2.5, with two balls on the floor."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(-1, 1, (4500, 3))
    axis = generator.choice(3, len(points), p=[0.28, 0.28, 0.44])
    points[np.arange(len(points)), axis] = np.sign(points[np.arange(len(points)), axis])
    balls = [on_sphere((x, y, -0.9), 0.35, 400, seed + 1) for x, y in ((1.0, 1.0), (-1.0, 0.5))]
    return np.concatenate([points * [2, 2, 1.25], *balls])


@functools.cache
def of_table() -> choosing.ChosenViews:
    """The views of the things on a table, with all settings as usual but for the number of candidates."""
    return choose_views(solid(on_table()))


@pytest.mark.slow
def test_views_of_things_on_a_table_come_from_above_and_see_nearly_everything():
    chosen = of_table()
    assert chosen.up.direction @ UP > 0.99
    positions = np.stack([camera.position for camera in chosen.cameras])
    assert (positions[:, 2] > 0).all()
    assert chosen.unseen < 0.05 * chosen.visible
    assert chosen.visible > 0.8 * len(on_table())
    for camera in chosen.cameras:  # level: the right axis is horizontal
        assert abs(camera.viewmat[0, :3] @ UP) < 0.02


@pytest.mark.slow
def test_the_up_direction_turns_with_the_scene():
    turn = rotation_about(np.array([1.0, 0.3, 0.2]), 70)
    chosen = choose_views(solid(on_table() @ turn.T))
    assert chosen.up.direction @ (turn @ UP) > 0.98


@pytest.mark.slow
def test_a_furnished_room_is_looked_at_from_inside_at_eye_height(monkeypatch):
    """Up is not given. Most views are level with the eyes of a person, between 1.1 and 1.9 of 2.5."""
    monkeypatch.setattr(candidates, "_MOST_PLACES", 20)
    points = furnished(0.35)
    chosen = choose_views(solid(points))
    assert chosen.up.direction @ UP > 0.99
    positions = np.stack([camera.position for camera in chosen.cameras])
    assert ((positions > 0) & (positions < [5, 4, 2.5])).all()
    assert ((positions[:, 2] > 1.1) & (positions[:, 2] < 1.9)).mean() > 0.7
    assert chosen.unseen < 0.02 * chosen.visible
    assert chosen.visible > 0.5 * len(points)  # sides of furniture face walls


@pytest.mark.slow
def test_views_of_a_closed_room_come_from_inside():
    chosen = choose_views(solid(in_room()), up=UP)
    positions = np.stack([camera.position for camera in chosen.cameras])
    assert (np.abs(positions) < [2, 2, 1.25]).all()
    assert chosen.unseen < 0.1 * chosen.visible


@pytest.mark.slow
def test_a_choice_is_the_same_twice_and_a_given_up_direction_is_kept():
    first, second = of_table(), choose_views(solid(on_table()))
    assert [c.viewmat.tolist() for c in first.cameras] == [c.viewmat.tolist() for c in second.cameras]
    tilted = choose_views(solid(on_table()[::4]), up=np.array([0.0, 0.1, 2.0]))
    np.testing.assert_allclose(tilted.up.direction, np.array([0, 0.1, 2]) / np.hypot(0.1, 2))


def test_a_pixel_shows_a_surface_if_what_is_blended_lies_at_one_depth():
    """Left to right: a surface at 2; half at 1 and half at 3; a hole; a thin layer of fog over nothing."""
    depth = np.array([[2, 2, 0, 2]], np.float32)
    square = np.array([[4.0, 5.0, 0, 4.0]], np.float32)
    alpha = np.array([[1, 1, 0, 0.3]], np.float32)
    assert surface_share(depth, square, alpha) == pytest.approx(1 / 3)
    assert surface_share(depth, square, np.zeros((1, 4), np.float32)) == 0


def test_floaters_in_front_of_a_surface_lower_its_share():
    wall = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * [1, 1, 0.001]
    camera = look_at(np.array([0, 0, 3.0]), np.zeros(3), np.array([0, 1.0, 0]), 48, 36, 0.5)
    clean = solid(wall)
    dust = solid(np.random.default_rng(1).uniform([-0.7, -0.7, 0.5], [0.7, 0.7, 1.9], (150, 3)))
    dust.log_scales[:] = np.log(0.05)
    dust.opacity_logits[:] = 0
    both = joined(clean, dust)
    with torch.no_grad():
        before, after = (look(scene, camera)[1] for scene in (clean, both))
    assert before > 0.95
    assert after < 0.8 * before


def test_a_bar_that_is_lowered_admits_hazier_views_but_none_far_below_the_best():
    """The best tenth is at 0.5, so the bars are at 0.325, 0.1625 and 0.08125, and absolutely at 0.2, 0.1 and 0.05."""
    shares = np.array([0.0, 0.06, 0.09, 0.14, 0.17, 0.25, 0.35, 0.5, 0.5, 0.5, 0.5], np.float32)
    passed = [choosing._clear_enough(shares, part).sum() for part in (1.0, 0.5, 0.25)]
    assert passed == [5, 7, 9]
    assert not choosing._clear_enough(np.zeros(5, np.float32), 0.25).any()


def with_floaters(clean: Gaussians, low, high, count: int) -> Gaussians:
    """Half-opaque Gaussians of 2 to 15 cm in a box of meters."""
    generator = np.random.default_rng(1)
    points = generator.uniform(low, high, (count, 3))
    floaters = gaussians_from_points(points, generator.random((count, 3)), sh_degree=0, opacity=0.5)
    sizes = np.exp(generator.uniform(np.log(0.02), np.log(0.15), (count, 1)))
    floaters.log_scales[:] = torch.from_numpy(np.log(sizes)).float()
    return joined(clean, floaters)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.01, 0.05])
def test_a_furnished_room_with_floaters_is_looked_at_from_inside(share, monkeypatch):
    monkeypatch.setattr(candidates, "_MOST_PLACES", 10)
    room = solid(furnished(0.35))
    scene = with_floaters(room, [0, 0, 0], [5, 4, 2.5], round(share * len(room)))
    floating = find_floaters(scene, Path("room.ply"))
    chosen = choose_views(scene.select(torch.from_numpy(np.delete(np.arange(len(scene)), floating))), up=UP)
    positions = np.stack([camera.position for camera in chosen.cameras])
    assert chosen.room
    assert "as of a room or another closed place, from inside" in chosen.note
    assert ((positions > 0) & (positions < [5, 4, 2.5])).all()
    if share < 0.02:  # more floaters hide the room from most of its places, and the count says so
        assert chosen.unseen < 0.1 * chosen.visible


def outside_balls(balls, points: np.ndarray) -> np.ndarray:
    """Which points are in none of some balls."""
    centers, radii = np.array([center for center, _ in balls]), np.array([radius for _, radius in balls])
    return (np.linalg.norm(points[:, None] - centers, axis=2) > radii - 1e-6).all(1)


def ball():
    """Points on a hollow thing, and which positions are outside of it."""
    whole = [((0, 0, 0), 1.0)]
    return on_sphere(*whole[0], 3000, 0), lambda positions: outside_balls(whole, positions)


def crate():
    low, high = np.array([-1, -0.6, 0]), np.array([1, 0.6, 1.2])
    return sides_of_box(low, high, 4500, 0), lambda positions: ((positions < low) | (positions > high)).any(1)


def person():
    """The skin of a person of balls in rows, all one hollow: a trunk, a head, two arms and two legs."""
    balls = [((0, 0, z), 0.25) for z in np.arange(0.9, 1.5, 0.06)] + [((0, 0, 1.8), 0.2)]
    balls += [((x, 0, z), 0.12) for x in (-0.16, 0.16) for z in np.arange(0.12, 0.9, 0.05)]
    balls += [((side * x, 0, 1.45), 0.1) for side in (-1, 1) for x in np.arange(0.25, 0.8, 0.05)]
    skins = [on_sphere(*one, round(15_000 * one[1] ** 2), n) for n, one in enumerate(balls)]
    points = np.concatenate(skins)
    return points[outside_balls(balls, points)], lambda positions: outside_balls(balls, positions)


@pytest.mark.slow
@pytest.mark.parametrize("shell", [ball, person, crate])
def test_a_hollow_object_alone_is_looked_at_from_all_around(shell):
    points, are_outside = shell()
    chosen = choose_views(solid(points), up=UP)
    assert not chosen.room
    assert "as of an object, from around" in chosen.note
    positions = np.stack([camera.position for camera in chosen.cameras])
    low, high = points.min(0), points.max(0)
    assert are_outside(positions).all()
    azimuths = np.sort(np.arctan2(*(positions - (low + high) / 2).T[:2]))
    assert np.diff(azimuths, append=azimuths[0] + 2 * np.pi).max() < np.pi / 2
    assert chosen.visible > 0.8 * len(points)
    assert chosen.unseen < 0.05 * chosen.visible


def row_of_rooms(count: int) -> np.ndarray:
    """Closed rooms of 4.8 x 4 x 2.5 in a row, each with a ball on the floor."""
    parts = []
    for k in range(count):
        parts.append(sides_of_box((5 * k, 0, 0), (5 * k + 4.8, 4, 2.5), 3000, k))
        parts.append(on_sphere((5 * k + 2.4, 2, 0.5), 0.5, 400, k))
    return np.concatenate(parts)


@pytest.mark.slow
def test_every_closed_room_of_a_row_has_views(monkeypatch):
    monkeypatch.setattr(candidates, "_MOST_PLACES", 12)
    points = row_of_rooms(3)
    chosen = choose_views(solid(points), up=UP)
    positions = np.stack([camera.position for camera in chosen.cameras])
    assert np.unique(positions[:, 0] // 5).tolist() == list(range(3))
    assert chosen.visible > 0.75 * len(points)  # ceilings are above all views
    assert chosen.unseen < 0.1 * chosen.visible


@pytest.mark.slow
def test_rooms_that_no_chosen_view_shows_count_as_unseen(monkeypatch):
    """Four views do for one room of three."""
    monkeypatch.setattr(choosing, "_MOST_VIEWS", 4)
    points = row_of_rooms(3)
    chosen = choose_views(solid(points), up=UP)
    assert chosen.unseen > 0.3 * chosen.visible > 0.15 * len(points)


@pytest.mark.slow
def test_a_room_is_looked_at_from_around_and_a_table_from_the_places_on_it_if_a_user_says_so():
    around = choose_views(solid(furnished(0.35)), up=UP, side="around")
    positions = np.stack([camera.position for camera in around.cameras])
    assert ((positions > 0) & (positions < [5, 4, 2.5])).all(1).mean() < 0.1
    assert "an object" in around.note
    table = on_table()
    inside = choose_views(solid(table), up=UP, side="inside")
    positions = np.stack([camera.position for camera in inside.cameras])
    assert ((positions > table.min(0)) & (positions < table.max(0))).all()
    assert "from inside" in inside.note


@pytest.mark.parametrize("count", [0, 1, 60])
def test_splats_without_surfaces_are_refused(count):
    """None, one, and many at one point."""
    one = gaussians_from_points(np.zeros((1, 3)), np.ones((1, 3)), opacity=0.9)
    with pytest.raises(CaptureError, match="form surfaces"):
        choose_views(one.select(torch.zeros(count, dtype=torch.long)))


@pytest.mark.slow
def test_fog_in_which_no_place_shows_a_surface_is_refused():
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 3))
    fog = gaussians_from_points(points, np.ones_like(points), opacity=0.35)
    fog.log_scales -= 1.2
    with pytest.raises(CaptureError, match=r"none of \d+ tried"):
        choose_views(fog)


@pytest.mark.slow
def test_a_flat_picture_is_looked_at_with_a_warning(caplog):
    picture = np.random.default_rng(0).uniform(-1, 1, (4000, 3)) * [1.3, 0, 1]
    with caplog.at_level(logging.WARNING, "lexsplat"):
        chosen = choose_views(solid(picture), up=UP, subject=Path("picture.ply"))
    assert "picture.ply: all Gaussians lie in one plane" in caplog.text
    assert len(chosen.cameras) >= 1


@pytest.mark.slow
def test_a_wrong_up_direction_is_a_warning(caplog):
    with caplog.at_level(logging.WARNING, "lexsplat"):
        chosen = choose_views(solid(on_table()), up=-UP)
    assert "--up is not the direction in which things seem to stand (0,0,1)" in caplog.text
    assert chosen.up.direction @ UP == -1


def test_chosen_views_are_kept_as_a_capture_with_a_contact_sheet(tmp_path):
    gaussians = solid(on_table())
    cameras = tuple(
        look_at(np.array([x, -3.0, 1.5]), np.zeros(3), UP, *choosing.SIZE, 0.7) for x in (-1.0, 0.0, 1.0)
    )
    chosen = choosing.ChosenViews(cameras, choosing.Up(UP, True), 3, 0, 10, 0)
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "view_007.jpg").write_bytes(b"of an earlier choice")
    write_chosen_capture(gaussians, chosen, tmp_path)
    capture = load_capture(tmp_path, test_every=0)
    assert list(capture.views) == ["view_000.jpg", "view_001.jpg", "view_002.jpg"]
    for view, camera in zip(capture.views.values(), cameras):
        np.testing.assert_allclose(view.camera.viewmat, camera.viewmat, atol=1e-9)
        np.testing.assert_allclose(view.camera.K, camera.K, atol=1e-9)
        assert view.load_image((8, 6)).std() > 0.01
    assert (tmp_path / "contact_sheet.jpg").stat().st_size > 1000


@pytest.mark.slow
def test_a_build_of_splats_alone_keeps_its_views_and_repeats_no_choice(tmp_path):
    splats, output = tmp_path / "theirs.ply", tmp_path / "scene"
    write_ply(solid(on_table()), splats)
    config = BuildConfig(clip="bundled", dino="none", device="cpu", up="0,0,1")
    events, told = [], []
    folder = build(None, output, config, until="reconstruct", splats=splats, listener=told.append)
    for name in ("floaters", "surroundings", "views", "comparison", "pictures"):
        shares = [event.done / event.total for event in told if event.stage == name]
        assert shares == sorted(shares)
        assert shares[-1] == 1
    again = build(None, output, config, until="reconstruct", splats=splats, listener=events.append)
    assert folder.record["stages"]["views"] == again.record["stages"]["views"]
    assert "views" not in {event.stage for event in events}
    views = again.read_cameras()
    assert len(views) == again.record["stages"]["views"]["views"] >= 8
    assert {view.split for view in views.values()} == {"train"}
    assert (output / "poses" / "contact_sheet.jpg").is_file()
    moved = output.rename(tmp_path / "moved")
    assert len(reload_capture(SceneFolder.open(moved)).train_names) == len(views)
    with pytest.raises(ValueError, match="a capture or splats"):
        build(None, tmp_path / "nothing", config)


def test_a_build_whose_views_cannot_be_chosen_leaves_nothing(tmp_path):
    splats = tmp_path / "one.ply"
    write_ply(gaussians_from_points(np.zeros((1, 3)), np.ones((1, 3))), splats)
    with pytest.raises(CaptureError, match=r"one\.ply: expected at least 50 Gaussians"):
        build(None, tmp_path / "scene", BuildConfig(clip="bundled", device="cpu"), splats=splats)
    assert not (tmp_path / "scene").exists()
