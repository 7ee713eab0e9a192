"""Blocks are reconstructed apart, each beside what surrounds it, and merged by their cells."""

import dataclasses

import numpy as np
import pytest
import torch
from support.blind_workers import BlindWorkers
from support.street import street
from support.tiny_capture import QUICK_BUILD

from lexsplat import cli
from lexsplat.captures.sfm.triangulation import InitialPoints
from lexsplat.geometry.boxes import Up
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.reconstruction import Reconstructor, block_training, block_visits, surroundings
from lexsplat.reconstruction.block_files import BETAS, CellState, idle, plan
from lexsplat.reconstruction.block_training import BlockRun, reconstruct_blocks
from lexsplat.reconstruction.block_visits import VisitReconstructor
from lexsplat.reconstruction.blocks import cut_blocks, ground_axes
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.reconstruction.surroundings import Surroundings, shares_in_images
from lexsplat.reconstruction.surroundings_kernels import largest_shares
from lexsplat.runtime.errors import MemoryBudgetError, WorkersError
from lexsplat.runtime.workers import open_workers
from lexsplat.scenes.folder import SceneFolder

UP = Up(np.array([0.0, 0.0, 1.0]), True)
CONFIG = ReconstructionConfig(iterations=30, max_gaussians=600, sh_degree=0)


@pytest.fixture
def points(capture) -> InitialPoints:
    return InitialPoints(capture.points, capture.point_colors, "capture", "")


def test_idle_steps_are_those_of_adam_without_gradients():
    generator = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        *(
            torch.rand(size, generator=generator)
            for size in ((5, 3), (5, 4), (5, 3), (5,), (5, 1, 3), (5, 0, 3))
        )
    )
    parameter = torch.nn.Parameter(gaussians.means.clone())
    optimizer = torch.optim.Adam([parameter], lr=0.01, betas=BETAS, eps=1e-15)
    for _ in range(200):
        parameter.grad = torch.randn(5, 3, generator=generator)
        optimizer.step()
    state = CellState.untrained(gaussians)
    state.parameters["means"] = parameter.detach().clone()
    for name, tensor in optimizer.state[parameter].items():
        state.moments[f"{name}/means"] = tensor.clone()
    idle(state, "means", 0.01, 30, 200)
    for _ in range(30):
        parameter.grad = torch.zeros(5, 3)
        optimizer.step()
    torch.testing.assert_close(state.parameters["means"], parameter.detach(), rtol=0, atol=5e-4)
    torch.testing.assert_close(state.moments["exp_avg_sq/means"], optimizer.state[parameter]["exp_avg_sq"])


def test_gaussians_that_reach_into_an_image_have_a_size_in_it(capture):
    made, _ = street(capture)
    camera = made.views["08.0"].camera
    places = np.random.default_rng(0).uniform((-10, -6, -5), (30, 9, 8), (500, 3)).astype(np.float32)
    local = places @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    surface = np.random.default_rng(1).normal(size=(2000, 3))
    surface /= np.linalg.norm(surface, axis=1, keepdims=True)
    radius = 0.7
    extents = np.column_stack([places, np.full((500, 2), radius / 3)]).astype(np.float32)
    found = shares_in_images([camera], extents)[0] > 0
    assert 0 < found.sum() < 400
    for center in local[~found]:
        x, y, z = (center + radius * surface).T
        shown = (z > 0) & (abs(50 * x / z) < 48) & (abs(50 * y / z) < 36)
        assert not shown.any()


def test_a_visit_with_all_views_takes_the_steps_of_one_piece(capture, points, monkeypatch):
    monkeypatch.setattr(block_visits, "BETAS", (0.9, 0.999))  # those of one piece
    whole = Reconstructor(capture, dataclasses.replace(CONFIG, warm_up=0.0, cool_down=0.0), points)
    cut = cut_blocks(capture, points.points, ground_axes(UP), 1, deal=False)
    (visit,) = (visit for group in plan(cut, CONFIG.iterations, 1) for visit in group)
    config, start = whole.config, CellState.untrained(whole.gaussians().map(torch.clone))
    trainer = VisitReconstructor(capture, config, visit, start, None, 0)
    for _ in range(8):
        order = trainer._next_view()
        whole._next_view = lambda order=order: order
        whole.step()
        trainer.step()
    for name, tensor in whole.gaussians().tensors().items():
        assert torch.equal(tensor, trainer.gaussians().tensors()[name])


