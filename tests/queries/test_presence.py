"""Presence: on scenes where it is known which codes there are."""

import dataclasses

import pytest
import torch
from support.language_scene import make_scene

from lexsplat.codebook import Codebook
from lexsplat.language.fields import CodeField
from lexsplat.language.segments import Segments
from lexsplat.queries.everyday import EverydayScale
from lexsplat.queries.presence import NO, YES, Evidence, PresenceClassifier
from lexsplat.queries.relevancy import Question, gaussian_relevancy
from lexsplat.queries.vocabulary import is_part, thing_of_part

unit = torch.nn.functional.normalize


def embed_nothing(texts):
    raise AssertionError("a field without segments needs no words")


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
    return PresenceClassifier(gaussians, field, scale, embed_nothing).evidence(
        ["phrase"] * len(texts), texts, scores
    )


def test_what_is_there_is_distinguished_from_what_is_not(parts):
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
    [
        (YES, YES, "yes"),
        (1.2, 0.5, "yes"),
        (0.65, 1.2, "unsure"),
        (NO, NO - 0.01, "no"),
        (0.65, 0.65, "unsure"),
        (-1, -1, "no"),
    ],
)
def test_the_answer_is_the_geometric_mean_of_the_evidence_but_no_better_than_the_ratio(
    ratio, height, presence
):
    assert Evidence(ratio, height).presence == presence


def test_an_empty_scene_holds_nothing(parts):
    gaussians, field, words = parts
    nothing = torch.zeros(500, dtype=torch.bool)
    scale = EverydayScale.of(field.codebook.clip, words)
    classifier = PresenceClassifier(gaussians.select(nothing), field.select(nothing), scale, embed_nothing)
    assert classifier.classify(["phrase"], words[:1], torch.zeros(1, 0)) == ("no",)


WORDS = 6
"""Everyday words of the scene below: 0 to 3 name its things, 4 and 5 nothing."""


class Words:
    """Axes of a space as embeddings: word n is axis n, and "red WORD" leans half as far to the axis of red."""

    def __call__(self, texts):
        return torch.stack([self.of(text) for text in texts])

    def of(self, text):
        vector = torch.zeros(12)
        for word in text.split():
            vector += torch.eye(12)[{"red": 8, "green": 9}.get(word, int(word) if word.isdigit() else 11)]
        return unit(vector, dim=0)


@pytest.fixture
def classifier(monkeypatch):
    """A red 0, a green 1, a ball 2 with one stripe like 3, and much of nothing."""
    from lexsplat.queries import presence

    monkeypatch.setattr(presence, "everyday_words", lambda: tuple(map(str, range(WORDS))))
    monkeypatch.setattr(presence, "COLORS", frozenset({"red", "green"}))
    embed = Words()
    codewords = torch.stack(
        [*map(embed.of, ("0 red", "1 green", "2", "3")), *torch.eye(12)[6:8].repeat(4, 1)]
    )
    made = make_scene(per_ball=100)
    codes = torch.arange(500) // 100  # a thing of 100 Gaussians for each code; of the fourth only a stripe
    codes[300:490], codes[490:] = 2, 3
    codes[400:490] = 4 + torch.arange(90) % 8
    labels = codes.clamp(max=4)
    # From below: the stripe is a segment of its own, then part of the ball.
    segments = Segments(labels, torch.ones(500), torch.tensor([[0, 1, 2, 3, 4], [0, 1, 2, 2, 4]]))
    field = CodeField(Codebook(codewords, codewords), codes.to(torch.uint8)[:, None], torch.ones(500, 1),
                      torch.zeros(500), segments=segments)  # fmt: skip
    scale = EverydayScale.of(codewords, embed([str(word) for word in range(WORDS)]))
    classifier = PresenceClassifier(made.gaussians, field, scale, embed)

    return classifier


def strength(classifier, phrase):
    return classifier.evidence([phrase], Words()([phrase]), torch.zeros(1, 500))[0].strength


