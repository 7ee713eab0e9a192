import itertools

import numpy as np
import pytest
import torch
from support.question_scene import coded_cloud, texts

from lexsplat.language.segments import Segments
from lexsplat.queries.relevancy import QueryConfig, Question, gaussian_relevancy
from lexsplat.queries.scoring import form_used, render_gaussian_scores, scores_in_form
from lexsplat.queries.segments import (
    LOWEST,
    MOST_CERTAIN,
    OWN_SHARE,
    SEGMENT_THRESHOLD,
    STEEPNESS,
    segment_relevancy,
)
from lexsplat.rendering import render

# A mug of body (segments 0, 1) and handle (2), a table (3, 4) and a wall (5); 4 Gaussians each.
LEVELS = torch.tensor([[0, 1, 2, 3, 4, 5], [0, 0, 0, 1, 1, 2]])
LABELS = torch.arange(6).repeat_interleave(4)


def taken(scores, masses=None) -> list[bool]:
    """Whether each of the 6 lowest segments is taken for scores of segments ``[6]``."""
    segments = Segments(LABELS, torch.ones(24) if masses is None else masses, LEVELS)
    found = segment_relevancy(torch.tensor(scores).repeat_interleave(4)[None], segments)[0]
    sides = (found >= SEGMENT_THRESHOLD).view(6, 4)
    assert torch.equal(sides.all(1), sides.any(1))
    return sides.any(1).tolist()


def test_whole_things_are_taken_where_their_parts_score_alike():
    assert taken([0.9, 0.8, 0.6, 0.2, 0.1, 0.1]) == [True, True, True, False, False, False]


def test_a_part_is_taken_alone_where_only_the_part_exceeds_half():
    assert taken([0.3, 0.3, 0.8, 0.05, 0.0, 0.0]) == [False, False, True, False, False, False]


def test_a_part_that_scores_low_is_taken_with_its_thing():
    # As the foot of a mug: crops that show it also show the cloth under it.
    assert taken([0.9, 0.5, 0.16, 0.0, 0.0, 0.0]) == [True, True, True, False, False, False]


def test_a_thin_piece_that_a_level_joins_to_what_is_behind_it_is_taken_with_its_thing():
    # As the stand of a lamp (3) before a wall (4): the level of things joins them.
    weights = torch.tensor([1.0, 1.0, 1.0, 0.3, 9.0, 9.0]).repeat_interleave(4)
    lamp = [0.9, 0.85, 0.9]
    assert taken([*lamp, 0.95, 0.0, 0.0], weights) == [True, True, True, True, False, False]
    assert taken([*lamp, 0.85, 0.0, 0.0], weights)[3] is False, "no better than most of the lamp"
    weights[:12] = 0.05
    assert taken([*lamp, 0.95, 0.0, 0.0], weights)[3] is False, (
        "more than the lamp: faint remains have no pieces"
    )
    weights[:12] = 1.0
    weights[12:16] = 0.1
    assert taken([*lamp, 0.95, 0.0, 0.0], weights)[3] is False, "a speck"


def test_pieces_that_score_below_half_are_left_whatever_is_taken():
    weights = torch.tensor([1.0, 1.0, 1.0, 0.3, 9.0, 9.0]).repeat_interleave(4)
    assert taken([0.45, 0.4, 0.45, 0.48, 0.0, 0.0], weights)[3] is False


def test_something_is_taken_where_nothing_exceeds_half():
    assert taken([0.35, 0.4, 0.45, 0.1, 0.1, 0.1]) == [True, True, True, False, False, False]


def test_a_gaussian_follows_its_segment():
    own = torch.tensor([0.9, 0.8, 0.9, 0.2] + [0.1] * 20)[None]
    segments = Segments(LABELS, torch.ones(24), LEVELS[:1])
    assert (segment_relevancy(own, segments) >= SEGMENT_THRESHOLD)[0].tolist() == [True] * 4 + [False] * 20


def test_unseen_gaussians_follow_but_have_no_say():
    masses = torch.ones(24)
    masses[1:4] = 0
    own = torch.tensor([0.9, 0.0, 0.0, 0.0] + [0.1] * 20)[None]
    segments = Segments(LABELS, masses, LEVELS[:1])
    assert (segment_relevancy(own, segments) >= SEGMENT_THRESHOLD)[0].tolist() == [True] * 4 + [False] * 20


def test_of_equal_gaussians_the_one_whose_views_agree_scores_higher_and_the_same_segments_are_taken():
    # As the edge of a cloth beside a ring: its crops show the ring, but not all of them.
    own = torch.tensor([0.9] * 12 + [0.1] * 12)[None]
    uncertainties = torch.full((24,), 0.1)
    uncertainties[[0, 13]] = 0.4
    segments = Segments(LABELS, torch.ones(24), LEVELS)
    found, alike = segment_relevancy(own, segments, uncertainties)[0], segment_relevancy(own, segments)[0]
    assert found[0] < found[1:12].min()
    assert found[13] < found[12]
    assert torch.equal(found >= SEGMENT_THRESHOLD, alike >= SEGMENT_THRESHOLD)
    assert torch.equal(segment_relevancy(own, segments, torch.full((24,), 0.5))[0], alike), (
        "only differences count"
    )
    assert torch.equal(segment_relevancy(own, segments, torch.ones(24))[0], alike), "the views agree nowhere"


