import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lexsplat import queries
from lexsplat.cameras import look_at
from lexsplat.codebook import Codebook
from lexsplat.errors import QueryError
from lexsplat.gaussians import gaussians_from_points
from lexsplat.language_field import LiftedField
from lexsplat.queries import QueryConfig

FORMS = ("feature", "code")


def texts(count, dim, seed):
    return torch.nn.functional.normalize(
        torch.randn(count, dim, generator=torch.Generator().manual_seed(seed)), dim=-1
    )


def distributions(shape, seed, sharpness=3.0):
    logits = sharpness * torch.randn(shape, generator=torch.Generator().manual_seed(seed))
    return logits.softmax(-1)


@pytest.fixture(scope="module")
def lifted():
    """Gaussians in a cloud with random codes, some with none, and a camera that sees past them."""
    rng = np.random.default_rng(0)
    gaussians = gaussians_from_points(
        rng.uniform(-0.6, 0.6, (150, 3)), rng.random((150, 3)), sh_degree=0, opacity=0.7
    )
    gaussians.log_scales -= 0.7  # small, so that the corners of the view are empty
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(150, 4, generator=generator)
    weights = weights / weights.sum(1, keepdim=True)
    weights[:20] = 0
    codes = torch.stack([torch.randperm(12, generator=generator)[:4] for _ in range(150)]).to(torch.uint8)
    field = LiftedField(Codebook(texts(12, 16, 2)), codes, weights, torch.zeros(150))
    camera = look_at(np.array([0, -4, 0.5]), np.zeros(3), np.array([0, 0, 1.0]), 48, 36, 0.9)
    return field, gaussians, camera


# Text


@pytest.mark.parametrize("prompts", [[], [""], ["apple", "  \n"], ""])
def test_an_empty_prompt_is_an_error_with_a_remedy(prompts):
    with pytest.raises(QueryError, match="red apple"):
        queries.expand_templates(prompts)


def test_templates_multiply_prompts_in_order():
    found = queries.expand_templates(["  red   apple ", "cup {x}"], ["a {}", "the {}."])
    assert found == ["a red apple", "the red apple.", "a cup {x}", "the cup {x}."]
    with pytest.raises(ValueError, match="once"):
        queries.expand_templates(["apple"], ["a photo"])


def test_averaged_templates_are_mean_directions_whatever_the_lengths():
    a, b = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 5.0]])
    found = queries.average_templates(torch.cat([a, b, b, b]), 2)
    torch.testing.assert_close(found, torch.tensor([[0.5**0.5, 0.5**0.5], [0.0, 1.0]]))


def test_prompts_are_embedded_by_one_call():
    calls = []

    def encode(batch):
        calls.append(batch)
        return torch.tensor([[float(len(text)), 1.0] for text in batch])

    found = queries.embed_prompts(["ab", "abcd"], encode, ("{}", "{}!"))
    assert calls == [["ab", "ab!", "abcd", "abcd!"]]
    assert found.shape == (2, 2)


# Relevancy


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 4), st.integers(1, 5), st.floats(0.5, 100), st.integers(0, 1000))
def test_relevancy_is_the_least_favourable_pairwise_softmax(prompts, negatives, temperature, seed):
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
    expected = queries.feature_cosines_naive(probabilities.double(), codewords.double(), prompts.double())
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
    codewords, positives, negatives = texts(6, 16, 0), texts(2, 16, 1), texts(4, 16, 2)
    found = queries.probability_relevancy(
        torch.eye(6), codewords, positives, negatives, QueryConfig(form=form)
    )
    torch.testing.assert_close(found, queries.code_relevancy(codewords, positives, negatives))


def test_the_code_form_is_linear_and_the_feature_form_is_not():
    codewords, positives, negatives = texts(6, 16, 0), texts(2, 16, 1), texts(4, 16, 2)
    mixed = torch.tensor([[0.25, 0.75, 0, 0, 0, 0]])
    table = queries.code_relevancy(codewords, positives, negatives)
    expected = 0.25 * table[:1] + 0.75 * table[1:2]
    by_code = queries.probability_relevancy(mixed, codewords, positives, negatives, QueryConfig(form="code"))
    torch.testing.assert_close(by_code, expected)
    by_feature = queries.probability_relevancy(
        mixed, codewords, positives, negatives, QueryConfig(form="feature")
    )
    assert (by_feature - expected).abs().max() > 1e-2