def test_objects_are_compared_and_not_their_parts(classifier):
    assert strength(classifier, "2") > YES
    assert strength(classifier, "3") < NO, "a stripe of the ball"


def test_a_listed_thing_is_a_place_of_its_own(classifier):
    stripe = torch.zeros(1, len(classifier.language.codebook.clip))
    stripe[0, 3] = 1
    known = (make_scene(per_ball=100).gaussians, classifier.language, classifier.scale, Words())
    listing = PresenceClassifier(*known, things=lambda: stripe)
    assert strength(listing, "3") > YES, "the stripe, without the ball that its segment has"
    assert strength(listing, "2") == pytest.approx(strength(classifier, "2"))
    assert listing.places.words == classifier.places.words


def test_compounds_need_the_strength_of_objects_and_colors_more(classifier, monkeypatch):
    from lexsplat.queries import presence

    monkeypatch.setattr(presence, "is_part", lambda phrase: phrase == "3")
    phrases = ["3", "2", "red 0"]
    found = classifier.evidence(phrases, Words()(phrases), torch.zeros(3, 500))
    assert [evidence.yes for evidence in found] == [0.62, 0.62, 0.82]
    assert Evidence(0.7, 0.7, found[0].yes).presence == "yes"


@pytest.mark.parametrize(
    ("thing", "presence"),
    [
        ("2 3", "yes"),  # the ball, which is described at its stripe, too
        ("0", "no"),  # elsewhere in the scene
        ("3", "no"),  # described there, but no object of the scene
        ("5", "no"),  # nowhere
    ],
)
def test_a_part_is_there_only_with_its_thing(classifier, monkeypatch, thing, presence):
    from lexsplat.queries import presence as module

    monkeypatch.setattr(module, "is_part", lambda phrase: phrase == "3 handle")
    monkeypatch.setattr(module, "thing_of_part", lambda phrase: thing if phrase == "3 handle" else "")
    (found,) = classifier.evidence(["3 handle"], Words()(["3"]), torch.zeros(1, 500))
    assert found.presence == presence
    assert found.strength == (pytest.approx(1, abs=0.1) if presence == "yes" else 0)
    assert (found.yes, found.no) == (module.YES_PART, module.NO_PART)
    for strength, answer in ((found.no - 0.01, "no"), (found.no + 0.01, "unsure"), (found.yes + 0.01, "yes")):
        assert dataclasses.replace(found, ratio=strength, height=strength).presence == answer


def test_a_color_is_that_of_the_thing(classifier):
    assert min(strength(classifier, phrase) for phrase in ("red 0", "green 1")) > YES
    assert max(strength(classifier, phrase) for phrase in ("green 0", "red 1")) < YES


def test_things_with_a_color_are_compared_with_objects_in_any_color(classifier):
    embed, scale, codes = Words(), classifier.scale, classifier.language.codebook.clip
    found = classifier.best_heights(["0", "red 0", "green 0"])
    # A stripe is no object, so no phrase of "3" takes part.
    colored = embed([f"{color} {thing}" for color in ("red", "green") for thing in (0, 1, 2)])
    expected = torch.maximum(scale.best, scale.heights(codes, colored).amax(1))
    torch.testing.assert_close(found, torch.stack([scale.best, expected, expected], dim=1))
    assert (expected[:2] > 1.1 * scale.best[:2]).all(), "the red 0 and the green 1"


def test_parts_are_compared_with_everyday_words_whatever_their_color(classifier, monkeypatch):
    from lexsplat.queries import presence

    monkeypatch.setattr(presence, "is_part", lambda phrase: phrase == "red 0 1")
    found = classifier.best_heights(["red 0 1", "red 0"])
    assert torch.equal(found[:, 0], classifier.scale.best)
    assert not torch.equal(found[:, 1], classifier.scale.best)


