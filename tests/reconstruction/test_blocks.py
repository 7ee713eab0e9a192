"""Blocks: cut on the ground plane with the views that see them, reconstructed apart, merged by their cells."""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
import torch
from support.tiny_capture import QUICK_BUILD

from lexsplat import cli
from lexsplat.captures import load_capture
from lexsplat.captures.sfm.triangulation import InitialPoints
from lexsplat.geometry.boxes import Up
from lexsplat.geometry.cameras import Camera
from lexsplat.reconstruction import Reconstructor, blocks
from lexsplat.reconstruction.blocks import (
    BlockReconstructor,
    BlockRun,
    cut_blocks,
    ground_axes,
    number_of_blocks,
    reconstruct_blocks,
)
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.runtime.errors import CaptureError, MemoryBudgetError
from lexsplat.runtime.files import read_tensors
from lexsplat.scenes.folder import SceneFolder

UP = Up(np.array([0.0, 0.0, 1.0]), True)
CONFIG = ReconstructionConfig(iterations=30, max_gaussians=600, sh_degree=0)


@pytest.fixture(scope="module")
def capture(tiny_capture):
    return load_capture(tiny_capture)


@pytest.fixture
def points(capture):
    return InitialPoints(capture.points, capture.point_colors, "capture", "")


def street(capture, length: float = 40.0):
    """Views every two meters along x that look sideways, and points on the house fronts three meters away."""
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    some, views = next(iter(capture.views.values())), {}
    K = np.array([[50.0, 0, 48], [0, 50.0, 36], [0, 0, 1]])
    for x in np.arange(0.0, length, 2.0):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.array([x, 0.0, 1.5])
        name = f"{x:04.1f}"
        views[name] = dataclasses.replace(some, name=name, camera=Camera(96, 72, K, pose))
    rng = np.random.default_rng(0)
    places = np.column_stack(
        [rng.uniform(0, length, 4000), rng.uniform(2.9, 3.1, 4000), rng.uniform(0, 3, 4000)]
    )
    return dataclasses.replace(capture, views=views, train_names=tuple(views), test_names=()), places.astype(
        np.float32
    )


@pytest.mark.parametrize("count", [1, 2, 3, 5, 9])
def test_cells_cover_the_plane_once_with_equal_numbers_of_points(count, capture):
    made, places = street(capture)
    axes = ground_axes(UP)
    cut = cut_blocks(made, places, axes, count)
    anywhere = np.random.default_rng(1).normal(0, 100, (500, 2))
    assert (sum(block.holds(anywhere).astype(int) for block in cut) == 1).all(), "also far away"
    numbers = [block.holds(places @ axes.T).sum() for block in cut]
    assert sum(numbers) == 4000
    np.testing.assert_allclose(numbers, 4000 / count, rtol=0.02)


def test_a_block_of_a_street_has_the_views_in_front_of_it_and_few_points_of_the_others(capture):
    made, places = street(capture)
    axes = ground_axes(UP)
    for block in cut_blocks(made, places, axes, 4):
        own = places[block.holds(places @ axes.T)][:, 0]
        near = {name for name in made.views if own.min() <= float(name) <= own.max()}
        assert near <= set(block.windows)
        # A view shows three meters to either side; the margin is 1.5 m.
        assert all(own.min() - 5 < float(name) < own.max() + 5 for name in block.windows)
        assert len(block.inside) < 0.4 * len(places)


def test_blocks_that_no_view_sees_are_refused(capture):
    made, places = street(capture)
    behind = places.copy()
    behind[places[:, 0] > 20, 1] -= 50.0
    with pytest.raises(
        CaptureError, match=r"block \d of 4: expected points, and at least 3 views .*smaller --blocks"
    ):
        cut_blocks(made, behind, ground_axes(UP), 4)


def test_captures_without_a_ground_plane_are_refused():
    with pytest.raises(
        CaptureError, match=r"--blocks: expected a ground plane.*give --up X,Y,Z or --blocks none"
    ):
        ground_axes(dataclasses.replace(UP, reliable=False))


