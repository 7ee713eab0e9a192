"""Presence: on scenes where it is known which codes there are."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from selection import fit_calibration
from support.language_scene import make_scene

from lexsplat.language.fields import CodeField
from lexsplat.queries.presence import (
    Calibration,
    Evidence,
    PresenceClassifier,
)
from lexsplat.queries.relevancy import Question, gaussian_relevancy


@pytest.fixture(scope="module")
def parts():
    """A scene of five directions in a space of 12; references and negatives in directions of their own."""
    made = make_scene(per_ball=100)
    g = torch.Generator().manual_seed(3)
    field = CodeField(
        made.codebook,
        torch.from_numpy(made.labels).to(torch.uint8)[:, None],
        torch.ones(500, 1),
        torch.zeros(500),
    )
    unit = torch.nn.functional.normalize
    references = unit(torch.randn(40, 12, generator=g), dim=1)
    negatives = unit(torch.randn(3, 12, generator=g), dim=1)
    return made.gaussians, field, references, negatives


def evidence_of(parts, text: torch.Tensor) -> Evidence:
    gaussians, field, references, negatives = parts
    classifier = PresenceClassifier(gaussians, field, Question(references, negatives))
    return classifier.evidence(gaussian_relevancy(field, Question(text[None], negatives))[0])


def test_what_is_there_has_more_evidence_than_what_is_not(parts):
    _, field, _, _ = parts
    g = torch.Generator().manual_seed(9)
    there = [evidence_of(parts, torch.nn.functional.normalize(code, dim=0)) for code in field.codebook.clip]
    absent = [
        evidence_of(parts, torch.nn.functional.normalize(torch.randn(12, generator=g), dim=0))
        for _ in range(20)
    ]
    assert min(e.rank for e in there) > 0.97
    assert sum(e.height for e in there) / 5 > max(sorted(e.height for e in absent)[:15])


def test_evidence_by_hand(parts):
    gaussians, field, references, negatives = parts
    classifier = PresenceClassifier(gaussians, field, Question(references, negatives))
    all_scores = gaussian_relevancy(field, Question(references, negatives))
    shown = gaussians.opacities >= 0.1
    peaks = all_scores[:, shown].topk(20, dim=1).values.mean(1)
    spread = (peaks - peaks.median()).abs().median() * 1.4826
    text = torch.nn.functional.normalize(field.codebook.clip[2] + 0.5, dim=0)
    scores = gaussian_relevancy(field, Question(text[None], negatives))[0]
    best = scores.topk(20)
    found = classifier.evidence(scores)
    assert found.height == pytest.approx(float((best.values.mean() - peaks.median()) / spread), rel=1e-3)
    lower = all_scores[:, best.indices].mean(1) < best.values.mean()
    assert found.rank == pytest.approx(float(lower.float().mean()))


@given(st.floats(-20, 20), st.floats(0, 1))
@settings(max_examples=40)
def test_a_probability_is_the_logistic_function_and_grows_with_evidence(height, rank):
    calibration = Calibration(-2.0, 0.7, 3.0, 0.6, 0.3)
    logit = -2 + 0.7 * min(10, max(-5, height)) + 3 * rank
    p = calibration.probability(Evidence(height, rank))
    assert p == pytest.approx(1 / (1 + math.exp(-logit)))
    assert calibration.classify(Evidence(height, rank)) == (
        "yes" if p >= 0.6 else "no" if p <= 0.3 else "unsure"
    )
    assert calibration.probability(Evidence(height + 1, rank)) >= p


def test_a_fit_separates_what_is_separable_and_keeps_its_promises():
    g = torch.Generator().manual_seed(0)

    def draw(mean: float, count: int) -> list[Evidence]:
        heights = mean + torch.randn(count, generator=g)
        ranks = (0.3 + 0.1 * mean + 0.1 * torch.randn(count, generator=g)).clamp(0, 1)
        return [Evidence(float(h), float(r)) for h, r in zip(heights, ranks)]

    present, absent = draw(4.0, 60), draw(0.0, 60)
    fitted = fit_calibration(present, absent)
    assert fitted.height > 0
    assert sum(fitted.classify(e) != "no" for e in present) >= 0.88 * 60
    assert sum(fitted.classify(e) == "yes" for e in absent) <= 0.12 * 60
    assert fitted.yes >= fitted.no
    with pytest.raises(ValueError, match="present and"):
        fit_calibration(present, [])


def test_an_empty_scene_holds_nothing(parts):
    gaussians, field, references, negatives = parts
    nothing = torch.zeros(500, dtype=torch.bool)
    question = Question(references, negatives)
    classifier = PresenceClassifier(gaussians.select(nothing), field.select(nothing), question)
    assert classifier.classify(torch.zeros(0)) == "no"
