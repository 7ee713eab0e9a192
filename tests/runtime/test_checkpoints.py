"""The training loop and its checkpoints: killed trainings continue bit for bit, invalid states are never saved."""

from __future__ import annotations

import signal

import pytest
import torch

from lexsplat.codebook import CodebookConfig
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import TrainingError
from lexsplat.runtime.training import Checkpoint, run_training


@pytest.fixture(autouse=True)
def ctrl_c_raises():
    """Tests started in the background of a shell inherit an ignored Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Counter:
    """The smallest training: counts."""

    parameter_prefixes = ("parameters/",)
    device, total_steps, rate_factor = torch.device("cpu"), 25, 1.0

    def __init__(self) -> None:
        self.value = torch.zeros(3)

    @property
    def steps_done(self):
        return int(self.value[0])

    @property
    def metrics(self):
        return {"value": float(self.value[0])}

    def step(self):
        self.value += 1

    def find_invalid(self):
        return ""

    def state_dict(self):
        return {"parameters/value": self.value.clone(), "count": torch.tensor(1)}

    def load_state_dict(self, state):
        if "parameters/value" not in state:
            raise ValueError("no value")
        self.value = state["parameters/value"]


def test_a_saved_state_comes_back_exactly(tmp_path):
    first, second = Counter(), Counter()
    first.value = torch.rand(3)
    Checkpoint(tmp_path / "state", "inputs").save(first)
    assert Checkpoint(tmp_path / "state", "inputs").resume(second)
    assert torch.equal(first.value, second.value)


def test_the_loop_sends_events_at_the_start_at_multiples_and_at_the_end():
    events = []
    run_training(Counter(), stage="count", name="counter", every=10, listener=events.append)
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("count", 0, 25),
        ("count", 10, 25),
        ("count", 20, 25),
        ("count", 25, 25),
    ]
    assert [event.metrics for event in events] == [{}, {"value": 10.0}, {"value": 20.0}, {"value": 25.0}]


def test_an_interrupted_loop_continues_where_it_stopped(tmp_path):
    class Interrupted(Counter):
        def step(self):
            super().step()
            if self.steps_done == 7:
                signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_training(
            Interrupted(), stage="s", name="n", every=10, checkpoint=Checkpoint(tmp_path / "state", "inputs")
        )
    counter, steps = Counter(), []
    counter.step = lambda: (steps.append(1), Counter.step(counter))
    run_training(counter, stage="s", name="n", every=10, checkpoint=Checkpoint(tmp_path / "state", "inputs"))
    assert counter.steps_done == 25
    assert len(steps) == 18


def test_ctrl_c_during_the_last_event_is_not_lost(tmp_path):
    def press_at_the_end(event):
        if event.done == event.total:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_training(
            Counter(),
            stage="s",
            name="n",
            every=10,
            checkpoint=Checkpoint(tmp_path / "state", "inputs"),
            listener=press_at_the_end,
        )


def test_the_time_of_earlier_runs_counts(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("lexsplat.runtime.training.time.perf_counter", lambda: now[0])
    path = tmp_path / "state"
    for begun, expected in ((100.0, 0.0), (500.0, 7.0), (900.0, 14.0)):
        now[0] = begun
        checkpoint = Checkpoint(path, "inputs")
        checkpoint.resume(Counter())
        assert checkpoint.seconds_before == expected
        now[0] += 7
        checkpoint.save(Counter())
    assert Checkpoint(path, "other inputs").seconds_before == 0


def test_the_state_of_other_inputs_is_ignored(tmp_path):
    Checkpoint(tmp_path / "state", "inputs").save(Counter())
    assert not Checkpoint(tmp_path / "state", "other inputs").resume(Counter())


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"\xff" * len(b)])
def test_a_damaged_state_is_reported_and_ignored(tmp_path, caplog, damage):
    path = tmp_path / "state"
    Checkpoint(path, "inputs").save(Counter())
    path.write_bytes(damage(path.read_bytes()))
    assert not Checkpoint(path, "inputs").resume(Counter())
    assert str(path) in caplog.text


def test_nan_is_never_saved_and_the_last_good_state_stays(tmp_path):
    checkpoint, trainer = Checkpoint(tmp_path / "state", "inputs"), Counter()
    trainer.value = torch.ones(3)
    checkpoint.save(trainer)
    trainer.value = torch.tensor([1.0, float("nan"), 1.0])
    with pytest.raises(TrainingError, match="parameters/value"):
        checkpoint.save(trainer)
    checkpoint.resume(trainer)
    assert torch.equal(trainer.value, torch.ones(3))


def test_ctrl_c_takes_effect_after_the_step_and_saves(tmp_path):
    checkpoint, trainer = Checkpoint(tmp_path / "state", "inputs", every=1e9), Counter()
    with checkpoint.deferring_interrupts():
        signal.raise_signal(signal.SIGINT)
        trainer.value += 5  # the rest of the step still happens
        with pytest.raises(KeyboardInterrupt):
            checkpoint.after_step(trainer)
    resumed = Counter()
    assert checkpoint.resume(resumed)
    assert torch.equal(resumed.value, torch.full((3,), 5.0))


def test_a_second_ctrl_c_takes_effect_immediately(tmp_path):
    checkpoint = Checkpoint(tmp_path / "state", "inputs")
    with checkpoint.deferring_interrupts():
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_states_are_saved_no_more_often_than_requested(tmp_path):
    checkpoint = Checkpoint(tmp_path / "state", "inputs", every=1e9)
    checkpoint.after_step(Counter())
    assert not checkpoint.path.exists()
    eager = Checkpoint(tmp_path / "eager", "inputs", every=0)
    eager.after_step(Counter())
    assert eager.path.exists()
    eager.remove()
    assert not eager.path.exists()


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["features", "reconstruct"])
def test_one_ctrl_c_stops_a_build_in_any_stage(tiny_capture, tmp_path, stage):
    config = BuildConfig(
        clip="bundled",
        dino="none",
        device="cpu",
        downscale=2.0,
        iterations=40,
        codebook=CodebookConfig(num_codes=4, steps=5),
    )
    later = []

    def press_once(event):
        if later or event.stage == stage:
            later.append(event)
        if len(later) == 1:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        build(tiny_capture, tmp_path / "scene", config, listener=press_once)
    assert {event.stage for event in later} == {stage}, "the build went on after Ctrl-C"
