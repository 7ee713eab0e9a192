"""A reconstruction on several GPUs: on one pretended GPU it is the usual one; its parts share points and views.

What gsplat exchanges between processes has not been tried: that needs two GPUs.
"""

import dataclasses

import pytest
import torch
from torch import distributed

from lexsplat.captures import Capture, load_capture
from lexsplat.captures.sfm.triangulation import InitialPoints
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor, several_gpus
from lexsplat.reconstruction.several_gpus import PartReconstructor
from lexsplat.runtime.errors import TrainingError

CONFIG = ReconstructionConfig(
    iterations=12, max_gaussians=230, sh_degree=1, densify_every=12_000, densify_min_every=1
)


@pytest.fixture(scope="module")
def capture(tiny_capture) -> Capture:
    return load_capture(tiny_capture).downscaled(2.0)


@pytest.fixture(scope="module")
def points(capture) -> InitialPoints:
    return InitialPoints(capture.points[::5], capture.point_colors[::5], "capture", "")


@pytest.fixture
def group(tmp_path):
    distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/group", rank=0, world_size=1)
    yield
    distributed.destroy_process_group()


@pytest.fixture
def three_ranks(monkeypatch):
    def become(rank):
        monkeypatch.setattr(several_gpus.distributed, "get_rank", lambda: rank)
        monkeypatch.setattr(several_gpus.distributed, "get_world_size", lambda: 3)

    return become


@pytest.mark.slow
def test_one_process_trains_what_the_usual_trainer_trains(pretended_gpu, group, capture, points):
    usual = Reconstructor(capture, CONFIG, points, device="cuda", seed=3)
    part = PartReconstructor(capture, CONFIG, points, device="cuda", seed=3)
    for _ in range(CONFIG.iterations):
        assert part.step() == pytest.approx(usual.step(), rel=1e-4)
        assert part.last_view == usual.last_view
    found, expected = part.gaussians().to("cpu").tensors(), usual.gaussians().to("cpu").tensors()
    assert len(found["means"]) > len(points.points), "density control has added Gaussians"
    for name, tensor in expected.items():
        torch.testing.assert_close(found[name], tensor, rtol=1e-3, atol=1e-4)


def test_three_parts_have_each_point_once_and_each_view_once_a_round(three_ranks, capture, points):
    parts = []
    for rank in range(3):
        three_ranks(rank)
        parts.append(PartReconstructor(capture, CONFIG, points, device="cpu", seed=3))
    assert sum(len(part.gaussians()) for part in parts) == len(points.points)
    means = torch.cat([part.gaussians().means for part in parts])
    assert set(map(tuple, means.tolist())) == set(map(tuple, points.points.tolist()))
    assert {part.total_steps for part in parts} == {4}
    seen = []
    views = len(capture.train_names)
    for step in range(views // 3):
        for part in parts:
            part.steps_done = step
            seen.append(part._next_view())
    assert views % 3 == 0
    assert sorted(seen) == list(range(views))


def test_photos_of_several_sizes_and_too_many_processes_are_refused(three_ranks, capture, points):
    three_ranks(0)
    first, *rest = capture.views.values()
    views = {first.name: dataclasses.replace(first, camera=first.camera.downscaled(2.0))}
    mixed = dataclasses.replace(capture, views=views | {view.name: view for view in rest})
    with pytest.raises(TrainingError, match="expected photos of one size, found 2 sizes; crop or scale"):
        PartReconstructor(mixed, CONFIG, points, device="cpu")
    two = dataclasses.replace(capture, train_names=capture.train_names[:2])
    with pytest.raises(TrainingError, match="expected at least 3 training views, found 2; start fewer"):
        PartReconstructor(two, CONFIG, points, device="cpu")


def test_without_torchrun_the_remedy_is_reported_in_one_line(monkeypatch, tmp_path):
    from lexsplat.pipeline import several_gpus

    for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.argv", ["several_gpus", str(tmp_path), "--output", str(tmp_path / "g.ply")])
    with pytest.raises(
        SystemExit, match=r"error: several GPUs: expected processes started by torchrun, .*torchrun --nproc"
    ):
        several_gpus.main()
