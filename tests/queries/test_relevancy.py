import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.question_scene import coded_cloud, texts

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import CodeField
from lexsplat.queries import relevancy as queries
from lexsplat.queries.relevancy import QueryConfig, Question
from lexsplat.runtime.errors import QueryError

FORMS = ("feature", "code")


def asked(form="code", prompts=3, dim=16) -> Question:
    return Question(texts(prompts, dim, 5), texts(4, dim, 6), QueryConfig(form=form))


def cosines_of_built_features(probabilities, codewords, prompts):
    """The reference of `feature_cosines`: it builds the feature map F = p S ``[..., D]``."""
    features = torch.nn.functional.normalize(probabilities @ codewords, dim=-1)
    return features @ torch.nn.functional.normalize(prompts, dim=-1).T


def distributions(shape, seed, sharpness=3.0):
    logits = sharpness * torch.randn(shape, generator=torch.Generator().manual_seed(seed))
    return logits.softmax(-1)


@pytest.fixture(scope="module")
def cloud() -> tuple[CodeField, Gaussians, Camera]:
    return coded_cloud()


# Text


@pytest.mark.parametrize("prompts", [[], [""], ["apple", "  \n"], ""])
def test_an_empty_prompt_is_an_error_with_a_remedy(prompts):
    with pytest.raises(QueryError, match="red apple"):
        queries.check_prompts(prompts)


def test_prompts_in_all_templates_are_encoded_in_one_call():
    calls = []

    def encode(batch):
        calls.append(batch)
        return torch.tensor([[float(len(text)), 1.0] for text in batch])

    found = queries.embed_prompts(["  red   apple ", "cup {x}"], encode, ("a {}", "the {}."))
    assert calls == [["a red apple", "the red apple.", "a cup {x}", "the cup {x}."]]
    assert found.shape == (2, 2)
    with pytest.raises(ValueError, match="once"):
        queries.QueryConfig(templates=("a photo",))


def test_templates_are_averaged_as_directions_whatever_the_lengths():
    vectors = {"a": [1.0, 0.0], "a!": [0.0, 5.0], "b": [0.0, 5.0], "b!": [0.0, 5.0]}
    found = queries.embed_prompts(
        ["a", "b"], lambda texts: torch.tensor([vectors[t] for t in texts]), ("{}", "{}!")
    )
    torch.testing.assert_close(found, torch.tensor([[0.5**0.5, 0.5**0.5], [0.0, 1.0]]))


# Relevancy


@settings(max_examples=30)
@given(st.integers(1, 4), st.integers(1, 5), st.floats(0.5, 100), st.integers(0, 1000))
def test_relevancy_is_the_least_favorable_pairwise_softmax(prompts, negatives, temperature, seed):
    rng = np.random.default_rng(seed)
    positive, negative = rng.uniform(-1, 1, (7, prompts)), rng.uniform(-1, 1, (7, negatives))
    pairs = np.exp(temperature * positive[..., None]) / (
        np.exp(temperature * positive[..., None]) + np.exp(temperature * negative[:, None, :])
    )
    found = queries.pairwise_relevancy(torch.tensor(positive), torch.tensor(negative), temperature)
    np.testing.assert_allclose(found.numpy(), pairs.min(-1), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("codes", "dim"), [(5, 64), (64, 64), (96, 32)])
@pytest.mark.parametrize("sharpness", [0.1, 3.0, 30.0])
def test_cosines_without_the_feature_map_equal_those_with_it(codes, dim, sharpness):
    codewords = texts(codes, dim, 0) * torch.linspace(0.5, 2, codes)[:, None]
    probabilities = distributions((9, 11, codes), 1, sharpness)
    prompts = texts(6, dim, 2)
    expected = cosines_of_built_features(probabilities.double(), codewords.double(), prompts.double())
    found = queries.feature_cosines(probabilities, codewords, prompts)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1e-5)


def test_cosines_do_not_depend_on_the_scale_and_an_empty_row_has_none():
    probabilities, codewords, prompts = distributions((8, 10), 0), texts(10, 16, 1), texts(3, 16, 2)
    found = queries.feature_cosines(0.01 * probabilities, codewords, prompts)
    torch.testing.assert_close(found, queries.feature_cosines(probabilities, codewords, prompts))
    assert not queries.feature_cosines(torch.zeros(2, 10), codewords, prompts).any()


def test_blocks_do_not_show(monkeypatch):
    probabilities, codewords, prompts = distributions((50, 10), 0), texts(10, 16, 1), texts(3, 16, 2)
    whole = queries.feature_cosines(probabilities, codewords, prompts)
    monkeypatch.setattr(queries, "_CHUNK", 7)
    torch.testing.assert_close(queries.feature_cosines(probabilities, codewords, prompts), whole)


@pytest.mark.parametrize("form", FORMS)
def test_both_forms_agree_on_hard_codes(form):
    codewords, question = texts(6, 16, 0), asked(form)
    found = queries.probability_relevancy(torch.eye(6), codewords, question)
    torch.testing.assert_close(found, queries.code_relevancy(codewords, question))


def test_the_code_form_is_linear_and_the_feature_form_is_not():
    codewords = texts(6, 16, 0)
    mixed = torch.tensor([[0.25, 0.75, 0, 0, 0, 0]])
    table = queries.code_relevancy(codewords, asked())
    expected = 0.25 * table[:1] + 0.75 * table[1:2]
    by_code = queries.probability_relevancy(mixed, codewords, asked("code"))
    torch.testing.assert_close(by_code, expected)
    by_feature = queries.probability_relevancy(mixed, codewords, asked("feature"))
    assert (by_feature - expected).abs().max() > 1e-2


