"""Sets of Gaussians: compared with sets of numbers, brute-force distances and balls at known places."""

import operator
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.language_scene import CENTERS, RADIUS, LanguageScene, make_scene

from lexsplat.geometry.cameras import Camera
from lexsplat.queries.selection import Selection
from lexsplat.runtime.errors import QueryError


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene(per_ball=200)


def select(balls, mask, **options) -> Selection:
    mask = torch.as_tensor(np.asarray(mask))
    return Selection(balls.gaussians, balls.cameras, mask, mask.float(), **options)


def ball(balls, *numbers) -> Selection:
    return select(balls, np.isin(balls.labels, numbers))


def test_each_ball_is_an_instance_where_it_stands(balls):
    chosen = ball(balls, 0, 1, 4)
    assert chosen.count == len(chosen.instances) == 3
    centers = sorted(tuple(instance.center.round(1)) for instance in chosen.instances)
    assert np.allclose(centers, sorted(map(tuple, CENTERS[[0, 1, 4]])), atol=0.1)
    for instance in chosen.instances:
        assert len(instance) == 200
        assert instance.size == pytest.approx(2 * RADIUS * 0.95, abs=0.12)


def test_specks_are_no_instances_and_can_be_left_out(balls):
    mask = balls.labels == 0
    mask[np.flatnonzero(balls.labels == 1)[:4]] = True
    chosen = select(balls, mask)
    assert len(chosen) == 204
    assert len(chosen.instances) == 1
    assert len(chosen.without_specks()) == 200
    assert len(chosen.clusters()) > 1


def test_only_instances_that_answer_about_as_well_as_the_best_convince(balls):
    labels = torch.from_numpy(balls.labels)
    scores = torch.tensor([0.9, 0.6, 0.85, 0.1, 0.1])[labels]  # two apples, a duck's back, the rest
    chosen = Selection(balls.gaussians, balls.cameras, scores >= 0.4, scores, threshold=0.4)
    assert len(chosen.instances) == 3
    kept = chosen.convincing()
    assert torch.equal(kept.mask, (labels == 0) | (labels == 2))
    assert len(kept.convincing()) == len(kept)
    alone = Selection(balls.gaussians, balls.cameras, labels == 1, scores, threshold=0.4)
    assert len(alone.convincing()) == 200, "the best one is never left out"
    by_themselves = torch.tensor([0.3, 0.2, 0.1, 0.1, 0.1])[labels]  # below the threshold of the segments
    assert torch.equal(chosen.convincing(by_themselves).mask, labels == 0), "not even then"


def test_operators_are_those_of_sets(balls):
    rng = np.random.default_rng(0)
    a, b = (rng.random(len(balls.labels)) < 0.4 for _ in range(2))
    first, second = select(balls, a), select(balls, b)
    for combined, expected in [
        (first | second, a | b), (first & second, a & b), (first - second, a & ~b), (~first, ~a),
    ]:  # fmt: skip
        assert np.array_equal(combined.mask.numpy(), expected)
        assert len(combined) == combined.num_gaussians == expected.sum()


def test_a_union_has_the_lower_threshold_and_other_combinations_the_first(balls):
    low, high = (select(balls, balls.labels == 0, threshold=threshold) for threshold in (0.3, 0.6))
    for first, second in ((low, high), (high, low)):
        assert (first | second).threshold == 0.3
        assert (first & second).threshold == (first - second).threshold == first.threshold


def test_presence_of_combinations_is_that_of_the_words(balls):
    yes, no = ball(balls, 0), select(balls, balls.labels == 1, present="no")
    assert [(yes | no).present, (yes & no).present, (yes - no).present, (no - yes).present] == [
        "yes", "no", "yes", "no",
    ]  # fmt: skip
    other = ball(balls, 2)
    assert [(yes & other).present, (yes - yes).present, (yes | other).present] == ["no", "no", "yes"], (
        "nothing is left"
    )


@pytest.mark.parametrize("distance", [0.05, 0.3, 1.2])
def test_grow_and_shrink_go_by_distance(balls, distance):
    means = balls.gaussians.means.numpy().astype(float)
    inside = balls.labels == 0
    apart = np.linalg.norm(means[:, None] - means[None], axis=-1)
    grown = apart[:, inside].min(1) <= distance
    shrunk = inside & (apart[:, ~inside].min(1) > distance)
    assert np.array_equal(ball(balls, 0).grow(distance).mask.numpy(), grown)
    assert np.array_equal(ball(balls, 0).shrink(distance).mask.numpy(), shrunk)


def test_growing_never_loses_and_shrinking_never_gains(balls):
    chosen = ball(balls, 0, 2)
    assert bool((chosen.grow().mask >= chosen.mask).all())
    assert bool((chosen.shrink().mask <= chosen.mask).all())


