"""Claims about the views that method "averaged" reads; references are loops by definition and hand-made scenes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.blind_workers import BlindWorkers
from support.language_scene import LanguageScene, make_scene
from torch.nn.functional import normalize

from lexsplat.features import FeatureMap
from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.language.methods import FitRun, TrainingViews
from lexsplat.language.methods import sightings as sightings_module
from lexsplat.language.methods.averaged import Averaged, AveragedConfig
from lexsplat.language.methods.sightings import ENOUGH, ENOUGH_ONCE, covering, views_that_show
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.progress import Event

pytestmark = pytest.mark.usefixtures("one_thread")


class View:
    """A view without a photo; ``valid`` are the pixels that count."""

    def __init__(self, camera, valid=None):
        self.camera, self.valid = camera, valid

    def valid_share(self, size):
        return None if self.valid is None else np.full(size[::-1], self.valid, np.float32)

    def load_valid(self, size):
        return None if self.valid is None else np.full(size[::-1], self.valid > 0.999)


@pytest.fixture(scope="module")
def ring() -> LanguageScene:
    return make_scene(per_ball=30, views=12)


def looking_at(center, azimuths, distance=4.0):
    eyes = [center + distance * np.array([np.cos(a), np.sin(a), 0.4]) for a in azimuths]
    return [View(look_at(eye, center, np.array([0, 0, 1.0]), 64, 48, 0.6)) for eye in eyes]


@pytest.fixture(scope="module")
def two_places():
    """Two heaps of 200 Gaussians far apart; eight views show the first, one the second."""
    heap = np.random.default_rng(0).normal(0, 0.3, (200, 3))
    centers = np.array([[0.0, 0, 0], [100.0, 0, 0]])
    points = np.concatenate([heap + center for center in centers])
    gaussians = gaussians_from_points(points, np.full_like(points, 0.5), sh_degree=0, opacity=0.5)
    first = looking_at(centers[0], np.linspace(0, 2 * np.pi, 8, endpoint=False))
    (second,) = looking_at(centers[1], [1.0])
    return gaussians, {**{f"a{i}": view for i, view in enumerate(first)}, "b": second}


def names(gaussians, views, sightings, run=None):
    return views_that_show(gaussians, views, sightings, run or FitRun())[0]


def test_a_place_that_one_view_shows_is_read_and_a_place_that_many_show_is_read_in_some(two_places):
    gaussians, views = two_places
    chosen = names(gaussians, views, 2)
    assert "b" in chosen
    assert 2 <= len(chosen) - 1 < 8
    assert len(names(gaussians, views, 4)) > len(chosen)


def test_masked_views_show_nothing(two_places):
    gaussians, views = two_places
    chosen = names(gaussians, views, 2)
    masked = {name: View(view.camera, valid=name not in chosen[:1]) for name, view in views.items()}
    assert chosen[0] not in names(gaussians, masked, 2)


def test_half_masked_views_are_chosen_as_whole_ones(two_places):
    """A small pixel counts by its share that is not masked: thin masks leave no view without a pixel."""
    gaussians, views = two_places
    masked = {name: View(view.camera, valid=0.5) for name, view in views.items()}
    assert "b" in names(gaussians, masked, 2)
    assert len(names(gaussians, masked, 2)) < len(views)


def test_gaussians_without_the_mip_filter_are_drawn_with_it(two_places):
    """A small image makes them too large otherwise, and so far views too good."""
    gaussians, views = two_places
    plain, filtered = (replace(gaussians, antialiased=mip) for mip in (False, True))
    assert names(plain, views, 3) == names(filtered, views, 3)
    np.testing.assert_array_equal(*(views_that_show(g, views, 3, FitRun())[1] for g in (plain, filtered)))


def test_the_shares_are_those_of_the_weight_in_all_views(two_places):
    gaussians, views = two_places
    chosen, shares = views_that_show(gaussians, views, 2, FitRun())
    hidden = shares[200:] == float(np.float16(len(chosen) / len(views)))
    assert bool(((shares[200:] == 1) | hidden).all()), "one view shows them, and it is read"
    assert float(hidden.float().mean()) < 0.1
    of_first_place = (len(chosen) - 1) / 8
    assert float(shares[:200].mean()) == pytest.approx(of_first_place, rel=0.3)
    assert float(shares.min()) >= float(np.float16(len(chosen) / len(views) / 2))
    assert torch.equal(shares, shares.half().float()), "a build that goes on has the same ones from its file"


def test_a_place_that_is_shown_once_is_trusted_as_before(two_places):
    gaussians, views = two_places
    maps = {name: FeatureMap(normalize(torch.ones(48, 64, 4), dim=-1)) for name in views}
    found = [
        Averaged()
        .fit(
            gaussians,
            TrainingViews(views, features=maps),
            BuildConfig(dino="none", averaged=AveragedConfig(sightings=number, segments=False)),
            FitRun(),
        )
        .uncertainties[200:]
        for number in (0, 2)
    ]
    torch.testing.assert_close(*found)


def test_the_choice_does_not_depend_on_the_order_of_the_views(two_places):
    gaussians, views = two_places
    backwards = dict(reversed(views.items()))
    chosen = names(gaussians, views, 2)
    assert names(gaussians, backwards, 2) == chosen


def test_the_choice_does_not_depend_on_workers(two_places, tmp_path):
    gaussians, views = two_places
    (tmp_path / "scene").mkdir()
    workers, told = BlindWorkers(tmp_path / "scene"), list[Event]()
    run = FitRun(workers=workers, listener=told.append)
    assert names(gaussians, views, 2, run) == names(gaussians, views, 2)
    assert workers.tasks == 2, "sixteen views a task: of all views, and of the chosen ones"
    ends = [(event.stage, event.total) for event in told if event.done == event.total]
    assert ends == [("views to read", 9), ("sightings", len(names(gaussians, views, 2)))]


def test_sums_over_several_tasks_have_the_same_bits_with_workers(two_places, tmp_path):
    gaussians, _ = two_places
    views = {f"{i:02}": view for i, view in enumerate(looking_at(np.zeros(3), np.linspace(0, 6, 40)))}
    (tmp_path / "scene").mkdir()
    workers = BlindWorkers(tmp_path / "scene")
    found, shares = views_that_show(gaussians, views, 20, FitRun(workers=workers))
    assert workers.tasks >= 3 + 2
    alone, expected = views_that_show(gaussians, views, 20, FitRun())
    assert found == alone
    assert torch.equal(shares, expected)


def test_many_views_are_compared_by_fewer_gaussians(two_places, monkeypatch):
    gaussians, views = two_places
    monkeypatch.setattr(sightings_module, "_MOST_NUMBERS", 9 * 100)
    shapes = []
    monkeypatch.setattr(
        sightings_module, "covering", lambda weights, wish: shapes.append(weights.shape) or [0]
    )
    assert names(gaussians, views, 2) == ["a0"]
    assert shapes == [(9, 100)]


def test_all_views_are_read_where_they_are_few_or_show_nothing(two_places):
    gaussians, views = two_places
    few = {name: views[name] for name in ("b", "a0")}
    assert names(gaussians, few, 2) == ["a0", "b"]
    elsewhere = replace(gaussians, means=gaussians.means + 1e4)
    assert names(elsewhere, views, 2) == sorted(views)


def test_of_three_views_the_near_and_the_opposite_one_are_taken():
    #  Gaussian      1    2    3
    weights = [[4.0, 2.0, 0.0],  # near the first two: sightings 1, 1/2, 0
               [1.0, 0.5, 0.0],  # the same from afar: 1/4, 1/8, 0
               [0.0, 4.0, 1.0]]  # 0, 1, 1  # fmt: skip
    assert covering(np.array(weights), 1) == [0, 2]


def test_a_place_with_few_gaussians_is_read_before_others_are_read_twice():
    """Forty of a thousand Gaussians are less than the share at which the second reading ends."""
    weights = np.zeros((9, 1000))
    weights[:8, 40:] = 1
    weights[8, :40] = 1
    assert 8 in covering(weights, 4)


def by_definition(weights, sightings):
    """The greedy choice, with the sum of all Gaussians for every view at every step, in float64."""
    best = weights.max(0)
    parts = [[w / b for w, b in zip(row, best) if b >= 0.01] for row in weights.astype(float)]
    chosen: list[int] = []

    def sightings_of(rows, wanted):
        return sum(min(wish, sum(parts[row][n] for row in rows)) for n, wish in enumerate(wanted))

    for most, enough in ((1, ENOUGH_ONCE), (sightings, ENOUGH)):
        wanted = [min(most, sum(column)) for column in zip(*parts)]
        while sightings_of(chosen, wanted) < enough * sum(wanted) - 1e-9:
            left = [row for row in range(len(parts)) if row not in chosen]
            chosen.append(max(left, key=lambda row: (round(sightings_of([*chosen, row], wanted), 9), -row)))
    return chosen


@settings(max_examples=60)
@given(
    arrays(
        float,
        st.tuples(st.integers(1, 9), st.integers(1, 12)),
        elements=st.sampled_from([0.0, 1.0, 2.0, 4.0, 8.0]),  # whose quotients and sums are exact
    ),
    st.integers(1, 4),
)
def test_the_choice_is_the_greedy_one_and_shows_nearly_all_that_all_views_show(weights, sightings):
    chosen = covering(weights.copy(), sightings)
    assert chosen == sorted(by_definition(weights, sightings))
    shown = weights[:, weights.max(0) > 0]
    parts = shown / shown.max(0)
    wanted = np.minimum(parts.sum(0), sightings).sum()
    assert np.minimum(parts[chosen].sum(0), sightings).sum() >= ENOUGH * wanted - 1e-9


def test_the_fit_reads_the_chosen_views_alone_and_trusts_them_as_all(ring):
    generator = torch.Generator().manual_seed(0)
    views = {name: View(camera) for name, camera in ring.cameras.items()}
    codes = {name: torch.from_numpy(found.clip(max=4)).long() for name, found in ring.code_maps.items()}
    colors = normalize(torch.randn(5, 6, generator=generator), dim=-1)
    read: set[str] = set()

    class Maps(dict):
        def __getitem__(self, name):
            read.add(name)
            return super().__getitem__(name)

    maps = Maps({name: FeatureMap(colors[codes[name]]) for name in views})
    config = BuildConfig(dino="none", averaged=AveragedConfig(sightings=3, segments=False))
    all_views = replace(config, averaged=replace(config.averaged, sightings=0))
    few = Averaged().fit(ring.gaussians, TrainingViews(views, features=maps), config, FitRun())
    assert read == set(names(ring.gaussians, views, 3)) < set(views)
    every = Averaged().fit(ring.gaussians, TrainingViews(views, features=maps), all_views, FitRun())
    assert read == set(views)
    # Sums over a part of the views are smaller, which is no reason to trust them less.
    assert abs(float((few.uncertainties - every.uncertainties).mean())) < 0.02


def test_a_choice_is_made_once(ring):
    views = TrainingViews({name: View(camera) for name, camera in ring.cameras.items()})
    config = SimpleNamespace(averaged=AveragedConfig(sightings=3))
    method, told = Averaged(), list[Event]()
    run = FitRun(listener=told.append)
    chosen = method.views_to_read(ring.gaussians, views, config, run)
    assert told[-1].total == told[-1].done == len(chosen.views) < len(views.views)
    assert method.views_to_read(ring.gaussians, chosen, config, run) is chosen


@pytest.mark.parametrize(
    ("given_settings", "expected"),
    [
        ({"clip": "bundled"}, 4),
        ({}, 8),
        ({"averaged": AveragedConfig(sightings=0)}, 0),
        ({"averaged": AveragedConfig(sightings=2), "clip": "bundled"}, 2),
    ],
)
def test_the_bundled_encoders_need_fewer_sightings_than_any_other(given_settings, expected, monkeypatch):
    monkeypatch.setattr("lexsplat.pipeline.config.patch_grid", lambda name: 14)
    assert BuildConfig(**given_settings).resolved("cpu", (640, 480)).averaged.sightings == expected


def test_features_of_another_program_are_all_read(tmp_path, monkeypatch):
    monkeypatch.setattr("lexsplat.pipeline.config.patch_grid", lambda name: 14)
    assert BuildConfig(features_from=tmp_path).resolved("cpu", (640, 480)).averaged.sightings == 0
    with pytest.raises(ValueError, match=r"leave --averaged\.sightings out"):
        BuildConfig(features_from=tmp_path, averaged=AveragedConfig(sightings=8))


def test_a_negative_number_of_sightings_is_refused():
    with pytest.raises(ValueError, match="sightings must not be negative, got -1"):
        AveragedConfig(sightings=-1)