def test_blocks_keep_the_rates_of_a_training_without_a_cool_down(capture, points, tmp_path, monkeypatch):
    class Begun(Exception):
        pass

    def stop(files, blocks, config, *rest):
        assert config.scale_of_rates == pytest.approx(
            dataclasses.replace(CONFIG, cool_down=0.0).scale_of_rates
        )
        assert config.scale_of_rates < CONFIG.scale_of_rates
        raise Begun

    monkeypatch.setattr(block_training, "_write_start", stop)
    with pytest.raises(Begun):
        reconstruct_blocks(capture, CONFIG, points, UP, 2, BlockRun("cpu", 0, 1 << 30, tmp_path, "key"))


def test_gaussians_of_other_cells_are_drawn_and_stay_as_they_are(capture, points, monkeypatch):
    monkeypatch.setattr(surroundings, "SMALL", 1e-3)  # none is thinned
    cut = cut_blocks(capture, points.points, ground_axes(UP), 1, deal=False)
    (visit,) = (visit for group in plan(cut, CONFIG.iterations, 1) for visit in group)
    gaussians = Reconstructor(capture, CONFIG, points).gaussians().map(torch.clone)
    half = len(gaussians) // 2
    own, fixed = gaussians.select(slice(0, half)), gaussians.select(slice(half, None))
    around = Surroundings(fixed, surroundings.extents_of(fixed), np.zeros(len(fixed), np.float32))
    trainer = VisitReconstructor(capture, CONFIG, visit, CellState.untrained(own), around, 0)
    camera = capture.train_views[0].camera
    drawn = trainer._render(trainer._as_gaussians(), camera).image
    torch.testing.assert_close(drawn, Reconstructor(capture, CONFIG, points)._render(gaussians, camera).image)
    before = fixed.means.clone()
    trainer.step()
    assert torch.equal(trainer._around.gaussians.means, before)
    assert len(trainer.gaussians()) == half


def cloud(places, deviation: float) -> Gaussians:
    """Round Gaussians of one size."""
    count = len(places)
    return Gaussians(
        torch.from_numpy(places).float(),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), float(np.log(deviation))),
        torch.zeros(count),
        torch.zeros(count, 1, 3),
        torch.zeros(count, 0, 3),
    )


def test_small_gaussians_of_other_cells_are_thinned_and_keep_their_area(capture):
    made, _ = street(capture)
    rng = np.random.default_rng(0)
    count = 4000
    places = np.column_stack([rng.uniform(6, 10, count), rng.uniform(8, 12, count), rng.uniform(1, 2, count)])
    gaussians = cloud(places, 0.1)  # half a pixel at a distance of ten meters
    camera = made.views["08.0"].camera
    found = Surroundings.seen([gaussians], [camera], rng).in_image(camera)
    assert count / 40 < len(found) < count / 8
    areas = [float(each.scales[:, :2].prod(1).sum()) for each in (gaussians, found)]
    assert areas[1] == pytest.approx(areas[0], rel=0.15)
    large = cloud(places, 1.0)
    same = Surroundings.seen([large], [camera], rng).in_image(camera)
    assert all(torch.equal(a, b) for a, b in zip(large.tensors().values(), same.tensors().values()))
    behind = cloud(places - [0.0, 30.0, 0.0], 0.1)
    assert len(Surroundings.seen([behind], [camera], rng)) == 0


def test_gaussians_are_thinned_by_the_image_and_not_by_the_nearest_view_of_the_visit(capture):
    made, _ = street(capture)
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(6, 10, 4000), rng.uniform(1, 12, 4000), rng.uniform(1, 2, 4000)])
    near = made.views["08.0"].camera
    pose = near.viewmat.copy()
    pose[2, 3] += 40.0
    far = dataclasses.replace(near, viewmat=pose)
    both = Surroundings.seen([cloud(places, 0.1), cloud(places + 0.01, 0.1)], [near, far], rng)
    alone, other = len(both.in_image(near)), len(both.in_image(far))
    assert 0 < 20 * other < alone, "a view from afar shows few of those that the near one shows"
    assert alone <= len(both) <= alone + other
    # The same by hand: the share of a Gaussian is its area over that of one of SMALL pixels.
    expected = (50 * 0.1 / (places[:, 1] + 40.0) / surroundings.SMALL) ** 2
    extents = np.column_stack([places, np.full((4000, 2), 0.1)]).astype(np.float32)
    shares = shares_in_images([near, far], extents)
    np.testing.assert_allclose(shares[1], expected, rtol=1e-3)
    images = surroundings._images([near, far])
    assert np.array_equal(largest_shares(images, extents, surroundings.SMALL), shares.max(0))


