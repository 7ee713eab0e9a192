"""The rebuilt methods on balls with known meaning, and their parts against independent references."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import jensenshannon
from support.language_scene import CENTERS, IGNORED, LanguageScene, make_scene

from lexsplat.evaluation import Method
from lexsplat.evaluation.baselines import (
    BaselineRun,
    Dff,
    DffConfig,
    GaussianFeatures,
    Lerf,
    LerfConfig,
    Ovs3d,
    Ovs3dConfig,
    TrainingData,
    ViewFeatures,
)
from lexsplat.evaluation.baselines.feature_rendering import TrainingViews, back_projected_mean, render_cosines
from lexsplat.evaluation.baselines.lerf import level_weights, smooth_by_similarity
from lexsplat.evaluation.baselines.ovs3d import alignment_loss, js_divergence
from lexsplat.features import FeatureMap
from lexsplat.queries.relevancy import Question, pairwise_relevancy
from lexsplat.rendering import back_project, render

pytestmark = pytest.mark.slow

BALLS = len(CENTERS)
DIM = BALLS + 1  # one direction for each ball, one for everything else
WORDS = torch.eye(DIM)[:BALLS]
OTHER = torch.eye(DIM)[BALLS:]


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene(per_ball=40, views=6)


def feature_maps(balls, noise=0.0, seed=0):
    generator = torch.Generator().manual_seed(seed)
    maps = {}
    for name, codes in balls.code_maps.items():
        index = torch.from_numpy(np.where(codes == IGNORED, BALLS, codes)).long()
        clip = torch.eye(DIM)[index] + noise * torch.randn(*codes.shape, DIM, generator=generator)
        maps[name] = FeatureMap(F.normalize(clip, dim=-1), F.normalize(torch.eye(DIM)[index] + 0.05, dim=-1))
    return maps


@pytest.fixture(scope="module")
def maps(balls):
    return feature_maps(balls)


def ball_scores(method, balls):
    """Share of the Gaussians whose highest score is that of their own ball."""
    scores = method.gaussian_scores(Question(WORDS, OTHER))
    assert scores.shape == (BALLS, len(balls.gaussians))
    assert float(scores.min()) >= 0
    assert float(scores.max()) <= 1
    return (scores.argmax(0).numpy() == balls.labels).mean()


def pixel_accuracy(method, balls, maps_shape=(24, 32)):
    right = total = 0
    for name, camera in balls.cameras.items():
        found = method.relevancy(balls.gaussians, camera, Question(WORDS, OTHER))
        assert found.shape == (BALLS, *maps_shape)
        ground_truth = balls.code_maps[name]
        on = ground_truth != IGNORED
        right += (found.argmax(0).numpy() == ground_truth)[on].sum()
        total += on.sum()
    return right / total


# Full-dimensional features


def training_data(balls, maps=None):
    """Data for methods that need no crop sizes; without maps, views have some of 16x12 cells."""
    maps = maps or {name: FeatureMap(torch.zeros(12, 16, 1)) for name in balls.cameras}
    return TrainingData(balls.gaussians, balls.cameras, maps, level_maps=None)


def test_back_projection_is_the_transpose_of_rendering(balls):
    views = TrainingViews(training_data(balls))
    camera, prepared = views.prepared("view0")
    weights = render(balls.gaussians, camera, features=torch.eye(len(balls.gaussians)), color=False).features
    values = torch.randn(camera.height, camera.width, 70, generator=torch.Generator().manual_seed(0))
    expected = torch.einsum("hwn,hwc->nc", weights.double(), values.double())
    found = back_project(balls.gaussians, camera, values, prepared)
    torch.testing.assert_close(found.double(), expected, atol=1e-4, rtol=1e-4)


def test_the_mean_of_a_constant_is_that_constant_where_a_gaussian_was_seen(balls):
    views = TrainingViews(training_data(balls), scale=2)
    events = []
    constant = torch.tensor([0.25, -1.0])
    features, weights = back_projected_mean(
        views, lambda name: constant.expand(24, 32, 2), listener=events.append
    )
    assert events == [1, 2, 3, 4, 5, 6]
    seen = weights >= 0.01
    torch.testing.assert_close(features[seen], constant.expand(int(seen.sum()), 2), atol=1e-4, rtol=1e-3)
    assert not features[~seen].any()


def test_cosines_in_chunks_are_those_of_the_whole_feature(balls):
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(len(balls.gaussians), 70, generator=generator)
    texts = F.normalize(torch.randn(3, 70, generator=generator), dim=-1)
    camera = balls.cameras["view1"]
    found, alpha = render_cosines(balls.gaussians, camera, features, texts)
    whole = render(balls.gaussians, camera, features=features, color=False)
    expected = F.cosine_similarity(whole.features[:, :, None], texts, dim=-1)
    lit = whole.alpha > 1e-3
    torch.testing.assert_close(found[lit], expected[lit], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(alpha, whole.alpha)


# dff


def test_distilled_features_find_the_balls(balls, maps):
    data = training_data(balls, maps)
    found = Dff(DffConfig(steps=20)).fit(data, BaselineRun({}))
    assert isinstance(found, Method)
    assert ball_scores(found, balls) > 0.85
    assert pixel_accuracy(found, balls) > 0.9
    assert found.tensors()["features"].dtype == torch.float16


def test_distilling_moves_from_the_mean_towards_the_least_squares_solution_and_is_reproducible(balls):
    noisy = feature_maps(balls, noise=0.3)
    eye = torch.eye(len(balls.gaussians))
    weights, targets = [], []
    for name, found in noisy.items():
        rendered = render(balls.gaussians, balls.cameras[name], features=eye, color=False).features
        weights.append(rendered.flatten(0, 1).double())
        targets.append(found.clip.flatten(0, 1).double())
    system, target = torch.cat(weights), torch.cat(targets)
    best = torch.linalg.lstsq(system, target, driver="gelsd").solution

    def error(features):
        return float((system @ features.double() - target).square().mean())

    data = training_data(balls, noisy)
    average = Dff(DffConfig(steps=0)).fit(data, BaselineRun({}))
    fitted = Dff(DffConfig(steps=40, learning_rate=0.05)).fit(data, BaselineRun({}))
    left = (error(fitted.features[0]) - error(best)) / (error(average.features[0]) - error(best))
    assert 0 <= left < 0.6
    again = Dff(DffConfig(steps=40, learning_rate=0.05)).fit(data, BaselineRun({}))
    torch.testing.assert_close(fitted.features, again.features)


# lerf


def test_level_weights_by_hand():
    sides = [0.4, 0.1]  # not in order
    wanted = torch.tensor([[0.05, 0.1, 0.2, 0.4, 3.0]])
    weights = level_weights(wanted, sides)
    torch.testing.assert_close(weights[1, 0], torch.tensor([1.0, 1.0, 0.5, 0.0, 0.0]), atol=1e-5, rtol=0)
    torch.testing.assert_close(weights.sum(0), torch.ones(1, 5))
    assert level_weights(wanted, [0.3]).tolist() == [[[1.0] * 5]]


@given(
    st.lists(st.floats(0.01, 1), min_size=1, max_size=5, unique_by=lambda x: round(x, 3)),
    st.floats(0.001, 10),
)
def test_level_weights_sum_to_one_and_interpolate_the_logarithm(sides, wanted):
    weights = level_weights(torch.tensor([[wanted]]), sides)[:, 0, 0]
    assert float(weights.sum()) == pytest.approx(1, abs=1e-5)
    assert float(weights.min()) >= -1e-6
    mean = float((weights * torch.tensor([math.log(side) for side in sides])).sum())
    assert mean == pytest.approx(math.log(min(max(wanted, min(sides)), max(sides))), abs=1e-3)


def test_each_prompt_takes_the_scale_with_the_highest_relevancy(balls):
    blind = torch.eye(DIM)[BALLS].expand(len(balls.gaussians), DIM)
    first, second = blind.clone(), blind.clone()
    labels = torch.from_numpy(balls.labels)
    first[labels == 0] = WORDS[0]
    second[labels == 1] = WORDS[1]
    both = GaussianFeatures("both", torch.stack([first, second]), torch.tensor([0.1, 0.2]))
    camera = balls.cameras["view0"]
    found = both.relevancy(balls.gaussians, camera, Question(WORDS[:2], OTHER))
    for index, features in enumerate((first, second)):
        alone = GaussianFeatures("one", features[None])
        alone = alone.relevancy(balls.gaussians, camera, Question(WORDS[:2], OTHER))
        torch.testing.assert_close(found[index], alone[index])
    scores = both.gaussian_scores(Question(WORDS[:2], OTHER))
    assert ((scores[0] > 0.9).numpy() == (balls.labels == 0)).all()
    assert ((scores[1] > 0.9).numpy() == (balls.labels == 1)).all()


def test_dissimilar_neighbors_do_not_mix_and_unseen_gaussians_are_filled_in():
    means = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.15, 0, 0]])
    dino = torch.tensor([[1.0, 0], [1, 0], [0, 1], [0, 0]])
    features = torch.tensor([[[1.0], [3.0], [9.0], [0.0]]])
    found = smooth_by_similarity(means, dino, features, LerfConfig(neighbors=3, sharpness=50.0))[0, :, 0]
    torch.testing.assert_close(found[:3], torch.tensor([2.0, 2.0, 9.0]), atol=1e-4, rtol=0)
    assert float(found[3]) == pytest.approx((1 + 3 + 9) / 3)


def test_lerf_finds_the_balls(balls, maps):
    def levels(name):  # the larger crops show only the surroundings
        blur = torch.eye(DIM)[BALLS].expand_as(maps[name].clip)
        return torch.stack([maps[name].clip, blur]), [0.1, 0.6]

    data = TrainingData(balls.gaussians, balls.cameras, maps, levels)
    found = Lerf(LerfConfig(scales=2, neighbors=3)).fit(data, BaselineRun({}))
    again = Lerf(LerfConfig(scales=2, neighbors=3)).fit(data, BaselineRun({}, seed=7))
    assert torch.equal(found.features, again.features), "seeds have no effect, as docs/evaluation.md says"
    assert isinstance(found, Method)
    assert found.features.shape == (2, len(balls.gaussians), DIM)
    assert float(found.scales[0]) < float(found.scales[1])
    assert ball_scores(found, balls) > 0.85
    assert pixel_accuracy(found, balls) > 0.85


# 3dovs


@given(st.lists(st.floats(-8, 8), min_size=4, max_size=4), st.lists(st.floats(-8, 8), min_size=4, max_size=4))
def test_the_divergence_is_scipys_and_bounded(first, second):
    logs = [torch.tensor(values, dtype=torch.float64).log_softmax(-1) for values in (first, second)]
    found = float(js_divergence(*logs))
    distance = jensenshannon(*[log.exp().numpy() for log in logs])  # NaN where rounding takes it below zero
    assert found == pytest.approx(np.nan_to_num(distance) ** 2, abs=1e-9)
    assert -1e-12 <= found <= math.log(2) + 1e-12


def test_alignment_pulls_similar_pixels_together_and_pushes_others_apart():
    config = Ovs3dConfig(similar_weight=1.0, dissimilar_weight=1.0)
    same, other = torch.tensor([4.0, 0]).log_softmax(-1), torch.tensor([0.0, 4]).log_softmax(-1)
    similar, different = torch.tensor([[1.0, 0], [1, 0]]), torch.tensor([[1.0, 0], [0, 1]])
    assert float(alignment_loss(torch.stack([same, same]), similar, config)) == pytest.approx(0, abs=1e-6)
    gap = float(js_divergence(same, other))
    assert float(alignment_loss(torch.stack([same, other]), similar, config)) == pytest.approx(
        0.3 * gap, rel=1e-4
    )
    assert float(alignment_loss(torch.stack([same, other]), different, config)) == pytest.approx(
        -0.7 * gap, rel=1e-4
    )


def test_3dovs_separates_the_classes_and_one_half_selects_the_best_class(balls, maps):
    def levels(name):
        return torch.stack([maps[name].clip, maps[name].clip.flip(0)]), [0.1, 0.6]

    classes = torch.cat([WORDS, OTHER])
    data = TrainingData(balls.gaussians, balls.cameras, maps, levels)
    found = Ovs3d(Ovs3dConfig(steps=15, pairs=32)).fit(data, BaselineRun({}, classes))
    assert isinstance(found, Method)
    assert ball_scores(found, balls) > 0.85
    scores = found.gaussian_scores(Question(classes, OTHER))
    known = found.features.norm(dim=1) > 0
    assert ((scores >= 0.5).sum(0)[known] == 1).all(), "one class is the best of all"
    with pytest.raises(ValueError, match="two classes"):
        Ovs3d().fit(data, BaselineRun({}, WORDS[:1]))


# nearest


def test_nearest_is_the_relevancy_of_the_views_own_features(balls, maps):
    found = ViewFeatures(balls.cameras, maps)
    assert isinstance(found, Method)
    camera = balls.cameras["view2"]
    expected = pairwise_relevancy(maps["view2"].clip @ WORDS.T, maps["view2"].clip @ OTHER.T, 10.0)
    same = found.relevancy(balls.gaussians, camera, Question(WORDS, OTHER))
    torch.testing.assert_close(same, expected.permute(2, 0, 1))
    larger = found.relevancy(balls.gaussians, camera.resized(64, 48), Question(WORDS, OTHER))
    assert larger.shape == (BALLS, 48, 64)
    assert float((F.avg_pool2d(larger[None], 2)[0] - same).abs().mean()) < 0.02
    assert found.gaussian_scores(Question(WORDS, OTHER)) is None
    stranger = make_scene(per_ball=2, views=7).cameras["view3"]
    with pytest.raises(ValueError, match="poses"):
        found.relevancy(balls.gaussians, stranger, Question(WORDS, OTHER))