def test_scores_are_those_of_a_loop_over_gaussians():
    generator = np.random.default_rng(5)
    own, masses, u = generator.random(24), generator.random(24), generator.random(24)
    means = [np.average(own[k == LABELS], weights=masses[k == LABELS]) for k in range(6)]
    ranked = sorted(means, reverse=True)
    limit = max((a - b, (a + b) / 2) for a, b in itertools.pairwise(ranked) if a >= LOWEST * ranked[0])[1]
    inside = np.array([means[label] >= limit for label in LABELS])
    gap = np.average(own[inside], weights=masses[inside]) - np.average(own[~inside], weights=masses[~inside])
    usual = np.average(1 - u[inside], weights=masses[inside])
    expected = []
    for n in range(24):
        certainty = min((1 - u[n]) / usual, MOST_CERTAIN)
        odds = OWN_SHARE * own[n] * certainty + (1 - OWN_SHARE) * means[LABELS[n]] - limit
        expected.append(0.5 * inside[n] + 0.5 / (1 + np.exp(-STEEPNESS * odds / gap)))
    segments = Segments(LABELS, torch.from_numpy(masses).float(), LEVELS[:1])
    found = segment_relevancy(torch.from_numpy(own)[None], segments, torch.from_numpy(u))[0]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)


def test_no_gaussian_of_a_segment_that_is_left_reaches_the_threshold():
    own = torch.full((1, 24), 0.05)
    own[0, :4] = 0.06
    own[0, 23] = 1.0  # one of a hundred in its segment, so that its segment is left
    masses = torch.ones(24)
    masses[23] = 1e-3
    found = segment_relevancy(own, Segments(LABELS, masses, LEVELS[:1]))[0]
    assert (found >= SEGMENT_THRESHOLD).tolist() == [True] * 4 + [False] * 20


def test_scores_stay_in_range_and_do_not_depend_on_the_other_prompts():
    own = torch.rand(5, 24, generator=torch.Generator().manual_seed(0))
    segments = Segments(LABELS, torch.rand(24, generator=torch.Generator().manual_seed(1)), LEVELS)
    together = segment_relevancy(own, segments)
    assert float(together.min()) >= 0
    assert float(together.max()) <= 1
    assert torch.equal(together, torch.cat([segment_relevancy(row[None], segments) for row in own]))


def test_the_cut_is_the_widest_gap_of_means_by_hand():
    generator = np.random.default_rng(3)
    own, masses = generator.random(24), generator.random(24)
    means = [np.average(own[k == LABELS], weights=masses[k == LABELS]) for k in range(6)]
    ranked = sorted(means, reverse=True)
    gaps = [(a - b, (a + b) / 2) for a, b in itertools.pairwise(ranked) if a >= 0.3 * ranked[0]]
    expected = [mean >= max(gaps)[1] for mean in means]
    segments = Segments(LABELS, torch.from_numpy(masses).float(), LEVELS[:1])
    found = (
        segment_relevancy(torch.from_numpy(own)[None], segments)[0].view(6, 4).amin(1) >= SEGMENT_THRESHOLD
    )
    assert found.tolist() == expected


@pytest.mark.parametrize("form", ["code", "feature", "segment"])
def test_absent_prompts_and_other_forms_keep_the_scores_of_gaussians(form):
    field, *_ = coded_cloud()
    count = len(field.codes)
    field.segments = Segments(torch.arange(count) % 3, torch.ones(count), torch.tensor([[0, 1, 2]]))
    query = QueryConfig(form=form)
    plain = gaussian_relevancy(field, Question(texts(3, 16, 5), texts(4, 16, 6), query))
    scores = scores_in_form(field, query, plain, ("no", "yes", "unsure"))
    same = [torch.equal(*pair) for pair in zip(plain, scores)]
    assert same == ([True, False, False] if form == "segment" else [True] * 3)


def test_a_field_without_segments_answers_by_gaussians():
    field, *_ = coded_cloud()
    query = QueryConfig()
    plain = gaussian_relevancy(field, Question(texts(2, 16, 5), texts(4, 16, 6), query))
    assert form_used(field, query) == "code"
    assert torch.equal(scores_in_form(field, query, plain, ("yes", "yes")), plain)


def test_the_map_is_the_rendering_of_the_scores():
    _, gaussians, camera = coded_cloud()
    scores = torch.rand(40, len(gaussians), generator=torch.Generator().manual_seed(0))
    found = render_gaussian_scores(gaussians, camera, scores)
    for place in (0, 17, 39):  # more prompts than are rendered at once
        alone = render(gaussians, camera, features=scores[place][:, None], color=False).features[..., 0]
        torch.testing.assert_close(found[place], alone.detach().clamp(0, 1))