@pytest.mark.parametrize(("steps", "kept"), [(20, False), (60, True)])
def test_a_visit_keeps_photos_in_memory_only_if_it_takes_them_often(capture, points, steps, kept):
    cut = cut_blocks(capture, points.points, ground_axes(UP), 1, deal=False)
    assert len(cut.blocks[0].views) in range(8, 20)
    (visit,) = (visit for group in plan(cut, steps, 1) for visit in group)
    start = CellState.untrained(Reconstructor(capture, CONFIG, points).gaussians().map(torch.clone))
    config = dataclasses.replace(CONFIG, iterations=steps)
    trainer = VisitReconstructor(capture, config, visit, start, None, 0)
    trainer.step()
    assert (trainer._images.cached_bytes > 0) == kept


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on_after_the_last_finished_visit_with_the_same_result(
    capture, points, tmp_path, monkeypatch
):
    config = dataclasses.replace(CONFIG, iterations=36, densify_min_every=2, densify_every=2)
    visit, events = block_training._visit, []

    def killed(left):
        def some(shared, item):
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return visit(shared, item)

        return some

    run = BlockRun("cpu", 0, 1 << 30, tmp_path / "whole", "key", listener=events.append)
    whole = reconstruct_blocks(capture, config, points, UP, 3, run)
    done = [event.done for event in events if event.stage == "blocks"]
    assert done == list(range(len(done)))
    assert done[-1] == events[-1].total > 4
    assert 0 < len(whole) <= config.max_gaussians
    run = dataclasses.replace(run, folder=tmp_path / "killed")
    events.clear()
    for _ in range(len(done)):
        monkeypatch.setattr(block_training, "_visit", killed([2]))
        try:
            again = reconstruct_blocks(capture, config, points, UP, 3, run)
            break
        except KeyboardInterrupt:
            continue
    numbers = [event.done for event in events if event.stage == "blocks"]
    assert numbers == sorted(numbers), "a run that goes on counts what is finished"
    assert all(torch.equal(a, b) for a, b in zip(whole.tensors().values(), again.tensors().values()))
    assert len(list((tmp_path / "killed").glob("*.safetensors"))) <= 4, (
        "files that no state needs are deleted"
    )


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_density_control_adds_gaussians_and_keeps_the_cap(strategy, capture, points, tmp_path):
    config = dataclasses.replace(
        CONFIG, strategy=strategy, exposure=True, iterations=48, densify_min_every=2, densify_every=2
    )
    config = dataclasses.replace(config, grow_gradient=1e-9)
    few = dataclasses.replace(points, points=points.points[::2], colors=points.colors[::2])
    config = dataclasses.replace(config, max_gaussians=len(few.points) + 40)
    run = BlockRun("cpu", 0, 1 << 30, tmp_path, "key")
    found = reconstruct_blocks(capture, config, few, UP, 2, run)
    assert len(few.points) < len(found) <= config.max_gaussians


def test_a_worker_that_does_not_see_the_folder_is_refused_in_one_line(capture, points, tmp_path, monkeypatch):
    monkeypatch.setattr(block_training.SharedFolder, "is_visible", False)
    run = BlockRun("cpu", 0, 1 << 30, tmp_path, "key")
    with pytest.raises(WorkersError, match=r"a folder that every worker sees.*mounts at the same path"):
        reconstruct_blocks(capture, CONFIG, points, UP, 2, run)


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


@pytest.mark.slow
def test_blocks_on_ray_have_the_bits_of_one_process(capture, points, tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="needs Ray: pip install 'lexsplat[cluster]'")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    config = dataclasses.replace(CONFIG, iterations=36, densify_min_every=2, densify_every=2)
    run = BlockRun("cpu", 0, 256 << 20, tmp_path / "here", "key")
    here = reconstruct_blocks(capture, config, points, UP, 2, run)
    with open_workers("ray", (capture.root,)) as workers:
        run = dataclasses.replace(run, folder=tmp_path / "ray", workers=workers)
        there = reconstruct_blocks(capture, config, points, UP, 2, run)
    assert all(torch.equal(a, b) for a, b in zip(here.tensors().values(), there.tensors().values()))


@pytest.mark.slow
def test_blocks_of_workers_that_do_not_see_the_scene_folder_have_the_bits_of_one_process(
    capture, points, tmp_path
):
    config = dataclasses.replace(CONFIG, iterations=36, densify_min_every=2, densify_every=2)
    run = BlockRun("cpu", 0, 256 << 20, tmp_path / "here", "key")
    here = reconstruct_blocks(capture, config, points, UP, 2, run)
    workers = BlindWorkers(tmp_path / "unseen")
    run = dataclasses.replace(run, folder=tmp_path / "unseen", workers=workers)
    there = reconstruct_blocks(capture, config, points, UP, 2, run)
    assert workers.tasks > 2
    assert all(torch.equal(a, b) for a, b in zip(here.tensors().values(), there.tensors().values()))
