"""The hole under a deleted thing: on a table of known colors with a known hole."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from support.language_scene import make_codebook

from lexsplat.geometry.boxes import Up
from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.geometry.world import World
from lexsplat.language.fields import CodeField
from lexsplat.queries.selection import Selection
from lexsplat.rendering import render
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.editing import Editor, Motion
from lexsplat.scenes.filling import fill_for
from lexsplat.scenes.fills import Fill
from lexsplat.scenes.journal import Step
from lexsplat.scenes.materials import THING
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.views import StoredView

pytestmark = pytest.mark.slow

LEFT, RIGHT = np.array([0.8, 0.3, 0.1]), np.array([0.2, 0.5, 0.7])


def table_with_a_ball(turned=None, ball_height=0.3):
    """A table of two colors with a hole of radius 0.2 under a ball of radius 0.3, which has code 1."""
    side = np.linspace(-1.5, 1.5, 76)
    table = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    table = table[np.linalg.norm(table, axis=1) > 0.2]
    table = np.concatenate([table, np.zeros((len(table), 1))], 1)
    directions = np.random.default_rng(0).normal(size=(600, 3))
    ball = 0.3 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + [0, 0, ball_height]
    points = np.concatenate([table, ball])
    colors = np.concatenate([np.where(table[:, :1] < 0, LEFT, RIGHT), np.full_like(ball, 0.5)])
    points = points if turned is None else points @ turned.T
    gaussians = gaussians_from_points(points, colors, sh_degree=0, opacity=0.95)
    gaussians.log_scales.fill_(float(np.log(0.025)))
    codes = torch.cat([torch.zeros(len(table), 1), torch.ones(len(ball), 1)]).to(torch.uint8)
    field = CodeField(make_codebook(2), codes, torch.ones(len(codes), 1), torch.zeros(len(codes)))
    up = np.array([0, 0, 1.0]) if turned is None else turned[:, 2]
    return Scene(gaussians, field, {}, "bundled"), World(Up(up, True))


def ball_of(scene, world):
    mask = scene.field.codes[:, 0] == 1
    return Selection(scene.gaussians, {}, mask, mask.float(), phrase="ball", world=world)


TURN = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
TURN = TURN * np.sign(np.linalg.det(TURN))


@pytest.mark.parametrize("turned", [None, TURN])
def test_a_deleted_thing_leaves_a_closed_surface_with_the_colors_around(turned):
    scene, world = table_with_a_ball(turned)
    editor = Editor(scene)
    editor.delete(ball_of(scene, world))
    after = editor.scene.gaussians
    added = after.select(torch.arange(len(after)) >= int((scene.field.codes[:, 0] == 0).sum()))
    places = added.means.double().numpy() @ (np.eye(3) if turned is None else turned)
    assert np.abs(places[:, 2]).max() < 0.01, "in the plane of the table"
    assert np.linalg.norm(places[:, :2], axis=1).max() < 0.3
    # Every point of the hole lies within a standard deviation of a disk.
    angle, radius = np.meshgrid(np.linspace(0, 6.2, 40), np.linspace(0, 0.17, 10))
    hole = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1).reshape(-1, 1, 2)
    apart = np.linalg.norm(hole - places[None, :, :2], axis=-1).min(1)
    assert apart.max() < float(added.scales[:, 0].max()) * 1.5
    colors = added.sh0[:, 0].double().numpy() * 0.28209479177387814 + 0.5
    assert np.abs(colors[places[:, 0] < -0.15] - LEFT).max() < 0.15
    assert np.abs(colors[places[:, 0] > 0.15] - RIGHT).max() < 0.15
    assert not editor.scene.field.codes.any(), "the language of the table"


def test_where_two_surfaces_meet_under_a_thing_each_goes_on_to_the_edge_and_things_on_them_are_not_copied():
    scene, world = table_with_a_ball()
    chosen = ball_of(scene, world)
    means = scene.gaussians.means.numpy()
    stain = (
        np.hypot(means[:, 0] + 0.5, means[:, 1]) < 0.15
    ) & ~chosen.mask.numpy()  # a thing, seen from above
    scene.gaussians.sh0[torch.from_numpy(stain)] = 1.5
    kinds = np.where(stain | chosen.mask.numpy(), THING, np.where(means[:, 0] < 0, 0, 1))

    def wrong(fill):
        places, colors = fill.disks[:, :2], fill.disks[:, -3:]
        right = np.where(places[:, :1] < 0, LEFT, RIGHT)
        return (np.abs(colors - right).max(1) > 0.05)[np.abs(places[:, 0]) > 0.08]  # beside the blurred edge

    assert not wrong(fill_for(chosen, kinds=kinds)[0]).any()
    assert wrong(fill_for(chosen)[0]).mean() > 0.2, "as one surface it copies the stain"


def test_a_moved_thing_leaves_the_surface_that_a_deleted_one_leaves(tmp_path):
    scene, _ = checkered_table_with_a_box(shadow=False)
    chosen = box_of(scene)
    deleted, moved, kept = Editor(scene), Editor(scene, tmp_path / "edits.jsonl"), Editor(scene)
    deleted.delete(chosen)
    away = Motion(translation=(1.0, 0.5, 0.2))
    moved.move(chosen, away)
    there = moved.scene.gaussians.means[moved.scene.field.codes[:, 0] == 1]
    expected = scene.gaussians.means[chosen.mask] + torch.tensor(away.translation)
    torch.testing.assert_close(there, expected)
    rest = moved.scene.gaussians.select(moved.scene.field.codes[:, 0] == 0)
    assert torch.equal(rest.means, deleted.scene.gaussians.means)
    assert len(rest) != int((~chosen.mask).sum()), "remains under the box are gone, and the hole is filled"
    again = Editor(scene, tmp_path / "edits.jsonl")
    assert torch.equal(again.scene.gaussians.means, moved.scene.gaussians.means)
    assert moved.undo()
    assert torch.equal(moved.scene.gaussians.means, scene.gaussians.means)
    kept.move(chosen, away, fill=False)
    assert len(kept.scene.gaussians) == len(scene.gaussians)


def test_a_thing_that_stands_on_a_deleted_one_stays_whole():
    side, edge = np.linspace(-1.5, 1.5, 90), np.linspace(-0.1, 0.1, 9)
    plane = np.stack(np.meshgrid(side, side, [0.0]), -1).reshape(-1, 3)
    on_cloth = np.abs(plane[:, :2]).max(1) < 0.6
    block = np.stack(np.meshgrid(edge, edge, np.linspace(0.04, 0.24, 9)), -1).reshape(-1, 3)
    points = np.concatenate([plane[~on_cloth], block, plane[on_cloth] + [0, 0, 0.02]])
    scene = solid(points, np.full_like(points, 0.5), int(on_cloth.sum()))
    editor = Editor(scene)
    editor.delete(box_of(scene))
    assert str(editor.steps[0]).find("filled") > 0
    assert int((editor.scene.gaussians.means[:, 2] > 0.03).sum()) == len(block)


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """A table with a ball, and the two lines of a journal that moves the ball; read-only."""
    scene, world = table_with_a_ball()
    journal = tmp_path_factory.mktemp("moved") / "edits.jsonl"
    Editor(scene, journal).move(ball_of(scene, world), Motion(translation=(1.0, 0, 0)))
    return scene, journal.read_text().splitlines()


@pytest.mark.parametrize("undone", [False, True])
@pytest.mark.parametrize("broken", ["####", None, 5, "", "the mask"])
def test_damaged_remains_of_a_moved_thing_are_reported_in_one_line(moved, tmp_path, broken, undone):
    scene, (header, line) = moved
    journal = tmp_path / "edits.jsonl"
    step = json.loads(line)
    changed = json.dumps({**step, "remains": step["mask"] if broken == "the mask" else broken})
    journal.write_text(f"{header}\n{changed}\n" + ('{"undo": true}\n' if undone else ""))
    with pytest.raises(FileFormatError) as error:
        Editor(scene, journal)
    assert "\n" not in str(error.value)


def test_an_undone_step_that_cannot_be_replayed_is_reported_in_one_line(moved, tmp_path):
    scene, (header, line) = moved
    journal = tmp_path / "edits.jsonl"
    journal.write_text(f'{header}\n{json.dumps({**json.loads(line), "scale": -1})}\n{{"undo": true}}\n')
    editor = Editor(scene, journal)
    with pytest.raises(FileFormatError, match="replayed"):
        editor.redo()
    assert torch.equal(editor.scene.gaussians.means, scene.gaussians.means)
    assert len(editor.undone) == 1


def test_numbers_that_a_step_does_not_have_are_ignored_and_phrases_are_one_line(tmp_path):
    scene, world = table_with_a_ball()
    journal = tmp_path / "edits.jsonl"
    Editor(scene, journal).recolor(ball_of(scene, world), (0.1, 0.2, 0.3))
    header, line = journal.read_text().splitlines()
    changed = {**json.loads(line), "fill": "none", "remains": 3, "phrase": "a\nball\x1b[31m"}
    journal.write_text(f"{header}\n{json.dumps(changed)}\n")
    assert str(Editor(scene, journal).steps[0]) == "recolor a ball [31m (600 Gaussians)"


def test_nothing_is_filled_where_a_thing_stands_on_nothing_or_a_fill_is_not_wanted():
    hanging, world = table_with_a_ball(ball_height=2.0)
    events = []
    fill, gone = fill_for(ball_of(hanging, world), listener=events.append)
    assert fill is None
    assert [(event.stage, event.done, event.total) for event in events] == [("fill", 0, 1), ("fill", 1, 1)]
    assert torch.equal(gone, ball_of(hanging, world).mask)
    scene, world = table_with_a_ball()
    editor = Editor(scene)
    editor.delete(ball_of(scene, world), fill=False)
    assert torch.equal(editor.scene.gaussians.means, scene.gaussians.means[scene.field.codes[:, 0] == 0])


def test_a_journal_replays_a_fill_and_its_undo(tmp_path):
    scene, world = table_with_a_ball()
    editor = Editor(scene, tmp_path / "edits.jsonl")
    editor.delete(ball_of(scene, world))
    again = Editor(scene, tmp_path / "edits.jsonl")
    for name, tensor in editor.scene.gaussians.tensors().items():
        assert torch.equal(again.scene.gaussians.tensors()[name], tensor), name
    added = len(again.scene.gaussians) - len(scene.gaussians) + int(again.steps[0].mask.sum())
    assert str(again.steps[0]).endswith(f" Gaussians, filled with {added})")
    assert again.undo()
    assert torch.equal(again.scene.gaussians.means, scene.gaussians.means)


@pytest.fixture(scope="module")
def journaled_fill(tmp_path_factory) -> tuple[Scene, str, dict]:
    """A scene, the first line of its journal, and a deletion with its fill."""
    scene, world = table_with_a_ball()
    journal = tmp_path_factory.mktemp("fill") / "edits.jsonl"
    Editor(scene, journal).delete(ball_of(scene, world))
    header, line = journal.read_text().splitlines()
    return scene, header, json.loads(line)


def number_of_sources(fill):
    return {**fill, "gaussians": fill["gaussians"] + 1}


def brightened(lit, light):
    """A fill of no Gaussians that only brightens some."""
    none = np.zeros(0, "<i4"), np.zeros((0, 13), "<f4")
    return Fill(*none, np.array(lit, "<i4"), np.array(light, "<f4")).to_json()


@pytest.mark.parametrize(
    "broken",
    [
        number_of_sources,
        lambda fill: {**fill, "gaussians": 10**9},
        lambda fill: {**fill, "disks": "####"},
        lambda fill: {**fill, "disks": None},
        lambda fill: {},
        lambda fill: Fill(np.array([10**6], "<i4"), np.zeros((1, 13), "<f4")).to_json(),
        lambda fill: Fill(np.zeros(1, "<i4"), np.full((1, 13), np.nan, "<f4")).to_json(),
        lambda fill: "fill",
        lambda fill: {**fill, "lit": fill.get("lit", 0) + 1},
        lambda fill: {**fill, "lit": -1},
        lambda fill: {**fill, "light": None},
        lambda fill: brightened([10**6], [1.5]),
        lambda fill: brightened([0], [np.nan]),
        lambda fill: brightened([0], [0.0]),
    ],
)
def test_a_damaged_fill_is_reported_in_one_line(journaled_fill, tmp_path, broken):
    scene, header, step = journaled_fill
    journal = tmp_path / "edits.jsonl"
    journal.write_text(f"{header}\n{json.dumps({**step, 'fill': broken(step['fill'])})}\n")
    with pytest.raises(FileFormatError) as error:
        Editor(scene, journal)
    assert "\n" not in str(error.value)


def checkered_table_with_a_box(shadow=False):
    """A checkered table, and a red box (code 1) on it with red remains under it; and the table alone, without shadow.

    The places under the box have no Gaussians of the table, as no view shows them.
    """
    side = np.linspace(-1.5, 1.5, 101)
    table = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    squares = np.floor((table @ [[0.96, -0.28], [0.28, 0.96]] + 0.07) / 0.2).sum(1) % 2 == 0
    colors = np.where(squares[:, None], [0.85, 0.82, 0.8], [0.15, 0.35, 0.7])
    table = np.concatenate([table, np.zeros((len(table), 1))], 1)
    face = np.stack(np.meshgrid(*[np.linspace(-0.25, 0.25, 26)] * 2), -1).reshape(-1, 2)
    sides = [
        np.insert(face + np.array([0, 0.25]), axis, value, 1)
        for axis, value in ((0, -0.25), (0, 0.25), (1, -0.25), (1, 0.25))
    ]
    box = np.concatenate([*sides, np.insert(face, 2, 0.5, 1)])
    remains = np.insert(np.random.default_rng(3).uniform(-0.2, 0.2, (30, 2)), 2, -0.01, 1)
    free = np.abs(table[:, :2]).max(1) > 0.26
    dark = (
        1 - 0.4 * np.exp(-(np.abs(table[:, :2]).max(1) - 0.25).clip(0) / 0.1)
        if shadow
        else np.ones(len(table))
    )
    points = np.concatenate([table[free], remains, box])
    paint = np.concatenate([(colors * dark[:, None])[free], np.tile([0.8, 0.1, 0.1], (30 + len(box), 1))])
    return solid(points, paint, len(box)), solid(table, colors, 0)


def solid(points, colors, last):
    """A scene of these points, the last of which have code 1, with views around it."""
    gaussians = gaussians_from_points(points, colors, sh_degree=0, opacity=0.98)
    gaussians.log_scales.fill_(float(np.log(0.018)))
    codes = (torch.arange(len(points)) >= len(points) - last).to(torch.uint8)[:, None]
    field = CodeField(make_codebook(2), codes, torch.ones(len(codes), 1), torch.zeros(len(codes)))
    views = {}
    for number, angle in enumerate(np.linspace(-0.7, 0.7, 9)):
        eye = 2.5 * np.array([np.sin(angle), -np.cos(angle), 0.5 + 0.05 * (number % 3)])
        camera = look_at(eye, np.zeros(3), np.array([0, 0, 1.0]), 160, 120, 0.7)
        views[f"v{number}"] = StoredView(f"v{number}", camera, "test" if number == 4 else "train")
    return Scene(gaussians, field, views, "bundled")


def box_of(scene):
    mask = scene.field.codes[:, 0] == 1
    world = World(Up(np.array([0, 0, 1.0]), True))
    return Selection(scene.gaussians, scene.cameras, mask, mask.float(), world=world)


@pytest.mark.parametrize("shadow", [False, True])
def test_checkers_go_on_where_a_box_stood_and_nothing_of_its_color_stays(shadow):
    scene, alone = checkered_table_with_a_box(shadow)
    chosen = box_of(scene)
    mask = chosen.mask
    editors = {fill: Editor(scene) for fill in (True, False)}
    for fill, editor in editors.items():
        editor.delete(chosen, fill=fill)
    original = alone.render("v4").image.numpy()
    place = render(scene.gaussians, scene.camera("v4"), features=mask[:, None].float(), color=False)
    seen = place.features[..., 0].numpy() > 0.5
    psnr, pictures = {}, {}
    for fill, editor in editors.items():
        pictures[fill] = editor.scene.render("v4").image.numpy()
        psnr[fill] = -10 * np.log10(((pictures[fill] - original)[seen] ** 2).mean())
    assert psnr[True] > 25, psnr
    assert psnr[False] < 15, psnr
    red = pictures[True][..., 0] - pictures[True][..., 1:].max(-1)
    assert (red[seen] < 0.2).all(), "neither the box nor the remains under it"


def test_a_shadow_around_a_deleted_thing_goes_with_it_and_comes_back_with_undo(tmp_path):
    scene, alone = checkered_table_with_a_box(shadow=True)
    editor = Editor(scene, tmp_path / "edits.jsonl")
    editor.delete(box_of(scene))
    kept = ~editor.steps[0].mask
    places = scene.gaussians.means[kept].double().numpy()
    far = np.abs(places[:, :2]).max(1)
    own = cKDTree(alone.gaussians.means.double().numpy()).query(places)[1]
    true = alone.gaussians.sh0[own, 0].numpy()
    before, after = (
        gaussians.sh0[: len(places), 0].numpy()
        for gaussians in (scene.gaussians.select(kept), editor.scene.gaussians)
    )
    beside = (far > 0.3) & (far < 0.4)
    assert np.abs(after - true)[beside].mean() < 0.7 * np.abs(before - true)[beside].mean()
    np.testing.assert_array_equal(after[far > 1.2], before[far > 1.2])
    again = Editor(scene, tmp_path / "edits.jsonl")
    assert torch.equal(again.scene.gaussians.sh0, editor.scene.gaussians.sh0)
    assert editor.undo()
    assert torch.equal(editor.scene.gaussians.sh0, scene.gaussians.sh0)


def test_steps_of_earlier_versions_which_brighten_nothing_are_replayed(journaled_fill, tmp_path):
    scene, header, step = journaled_fill
    fill = {name: value for name, value in step["fill"].items() if name in ("gaussians", "disks")}
    (tmp_path / "edits.jsonl").write_text(f"{header}\n{json.dumps({**step, 'fill': fill})}\n")
    after = Editor(scene, tmp_path / "edits.jsonl").scene.gaussians
    kept = scene.gaussians.select(~Step.from_json(step).mask)
    assert torch.equal(after.sh0[: len(kept)], kept.sh0)


def test_what_two_things_brighten_is_brightened_once_by_the_larger_factor():
    gaussians = gaussians_from_points(np.eye(3), np.full((3, 3), 0.4), sh_degree=1, opacity=0.9)
    gaussians.shN.fill_(0.1)
    none = np.zeros(0, "<i4"), np.zeros((0, 13), "<f4")
    fill = Fill(*none, np.array([0, 1, 1], "<i4"), np.array([1.5, 1.25, 1.5], "<f4"))
    found = Fill.from_json(json.loads(json.dumps(fill.to_json()))).relit(gaussians)
    colors = found.sh0[:, 0].numpy() * 0.28209479177387814 + 0.5
    np.testing.assert_allclose(colors, np.array([0.6, 0.6, 0.4])[:, None] * np.ones(3), atol=1e-6)
    np.testing.assert_allclose(found.shN[:, 0, 0].numpy(), [0.15, 0.15, 0.1], atol=1e-6)
    assert torch.equal(gaussians.shN, torch.full_like(gaussians.shN, 0.1)), "the scene itself stays"


def test_specks_that_only_a_deleted_thing_hid_go_with_it_and_others_stay():
    places = {
        "behind it": (0.0, 0.3, 0.3),
        "behind it, farther away": (0.0, 0.45, 0.2),
        "beside it, in sight": (0.3, -0.2, 0.1),
    }
    table, _ = checkered_table_with_a_box()
    own = table.field.codes[:, 0] == 1
    means, colors = table.gaussians.means, table.gaussians.sh0[:, 0] * 0.28209479177387814 + 0.5
    specks = torch.tensor(list(places.values()), dtype=torch.float32)
    points = torch.cat([means[~own], specks, means[own]]).double().numpy()
    green = torch.tensor([[0.1, 0.8, 0.1]]).expand(len(specks), 3)
    scene = solid(points, torch.cat([colors[~own], green, colors[own]]).double().numpy(), int(own.sum()))
    editor = Editor(scene)
    editor.delete(box_of(scene))
    left = {
        name
        for name, place in places.items()
        if bool(torch.isclose(editor.scene.gaussians.means, torch.tensor(place), atol=1e-6).all(1).any())
    }
    assert left == {"behind it, farther away", "beside it, in sight"}


def test_what_a_deleted_thing_and_others_hid_together_is_filled_and_what_only_others_hid_is_not():
    table, _ = checkered_table_with_a_box()
    own = (table.field.codes[:, 0] == 1).numpy()
    means = table.gaussians.means.double().numpy()
    colors = table.gaussians.sh0[:, 0].double().numpy() * 0.28209479177387814 + 0.5
    across, height = (
        side.ravel() for side in np.meshgrid(np.arange(0.34, 1.3, 0.02), np.arange(0, 0.4, 0.02))
    )
    plate = np.stack([across, np.full_like(across, 0.2), height], 1)  # beside the box, before both places
    together, others = np.array([0.36, 0.6, 0]), np.array([0.75, 0.42, 0])
    apart = np.minimum(*(np.linalg.norm(means - place, axis=1) for place in (together, others)))
    kept = ~own & (apart > 0.1)
    points = np.concatenate([means[kept], plate, means[own]])
    green = np.tile([0.1, 0.8, 0.1], (len(plate), 1))
    scene = solid(points, np.concatenate([colors[kept], green, colors[own]]), int(own.sum()))
    editor = Editor(scene)
    editor.delete(box_of(scene))
    left = editor.scene.gaussians.means.double().numpy()
    nearest = cKDTree(left).query(np.stack([together, others]))[0]
    assert nearest[0] < 0.03
    assert nearest[1] > 0.08
    assert cKDTree(left).query(plate)[0].max() < 1e-6, "the plate is whole"


def test_a_fill_ends_where_the_photos_show_that_the_table_ends():
    """As below a plant that reaches over the edge of a table."""
    scene, world = table_with_a_ball()
    kept = ((scene.gaussians.means[:, 0] < 0.15) | (scene.field.codes[:, 0] == 1)).nonzero()[:, 0]
    scene = Scene(scene.gaussians.select(kept), scene.field.select(kept), {}, "bundled")
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    eyes = [np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), 1.2]) for angle in angles]
    cameras = [look_at(eye, np.zeros(3), np.array([0, 0, 1.0]), 160, 120, 1.0) for eye in eyes]
    fill, _ = fill_for(ball_of(scene, world), cameras)
    assert (fill.disks[:, 0] > 0.25).mean() < 0.05
    inside = np.hypot(fill.disks[:, 0], fill.disks[:, 1]) < 0.15
    assert inside.sum() > 20, "the hole under the ball is filled"
    unknown = fill_for(ball_of(scene, world))[0]
    assert (unknown.disks[:, 0] > 0.25).mean() > 0.06, "nobody sees the end without photos"
