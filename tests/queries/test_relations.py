"""Relations between balls and plates at known places."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.phrases import parse

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.queries.answering import Searched, answer
from lexsplat.queries.phrases import Related, Thing, Viewer
from lexsplat.queries.relations import distance, frame_of, holds, nearest, related
from lexsplat.queries.selection import Selection
from lexsplat.runtime.errors import QueryError

UP = np.array([0.0, 0.0, 1.0])
THINGS = {  # a table top, things on it, a lamp over it, a pea in a bowl, a ball on the floor
    "table": ("plate", (0.0, 0.0, 0.0), 1.5),
    "left ball": ("ball", (-0.8, -0.5, 0.25), 0.25),
    "right ball": ("ball", (0.8, -0.5, 0.25), 0.25),
    "far ball": ("ball", (0.0, 1.1, 0.25), 0.25),
    "lamp": ("ball", (0.0, 0.0, 2.0), 0.3),
    "bowl": ("ball", (0.0, -0.9, 0.35), 0.35),
    "pea": ("ball", (0.0, -0.9, 0.3), 0.08),
    "floor ball": ("ball", (3.0, 0.0, -1.0), 0.25),
    "beside": ("ball", (1.8, 0.0, 0.25), 0.25),  # a hand's breadth from the table's edge, at its height
    "cup": ("ball", (0.6, 1.0, 0.29), 0.15),  # on the table, its foot lost in the shadow
    "coin": ("coin", (0.9, 0.9, 0.03), 0.15),
    "pole": ("pole", (-1.0, -1.2, 1.0), 1.0),
    "other pole": ("pole", (0.2, -1.2, 1.0), 1.0),
}
FRONT = look_at([0.0, -5.0, 1.5], [0.0, 0.0, 0.0], UP, 64, 48, 0.8)
BACK = look_at([0.0, 5.0, 1.5], [0.0, 0.0, 0.0], UP, 64, 48, 0.8)


@pytest.fixture(scope="module")
def select() -> Callable[..., Selection]:
    rng = np.random.default_rng(0)
    points, labels = [], []
    for number, (kind, place, size) in enumerate(THINGS.values()):
        count = {"plate": 1500, "coin": 40}.get(kind, 200)
        if kind in ("plate", "coin"):
            cloud = np.c_[rng.uniform(-size, size, (count, 2)), rng.normal(0, 0.01, count)]
        elif kind == "pole":
            cloud = np.c_[rng.uniform(-0.1, 0.1, (count, 2)), rng.uniform(-size, size, count)]
        else:
            cloud = rng.normal(size=(count, 3))
            cloud *= size / np.linalg.norm(cloud, axis=1, keepdims=True)
        points.append(cloud + place)
        labels += [number] * count
    gaussians = gaussians_from_points(
        np.concatenate(points), np.full((len(labels), 3), 0.5), sh_degree=0, opacity=0.8
    )
    gaussians.log_scales -= 1.5  # thin, as training makes those of surfaces
    labels = np.array(labels)
    cameras = {"front": FRONT, "back": BACK, "side": look_at([5.0, 0, 1.5], [0, 0, 0], UP, 64, 48, 0.8)}

    def select(*names: str) -> Selection:
        mask = torch.from_numpy(np.isin(labels, [list(THINGS).index(name) for name in names]))
        return Selection(gaussians, cameras, mask, mask.float(), phrase=" ".join(names))

    return select


TRUE = [
    ("left ball", "left of", "right ball"), ("right ball", "right of", "bowl"), ("far ball", "behind", "bowl"),
    ("bowl", "in front of", "far ball"), ("left ball", "on", "table"), ("bowl", "on", "table"),
    ("coin", "on", "table"), ("table", "under", "left ball"), ("lamp", "above", "table"), ("table", "below", "lamp"),
    ("pea", "inside", "bowl"),
    ("left ball", "next to", "bowl"), ("floor ball", "right of", "table"), ("cup", "on", "table"),
    ("bowl", "larger than", "pea"), ("pea", "smaller than", "bowl"), ("pole", "taller than", "lamp"),
    ("table", "shorter than", "pea"),
]  # fmt: skip
FALSE = [
    ("right ball", "left of", "left ball"), ("lamp", "on", "table"), ("floor ball", "on", "table"),
    ("table", "on", "left ball"), ("bowl", "inside", "pea"), ("left ball", "inside", "bowl"),
    ("left ball", "next to", "floor ball"), ("left ball", "above", "right ball"), ("bowl", "behind", "far ball"),
    ("far ball", "left of", "bowl"), ("lamp", "next to", "table"), ("left ball", "next to", "right ball"),
    ("far ball", "next to", "right ball"),
    ("beside", "on", "table"), ("table", "under", "beside"), ("pole", "next to", "other pole"),
    ("bowl", "inside", "bowl"), ("left ball", "next to", "table"),
    ("pea", "larger than", "bowl"), ("bowl", "smaller than", "pea"), ("table", "taller than", "pole"),
    ("bowl", "larger than", "bowl"), ("bowl", "smaller than", "bowl"),
]  # fmt: skip


@pytest.mark.parametrize(("first", "relation", "second"), TRUE)
def test_what_is_so_holds(select, first, relation, second):
    assert holds(relation, select(first), select(second), frame_of(FRONT, UP))


@pytest.mark.parametrize(("first", "relation", "second"), FALSE)
def test_what_is_not_so_does_not_hold(select, first, relation, second):
    assert not holds(relation, select(first), select(second), frame_of(FRONT, UP))


def test_left_is_the_viewers_left(select):
    left, right = select("left ball"), select("right ball")
    assert holds("left of", right, left, frame_of(BACK, UP))
    assert not holds("left of", left, right, frame_of(BACK, UP))
    assert holds("behind", left, right, frame_of(look_at([5, 0, 1], [0, 0, 0], UP, 64, 48, 0.8), UP))


@given(st.floats(0.1, 3.0), st.floats(-3.0, 3.0))
@settings(max_examples=30)
def test_the_viewers_axes_are_level_and_right_angled(pitch, turn):
    eye = 4 * np.array([np.cos(turn) * np.cos(pitch), np.sin(turn) * np.cos(pitch), np.sin(pitch)])
    frame = frame_of(look_at(eye, np.zeros(3), [0.1, 0.2, 1.0], 64, 48, 0.8), UP)
    axes = np.stack([frame.right, frame.ahead, frame.up])
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_somebody_who_looks_straight_down_has_the_top_of_the_picture_ahead():
    frame = frame_of(look_at([0, 0, 5.0], [0, 0, 0], [0, 1.0, 0], 64, 48, 0.8), UP)
    assert frame.ahead == pytest.approx([0, 1, 0], abs=1e-9)
    assert frame.right == pytest.approx([1, 0, 0], abs=1e-9)


@pytest.mark.slow
def test_what_is_next_to_something_has_it_next_to_itself(select):
    frame = frame_of(FRONT, UP)
    for first, second in itertools.combinations(map(select, THINGS), 2):
        assert distance(first, second) == distance(second, first)
        assert holds("next to", first, second, frame) == holds("next to", second, first, frame)


def test_distance_is_that_between_surfaces(select):
    assert distance(select("left ball"), select("right ball")) == pytest.approx(1.6 - 0.5, abs=0.06)
    assert distance(select("lamp"), select("table")) == pytest.approx(2.0 - 0.3, abs=0.06)


def test_of_several_instances_those_that_fit_are_kept(select):
    balls = select("left ball", "right ball", "floor ball")
    frame = frame_of(FRONT, UP)
    on_table = related("on", balls, select("table"), frame)
    assert torch.equal(on_table.mask, select("left ball", "right ball").mask)
    assert torch.equal(
        nearest(balls, select("far ball", "lamp")).mask & select("floor ball").mask,
        torch.zeros_like(balls.mask),
    )
    assert torch.equal(nearest(select("lamp", "floor ball"), select("right ball")).mask, select("lamp").mask)
    assert related("on", select("floor ball"), select("table"), frame).present == "no"


def test_a_small_thing_that_a_large_ones_selection_takes_in_still_stands_on_it(select):
    """A coin lies so close to its table that it answers to "table" as well."""
    found = related("on", select("coin"), select("table", "coin"), frame_of(None, UP))
    assert len(found) == len(select("coin"))


def test_a_thing_is_not_next_to_itself_under_another_name(select):
    assert not related("next to", select("cup"), select("cup", "left ball"), frame_of(None, UP))


def test_a_phrase_is_answered_with_what_it_asks_for(select):
    words = {"ball": ("left ball", "right ball", "floor ball"), "table": ("table",), "lamp": ("lamp",)}

    def ask(text: str) -> Selection:
        return answer(parse(text), Searched(lambda word: select(*words[word]), lambda _: FRONT))

    assert torch.equal(ask("ball on the table").mask, select("left ball", "right ball").mask)
    assert torch.equal(
        ask("ball right of the lamp").mask & select("left ball").mask, torch.zeros_like(ask("ball").mask)
    )
    assert torch.equal(ask("ball but not the ball on the table").mask, select("floor ball").mask)
    assert torch.equal(ask("ball and lamp").mask, select(*words["ball"], "lamp").mask)
    assert len(ask("how many ball").instances) == 3
    assert ask("lamp on the table").present == "no"
    assert len(ask("largest ball")) == 200
    assert ask("ball on the table").phrase == '("ball" on "table")'


def test_what_fits_is_as_sure_as_the_least_sure_of_the_words(select):
    sure = {"ball": "yes", "table": "unsure", "bowl": "no", "lamp": "yes", "bear": "yes"}
    words = {"ball": ("left ball", "right ball"), "table": ("table",), "bowl": ("bowl",), "lamp": ("lamp",)}

    def ask(text: str) -> Selection:
        return answer(
            parse(text),
            Searched(lambda word: replace(select(*words[word]), present=sure[word]), lambda _: FRONT),
        )

    assert ask("ball on the table").present == "unsure"
    assert len(ask("ball next to the bowl")) == 0, "a no has no instances"
    assert ask("ball next to the bowl").present == "no", "what it stands next to is not in the scene"
    assert ask("ball nearest to the bowl").present == "no"
    assert (ask("ball but not the lamp").present, ask("ball but not the bowl").present) == ("yes", "yes")
    assert (len(ask("ball but not the ball")), ask("ball but not the ball").present) == (0, "no")


NAMES = {
    "ball": ("left ball", "right ball", "floor ball"),
    "table": ("table",),
    "lamp": ("lamp",),
    "bowl": ("bowl",),
}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("what is between the bowl and the far ball", ()),
        ("bowl between the left ball and the right ball", ("bowl",)),
        ("lamp between the left ball and the bowl", ()),
        ("ball farthest from the lamp", ("floor ball",)),
        ("the leftmost ball", ("left ball",)),
        ("the ball on the right", ("floor ball",)),
        ("what is closest to me", ("bowl",)),
        ("ball to my left", ("left ball",)),
        ("ball behind me", ()),
        ("which thing is on the table", ("left ball", "right ball", "bowl")),
        ("everything but the lamp", ("left ball", "right ball", "floor ball", "bowl")),
        ("the tallest thing", ("bowl",)),
        ("two lamps", ()),
        ("three balls", ("left ball", "right ball", "floor ball")),
        ("ball in the right corner", ("floor ball",)),
        ("the second ball from the left", ("right ball",)),
        ("the third nearest ball to the lamp", ("floor ball",)),
        ("three nearest things to the lamp", ("left ball", "right ball", "bowl")),
        ("four nearest balls to the lamp", ()),
        ("the third closest ball to me", ("floor ball",)),
        ("two balls closest to me", ("left ball", "right ball")),
        ("things larger than the lamp", ("bowl",)),
        ("is the bowl smaller than the lamp?", ()),
        ("which is smaller, the lamp or the bowl?", ("lamp",)),
        ("is there a lamp and a bowl?", ("lamp", "bowl")),
        ("are all balls on the table?", ()),
        ("is every lamp above the table?", ("lamp",)),
        ("things in the middle", ("right ball",)),
        ("ball at the back", ("floor ball",)),
        ("what is at the edge", ("left ball", "floor ball")),
        ("what is at the front of the table", ("bowl",)),
        ("the far ball at the back of the table", ("far ball",)),
        ("lamp in the middle of the table", ()),
        ("balls on the left side of the table", ("left ball",)),
    ],
)
def test_questions_are_answered_with_the_things_that_fit(select, text, expected):
    words = {**NAMES, "far ball": ("far ball",)}
    objects = [replace(select(name), phrase=word) for word, names in NAMES.items() for name in names]
    searched = Searched(lambda word: select(*words[word]), lambda _: FRONT, lambda: objects)
    found = answer(parse(text), searched)
    empty = torch.zeros_like(found.mask)
    assert torch.equal(found.mask, select(*expected).mask if expected else empty)
    assert len(found.instances) == len(expected)
    assert (found.present == "no") == (not expected)


@pytest.mark.parametrize(
    ("text", "present", "note"),
    [
        ("is there a ball and a bear?", "no", 'nothing fits "bear"'),
        ("balls and bears", "yes", 'nothing fits "bear"'),
        ("is there a ball, a bear and a table?", "no", 'nothing fits "bear"'),
        ("is there a ball and a table?", "unsure", ""),
        ("are all balls on the table?", "no", '2 of 3 are ("ball" on "table")'),
        ("which is bigger, the ball or the bear?", "no", 'nothing fits "bear"'),
    ],
)
def test_what_is_missing_of_several_is_reported(select, text, present, note):
    sure = {"ball": "yes", "table": "unsure", "bear": "no"}
    words = {**NAMES, "bear": ("lamp",)}
    searched = Searched(lambda word: replace(select(*words[word]), present=sure[word]), lambda _: FRONT)
    found = answer(parse(text), searched)
    assert (found.present, found.note) == (present, note)
    assert bool(found) == (present != "no")


def test_a_cluster_of_several_known_objects_is_answered_by_those_that_score_as_wholes(select):
    toys = ("left ball", "right ball", "bowl")
    whole = select(*toys, "table")
    scores = whole.scores * 0.6
    for name in toys[:2]:
        scores = torch.where(select(name).mask, 0.9, scores)
    objects = [replace(select(name), phrase=name) for name in (*toys, "table")]
    searched = Searched(
        lambda word: replace(whole, scores=scores, phrase=word), lambda _: None, lambda: objects
    )
    assert [each.phrase for each in answer(parse("toy"), searched).instances] == ["left ball", "right ball"]


def test_a_place_that_a_viewer_cannot_be_at_is_refused(select):
    searched = Searched(lambda word: select("lamp"), lambda _: FRONT)
    with pytest.raises(QueryError, match="closest to me"):
        answer(Related("on", Thing("lamp"), Viewer()), searched)
    with pytest.raises(QueryError, match="in front of me"):
        answer(Viewer(), searched)