@pytest.mark.parametrize("form", FORMS)
def test_what_is_not_covered_is_not_relevant(form):
    codewords, positives, negatives = texts(6, 16, 0), texts(2, 16, 1), texts(4, 16, 2)
    full = distributions((1, 6), 3)
    rows = torch.cat([full, 0.4 * full, 0 * full])
    composite = queries.probability_relevancy(rows, codewords, positives, negatives, QueryConfig(form=form))
    torch.testing.assert_close(composite[1], 0.4 * composite[0])
    assert not composite[2].any()
    config = QueryConfig(form=form, coverage="divide")
    divided = queries.probability_relevancy(rows, codewords, positives, negatives, config)
    torch.testing.assert_close(divided[1], composite[0])
    assert not divided[2].any()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("coverage", ["composite", "divide"])
def test_a_view_is_answered_as_its_distributions_are(lifted, form, coverage):
    field, gaussians, camera = lifted
    config = QueryConfig(form=form, coverage=coverage)
    positives, negatives = texts(3, 16, 5), texts(4, 16, 6)
    found = queries.render_relevancy(field, gaussians, camera, positives, negatives, config)
    probabilities = field.render_code_probabilities(gaussians, camera)
    expected = queries.probability_relevancy(probabilities, field.codebook.clip, positives, negatives, config)
    assert found.shape == (3, 36, 48)
    torch.testing.assert_close(found, expected.permute(2, 0, 1), rtol=0, atol=2e-5)
    assert not found[:, 0, 0].any(), "nothing is in the corner"


def test_in_the_code_form_a_view_is_the_rendering_of_the_gaussians_scores(lifted):
    from lexsplat.rendering import render

    field, gaussians, camera = lifted
    positives, negatives, config = texts(3, 16, 5), texts(4, 16, 6), QueryConfig(form="code")
    scores = queries.gaussian_relevancy(field, positives, negatives, config)
    rendered = render(gaussians, camera, features=scores.T.contiguous(), color=False).features
    found = queries.render_relevancy(field, gaussians, camera, positives, negatives, config)
    torch.testing.assert_close(found, rendered.permute(2, 0, 1), rtol=0, atol=1e-5)
    assert found.max() > 0.1


@pytest.mark.parametrize("form", FORMS)
def test_scores_of_gaussians_come_from_their_own_distributions(lifted, form):
    field, _, _ = lifted
    positives, negatives, config = texts(3, 16, 5), texts(4, 16, 6), QueryConfig(form=form)
    found = queries.gaussian_relevancy(field, positives, negatives, config)
    dense = queries.probability_relevancy(
        field.code_probabilities(), field.codebook.clip, positives, negatives, config
    )
    torch.testing.assert_close(found, dense.T, rtol=0, atol=1e-6)
    assert not found[:, :20].any(), "Gaussians without language answer nothing"


@pytest.mark.parametrize("form", FORMS)
def test_several_prompts_at_once_are_each_alone(lifted, form):
    field, gaussians, camera = lifted
    positives, negatives, config = texts(3, 16, 5), texts(4, 16, 6), QueryConfig(form=form)
    together = queries.render_relevancy(field, gaussians, camera, positives, negatives, config)
    for index in range(3):
        alone = queries.render_relevancy(
            field, gaussians, camera, positives[index : index + 1], negatives, config
        )
        torch.testing.assert_close(alone[0], together[index], rtol=0, atol=1e-6)


def test_embeddings_of_another_encoder_are_refused():
    with pytest.raises(ValueError, match=r"positives must be \[\*, 16\]"):
        queries.code_relevancy(texts(6, 16, 0), texts(2, 8, 1), texts(4, 16, 2))


@pytest.mark.parametrize(
    "change", [{"temperature": 0}, {"form": "both"}, {"negatives": ()}, {"threshold": 1.5}, {"coverage": "?"}]
)
def test_a_setting_that_cannot_be_is_refused(change):
    with pytest.raises(ValueError):
        QueryConfig(**change)


# Thresholds and masks


def two_groups(share, low=0.2, high=0.6, spread=0.03, count=20_000):
    rng = np.random.default_rng(0)
    objects = int(share * count)
    samples = np.concatenate([rng.normal(low, spread, count - objects), rng.normal(high, spread, objects)])
    return torch.tensor(samples[None], dtype=torch.float32).clamp(0, 1)


@pytest.mark.parametrize("share", [0.3, 0.05, 0.01])
def test_the_automatic_threshold_separates_an_object_of_any_size(share):
    assert 0.3 < float(queries.automatic_threshold(two_groups(share), pull=0.0)) < 0.5
    assert 0.3 < float(queries.automatic_threshold(two_groups(share))) < 0.55


def test_plain_otsu_is_scikit_images():
    from skimage.filters import threshold_otsu

    samples = two_groups(0.3, spread=0.1)
    expected = threshold_otsu(samples.numpy().ravel(), nbins=512)
    found = float(queries.automatic_threshold(samples, tempering=1.0, pull=0.0))
    assert found == pytest.approx(expected, abs=0.6 * float(samples.max() - samples.min()) / 512 + 1e-6)