def test_the_wrong_color_is_less_relevant_at_a_thing(classifier):
    asked, codes = ["green 0", "red 0"], classifier.language.codebook.clip
    texts = Words()(asked)
    plain = classifier.scale.relevancy(codes, texts)
    colored = classifier.scale.relevancy(codes, texts, classifier.best_heights(asked))
    assert colored[0, 0] < 0.5 * plain[0, 0], "a green 0 where the 0 is red"
    assert colored[0, 1] == plain[0, 1] > 0.9


@pytest.mark.parametrize(
    ("phrase", "part"),
    [
        ("mug handle", True), ("bear nose", True), ("bottle cap", True), ("mug", False), ("red mug", False),
        ("stack of books", False), ("table lamp", False), ("mug red", False), ("something to drink from", False),
        ("toy car wheels", True), ("car wheel", True), ("wheel", False),
    ],
)  # fmt: skip
def test_a_part_is_named_behind_its_thing(phrase, part):
    assert is_part(phrase) == part


@pytest.mark.parametrize(
    ("phrase", "thing"),
    [
        ("mug handle", "mug"), ("Red mug handles", "red mug"), ("teddy bear nose", "teddy bear"),
        ("table leg", "table"), ("toy car wheels", "toy car"), ("bear belly", "bear"), ("apple stalk", "apple"),
        ("lamp stand", "lamp"),
        ("candle holder", ""), ("phone charger", ""), ("nose", ""), ("big nose", ""), ("table lamp", ""), ("", ""),
    ],
)  # fmt: skip
def test_the_thing_of_a_part_is_what_stands_before_it(phrase, thing):
    assert thing_of_part(phrase) == thing


@pytest.fixture
def mug_and_handle():
    """Codes of the body of a mug, of its handle and of much else; and the embeddings of "mug" and "mug handle"."""
    axes = torch.eye(12)
    texts = {"mug": axes[0], "mug handle": unit(axes[0] + 0.8 * axes[1], dim=0)}
    codewords = torch.stack([axes[0], unit(axes[0] + axes[1], dim=0), *axes[4:12].repeat(4, 1)])
    words = torch.stack([texts["mug"], *axes[8:12]])
    made = make_scene(per_ball=100)
    codes = (torch.arange(500) % len(codewords)).to(torch.uint8)[:, None]
    field = CodeField(Codebook(codewords, codewords), codes, torch.ones(500, 1), torch.zeros(500))

    def embed(phrases):
        return torch.stack([texts[phrase] for phrase in phrases])

    scale = EverydayScale.of(codewords, words)
    return scale, codewords, PresenceClassifier(made.gaussians, field, scale, embed), embed


def test_the_body_of_a_mug_is_no_mug_handle(mug_and_handle):
    scale, codewords, classifier, embed = mug_and_handle
    asked = ["mug handle", "mug"]
    body, handle = scale.relevancy(codewords, embed(asked), classifier.best_heights(asked))[:2]
    assert body[0] < 0.5 < handle[0]
    assert handle[1] > 0.5, "the handle belongs to the mug"
    alone = scale.relevancy(codewords, embed(asked))
    assert alone[0, 0] > 0.5, "everyday words alone do not tell them apart"
    assert torch.equal(
        alone[:, 1], scale.relevancy(codewords, embed(asked), classifier.best_heights(asked))[:, 1]
    )


def test_a_part_is_compared_with_its_thing_by_shares_of_their_best_heights(mug_and_handle):
    scale, codewords, classifier, embed = mug_and_handle
    heights = scale.heights(codewords, embed(["mug handle", "mug"])).double()
    top = heights.topk(1, dim=0).values[0]  # 4 % of 34 codes is one
    over_thing = (heights[:, 0] / top[0]) / (heights[:, 1].clamp_min(1e-6) / top[1]) / 1.05
    over_words = heights[:, 0] / scale.best / 0.72
    own = heights[:, 0] / top[0] / 0.68
    expected = torch.sigmoid(12 * 0.68 * (torch.stack([over_thing, over_words, own]).amin(0) - 1))
    found = scale.relevancy(codewords, embed(["mug handle"]), classifier.best_heights(["mug handle"]))[:, 0]
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-5)
