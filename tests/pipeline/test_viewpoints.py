"""Claims about views chosen from splats alone, on scenes whose surfaces are known."""

from __future__ import annotations

import functools
import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.splats import solid

from lexsplat.captures import load_capture
from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points
from lexsplat.geometry.rotations import rotation_about
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.inputs import reload_capture
from lexsplat.pipeline.viewpoints import candidates, choosing, stage
from lexsplat.pipeline.viewpoints.choosing import choose_views
from lexsplat.pipeline.viewpoints.floaters import find_floaters, isolation
from lexsplat.pipeline.viewpoints.looking import look, surface_share
from lexsplat.pipeline.viewpoints.writing import write_chosen_capture
from lexsplat.runtime.errors import CaptureError
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.ply import write_ply

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(autouse=True)
def _few_candidates(monkeypatch) -> None:
    """Choices of a test take seconds."""
    monkeypatch.setattr(choosing, "_MOST_CANDIDATES", 60)
    monkeypatch.setattr(candidates, "_MOST_PLACES", 20)


def on_sphere(center, radius: float, count: int, seed: int) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(center) + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def on_table(seed: int = 0) -> np.ndarray:
    """Three balls on a square table top at z = 0."""
    floor = np.random.default_rng(seed).uniform(-1, 1, (4000, 3)) * [1.5, 1.5, 0.002]
    balls = [
        on_sphere((x, y, r), r, 1200, seed + 1)
        for x, y, r in ((0, 0, 0.4), (0.8, 0.3, 0.3), (-0.7, 0.5, 0.35))
    ]
    return np.concatenate([floor, *balls])