def test_the_threshold_lies_in_the_middle_of_a_gap():
    samples = torch.tensor([[0.1] * 90 + [0.8] * 10])
    assert float(queries.automatic_threshold(samples, pull=0.0)) == pytest.approx(0.45, abs=2e-3)


def test_the_threshold_is_half_where_the_classes_lie_on_either_side_of_it():
    assert queries.automatic_threshold(torch.tensor([[0.1] * 90 + [0.8] * 10])).tolist() == [0.5]
    below, above = torch.tensor([[0.1] * 90 + [0.4] * 10]), torch.tensor([[0.6] * 90 + [0.9] * 10])
    assert float(queries.automatic_threshold(below)) == pytest.approx(0.25, abs=2e-3)
    assert float(queries.automatic_threshold(above)) == pytest.approx(0.75, abs=2e-3)


def test_what_is_over_half_is_told_apart_from_what_is_only_a_little_alike():
    # Asked for a nose: the room says 0.02, the bear 0.3, its nose 0.7. Otsu alone parts bear and room.
    row = torch.tensor([[0.02] * 18_000 + [0.3] * 1_900 + [0.7] * 100])
    assert 0.3 < float(queries.automatic_threshold(row)) <= 0.5
    lower = torch.tensor([[0.02] * 18_000 + [0.3] * 1_900 + [0.45] * 100])
    assert 0.02 < float(queries.automatic_threshold(lower)) < 0.3, (
        "nothing is over 0.5: the widest gap counts"
    )


def test_the_cut_above_half_weighs_samples_like_repetitions():
    samples = torch.tensor([[0.02, 0.3, 0.7]])
    weights = torch.tensor([18_000, 1_900, 100])
    found = queries.automatic_threshold(samples, weights.float())
    torch.testing.assert_close(found, queries.automatic_threshold(samples.repeat_interleave(weights, dim=1)))
    assert float(found) > 0.3


@pytest.mark.parametrize("level", [0.05, 0.5, 0.9])
def test_a_flat_prompt_falls_back_to_half(level):
    noise = 0.01 * torch.rand(1, 1000, generator=torch.Generator().manual_seed(0))
    assert queries.automatic_threshold(level + noise).tolist() == [0.5]
    outlier = torch.full((1, 5000), 0.1)
    outlier[0, 0] = 0.9
    assert queries.automatic_threshold(outlier).tolist() == [0.5], "one stray sample is no object"


def test_weights_count_like_repetitions():
    samples = torch.tensor([[0.1, 0.12, 0.3, 0.5, 0.52]])
    weights = torch.tensor([50, 30, 0, 5, 9])
    repeated = samples.repeat_interleave(weights, dim=1)
    weighted = queries.automatic_threshold(samples, weights.float())
    torch.testing.assert_close(weighted, queries.automatic_threshold(repeated))


def test_each_prompt_has_its_own_threshold():
    rows = torch.cat([two_groups(0.05), two_groups(0.05, 0.6, 0.9), torch.full((1, 20_000), 0.3)])
    first, second, flat = queries.automatic_threshold(rows).tolist()
    assert first == 0.5 < second
    assert flat == 0.5


def test_the_threshold_of_a_scene_is_that_of_its_rendered_views(lifted):
    field, gaussians, camera = lifted
    positives, negatives, config = texts(3, 16, 5), texts(4, 16, 6), QueryConfig(form="code")
    views = [camera, camera.resized(96, 72)]
    found = queries.scene_threshold(field, gaussians, views, positives, negatives, config, long_side=48)
    one = queries.render_relevancy(field, gaussians, camera, positives, negatives, config).flatten(1)
    torch.testing.assert_close(found, queries.automatic_threshold(torch.cat([one, one], dim=1)))
    with pytest.raises(ValueError, match="at least one camera"):
        queries.scene_threshold(field, gaussians, [], positives, negatives, config)


def test_masks_take_one_threshold_or_one_for_each_prompt():
    relevancy = torch.tensor([[[0.4, 0.5]], [[0.6, 0.8]]])
    assert queries.masks(relevancy, 0.5).tolist() == [[[False, True]], [[True, True]]]
    assert queries.masks(relevancy, torch.tensor([0.4, 0.7])).tolist() == [[[True, True]], [[False, True]]]


def test_ranking_is_best_first_and_ties_keep_their_order():
    scores = torch.tensor([[0.2, 0.9, 0.9, 0.1]])
    indices, values = queries.ranking(scores, 3)
    assert indices.tolist() == [[1, 2, 0]]
    torch.testing.assert_close(values, torch.tensor([[0.9, 0.9, 0.2]]))
    assert queries.ranking(scores, 10)[0].shape == (1, 4)
