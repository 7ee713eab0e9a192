"""The forecast of a reconstruction. No time is measured: the clock counts Gaussians and pixels."""

import numpy as np
import pytest
import torch

from lexsplat.captures import InitialPoints, initial_points, load_capture
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor, forecasting
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
