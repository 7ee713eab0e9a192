"""Blocks are cut on the ground plane with the views that see them, and take turns."""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
from support.street import street
from support.tiny_capture import QUICK_BUILD

from lexsplat import cli
from lexsplat.geometry.boxes import Up
from lexsplat.geometry.cameras import look_at
from lexsplat.reconstruction.block_files import plan
from lexsplat.reconstruction.blocks import (
    CELLS_OF_PAIR,
    cut_blocks,
    ground_axes,
    number_of_blocks,
    side_by_side,
)
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.runtime.errors import CaptureError

UP = Up(np.array([0.0, 0.0, 1.0]), True)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 9])
def test_cells_cover_the_plane_once_with_equal_numbers_of_points(count, capture):
    made, places = street(capture)
    axes = ground_axes(UP)
    cells = cut_blocks(made, places, axes, count, deal=False).cells
    anywhere = np.random.default_rng(1).normal(0, 100, (500, 2))
    assert (sum(cell.holds(anywhere).astype(int) for cell in cells) == 1).all(), "also far away"
    numbers = [cell.holds(places @ axes.T).sum() for cell in cells]
    assert sum(numbers) == 4000
    np.testing.assert_allclose(numbers, 4000 / count, rtol=0.02)


def assert_views_and_cells_are_shared_out(cut, made, count: int) -> None:
    assert sorted(name for block in cut.blocks for name in block.views) == sorted(made.views)
    assert max(len(b.views) for b in cut.blocks) - min(len(b.views) for b in cut.blocks) <= 1
    assert sorted(cell for block in cut.blocks for cell in block.owned) == list(range(count))


@pytest.mark.parametrize("count", [2, 3, 6])
def test_each_view_belongs_to_one_block_and_each_cell_is_owned_by_one_that_trains_it(count, capture):
    made, places = street(capture)
    cut = cut_blocks(made, places, ground_axes(UP), count, deal=False)
    assert_views_and_cells_are_shared_out(cut, made, count)
    assert all(set(block.owned) <= set(block.trained) for block in cut.blocks)


def test_a_block_of_a_street_trains_the_cells_in_front_of_its_views(capture):
    made, places = street(capture)
    axes = ground_axes(UP)
    cut = cut_blocks(made, places, axes, 6, deal=False)
    for block in cut.blocks:
        stands = np.array([float(name) for name in block.views])
        for cell in block.trained:
            own = places[cut.cells[cell].holds(places @ axes.T)][:, 0]
            # A view shows three meters to either side.
            assert own.max() > stands.min() - 3
            assert own.min() < stands.max() + 3
        assert 1 <= len(block.trained) <= 3
        assert not set(block.trained) & set(block.shown)
        assert len(block.trained) + len(block.shown) < 6, "cells that no view shows take no part"


def around(capture):
    """Views on a circle that look at a table in its middle, and points on the table."""
    some, views = next(iter(capture.views.values())), {}
    for number, angle in enumerate(np.linspace(0, 2 * np.pi, 40, endpoint=False)):
        place = np.array([6 * np.cos(angle), 6 * np.sin(angle), 4.0])
        name = f"{number:02}"
        camera = look_at(place, np.zeros(3), UP.direction, 96, 72, 1.0)
        views[name] = dataclasses.replace(some, name=name, camera=camera)
    places = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, 0.3], (3000, 3)).astype(np.float32)
    return dataclasses.replace(capture, views=views, train_names=tuple(views), test_names=()), places


@pytest.mark.parametrize("count", [3, 6])
def test_blocks_around_a_table_have_views_from_all_sides_and_train_all_cells(count, capture):
    made, places = around(capture)
    cut = cut_blocks(made, places, ground_axes(UP), count, deal=True)
    assert_views_and_cells_are_shared_out(cut, made, count)
    for block in cut.blocks:
        assert block.dealt
        assert block.trained == tuple(range(count))
        stands = np.array([made.views[name].camera.position[:2] for name in block.views])
        assert np.linalg.norm(stands.mean(0)) < 3.5, "those of one side have a mean about 5.7 from the middle"
    assert cut.pairs(0) == [(number,) for number in range(count)]
    apart = cut_blocks(made, places, ground_axes(UP), count, deal=False)
    assert not any(block.dealt for block in apart.blocks), "the memory does not hold all Gaussians"


def test_blocks_of_a_street_are_the_same_whether_views_may_be_dealt_or_not(capture):
    made, places = street(capture)
    for count in (2, 3, 6):
        either = [
            cut_blocks(made, places, ground_axes(UP), count, deal=deal).blocks for deal in (False, True)
        ]
        assert either[0] == either[1]


def test_blocks_that_are_trained_side_by_side_have_no_cell_in_common(capture):
    made, places = street(capture)
    cut = cut_blocks(made, places, ground_axes(UP), 6, deal=False)
    groups = side_by_side(cut.blocks)
    assert len(groups) < 6
    assert sorted(index for group in groups for index in group) == list(range(6))
    for group in groups:
        cells = [cell for index in group for cell in cut.blocks[index].trained]
        assert len(cells) == len(set(cells))


