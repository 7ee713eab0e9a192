"""What a published page answers of the questions that `Scene.find` answers, in headless Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from questions import questions
from support.page_browser import CHROMIUM, HALF, ask, open_page, serving, until

from lexsplat.queries.phrases import Anything, Both, Colored, Thing, Together, parts_of
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.scene import Scene, open_scene

PIXEL_SCALE = HALF
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path")]

SINGLE = (
    "red things", "something red", "what is red?", "red toys", "all fruits", "every fruit", "blue or red mug",
    "red or green apple",
    "apple and banana", "what can I eat?", "what do I drink from?", "things made of wood", "everything",
    "yellow things", "wooden things", "anything soft", "is there a mug and a duck?", "blue mugs", "any animals?",
    "objects", "a place to sit", "cone you see at road works", "is the mug red?", "hey robot, where is the duck?",
    "show me the mug, please", "mug, duck and banana", "the handle of that blue mug", '"red apple"', "vase, white",
    'the "red apple" and the duck', "is there a zebra or a duck?", "is there a zebra and a duck?", "pink things",
    "red toy", "orange fruit", "yellow fruit", "blue toy", "something with leaves", "things with leaves",
    "can you see the mug?", "How many books?", "zebra", "red apple", "handle", "which things are toys?",
    "is the plant dead?", "is the lamp still on?", "is the mug empty or full?",
    "which mug is clean?", "where is the duck standing?",
    "how many wheels does the car have?",
    "things that are animals", "green leaves", "yellow books", "leaves of the plant", "plant leaves", "lampshade",
    "white lampshade", "flowerpot", "teddybear", "cupboard", "what touches the cloth?", "loaves of bread",
    "is the apple far from the lamp?", "which object is the heaviest?", "apple touching the banana",
    "white cloth", "red and white checkered cloth", "black things", "white bear",
    "metal duck", "blue vase", "vase with flowers",
)  # fmt: skip
FURTHER = (
    "banana next to the apple", "apple on the table", "what is on the table?", "the biggest toy", "the largest fruit",
    "mug left of the duck", "the thing behind the mug", "biggest object", "things on the tablecloth",
    "left of the teddy bear", "what is next to the mug?", "two mugs", "mug without handle", "the smallest thing",
    "closest to the lamp", "how many things are on the table?", "which is bigger, the mug or the duck?", "small mug",
    "not the mug", "second toy from the left", "mug between the duck and the apple", "all fruit except the banana",
    "the toy in the back left corner", "is the mug on the table?", "are all toys red?", "the thing closest to me",
    "small table", "large lamp", "all except the books", "all but the apple",
    "mug that is not blue", "book that is larger than the mug", "fruits that are not apples",
    "toys that are animals", "things that are not toys", "is the lamp the tallest object?", "is there no violin?",
    "there are no violins", "fewer than three apples", "at most two mugs", "two or fewer mugs", "is the duck a toy?",
    "is the banana longer than the apple?", "is the duck closer than the mug?", "neither the mug nor the duck",
    "objects that are neither red nor yellow", "is there neither a mug nor a duck?", "no toys on the table",
    "mug with a handle", "toy car with wheels",
)  # fmt: skip
"""What needs relations, an order, a comparison, a number or an exception."""
ASK = """async (prompts) => {
    const app = await lexsplat.ready;
    const answers = [];
    for (const prompt of prompts) {
        const answer = await app.source.answer(prompt, "#fff");
        await app.source.refine(answer);
        const { presence, unknown, note, beyond, offers, places } = answer;
        answers.push({ presence, unknown, note, beyond, offers, places: places.length });
    }
    return answers;
}"""


@pytest.fixture(scope="module")
def demo() -> Scene:
    return open_scene("demo")


@pytest.fixture(scope="module")
def page(browser, light_demo) -> Iterator[Any]:
    with serving(light_demo) as address:
        yield open_page(browser, address, 900, 600, scale=HALF)


@pytest.fixture(scope="module")
def asked() -> list[str]:
    return [*SINGLE, *FURTHER, *(q["ask"] for q in questions("tune") if q["scene"] == "demo")]


@pytest.fixture(scope="module")
def answers(page, asked):
    return dict(zip(asked, page.evaluate(ASK, asked)))


def is_simple(phrase) -> bool:
    """Whether a phrase is a thing, a color of things, or a union of these."""
    if isinstance(phrase, (Thing, Anything)):
        return True
    return isinstance(phrase, (Both, Together, Colored)) and all(map(is_simple, parts_of(phrase).values()))


def test_nothing_that_python_finds_is_denied_without_a_word(answers, demo):
    denied = [
        prompt
        for prompt, answer in answers.items()
        if answer["presence"] == "no"
        and not (answer["unknown"] and answer["note"])
        and demo.find(prompt).present == "yes"
    ]
    assert denied == []


def test_things_unions_and_colors_are_answered_as_python_answers_them(answers, demo):
    compared = {prompt for prompt in answers if is_simple(demo.understand(prompt).phrase)}
    assert compared >= set(SINGLE)
    for prompt in compared:
        answer, found = answers[prompt], demo.find(prompt)
        assert answer["beyond"] == "", prompt
        assert answer["presence"] == found.present, prompt
        assert answer["places"] == found.count, prompt
        assert ("not understood" in answer["note"]) == ("not understood" in demo.understand(prompt).note), (
            prompt
        )


def test_what_needs_more_than_things_is_never_denied_and_its_things_are_offered(answers, demo):
    further = [prompt for prompt in answers if not is_simple(demo.understand(prompt).phrase)]
    assert {*FURTHER} <= {*further}
    for prompt in further:
        answer = answers[prompt]
        assert (answer["presence"], answer["places"]) == ("unsure", 0), prompt
        assert f"“{answer['beyond']}” needs lexsplat view" in answer["note"], prompt
        assert answer["beyond"].lower() in prompt.lower()
    assert answers["mug left of the duck"]["beyond"] == "left of"
    assert answers["mug left of the duck"]["offers"] == ["mug", "duck"]
    assert answers["the biggest toy"]["offers"] == ["toy"]
    assert answers["two mugs"]["offers"] == ["mug"]
    assert answers["is the lamp the tallest object?"]["offers"] == ["lamp"]
    assert answers["fewer than three apples"]["offers"] == ["apple"]
    assert answers["all fruit except the banana"]["offers"] == ["fruit", "banana"]


def test_the_card_says_what_is_not_answered_and_asks_for_the_things_instead(page):
    ask(page, "mug left of the duck")
    card = page.locator(".card")
    assert card.locator(".state").inner_text() == "not answered here"
    assert "in this scene" not in card.inner_text()
    assert "“left of” needs lexsplat view" in card.locator(".fine").inner_text()
    assert card.locator("input:visible").count() == 0, "no threshold and no color"
    card.get_by_role("button", name="duck", exact=True).click()
    until(page, "document.querySelectorAll('.card').length === 2")
    assert card.nth(1).locator("strong").inner_text() == "duck"
    assert "here, one place" in card.nth(1).inner_text()
    ask(page, "cone you see at road works")
    assert "not understood (“you”)" in card.locator(".fine").inner_text()
    assert card.locator(".state").inner_text() == "not understood"
    ask(page, "hey robot, where is the duck?")
    assert card.count() == 1
    assert card.locator(".understood").inner_text() == "as “duck”"


def test_words_that_name_nothing_are_not_compared_with_the_phrases(page):
    nearest = page.evaluate("lexsplat.app.source.dictionary.similar('gizmo left of the duck')")
    assert nearest
    assert all("duck" in phrase for phrase in nearest)
    assert page.evaluate("lexsplat.app.source.dictionary.complete('where is the pump')[0]") == "pumpkin"


@pytest.mark.parametrize("prompt", ['"', 'red "apple', '"red" "apple', "red “apple"])
def test_a_quotation_mark_without_its_pair_is_not_answered_as_python_refuses_it(page, demo, prompt):
    with pytest.raises(QueryError, match="expected quotation marks in pairs, found an odd number"):
        demo.find(prompt)
    ask(page, prompt)
    card = page.locator(".card")
    assert card.locator(".state").inner_text() == "not answered here"
    assert card.locator(".fine").inner_text() == "Expected quotation marks in pairs, found an odd number."
    assert page.evaluate("lexsplat.app.answers[0].places") == []