def test_auto_takes_as_few_blocks_as_fit():
    config = ReconstructionConfig(max_gaussians=1_000_000)
    need = 2 * 1_000_000 * 1_700
    assert number_of_blocks("auto", config, "cpu", need) == 1
    assert number_of_blocks("auto", config, "cpu", need - 1) == 4, (
        "a block has three times its share of Gaussians"
    )
    assert number_of_blocks("auto", config, "cpu", need // 4) == 12
    assert number_of_blocks("none", config, "cpu", 1) == 1
    for wrong in ("0", "-1", "2.5", "many", "", "100000"):
        with pytest.raises(ValueError, match="blocks must be auto, none or a number"):
            number_of_blocks(wrong, config, "cpu", need)


def test_merged_gaussians_lie_each_in_the_cell_of_its_block_and_a_second_run_keeps_finished_blocks(
    capture, points, tmp_path, monkeypatch
):
    trained, coarse, events = [], [], []
    train, model = blocks._train_block, Reconstructor.run

    def counted_model(self, *arguments):
        if type(self) is Reconstructor:
            coarse.append(self)
        model(self, *arguments)

    monkeypatch.setattr(Reconstructor, "run", counted_model)

    def counted(shared, block, path):
        trained.append(block)
        found = train(shared, block, path)
        assert block.holds(found.means.numpy() @ shared.axes.T).all()
        return found

    monkeypatch.setattr(blocks, "_train_block", counted)
    run = BlockRun("cpu", 0, 1 << 30, tmp_path, "key", listener=events.append)
    first = reconstruct_blocks(capture, CONFIG, points, UP, 3, run)
    assert len(trained) == 3
    assert [e.done for e in events if e.stage == "blocks"] == [0, 1, 2, 3]
    assert 0 < len(first) <= 2 * CONFIG.max_gaussians
    for path in tmp_path.glob("*.safetensors"):
        if trained[0].holds(read_tensors(path)[0]["means"].numpy() @ ground_axes(UP).T).all():
            path.unlink()
    again = reconstruct_blocks(capture, CONFIG, points, UP, 3, run)
    assert len(trained) == 4
    assert len(coarse) == 1, "the coarse model is kept too"
    assert all(torch.equal(a, b) for a, b in zip(first.tensors().values(), again.tensors().values()))


def test_a_block_that_does_not_fit_is_refused_before_it_starts(capture, points, tmp_path):
    run = BlockRun("cpu", 0, 1 << 20, tmp_path, "key")
    with pytest.raises(
        MemoryBudgetError, match=r"Gaussians of a block, found --memory 1MB; .*larger --blocks"
    ):
        reconstruct_blocks(capture, CONFIG, points, UP, 2, run)


@pytest.mark.slow
def test_build_with_blocks_makes_a_scene_and_repeats_nothing(tiny_capture, tmp_path):
    output = tmp_path / "scene"
    arguments = ["build", str(tiny_capture), "--output", str(output), *QUICK_BUILD, "--blocks", "2"]
    assert cli.main(arguments) == 0
    folder = SceneFolder.open(output)
    assert folder.record["stages"]["reconstruct"]["blocks"] == 2
    assert not (output / "checkpoints" / "blocks").exists()
    before = folder.gaussians_path.stat().st_mtime_ns
    assert cli.main(arguments) == 0
    assert folder.gaussians_path.stat().st_mtime_ns == before


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


@pytest.mark.parametrize(
    ("count", "message"),
    [
        ("200", r"error: block \d+ of 200: expected points, .*; give a smaller --blocks"),
        ("2", r"error: --blocks: expected a ground plane, .*; give --up X,Y,Z or --blocks none"),
    ],
)
def test_a_command_tells_in_one_line_why_it_cannot_cut(count, message, capture, tmp_path, capsys):
    source = capture.root if count == "200" else rolled(capture, tmp_path / "rolled")
    arguments = ["reconstruct", str(source), "--output", str(tmp_path / "scene"), *QUICK_BUILD]
    assert cli.main([*arguments, "--blocks", count]) == 1
    errors = [line for line in capsys.readouterr().err.splitlines() if "error: " in line]
    assert len(errors) == 1
    assert re.fullmatch(message, errors[0])


def test_stray_points_far_away_do_not_widen_a_block(capture):
    made, places = street(capture)
    axes = ground_axes(UP)
    strays = np.array([[900.0, 3.0, 1.0], [-700.0, 3.0, 1.0]], np.float32)
    for block in cut_blocks(made, np.concatenate([places, strays]), axes, 4):
        assert block.margin.max() < 2.0
        assert len(block.windows) < len(made.views) / 2


def test_the_window_of_a_view_shows_the_points_of_the_block_and_leaves_the_rest_out(capture):
    made, places = street(capture)
    areas = []
    for block in cut_blocks(made, places, ground_axes(UP), 4):
        for name, (left, top, right, bottom) in block.windows.items():
            camera = made.views[name].camera
            local = places[block.inside] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
            x, y = local[:, :2].T / local[:, 2] * 50 + [[48], [36]]
            shown = (x >= 0) & (x < 96) & (y >= 0) & (y < 72)
            kept = (x >= 96 * left) & (x < 96 * right) & (y >= 72 * top) & (y < 72 * bottom)
            assert (shown & ~kept).sum() <= 0.03 * shown.sum()
            if block.holds(np.array([[float(name), 0.0, 1.5]]) @ ground_axes(UP).T)[0]:
                assert (left, top, right, bottom) == (0.0, 0.0, 1.0, 1.0), "a view from within"
            else:
                areas.append((right - left) * (bottom - top))
    assert max(areas) < 0.8


def test_gaussians_are_added_in_the_cell_and_its_margin_only(capture, points):
    axes = ground_axes(UP)
    block = cut_blocks(capture, points.points, axes, 2)[0]
    start = dataclasses.replace(points, points=points.points[::9], colors=points.colors[::9])
    coarse = Reconstructor(capture, CONFIG, start).gaussians()
    part = dataclasses.replace(capture, train_names=tuple(block.windows))
    trainer = BlockReconstructor(part, CONFIG, start, coarse, block, axes)
    means = trainer.gaussians().means
    assert torch.equal(means, torch.cat([coarse.means, torch.from_numpy(start.points)])), "coarse and own"
    trainer.step()
    means2d = torch.zeros(len(means), 2)
    means2d.grad = torch.ones(len(means), 2)
    means = trainer.gaussians().means.numpy()
    trainer._control_density(means2d, torch.ones(len(means)), (96, 72))
    ground = means @ axes.T
    inside = np.all((ground >= block.low - block.margin) & (ground < block.high + block.margin), axis=1)
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_array_equal(means2d.grad.all(1).numpy(), inside)


def test_a_view_that_stands_in_a_cell_and_looks_elsewhere_belongs_to_it_as_a_whole(capture):
    made, places = street(capture)
    name = "08.0"
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ made.views[name].camera.viewmat
    view = dataclasses.replace(made.views[name], camera=Camera(96, 72, made.views[name].camera.K, turned))
    made = dataclasses.replace(made, views={**made.views, name: view})
    shown = blocks.places_in_image(view, places)[0]
    assert len(shown) == 0
    cut = cut_blocks(made, places, ground_axes(UP), 4)
    assert [block.windows.get(name) for block in cut].count((0.0, 0.0, 1.0, 1.0)) == 1
