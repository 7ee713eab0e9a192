"""Presence: on scenes where it is known which codes there are."""

import pytest
import torch
from support.language_scene import make_scene

from lexsplat.language.fields import CodeField
from lexsplat.queries.everyday import EverydayScale
from lexsplat.queries.presence import NO, YES, Evidence, PresenceClassifier
from lexsplat.queries.relevancy import Question, gaussian_relevancy

unit = torch.nn.functional.normalize


@pytest.fixture(scope="module")
def parts():
    """A scene of five directions in a space of 12, and words of which two name something in it."""
    made = make_scene(per_ball=100)
    g = torch.Generator().manual_seed(3)
    codes = torch.from_numpy(made.labels).to(torch.uint8)[:, None]
    field = CodeField(made.codebook, codes, torch.ones(500, 1), torch.zeros(500))
    words = torch.cat([unit(torch.randn(60, 12, generator=g), dim=1), unit(made.codebook.clip[:2], dim=1)])
    return made.gaussians, field, words


def evidence_of(parts, texts: torch.Tensor) -> list[Evidence]:
    gaussians, field, words = parts
    scale = EverydayScale.of(field.codebook.clip, words)
    scores = gaussian_relevancy(field, Question(texts, words, scale=scale))
    return PresenceClassifier(gaussians, field, scale).evidence(texts, scores)


def test_what_is_there_is_told_from_what_is_not(parts):
    _, field, _ = parts
    absent = unit(torch.randn(20, 12, generator=torch.Generator().manual_seed(9)), dim=1)
    assert [evidence.presence for evidence in evidence_of(parts, field.codebook.clip)] == ["yes"] * 5
    wrong = sum(evidence.presence == "yes" for evidence in evidence_of(parts, absent))
    assert wrong <= 4  # a random direction of twelve is near one of five codes now and then


def test_evidence_by_hand(parts):
    _, field, words = parts
    scale = EverydayScale.of(field.codebook.clip, words)
    text = unit(field.codebook.clip[2] + 0.5, dim=0)[None]
    heights = scale.heights(field.codebook.clip, text)[:, 0]
    code = int(heights.argmax())  # each Gaussian has one code, and a ball has more Gaussians than a peak
    (found,) = evidence_of(parts, text)
    assert found.height == pytest.approx(float(heights[code] / scale.peak), rel=1e-4)
    assert found.ratio == pytest.approx(float(heights[code] / scale.best[code]), rel=1e-4)


@pytest.mark.parametrize(
    ("ratio", "height", "presence"),
    [(YES, YES, "yes"), (1.2, 0.5, "yes"), (NO, NO - 0.01, "no"), (0.65, 0.65, "unsure"), (-1, -1, "no")],
)
def test_the_answer_is_the_geometric_mean_of_the_evidence(ratio, height, presence):
    assert Evidence(ratio, height).presence == presence


def test_an_empty_scene_holds_nothing(parts):
    gaussians, field, words = parts
    nothing = torch.zeros(500, dtype=torch.bool)
    scale = EverydayScale.of(field.codebook.clip, words)
    classifier = PresenceClassifier(gaussians.select(nothing), field.select(nothing), scale)
    assert classifier.classify(words[:1], torch.zeros(1, 0)) == ("no",)