@pytest.mark.parametrize("form", FORMS)
def test_what_is_not_covered_is_not_relevant(form):
    full = distributions((1, 6), 3)
    rows = torch.cat([full, 0.4 * full, 0 * full])
    found = queries.probability_relevancy(rows, texts(6, 16, 0), asked(form))
    torch.testing.assert_close(found[1], 0.4 * found[0])
    assert not found[2].any()


@pytest.mark.parametrize("form", FORMS)
def test_the_relevancy_of_a_view_is_that_of_its_rendered_distributions(cloud, form):
    field, gaussians, camera = cloud
    found = queries.render_relevancy(field, gaussians, camera, asked(form))
    probabilities = field.render_code_probabilities(gaussians, camera)
    expected = queries.probability_relevancy(probabilities, field.codebook.clip, asked(form))
    assert found.shape == (3, 36, 48)
    torch.testing.assert_close(found, expected.permute(2, 0, 1), rtol=0, atol=2e-5)
    assert not found[:, 0, 0].any(), "the corner is empty"


def test_in_the_code_form_a_view_is_the_rendering_of_the_gaussians_scores(cloud):
    from lexsplat.rendering import render

    field, gaussians, camera = cloud
    scores = queries.gaussian_relevancy(field, asked())
    rendered = render(gaussians, camera, features=scores.T.contiguous(), color=False).features
    found = queries.render_relevancy(field, gaussians, camera, asked())
    torch.testing.assert_close(found, rendered.permute(2, 0, 1), rtol=0, atol=1e-5)
    assert found.max() > 0.1


@pytest.mark.parametrize("form", FORMS)
def test_scores_of_gaussians_come_from_their_own_distributions(cloud, form):
    field, _, _ = cloud
    found = queries.gaussian_relevancy(field, asked(form))
    dense = queries.probability_relevancy(field.code_probabilities(), field.codebook.clip, asked(form))
    torch.testing.assert_close(found, dense.T, rtol=0, atol=1e-6)
    assert not found[:, :20].any(), "Gaussians without language score 0"


@pytest.mark.parametrize("form", FORMS)
def test_the_level_with_the_highest_peak_answers_a_prompt(cloud, form):
    """Two levels that differ in which codes the Gaussians have; a peak is the mean of 20 Gaussians."""
    first, gaussians, camera = cloud
    other = CodeField(first.codebook, (11 - first.codes).sort(1)[0], first.weights, first.uncertainties)
    both = torch.cat([first.codes, other.codes], 1), torch.cat([first.weights, other.weights], 1) / 2
    field, question = CodeField(first.codebook, *both, first.uncertainties, num_levels=2), asked(form, 8)
    alone = [queries.gaussian_relevancy(level, question).numpy() for level in (first, other)]
    peaks = [np.sort(scores, axis=1)[:, -20:].mean(1) for scores in alone]
    best = np.argmax(peaks, axis=0)
    assert 0 < best.sum() < 8, "each level answers some prompt"
    found = queries.gaussian_relevancy(field, question).numpy()
    maps = [queries.render_relevancy(level, gaussians, camera, question) for level in (first, other)]
    shown = queries.render_relevancy(field, gaussians, camera, question)
    for prompt, level in enumerate(best):
        np.testing.assert_allclose(found[prompt], alone[level][prompt], atol=1e-6)
        torch.testing.assert_close(shown[prompt], maps[level][prompt], rtol=0, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_scores_of_gaussians_never_hold_all_distributions(cloud, form, monkeypatch):
    """``[N, K]`` of millions of Gaussians would be gigabytes."""
    field, _, _ = cloud
    whole = queries.gaussian_relevancy(field, asked(form))
    most = []

    def probabilities(self):
        most.append(len(self.codes))
        return original(self)

    original = type(field).code_probabilities
    monkeypatch.setattr(type(field), "code_probabilities", probabilities)
    monkeypatch.setattr(queries, "_GAUSSIANS", 7)
    found = queries.gaussian_relevancy(field, asked(form))
    torch.testing.assert_close(found, whole, rtol=0, atol=1e-6)
    assert max(most, default=0) <= 7


@pytest.mark.parametrize("form", FORMS)
def test_prompts_do_not_influence_each_other(cloud, form):
    field, gaussians, camera = cloud
    question = asked(form)
    together = queries.render_relevancy(field, gaussians, camera, question)
    for index in range(3):
        one = Question(question.positives[index : index + 1], question.negatives, question.config)
        alone = queries.render_relevancy(field, gaussians, camera, one)
        torch.testing.assert_close(alone[0], together[index], rtol=0, atol=1e-6)


def test_embeddings_of_another_encoder_are_refused():
    with pytest.raises(ValueError, match=r"positives must be \[\*, 16\]"):
        queries.code_relevancy(texts(6, 16, 0), Question(texts(2, 8, 1), texts(4, 16, 2)))


@pytest.mark.parametrize("prompts", [[1], [None, "apple"], 3, None, [["apple"]]])
def test_prompts_that_are_not_text_are_refused(prompts):
    with pytest.raises(QueryError, match="expected a text or a list of texts"):
        queries.check_prompts(prompts)


def test_a_single_text_is_one_prompt():
    assert queries.check_prompts(" red  apple ") == ["red apple"]


@pytest.mark.parametrize("change", [{"temperature": 0}, {"form": "both"}, {"threshold": 1.5}])
def test_a_setting_that_cannot_be_is_refused(change):
    with pytest.raises(ValueError):
        QueryConfig(**change)