def in_room(seed: int = 0) -> np.ndarray:
    """The walls, floor and ceiling of a closed room of 4 x 4 x 2.5, with two balls on the floor."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(-1, 1, (9000, 3))
    axis = generator.choice(3, len(points), p=[0.28, 0.28, 0.44])
    points[np.arange(len(points)), axis] = np.sign(points[np.arange(len(points)), axis])
    balls = [on_sphere((x, y, -0.9), 0.35, 800, seed + 1) for x, y in ((1.0, 1.0), (-1.0, 0.5))]
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


def sides_of_box(low, high, count: int, seed: int) -> np.ndarray:
    """Points on the six sides of a box."""
    generator = np.random.default_rng(seed)
    sizes = np.subtract(high, low)
    areas = np.prod(sizes) / sizes
    axis = generator.choice(3, count, p=areas / areas.sum())
    points = generator.uniform(0, 1, (count, 3))
    points[np.arange(count), axis] = generator.integers(0, 2, count)
    return np.asarray(low) + points * sizes


def furnished(dense: float = 1.0) -> np.ndarray:
    """A closed room of 5 x 4 x 2.5 with a table, a wardrobe, a sofa and a ball on the table."""

    def box(low, high, count: int, seed: int) -> np.ndarray:
        return sides_of_box(low, high, round(dense * count), seed)

    return np.concatenate([
        box((0, 0, 0), (5, 4, 2.5), 14000, 0), box((1.5, 1.2, 0.7), (3, 2.2, 0.76), 1500, 1),
        *(box((x, y, 0), (x + 0.06, y + 0.06, 0.7), 80, 2) for x in (1.5, 2.9) for y in (1.2, 2.1)),
        box((0, 3.4, 0), (1.8, 4, 1.9), 1800, 3), box((3.6, 0, 0), (5, 0.9, 0.45), 1500, 4),
        box((3.6, 0, 0.45), (5, 0.25, 0.9), 700, 5), on_sphere((2.2, 1.7, 0.9), 0.13, round(dense * 300), 6),
    ])  # fmt: skip


@pytest.mark.slow
def test_a_furnished_room_is_looked_at_from_inside_at_eye_height():
    """Up is not given. Most views are level with the eyes of a person, between 1.1 and 1.9 of 2.5."""
    points = furnished(0.6)
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
    both = Gaussians(**{n: torch.cat([t, getattr(dust, n)]) for n, t in clean.tensors().items()})
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


def joined(*parts: Gaussians) -> Gaussians:
    return Gaussians(
        **{name: torch.cat([part.tensors()[name] for part in parts]) for name in parts[0].tensors()}
    )


def dusty() -> tuple[Gaussians, Gaussians]:
    """Balls on a table, and small floaters around them of which some are certainly floaters."""
    clean = solid(on_table())
    dust = solid(np.random.default_rng(3).uniform([-3, -3, 0.1], [3, 3, 4], (700, 3)))
    dust.log_scales[:] = clean.log_scales[:700]
    return clean, dust


@functools.cache
def of_dust() -> np.ndarray:
    """The floaters that are found in `dusty`."""
    return find_floaters(joined(*dusty()), Path("dusty.ply"))


@pytest.mark.slow
def test_many_floaters_are_left_out_with_a_warning_and_few_lonely_gaussians_stay(caplog):
    clean, dust = dusty()
    distances = np.linalg.norm(dust.means.numpy()[:, None] - on_table()[None, ::10], axis=2).min(1)
    both = joined(clean, dust)
    events = []
    with caplog.at_level(logging.WARNING, "lexsplat"):
        floating = find_floaters(both, Path("dusty.ply"), listener=events.append)
    assert {event.stage for event in events} == {"floaters"}
    assert max(event.done for event in events) == max(event.total for event in events) - 1
    assert "dusty.ply" in caplog.text
    assert "float free of all surfaces" in caplog.text
    assert (floating >= len(clean)).all()
    far = len(clean) + np.flatnonzero(distances > 1)
    assert len(far) > 300
    assert np.isin(far, floating).mean() > 0.95
    caplog.clear()
    for few in (both.select(torch.arange(len(clean) + 100)), clean):
        assert len(find_floaters(few, Path("dusty.ply"))) == 0
    assert not caplog.text


@pytest.mark.slow
def test_large_floaters_hang_in_front_of_surfaces_and_large_gaussians_behind_the_scene_stay():
    """Both are within four of their radii from their neighbors, so distances alone do not tell them apart."""
    clean, dust = dusty()
    rng = np.random.default_rng(5)
    above = solid(rng.uniform([-1, -1, 1.0], [1, 1, 1.4], (12, 3)))
    around = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    wall = solid(np.stack([9 * np.cos(around), 9 * np.sin(around), np.full(30, 0.5)], 1))
    above.log_scales[:], wall.log_scales[:] = np.log(0.25), np.log(1.5)
    scene = joined(clean, dust, above, wall)
    first = len(clean) + len(dust)
    own = isolation(scene)[1]
    assert (own[first:] < 4).all()
    floating = find_floaters(scene, Path("dusty.ply"))
    assert np.isin(np.arange(first, first + 12), floating).mean() > 0.8
    assert not np.isin(np.arange(first + 12, len(scene)), floating).any()
    assert (floating >= len(clean)).all()


@pytest.mark.slow
def test_floaters_larger_than_the_things_they_engulf_are_found():
    """Surfaces lie before, on and behind them. Plates under a fine pattern have near neighbors, too, and stay."""
    clean, dust = dusty()
    giants = solid(np.array([[-0.6, -0.6, 1.3], [0.5, -1.0, 0.9], [1.2, -0.5, 0.8], [-0.2, 1.2, 1.1]]))
    giants.log_scales[:] = torch.log(torch.tensor([[1.2], [0.6], [0.4], [0.9]]))
    plates = solid(np.array([[-0.8, -0.8, 0.0], [0.9, -0.9, 0.0]]))
    plates.log_scales[:] = torch.log(torch.tensor([0.4, 0.4, 0.002]))
    plates.quats[:] = torch.tensor([1.0, 0, 0, 0])
    scene = joined(clean, plates, dust, giants)
    own = isolation(scene)[1]
    assert (own[len(clean) : len(clean) + 2] < 0.8).all()
    assert (own[-4:] < 2).all()
    floating = find_floaters(scene, Path("dusty.ply"))
    assert np.isin(np.arange(len(scene) - 4, len(scene)), floating).all()
    assert (floating >= len(clean) + 2).all()


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
def test_a_furnished_room_with_floaters_is_looked_at_from_inside(share):
    room = solid(furnished(0.6))
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
    return on_sphere(*whole[0], 6000, 0), lambda positions: outside_balls(whole, positions)


def crate():
    low, high = np.array([-1, -0.6, 0]), np.array([1, 0.6, 1.2])
    return sides_of_box(low, high, 9000, 0), lambda positions: ((positions < low) | (positions > high)).any(1)


def person():
    """The skin of a person of balls in rows, all one hollow: a trunk, a head, two arms and two legs."""
    balls = [((0, 0, z), 0.25) for z in np.arange(0.9, 1.5, 0.06)] + [((0, 0, 1.8), 0.2)]
    balls += [((x, 0, z), 0.12) for x in (-0.16, 0.16) for z in np.arange(0.12, 0.9, 0.05)]
    balls += [((side * x, 0, 1.45), 0.1) for side in (-1, 1) for x in np.arange(0.25, 0.8, 0.05)]
    skins = [on_sphere(*one, round(25_000 * one[1] ** 2), n) for n, one in enumerate(balls)]
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
@pytest.mark.parametrize("count", [2, 6])
def test_every_closed_room_of_a_row_has_views(count):
    chosen = choose_views(solid(row_of_rooms(count)), up=UP)
    positions = np.stack([camera.position for camera in chosen.cameras])
    assert np.unique(positions[:, 0] // 5).tolist() == list(range(count))
    assert chosen.visible > 0.75 * len(row_of_rooms(count))  # ceilings are above all views
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
    around = choose_views(solid(furnished(0.6)), up=UP, side="around")
    positions = np.stack([camera.position for camera in around.cameras])
    assert ((positions > 0) & (positions < [5, 4, 2.5])).all(1).mean() < 0.1
    assert "an object" in around.note
    table = on_table()
    inside = choose_views(solid(table), up=UP, side="inside")
    positions = np.stack([camera.position for camera in inside.cameras])
    assert ((positions > table.min(0)) & (positions < table.max(0))).all()
    assert "from inside" in inside.note


@pytest.mark.slow
def test_a_build_leaves_floaters_out_of_the_scene_unless_they_are_kept(tmp_path, monkeypatch):
    clean, dust = dusty()
    scene, splats = joined(clean, dust), tmp_path / "dusty.ply"
    write_ply(scene, splats)
    monkeypatch.setattr(stage, "choose_views", lambda *_, **__: choosing.ChosenViews((), UP, 0, 0, 0, 0))
    monkeypatch.setattr(stage, "write_chosen_capture", lambda _, __, poses, *rest: poses.mkdir(parents=True))
    monkeypatch.setattr(stage, "load_capture", lambda poses, **_: SimpleNamespace(root=poses))
    for keep, count in ((False, len(scene) - len(of_dust())), (True, len(scene))):
        folder = SceneFolder(tmp_path / str(keep))
        folder.root.mkdir()
        config = BuildConfig(keep_floaters=keep)
        capture = stage.capture_of_splats(splats, folder, config, "cpu", lambda _: None)
        assert len(stage.splats_of_capture(splats, capture, folder)) == count
        assert folder.record["stages"]["views"]["floaters"] == len(scene) - count
    photos = SimpleNamespace(root=tmp_path / "photos")
    assert len(stage.splats_of_capture(splats, photos, SceneFolder(tmp_path / "False"))) == len(scene)


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