def test_largest_is_the_ball_with_most(balls):
    mask = (balls.labels == 0) | ((balls.labels == 1) & (np.arange(len(balls.labels)) % 2 == 0))
    assert np.array_equal(select(balls, mask).largest().mask.numpy(), balls.labels == 0)


def test_the_best_view_shows_the_ball_and_not_what_hides_it(balls):
    for number in range(5):
        counts = {name: int((codes == number).sum()) for name, codes in balls.code_maps.items()}
        assert counts[ball(balls, number).best_view] >= 0.8 * max(counts.values())


def test_an_empty_selection_has_no_box_but_answers_the_rest(balls):
    empty = select(balls, np.zeros(len(balls.labels), bool))
    assert not empty
    assert (len(empty), empty.count, empty.instances, empty.best_view, len(empty.grow())) == (0, 0, [], "", 0)
    assert empty.to_dict()["instances"] == []
    with pytest.raises(QueryError, match="something selected"):
        _ = empty.box


def test_one_gaussian_is_an_instance(balls):
    mask = np.zeros(len(balls.labels), bool)
    mask[7] = True
    assert len(select(balls, mask).instances) == 1
    assert select(balls, mask).center == pytest.approx(balls.gaussians.means[7].numpy(), abs=1e-6)


def test_masks_of_another_scene_are_refused(balls):
    with pytest.raises(ValueError, match="mask must be bool"):
        Selection(balls.gaussians, {}, torch.zeros(3, dtype=torch.bool), torch.zeros(3))
    few = balls.gaussians.select(torch.arange(3))
    other = Selection(few, {}, torch.ones(3, dtype=torch.bool), torch.ones(3))
    for combine in (operator.or_, operator.and_, operator.sub):
        with pytest.raises(ValueError, match="different scenes"):
            combine(ball(balls, 0), other)


def test_as_many_gaussians_elsewhere_are_another_scene_and_other_colors_are_the_same(balls):
    moved, painted = balls.gaussians.map(torch.clone), balls.gaussians.map(torch.clone)
    moved.means[0] += 1
    painted.sh0[0] += 1
    assert bool(ball(balls, 0) | replace(ball(balls, 1), gaussians=painted))
    with pytest.raises(ValueError, match="different scenes"):
        ball(balls, 0) | replace(ball(balls, 1), gaussians=moved)


def test_what_shrinks_to_nothing_is_not_there(balls):
    assert ball(balls, 0).shrink(1e-3).present == "yes"
    assert ball(balls, 0).shrink(100.0).present == "no"


def test_a_selection_combines_with_selections_only(balls):
    for combine in (operator.or_, operator.and_, operator.sub):
        with pytest.raises(TypeError, match="unsupported operand"):
            combine(ball(balls, 0), 5)
        with pytest.raises(TypeError, match="unsupported operand"):
            combine("mug", ball(balls, 0))


def test_plain_data_counts_instances_and_lists_none_of_what_is_not_there(balls):
    there = select(balls, np.isin(balls.labels, (0, 1)), phrase="ball").to_dict()
    assert (there["count"], len(there["instances"]), there["gaussians"]) == (2, 2, 400)
    absent = select(balls, balls.labels == 0, phrase="giraffe", present="no").to_dict()
    assert (absent["present"], absent["count"], absent["instances"], absent["best_view"]) == ("no", 0, [], "")
    assert absent["gaussians"] == 200


def test_the_representation_of_a_selection_is_one_line(balls):
    text = repr(select(balls, balls.labels == 0, phrase="ball"))
    assert text == "Selection('ball', present='yes', gaussians=200, threshold=0.5)"


class Shares:
    """What views show of a selection, all of which are known."""

    complete, names = True, ["near", "beside", "far"]

    def __init__(self, beside: float, far: float) -> None:
        self.known = sorted({"near": 1.0, "beside": beside, "far": far}.items(), key=lambda each: -each[1])

    def shares(self, indices, promising, most=1):
        assert promising is None
        return self.known[:most]

    def counted(self, indices):
        return None


@pytest.mark.parametrize(
    ("beside", "far", "best"),
    [(0.9, 0.85, "far"), (0.9, 0.79, "near"), (1.1, 0.85, "beside"), (1.1, 1.2, "far")],
)
def test_a_view_that_shows_a_thing_whole_wins_over_one_that_cuts_it_and_shows_hardly_more(
    balls, beside, far, best
):
    """The near view cuts it at the left, and the one beside it at the top."""
    place = np.eye(4)
    place[:3, 3] = np.array([0, 0, 5]) - CENTERS[0]
    middles = {"near": (0, 50), "beside": (50, 0), "far": (50, 50)}
    cameras = {
        name: Camera(100, 100, np.array([[100.0, 0, x], [0, 100, y], [0, 0, 1]]), place)
        for name, (x, y) in middles.items()
    }
    thing = replace(ball(balls, 0), cameras=cameras, seen=Shares(beside, far))
    assert thing.best_view == best
