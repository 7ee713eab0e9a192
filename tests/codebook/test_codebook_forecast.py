"""The forecast of a codebook. No time is measured: the clock counts views, features and steps."""

import pytest
import torch

from lexsplat.codebook import Codebook, CodebookConfig, forecasting
from lexsplat.features import FeatureMap

VIEWS, CELLS = 40, 30
READ, CLUSTERED, STEP, ASSIGNED = 2.0, 0.01, 0.5, 3.0
"""Seconds for reading a view, clustering a feature, a step, and the index map of a view that is read."""


@pytest.fixture
def timed_maps(monkeypatch):
    """Feature maps whose use moves the clock."""
    clock, generator = [0.0], torch.Generator().manual_seed(0)

    class Maps(dict):
        def __getitem__(self, name):
            clock[0] += READ
            return super().__getitem__(name)

    def slow(place, name, seconds):
        work = getattr(place, name)

        def wrapped(*inputs, **options):
            clock[0] += seconds(*inputs)
            return work(*inputs, **options)

        monkeypatch.setattr(place, name, wrapped)

    slow(forecasting, "spherical_kmeans", lambda clip, *_: CLUSTERED * len(clip))
    slow(forecasting, "refine", lambda clip, dino, codes, code_dino, config, *_: STEP * config.steps)
    slow(Codebook, "assign", lambda *_: ASSIGNED - READ)
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    return Maps({
        f"view {number}": FeatureMap(torch.randn(1, CELLS, 8, generator=generator)) for number in range(VIEWS)
    })  # fmt: skip


@pytest.mark.parametrize("kmeans", [True, False])
def test_the_forecast_is_the_sum_over_views_features_and_steps(timed_maps, kmeans):
    config = CodebookConfig(
        num_codes=4, use_dino=False, steps=100, sample_size=VIEWS * 10, init="kmeans" if kmeans else "uniform"
    )
    clustering = CLUSTERED * VIEWS * 10 if kmeans else 0.0
    expected = (READ + ASSIGNED) * VIEWS + clustering + STEP * 100
    assert forecasting.forecast(timed_maps, list(timed_maps), config) == pytest.approx(expected)


def test_a_step_of_the_forecast_has_a_whole_batch(timed_maps, monkeypatch):
    sizes, refine = [], forecasting.refine
    monkeypatch.setattr(
        forecasting, "refine", lambda clip, *rest: sizes.append(len(clip)) or refine(clip, *rest)
    )
    for batch in (64, 4096):
        config = CodebookConfig(num_codes=4, use_dino=False, batch_size=batch, sample_size=VIEWS * 10)
        forecasting.forecast(timed_maps, list(timed_maps), config)
    assert sizes == [64, VIEWS * 10], "all features of the sample are fewer than the batch"


def test_features_that_the_fit_refuses_are_told_nothing_of(timed_maps, caplog):
    for found in timed_maps.values():
        found.clip.zero_()
    forecasting.tell_codebook(timed_maps, list(timed_maps), CodebookConfig(num_codes=4, use_dino=False))
    assert caplog.messages == []
