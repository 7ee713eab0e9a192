"""Answers to unions, counts and widths, on groups of points at known places."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.phrases import parse

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.queries.answering import Searched, answer
from lexsplat.queries.selection import Selection

UP = np.array([0.0, 0.0, 1.0])
SIZES = {  # half sizes along x, y and z of boxes of points, of which 20 are in the middle
    "apple": (0.2, 0.2, 0.2),
    "other apple": (0.2, 0.2, 0.2),
    "board": (0.9, 0.2, 0.05),
    "pole": (0.1, 0.1, 1.2),
}
CAMERAS = {"front": look_at([0.0, -9.0, 1.5], [0.0, 0.0, 0.0], UP, 64, 48, 0.8)}


@pytest.fixture(scope="module")
def select() -> Callable[..., Selection]:
    rng = np.random.default_rng(0)
    points = [
        rng.uniform(-1, 1, (200, 3)) * size * np.where(np.arange(200) < 20, 0.2, 1.0)[:, None]
        + (3.0 * number, 0, 0)
        for number, size in enumerate(SIZES.values())
    ]
    gaussians = gaussians_from_points(
        np.concatenate(points), np.full((200 * len(SIZES), 3), 0.5), sh_degree=0, opacity=0.8
    )

    def select(*names: str, first: int = 200) -> Selection:
        mask = torch.zeros(len(gaussians), dtype=torch.bool)
        for name in names:
            start = 200 * list(SIZES).index(name)
            mask[start : start + first] = True
        return Selection(gaussians, CAMERAS, mask, mask.float(), phrase=" ".join(names))

    return select


def asked(
    text: str,
    words: dict[str, Selection],
    objects: tuple[Selection, ...] = (),
    colors: dict[str, list[str]] | None = None,
) -> Selection:
    told = colors or {}
    searched = Searched(
        lambda word: words[word], lambda _: None, lambda: objects, lambda each: told.get(each.phrase, [])
    )
    return answer(parse(text), searched)


def test_an_apple_that_is_red_and_a_bit_green_is_counted_once(select):
    words = {"red apple": select("apple"), "green apple": select("apple", first=20)}
    assert asked("is the apple red or green?", words).count == 1
    assert asked("is the apple green or red?", words).count == 1
    assert len(asked("is the apple green or red?", words)) == 200


def test_apples_of_two_colors_are_counted_both(select):
    words = {"red apple": select("apple"), "green apple": select("other apple")}
    assert asked("the red or the green apple", words).count == 2


def test_a_stem_and_its_apple_stay_apart(select):
    assert asked("apple or stem", {"apple": select("apple"), "stem": select("apple", first=20)}).count == 2


@pytest.mark.parametrize(
    ("text", "count"),
    [("exactly two apples", 2), ("exactly one apple", 0), ("only one apple", 0), ("exactly three apples", 0),
     ("at least one apple", 2)],
)  # fmt: skip
def test_a_number_is_exact_where_it_is_asked_so(select, text, count):
    found = asked(text, {"apple": select("apple", "other apple")})
    assert found.count == count
    assert (found.present == "no") == (count == 0)
    assert ("2 found" in found.note) == (count == 0)


@pytest.mark.parametrize(
    ("text", "present", "count"),
    [("at most two apples", "yes", 2), ("fewer than two apples", "no", 0), ("no apples", "no", 0),
     ("is there no bottle?", "yes", 0), ("fewer than two bottles", "yes", 0), ("at most two boards", "unsure", 1),
     ("are there no boards?", "unsure", 0)],
)  # fmt: skip
def test_little_of_a_thing_holds_where_there_is_none(select, text, present, count):
    words = {
        "apple": select("apple", "other apple"),
        "bottle": replace(select("pole"), present="no"),
        "board": replace(select("board"), present="unsure"),
    }
    found = asked(text, words)
    assert (found.present, found.count, bool(found)) == (present, count, count > 0)


def test_lengths_and_widths_are_those_of_boxes(select):
    words = {name: select(name) for name in ("apple", "board", "pole")}
    assert asked("is the pole longer than the board?", words).present == "yes"
    assert asked("is the board wider than the pole?", words).present == "yes"
    assert asked("is the pole wider than the board?", words).present == "no"


def test_a_statement_on_a_superlative_holds_for_the_thing_that_it_names(select):
    words = {name: select(name) for name in ("apple", "board", "pole")}
    objects = tuple(words.values())
    assert asked("is the pole the tallest object?", words, objects).num_gaussians == 200
    assert asked("is the apple the tallest object?", words, objects).present == "no"
    assert asked("is the apple not the tallest object?", words, objects).present == "yes"


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("the widest thing", "board"),
        ("the longest thing", "pole"),
        ("the longest thing but the pole", "board"),
    ],
)
def test_widths_are_horizontal_and_lengths_are_of_any_direction(select, text, name):
    objects = tuple(select(each) for each in SIZES)
    found = asked(text, {"pole": select("pole")}, objects)
    assert [each.phrase for each in found.instances] == [name]


def test_an_exception_leaves_the_next_one_of_a_superlative(select):
    objects = tuple(select(each) for each in SIZES)
    words = {"pole": select("pole"), "apple": select("apple")}
    (found,) = asked("the tallest thing except the pole", words, objects).instances
    assert "apple" in found.phrase
    words["board"] = select("board")
    (found,) = asked("the closest thing to the pole except the board", words, objects).instances
    assert found.phrase == "other apple"


def test_what_has_a_part_is_not_without_it(select):
    both = select("apple", "other apple")
    words = {"apple": both, "apple stem": select("other apple", first=20)}
    assert torch.equal(asked("apple without stem", words).mask, select("apple").mask)
    assert asked("apple without a stem", {**words, "apple stem": both}).present == "no"
    objects = tuple(
        each.described(parts=(each,)) for each in (select("apple"), select("other apple"), select("board"))
    )
    stems = {**words, "stem": select("other apple", first=20)}
    assert torch.equal(asked("things without a stem", stems, objects).mask, select("apple", "board").mask)
    gone = replace(words["apple stem"], present="no")
    assert asked("apple without stem", {**words, "apple stem": gone}).count == 2


def test_what_is_a_thing_of_another_name_is_taken_off(select):
    words = {"toy": select("apple", "board", "pole"), "apple": select("apple", "other apple")}
    assert torch.equal(asked("toys that are not apples", words).mask, select("board", "pole").mask)
    assert torch.equal(asked("toys that are apples", words).mask, select("apple").mask)


COLORS = {"apple": ["red"], "board": ["red", "brown"], "pole": ["gray", "brown"]}


@pytest.mark.parametrize(
    ("text", "names", "present", "note"),
    [
        ("something red", {"apple", "board"}, "yes", ""),
        ("gray things", {"pole"}, "yes", ""),
        ("brown things", {"board", "pole"}, "unsure", "no thing is mainly brown"),
        ("something blue", set(), "no", ""),
        ("things that are not red", {"pole"}, "yes", ""),
        ("things that are not brown", {"apple", "board", "pole"}, "yes", ""),
    ],
)
def test_a_thing_that_a_color_is_only_a_part_of_may_be_meant_where_none_is_mainly_of_it(
    select, text, names, present, note
):
    objects = tuple(select(name) for name in COLORS)
    found = asked(text, {}, objects, COLORS)
    assert {each.phrase for each in found.instances} == names
    assert (found.present, found.note) == (present, note)


def test_a_toy_that_is_only_partly_black_is_noted_as_a_toy(select):
    toys = (select("apple").described(phrase="toy car"),)
    found = asked("the black toy", {"toy": toys[0]}, toys, {"toy car": ["red", "black"]})
    assert (found.present, found.count, found.note) == ("unsure", 1, "no toy is mainly black")


def test_what_has_a_part_is_the_whole_thing_and_not_the_part(select):
    both = select("apple", "other apple")
    words = {"apple": both, "apple stem": select("other apple", first=20)}
    for text in ("apple with a stem", "apples with stems", "the apple that has a stem"):
        found = asked(text, words)
        assert torch.equal(found.mask, select("other apple").mask), text
        assert (found.present, found.count) == ("yes", 1)
    unsure = {**words, "apple stem": replace(words["apple stem"], present="unsure")}
    assert asked("apple with a stem", unsure).present == "unsure"


def test_what_the_whole_phrase_describes_has_the_part_that_is_not_found_alone(select):
    gone = replace(select("apple", first=20), present="no")
    words = {"apple": select("apple", "other apple"), "apple leaf": gone}
    whole = {**words, "apple with leaves": select("apple"), "apple with a leaf": gone}
    assert torch.equal(asked("apple with leaves", whole).mask, select("apple").mask)
    assert asked("apple with a leaf", whole).present == "no"
