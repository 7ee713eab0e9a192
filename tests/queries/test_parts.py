from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array
from support.splats import solid

from lexsplat.geometry.gaussians import SH_C0
from lexsplat.queries import parts
from lexsplat.queries.parts import ThingGraph, part_scores, with_parts
from lexsplat.queries.segments import SEGMENT_THRESHOLD

BROWN, TAN, BLACK = (0.4, 0.25, 0.1), (0.7, 0.55, 0.35), (0.05, 0.05, 0.05)
TABLE, HEAD, MUZZLE, NOSE, EARS = range(5)


def bear():
    """Gaussians of a head with a muzzle, a nose on it and two ears, on a table; their places in this list.

    The nose is smaller than any segment, and in the color of nothing around it.
    """
    rng = np.random.default_rng(0)
    table = np.concatenate([rng.uniform(-3, 3, (600, 2)), np.full((600, 1), -1.2)], 1)
    sphere = rng.normal(size=(3000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    front, height, side = sphere[:, 0], sphere[:, 2], np.abs(sphere[:, 1])
    kinds = np.full(3000, HEAD)
    kinds[front > 0.75] = MUZZLE
    kinds[front > 0.95] = NOSE
    kinds[(height > 0.7) & (side > 0.4)] = EARS
    places = np.concatenate([np.full(600, TABLE), kinds])
    gaussians = solid(np.concatenate([table, sphere]), -3.0)
    colors = np.array([TAN, BROWN, TAN, BLACK, BROWN])[places] + rng.normal(0, 0.02, (3600, 3))
    sh0 = torch.from_numpy((colors - 0.5) / SH_C0).float()[:, None]
    return replace(gaussians, sh0=sh0), places


def cut(own, thing, gaussians, masses):
    """The scores of a part of a thing ``[N]`` bool."""
    return part_scores(own, ThingGraph.of(thing, gaussians, masses))


def taken(scores, gaussians, places, masses=None):
    """The Gaussians ``[N]`` bool of a part whose relevancies are those of places."""
    rng = np.random.default_rng(1)
    own = torch.from_numpy(np.array(scores)[places] + rng.normal(0, 0.02, len(places))).clamp(0, 1).float()
    masses = torch.ones(len(places)) if masses is None else masses
    found = cut(own, torch.from_numpy(places != TABLE), gaussians, masses)
    assert 0 <= float(found.min()) <= float(found.max()) <= 1
    return (found >= SEGMENT_THRESHOLD).numpy()


def share(found, wanted) -> float:
    """Intersection over union of two masks."""
    return float((found & wanted).sum() / (found | wanted).sum())


def test_a_nose_is_cut_out_of_a_muzzle_that_scores_nearly_as_high():
    gaussians, places = bear()
    found = taken([0.1, 0.1, 0.75, 0.9, 0.1], gaussians, places)
    assert share(found, places == NOSE) > 0.9


def test_both_ears_are_taken_and_nothing_between_them():
    gaussians, places = bear()
    found = taken([0.1, 0.3, 0.1, 0.1, 0.8], gaussians, places)
    assert share(found, places == EARS) > 0.9


def test_a_part_may_be_most_of_its_thing():
    gaussians, places = bear()
    found = taken([0.1, 0.9, 0.1, 0.1, 0.9], gaussians, places)
    assert share(found, (places == HEAD) | (places == EARS)) > 0.9


def mug():
    """Gaussians of a white mug with a handle; and how near they are to the middle of the handle: 0 at its ends."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 2500), rng.uniform(-1, 1, 2500)
    body = np.stack([np.cos(angle), np.sin(angle), height], 1)
    along, around = rng.uniform(-np.pi / 2, np.pi / 2, 800), rng.uniform(0, 2 * np.pi, 800)
    wide = 0.6 + 0.1 * np.cos(around)
    handle = np.stack([1.02 + wide * np.cos(along), 0.1 * np.sin(around), wide * np.sin(along)], 1)
    near = np.concatenate([np.full(2500, -1.0), 1 - np.abs(along) / (np.pi / 2)])
    return solid(np.concatenate([body, handle]), -3.0), near


def test_a_part_grows_from_its_best_scores_to_where_it_meets_its_thing(monkeypatch):
    gaussians, near = mug()
    scores = np.where(near >= 0, 0.55 + 0.35 * near, 0.2) + np.random.default_rng(1).normal(
        0, 0.05, len(near)
    )
    own, thing = torch.from_numpy(scores).float(), torch.ones(len(near), dtype=torch.bool)

    def found() -> np.ndarray:
        return (cut(own, thing, gaussians, thing.float()) >= SEGMENT_THRESHOLD).numpy()

    assert share(found(), near >= 0) > 0.8
    monkeypatch.setattr(parts, "NEAREST", 1.0)
    assert share(found(), near >= 0) < 0.6, "without growing it is the middle alone"


def test_a_part_does_not_grow_where_nothing_stops_it():
    gaussians, places = bear()
    head = gaussians.means[:, 2].numpy()
    scores = np.where(places == TABLE, 0.1, np.where(head > 0.9, 0.9, 0.2 + 0.4 * np.clip(head, 0, 1)))
    own, thing = torch.from_numpy(scores).float(), torch.from_numpy(places != TABLE)
    grown = (cut(own, thing, gaussians, torch.ones(len(places))) >= SEGMENT_THRESHOLD).numpy()
    assert (grown & (head < 0.6)).sum() == 0, "around the top of a ball each wider border is longer"


@pytest.mark.parametrize(("neck", "taken"), [(0.05, 40), (0.1, 20)])
def test_a_part_grows_only_to_a_border_of_at_most_half_the_length(neck, taken):
    """Links of .3 lead from each of 20 Gaussians of a head to 20 of an ear, and of ``neck`` from 40 to the head."""
    ear, head, rest = np.arange(20), np.arange(20, 40), np.arange(40, 80)
    links = np.zeros((80, 80))
    for group, other, weight in ((ear, head, 0.3), (head, ear, 0.3), (head, rest, 0.1), (rest, head, neck)):
        links[np.ix_(group, other)] = weight / len(other)
    for group in (ear, head, rest):
        links[np.ix_(group, group)] = (1 - links[group].sum(1, keepdims=True)) / len(group)
    smooth = np.repeat([1.0, 0.6, 0.0], [20, 20, 40])
    assert links[np.ix_(head, ear)].sum() == pytest.approx(6), "the border of the ear"
    assert links[np.ix_(rest, head)].sum() == pytest.approx(40 * neck), "and that of the head: 2 or 4"
    assert parts._grown(smooth, 0.05, 0.9, csr_array(links)).nonzero()[0].tolist() == list(range(taken))


def test_a_part_with_a_border_of_its_own_does_not_grow_to_another_one():
    gaussians, places = bear()
    own = torch.from_numpy(np.array([0.1, 0.2, 0.5, 0.9, 0.1])[places]).float()
    found = cut(own, torch.from_numpy(places != TABLE), gaussians, torch.ones(len(places)))
    assert share((found >= SEGMENT_THRESHOLD).numpy(), places == NOSE) > 0.9, "not the muzzle"


def test_a_pixel_that_shows_a_part_for_the_most_part_shows_it():
    gaussians, places = bear()
    own = torch.from_numpy(np.array([0.1, 0.1, 0.75, 0.9, 0.1])[places]).float()
    found = cut(own, torch.from_numpy(places != TABLE), gaussians, torch.ones(len(places)))
    inside = found[found >= SEGMENT_THRESHOLD]
    assert 0.7 * float(inside.min()) > SEGMENT_THRESHOLD


def test_what_lies_outside_the_thing_is_no_part_of_it_however_it_scores():
    gaussians, places = bear()
    found = taken([1.0, 0.1, 0.3, 0.9, 0.1], gaussians, places)
    assert not found[places == TABLE].any()
    assert share(found, places == NOSE) > 0.9


def test_noise_of_single_gaussians_does_not_tear_a_part():
    gaussians, places = bear()
    rng = np.random.default_rng(2)
    own = torch.from_numpy(np.array([0.1, 0.2, 0.2, 0.2, 0.8])[places] + rng.normal(0, 0.2, len(places)))
    found = cut(
        own.clamp(0, 1).float(), torch.from_numpy(places != TABLE), gaussians, torch.ones(len(places))
    )
    alone = own.numpy() >= 0.5
    ears = places == EARS
    assert share((found >= SEGMENT_THRESHOLD).numpy(), ears) > share(alone & (places != TABLE), ears) + 0.2


def test_gaussians_that_no_view_shows_have_no_say():
    gaussians, places = bear()
    masses = torch.ones(len(places))
    masses[torch.from_numpy(np.flatnonzero(places == NOSE)[::2])] = 0
    found = taken([0.1, 0.1, 0.75, 0.9, 0.1], gaussians, places, masses)
    assert share(found, places == NOSE) > 0.85
    nothing = taken([0.1, 0.1, 0.75, 0.9, 0.1], gaussians, places, torch.zeros(len(places)))
    assert nothing.shape == places.shape, "also where nothing was shown at all"


def test_the_order_of_the_gaussians_does_not_matter():
    gaussians, places = bear()
    own = torch.from_numpy(np.array([0.1, 0.1, 0.75, 0.9, 0.1])[places]).float()
    thing, masses = torch.from_numpy(places != TABLE), torch.ones(len(places))
    order = torch.randperm(len(places), generator=torch.Generator().manual_seed(3))
    straight = cut(own, thing, gaussians, masses)
    turned = cut(own[order], thing[order], gaussians.select(order), masses)
    torch.testing.assert_close(turned, straight[order], rtol=1e-4, atol=1e-4)


def test_a_thing_that_is_described_as_the_part_throughout_is_not_cut():
    gaussians, places = bear()
    own = torch.from_numpy(np.array([0.1, 0.8, 0.8, 0.9, 0.8])[places]).float()
    assert cut(own, torch.from_numpy(places != TABLE), gaussians, torch.ones(len(places))) is None


def test_a_part_that_the_name_of_the_thing_misses_is_joined_but_nothing_apart_from_it():
    gaussians, places = bear()
    far = torch.from_numpy(gaussians.means[:, 0].numpy() > 2.5)
    thing = torch.from_numpy((places != TABLE) & (places != NOSE))
    taken = torch.from_numpy(places == NOSE) | far
    labels = torch.from_numpy(np.where(far.numpy(), 9, places))
    found = with_parts(thing, taken, gaussians, labels)
    assert torch.equal(found, torch.from_numpy(places != TABLE))
    assert torch.equal(with_parts(thing, thing, gaussians, labels), thing)


def test_links_are_those_between_neighbors_by_how_alike_they_are():
    gaussians, places = bear()
    thing = torch.from_numpy(places != TABLE)
    masses = torch.from_numpy(np.random.default_rng(4).uniform(0, 2, len(places))).float()
    graph = ThingGraph.of(thing, gaussians, masses)
    values = np.random.default_rng(5).uniform(0, 1, len(graph.places))
    chosen = gaussians.select(thing.nonzero()[:, 0])
    means, colors = (
        chosen.means.double().numpy(),
        (0.5 + SH_C0 * chosen.sh0[:, 0].double().numpy()).clip(0, 1),
    )
    apart = np.linalg.norm(means[:, None] - means[None], axis=-1)
    nearest = np.zeros_like(apart, bool)
    np.put_along_axis(
        nearest, np.argsort(apart, axis=1, kind="stable")[:, 1 : parts.NEIGHBORS + 1], True, axis=1
    )
    nearest |= nearest.T
    unlike = ((colors[:, None] - colors[None]) ** 2).sum(-1) / parts.COLOR**2
    unlike += (values[:, None] - values[None]) ** 2 / parts.SCORE**2
    expected = np.where(nearest, np.exp(-unlike) * masses.numpy()[graph.places][None], 0)
    expected /= expected.sum(1, keepdims=True)
    np.testing.assert_allclose(graph.links(values).toarray(), expected, atol=1e-6)
