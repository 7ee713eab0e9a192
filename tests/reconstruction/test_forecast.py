"""The forecast of a reconstruction. No time is measured: the clock counts Gaussians and pixels."""

import numpy as np
import pytest
import torch

from lexsplat.captures import InitialPoints, initial_points, load_capture
from lexsplat.geometry.boxes import Up
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor, forecasting
from lexsplat.reconstruction.blocks import cut_blocks, ground_axes
from lexsplat.runtime.errors import TrainingError
from lexsplat.runtime.progress import NOTE

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.slow
def test_the_forecast_is_the_sum_over_the_steps_and_leaves_the_training_alone(tiny_capture, monkeypatch):
    capture = load_capture(tiny_capture)
    points = initial_points(capture, memory=1 << 30)
    config = ReconstructionConfig(iterations=1000, max_gaussians=2 * len(points.points))
    clock, step = [0.0], Reconstructor.step

    def timed(self):
        loss = step(self)
        size = self._training_images().camera(self.last_view)
        clock[0] += 1e-6 * size.width * size.height + 1e-3 * len(self._parameters["means"])
        return loss

    monkeypatch.setattr(Reconstructor, "step", timed)
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    state = torch.get_rng_state()
    events = []
    found = forecasting.forecast(capture, config, points, memory=1 << 30, listener=events.append)
    done = [event.done for event in events]
    assert done == sorted(done)
    assert (done[0], done[-1], events[0].total) == (0, 112, 112)
    assert torch.equal(torch.get_rng_state(), state)
    view = capture.train_views[0].camera
    counts = forecasting._counts(config, len(points.points), config.cap(torch.device("cpu")))
    shrunk = 1000 * 0.3 * (view.downscaled(2.0).width * view.downscaled(2.0).height)
    pixels = shrunk + 1000 * 0.7 * view.width * view.height
    assert found == pytest.approx(1e-6 * pixels + 1e-3 * counts.sum(), rel=0.01)


def test_the_number_of_gaussians_grows_by_rounds_up_to_the_limit():
    counts = forecasting._counts(ReconstructionConfig(iterations=3000), 4000, 40_000)
    assert counts[0] == counts[49] == 4000
    assert counts[-1] == 40_000
    assert (counts[1:] >= counts[:-1]).all()
    assert forecasting._counts(ReconstructionConfig(iterations=100), 50_000, 40_000).max() == 40_000


def test_what_is_trained_beside_a_reconstruction_counts(monkeypatch, caplog):
    clock, device = [0.0], torch.device("cpu")
    points = InitialPoints(np.random.default_rng(0).random((60, 3)), np.ones((60, 3)), "capture", "")

    class Beside:
        """A step of both takes three seconds, the first ones of each trainer longer."""

        def __init__(self, reconstructor):
            assert reconstructor is made[-1]
            self.device, self.steps = device, 0

        def step(self):
            self.steps += 1
            clock[0] += 100.0 if self.steps <= forecasting._FIRST else 3.0

    made = []
    monkeypatch.setattr(forecasting, "Reconstructor", lambda *_, **__: made.append(object()) or made[-1])
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    for iterations in (999, 1000):
        config = ReconstructionConfig(iterations=iterations)
        with caplog.at_level(NOTE, "lexsplat"):
            forecasting.tell_time(None, config, points, memory=1 << 30, joined=Beside)
    assert caplog.messages == ["reconstruct: about 50:00 min for 1,000 iterations"]


def test_a_calibration_that_diverges_ends_no_build_and_leaves_no_bar(monkeypatch, caplog):
    def diverge(*_):
        raise TrainingError("reconstruct", expected="finite losses", found="nan")

    monkeypatch.setattr(forecasting, "Reconstructor", lambda *_, **__: None)
    monkeypatch.setattr(forecasting, "time_steps", diverge)
    points, events = InitialPoints(np.eye(6, 3), np.ones((6, 3)), "capture", ""), []
    with caplog.at_level(NOTE, "lexsplat"):
        forecasting.tell_time(None, ReconstructionConfig(), points, memory=1, listener=events.append)
    assert caplog.messages == []
    assert events[-1].done == events[-1].total > 0


def test_the_forecast_of_blocks_is_that_of_the_views_and_cells_of_one(tiny_capture, monkeypatch, caplog):
    capture = load_capture(tiny_capture)
    points = InitialPoints(capture.points, capture.point_colors, "capture", "")
    axes = ground_axes(Up(np.array([0.0, 0.0, 1.0]), True))
    blocks = cut_blocks(capture, points.points, axes, 2, deal=False)
    homes = blocks.cells_of(points.points)
    asked = []

    def timed(part, settings, some, *, counts, **options):
        asked.append((part.train_names, settings.max_gaussians, some.points, counts, options))
        return 10.0

    monkeypatch.setattr(forecasting, "forecast", timed)
    for iterations in (999, 1000):
        config = ReconstructionConfig(iterations=iterations, max_gaussians=4 * len(homes))
        with caplog.at_level(NOTE, "lexsplat"):
            forecasting.tell_time_of_blocks(capture, config, points, blocks, 100, device="cpu", memory=1)
    assert caplog.messages == ["blocks: about 0:12 min for 1,000 iterations"], "a fifth more than its steps"
    ((names, cap, some, counts, options),) = asked
    (block,) = (block for block in blocks.blocks if block.views == names)
    mine = np.isin(homes, block.trained)
    np.testing.assert_array_equal(some, points.points[mine])
    assert cap == 4 * mine.sum()
    assert options == {"device": "cpu", "memory": 1}
    rounds = (0, 1, 4, 5, 5)  # one of density control in each hundred steps, in the first half of them
    np.testing.assert_allclose(
        counts[[99, 100, 499, 500, 999]], [min(cap, mine.sum() * 1.32**number) for number in rounds]
    )