def test_blocks_are_paired_with_each_neighbor_in_turn(capture):
    made, places = street(capture)
    cut = cut_blocks(made, places, ground_axes(UP), 6, deal=False)
    partners: dict[int, set[int]] = {number: set() for number in range(6)}
    for turn in range(20):
        pairs = cut.pairs(turn)
        assert sorted(number for pair in pairs for number in pair) == list(range(6))
        for pair in pairs:
            block = cut.joined(pair)
            assert sorted(block.views) == sorted(name for n in pair for name in cut.blocks[n].views)
            assert set(block.owned) <= set(block.trained) == {c for n in pair for c in cut.blocks[n].trained}
            assert not set(block.trained) & set(block.shown)
            assert len(block.trained) <= CELLS_OF_PAIR
            for number in pair:
                partners[number] |= set(pair) - {number}
    assert all(others for others in partners.values())
    assert max(len(others) for others in partners.values()) > 1


@pytest.mark.parametrize("pairs", [False, True])
@pytest.mark.parametrize(("iterations", "rounds"), [(100, 4), (101, 7), (5, 3)])
def test_visits_have_all_steps_of_the_training_once_and_each_block_its_share(
    iterations, rounds, pairs, capture
):
    made, places = street(capture)
    cut = cut_blocks(made, places, ground_axes(UP), 3, deal=False)
    visits = [visit for group in plan(cut, iterations, rounds, pairs=pairs) for visit in group]
    assert [visit.start for visit in visits] == [0, *(visit.end for visit in visits[:-1])]
    assert visits[-1].end == iterations
    assert len(visits) == (2 if pairs else 3) * rounds
    for visit in visits:
        assert len(visit.views(0)) == visit.end - visit.start == sum(steps for _, _, steps in visit.parts)
    for block in cut.blocks:
        own = [part for visit in visits for part in visit.parts if part[0] is block]
        steps = np.cumsum([0, *(steps for _, _, steps in own)])
        assert [first for _, first, _ in own] == steps[:-1].tolist()
        assert abs(steps[-1] - iterations * len(block.views) / len(made.views)) <= 1


def test_every_view_is_used_equally_often(capture):
    made, places = street(capture)
    cut = cut_blocks(made, places, ground_axes(UP), 3, deal=False)
    visits = [visit for group in plan(cut, 5 * len(made.views), 4) for visit in group]
    names = [name for visit in visits for name in visit.views(0)]
    assert sorted(names) == sorted(5 * list(made.views))


def test_blocks_that_no_view_sees_are_refused(capture):
    made, places = street(capture)
    behind = places.copy()
    behind[places[:, 0] > 20, 1] -= 50.0
    with pytest.raises(
        CaptureError, match=r"block \d of 4: expected points, and at least 3 views .*smaller --blocks"
    ):
        cut_blocks(made, behind, ground_axes(UP), 4, deal=False)


def test_captures_without_a_ground_plane_are_refused():
    with pytest.raises(
        CaptureError, match=r"--blocks: expected a ground plane.*give --up X,Y,Z or --blocks none"
    ):
        ground_axes(dataclasses.replace(UP, reliable=False))


def test_auto_takes_as_few_blocks_as_fit():
    config = ReconstructionConfig(max_gaussians=1_000_000)
    need = 2 * 1_000_000 * 1_700
    assert number_of_blocks("auto", config, "cpu", need) == 1
    assert number_of_blocks("auto", config, "cpu", need - 1) == 7, "two blocks train up to six cells"
    assert number_of_blocks("auto", config, "cpu", need // 4) == 24
    assert number_of_blocks("none", config, "cpu", 1) == 1
    for wrong in ("0", "-1", "2.5", "many", "", "100000"):
        with pytest.raises(ValueError, match="blocks must be auto, none or a number"):
            number_of_blocks(wrong, config, "cpu", need)


def rolled(capture, folder):
    """The photos with cameras that are turned about their viewing axes, so that no direction is up."""
    turn = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    frames = []
    for number, view in enumerate(capture.views.values()):
        pose = np.linalg.inv(np.linalg.matrix_power(turn, number % 4) @ view.camera.viewmat)
        matrix = (pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": matrix})
    shutil.copytree(capture.root / "images", folder / "images")
    (folder / "transforms.json").write_text(json.dumps({"w": 96, "h": 72, "fl_x": 105.6, "frames": frames}))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "message"),
    [
        (
            "200",
            r"error: 200 blocks: expected at least 400 training views, found \d+; give at most --blocks \d+; "
            r"--blocks auto takes fewer with more --memory",
        ),
        ("2", r"error: --blocks: expected a ground plane, .*; give --up X,Y,Z or --blocks none"),
    ],
)
def test_a_command_reports_in_one_line_why_it_cannot_cut(count, message, capture, tmp_path, capsys):
    source = capture.root if count == "200" else rolled(capture, tmp_path / "rolled")
    arguments = ["reconstruct", str(source), "--output", str(tmp_path / "scene"), *QUICK_BUILD]
    assert cli.main([*arguments, "--blocks", count]) == 1
    errors = [line for line in capsys.readouterr().err.splitlines() if "error: " in line]
    assert len(errors) == 1
    assert re.fullmatch(message, errors[0])


def test_stray_points_far_away_do_not_change_what_a_block_trains(capture):
    made, places = street(capture)
    axes = ground_axes(UP)
    strays = np.array([[900.0, 3.0, 1.0], [-700.0, 3.0, 1.0]], np.float32)
    before, after = (
        cut_blocks(made, each, axes, 4, deal=False).blocks
        for each in (places, np.concatenate([places, strays]))
    )
    assert [(block.trained, block.owned) for block in before] == [(b.trained, b.owned) for b in after]
