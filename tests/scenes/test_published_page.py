"""Published pages in a real browser: headless Chromium with software WebGL. Nothing but the folder is served."""

from __future__ import annotations

import base64
import json
import os
import shutil
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion
from support.page_browser import CHROMIUM, HALF, ask, open_page, picture, serving, show, until

from lexsplat.queries.vocabulary import COLORS, is_part_alone, thing_of_part
from lexsplat.rendering import render
from lexsplat.scenes.scene import Scene, open_scene

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path")]

PROMPTS = (
    "red apple",
    "something to drink from",
    "the handle of that blue mug",  # in no dictionary
    "Café's über-mug 42!",  # accents, marks and digits
    "green apple stem",  # compared where its thing is
    "red mug handle",  # of a thing in another color
    "mug handle",  # cut within the mug
    "handle",  # of the mug
    "wheels",
    "pumpkin stalk",
    "giraffe nose",
    "old mug wheel",  # another part by its name
    "mug wheel",
    "bear eye",
    "wheel of the duck",
    "blue tea mug",  # compared with other things with a color
    "zebra",  # not in the scene
    "qwzx blorp",
)
PIXEL_SCALE = HALF
SIZE = (664, 498)
"""Of a window in which nothing covers the picture's bottom, with the sides of the demo's photos."""


@pytest.fixture(scope="module")
def demo() -> Scene:
    return open_scene("demo")


@pytest.fixture(scope="module")
def address(light_demo) -> Iterator[str]:
    with serving(light_demo) as found:
        yield found


@pytest.fixture(scope="module")
def page(browser, address) -> Iterator[Any]:
    opened = open_page(browser, address, scale=HALF)
    yield opened
    opened.close()


VISIBILITY = (
    "(how) => document.querySelectorAll('.bar, .tools, .title').forEach((e) => { e.style.visibility = how; })"
)


@pytest.fixture(scope="module")
def pictured(browser, published_demo) -> Iterator[Any]:
    """A page that draws all Gaussians, from where a photo was taken; nothing but the picture is seen."""
    with serving(published_demo) as place:
        opened = open_page(browser, place + "#view=view_010.jpg", *SIZE)
        opened.evaluate(VISIBILITY, "hidden")
        yield opened
        opened.close()


BASE64 = """(scores) => {
    const bytes = new Uint8Array(scores.buffer);
    let text = "";
    for (let i = 0; i < bytes.length; i += 4096) text += String.fromCharCode(...bytes.subarray(i, i + 4096));
    return btoa(text);
}"""
"""Numbers as text: a list of so many takes Playwright a third of a second."""


def numbers(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), np.float32)


def test_the_demo_with_its_text_tower_has_at_most_8_megabytes(published_demo):
    assert (published_demo / "text.safetensors").exists()
    assert sum(path.stat().st_size for path in published_demo.iterdir()) < 8e6


def test_a_phrase_with_a_color_takes_what_python_takes_of_its_thing(page, demo):
    script = f"""async () => {{
        const app = await lexsplat.ready;
        const answer = await app.source.answer("green bottle", "#fff");
        const scores = ({BASE64})(answer.scores);
        await app.source.refine(answer);
        return [scores, answer.places.map((place) => place.splats.length)];
    }}"""
    scores, marked = page.evaluate(script)
    taken = numbers(scores) >= 0.5
    expected = demo.ask("green bottle").scores[0].numpy() >= 0.5
    assert (taken == expected).all()
    bottle = next(each for each in demo.objects if each.phrase == "bottle")
    assert taken[bottle.mask.numpy()].all(), "its cork, too, which is not green"
    assert marked == [pytest.approx(len(demo.find("green bottle")), rel=0.01)], "faint splats, but no specks"


def test_answers_are_those_of_python(page, demo):
    found = page.evaluate(
        """async (prompts) => {
            const app = await lexsplat.ready;
            const tower = await app.source.loader.load();
            const answers = [];
            for (const prompt of prompts) {
                const answer = await app.source.answer(prompt, "#fff");
                const scores = (BASE64)(answer.scores);
                await app.source.refine(answer);
                const places = answer.places;
                answers.push({ ...answer, scores, places: places.length,
                    marked: places.reduce((sum, place) => sum + place.splats.length, 0),
                    embedding: [...tower.embed(prompt)] });
            }
            return answers;
        }""".replace("BASE64", BASE64),
        PROMPTS,
    )
    phrases = [answer["phrase"] for answer in found]
    asked = demo.ask(phrases)
    embeddings = demo.embed(PROMPTS)
    for number, answer in enumerate(found):
        scores = numbers(answer["scores"])
        expected, near = asked.scores[number].numpy(), 0.02
        if thing_of_part(answer["phrase"]) or is_part_alone(answer["phrase"]):
            # Rounded centers have other neighbors, which move the shortest border; scores of parts are stretched.
            assert np.quantile(np.abs(scores - expected), 0.999) <= 10 / 255, answer["prompt"]
            near = 0.08
            others = ((scores >= 0.5) != (expected >= 0.5)).sum()
            assert others <= near * (expected >= 0.5).sum(), answer["prompt"]
        else:
            assert np.abs(scores - expected).max() <= 1 / 255, answer["prompt"]
        assert answer["presence"] == asked.presences[number], answer["prompt"]
        assert answer["threshold"] == pytest.approx(float(asked.thresholds[number]), abs=0.02), answer[
            "prompt"
        ]
        cosine = torch.nn.functional.cosine_similarity(
            torch.tensor(answer["embedding"]), embeddings[number], dim=0
        )
        assert float(cosine) > 1 - 1e-3, answer["prompt"]
        if answer["presence"] == "yes":
            selection = asked.selection(number)
            assert answer["places"] == selection.count, answer["prompt"]
            # The few splats at the edge of a part may be a speck in one of the two.
            assert answer["marked"] == pytest.approx(len(selection), rel=2 * near), answer["prompt"]
    assert [answer["from"] for answer in found[:3]] == ["dictionary", "dictionary", "text tower"]
    assert [answer["presence"] for answer in found[-2:]] == ["no", "no"]


def test_a_page_without_a_text_tower_answers_its_phrases_as_one_with_a_tower(page, tab, light_demo, tmp_path):
    """Names are whole objects, and parts are cut within their things."""
    folder = shutil.copytree(light_demo, tmp_path / "page", copy_function=os.link)
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").unlink()
    (folder / "manifest.json").write_text(json.dumps(manifest | {"text": None}))
    asked = """async (prompts) => {
        const { source } = await lexsplat.ready;
        const answers = [];
        for (const prompt of prompts) answers.push(await source.answer(prompt, "#fff"));
        return answers.map(({ from, presence, scores }) => [from, presence, (BASE64)(scores)]);
    }""".replace("BASE64", BASE64)
    prompts = ["stack of books", "mug handle", "red apple"]
    with serving(folder) as place:
        found = show(tab, place).evaluate(asked, prompts)
    assert found == page.evaluate(asked, prompts)
    assert [answer[0] for answer in found] == ["dictionary"] * 3


def test_free_phrases_have_the_scores_and_segments_of_python(page, demo):
    """The widest gap of the first lies between 0.3 and 0.6 of its best segment, below which Python cuts nothing."""
    things = (
        "red apple",
        "green bowl",
        "rubber duck",
        "toy car",
        "cup of tea",
        "leaf of the plant",
        "violin case",
    )
    prompts = ["that shiny red apple", "the thing I drink coffee out of", "what keeps me warm"]
    prompts += [
        f"{which} {thing}" for which in ("somebody's", "one very old", "this dusty") for thing in things
    ]
    found = page.evaluate(
        """async (prompts) => {
            const answers = [];
            for (const prompt of prompts) {
                const { from, phrase, presence, scores } = await lexsplat.app.source.answer(prompt, "#fff");
                answers.push({ from, phrase, presence, scores: (BASE64)(scores) });
            }
            return answers;
        }""".replace("BASE64", BASE64),
        prompts,
    )
    assert {answer["from"] for answer in found} == {"text tower"}
    asked = demo.ask([answer["phrase"] for answer in found])
    for number, answer in enumerate(found):
        scores, expected = numbers(answer["scores"]), asked.scores[number].numpy()
        assert answer["presence"] == asked.presences[number], answer["phrase"]
        assert np.array_equal(scores >= 0.5, expected >= 0.5), answer["phrase"]
        assert np.abs(scores - expected).max() <= 1 / 255, answer["phrase"]


def test_things_with_a_color_have_the_places_of_python(page, demo):
    """Places are compared by the scores of each splat by itself: "black lamp" is not two lamps."""
    nouns = ("apple", "mug", "vase", "lamp", "bottle", "pumpkin", "teddy bear")
    prompts = [f"{color} {noun}" for color in sorted(COLORS) for noun in nouns]
    prompts.remove("brown lamp")  # its shade and its foot touch, and Python alone parts what touches
    found = page.evaluate(
        """async (prompts) => {
            const answers = [];
            for (const prompt of prompts) {
                const answer = await lexsplat.app.source.answer(prompt, "#fff");
                await lexsplat.app.source.refine(answer);
                answers.push({ phrase: answer.phrase, presence: answer.presence, places: answer.places.length });
            }
            return answers;
        }""",
        prompts,
    )
    asked = demo.ask([answer["phrase"] for answer in found])
    there = [number for number, answer in enumerate(found) if answer["presence"] != "no"]
    assert len(there) > 10
    expected = {prompts[number]: asked.selection(number).count for number in there}
    assert {prompts[number]: found[number]["places"] for number in there} == expected


KIND = """async (prompt) => {
    const answer = await lexsplat.app.source.answer(prompt, "#fff");
    await lexsplat.app.source.refine(answer);
    const bytes = new Uint8Array(lexsplat.app.geometry.count);
    answer.places.forEach((place, n) => place.splats.forEach((splat) => { bytes[splat] = n + 1; }));
    return { presence: answer.presence, note: answer.note, labels: [...bytes] };
}"""


@pytest.mark.parametrize("prompt", ["toy", "some fruit", "something to eat", "animals", "clothes"])
def test_a_kind_is_answered_by_the_objects_that_python_finds(page, demo, prompt):
    found, selection = page.evaluate(KIND, prompt), demo.find(prompt)
    assert found["presence"] == selection.present
    labels = np.array(found["labels"])
    assert labels.max() == selection.count
    for instance in selection.instances:
        own = np.unique(labels[instance.mask.numpy()])
        assert len(own) == 1
        assert np.array_equal(labels == own[0], instance.mask.numpy())
        assert instance.phrase in found["note"]


def test_an_answer_is_marked_where_it_is_and_nothing_is_marked_for_what_is_absent(pictured, demo):
    page = pictured
    before = picture(page)
    page.evaluate("lexsplat.app.ask('red apple', false, false)")
    after = picture(page)
    camera = demo.camera("view_010").resized(*SIZE)
    mask = demo.select("red apple", 0.5).mask.float()[:, None]
    seen = render(demo.gaussians, camera, features=mask, color=False).features[..., 0].numpy()
    ours = (render(demo.gaussians, camera).image.detach().clamp(0, 1) * 255).numpy()
    inside, outside = binary_erosion(seen > 0.9, iterations=2), seen < 0.02
    assert inside.sum() > 100
    warm = after[..., 0] - after[..., 2]
    assert (after[inside][:, 0] > after[inside][:, 2] + 40).mean() > 0.97, "the apple is orange"
    gray = np.ptp(after[outside], axis=1).mean() / np.ptp(before[outside], axis=1).mean()
    assert gray < 0.5, "everything else is gray"
    assert warm[inside].mean() > 3 * warm[outside].mean()
    assert 10 * np.log10(255**2 / np.square(before - ours).mean()) > 33, "the picture is that of our renderer"
    page.evaluate("lexsplat.app.ask('zebra', false, false)")
    assert np.abs(picture(page) - before).mean() < 0.5


def test_the_page_asks_for_nothing_but_its_folder_and_its_policy_forbids_it(page, address):
    ask(page, "the handle of that blue mug")
    assert page.requested
    assert all(url.startswith((address, "blob:", "data:")) for url in page.requested)
    assert page.complaints == []
    refused = page.evaluate("fetch('https://example.org/').then(() => 'sent', (error) => String(error))")
    assert "TypeError" in refused
    assert any("Content Security Policy" in text for text in page.complaints)


def test_asking_speaks_shows_a_card_and_is_kept_in_the_link(page, tab, address):
    ask(page, "red apple, zebra")
    cards = page.locator(".card")
    assert cards.count() == 2
    assert "here, one place" in cards.nth(0).inner_text()
    assert "not in this scene" in cards.nth(1).inner_text()
    assert "red apple: here" in page.locator("[role=status]").inner_text()
    until(page, "location.hash.includes('q=red+apple') && location.hash.includes('q=zebra')")
    link = page.evaluate("location.href")
    show(tab, link)
    assert tab.locator(".card strong").all_inner_texts() == ["red apple", "zebra"]
    positions = [one.evaluate("lexsplat.app.stage.camera.position.toArray()") for one in (page, tab)]
    assert np.allclose(*positions, atol=1e-3)


def test_of_several_prompts_the_camera_flies_to_the_first_that_is_here(page):
    ask(page, "zebra, rubber duck, unicorn")
    offset = "lexsplat.app.stage.target.distanceTo(lexsplat.app.answers[1].places[0].center)"
    assert page.evaluate(offset) < 1e-3


def test_enter_on_the_picture_names_what_is_in_its_middle_and_measures(page):
    page.evaluate("lexsplat.app.ask('rubber duck')")
    until(page, "Boolean(document.querySelector('.card'))")
    page.locator("canvas").focus()
    page.keyboard.press("Enter")
    until(page, "Boolean(document.querySelector('.status .examples button'))")
    assert "duck" in " ".join(page.locator(".status .examples button").all_inner_texts())
    page.keyboard.press("m")
    page.keyboard.press("Enter")
    for _ in range(4):
        page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('.distance').textContent !== ''")
    assert float(page.locator(".distance").inner_text().split()[0]) > 0
    page.keyboard.press("m")


def test_the_search_box_completes_and_the_keyboard_suffices(page):
    page.keyboard.press("Escape")
    page.locator("canvas").focus()
    page.keyboard.press("/")
    page.keyboard.type("pump")
    box = page.get_by_role("combobox", name="Search this place with words")
    assert box.get_attribute("aria-expanded") == "true"
    page.keyboard.press("ArrowDown")
    chosen = page.locator(f"#{box.get_attribute('aria-activedescendant')}").inner_text()
    assert chosen == "pumpkin"
    page.keyboard.press("Enter")
    until(page, "document.querySelector('.card strong')?.textContent === 'pumpkin'")
    assert box.input_value() == ""
    unnamed = "[...document.querySelectorAll('button, input')].filter((e) => !(e.ariaLabel || e.textContent.trim()))"
    assert page.evaluate(f"{unnamed}.length") == 0


def test_the_best_guess_for_what_is_absent_marks_the_place_with_the_best_scores(page):
    ask(page, "zebra")
    page.get_by_role("button", name="Show the best guess").click()
    splats = until(page, "lexsplat.app.answers[0].places?.flatMap((place) => place.splats)")
    scores = np.array(page.evaluate("[...lexsplat.app.answers[0].scores]"))
    assert 0 < len(splats) < 0.05 * len(scores)
    assert scores[splats].mean() > np.quantile(scores, 0.99)
    assert page.locator(".card .state").inner_text() == "not in this scene"
    page.keyboard.press("Escape")


def test_in_heat_two_prompts_keep_their_colors_and_the_page_says_so(pictured):
    page = pictured
    page.evaluate(VISIBILITY, "")
    page.evaluate("lexsplat.app.ask('red apple, banana', false, false)")
    page.keyboard.press("h")
    assert "each prompt in its own color" in page.locator(".status").inner_text()
    page.evaluate(VISIBILITY, "hidden")
    image = picture(page)
    orange = (image[..., 0] > image[..., 2] + 90).mean()  # the first color of Okabe and Ito
    blue = (image[..., 2] > image[..., 0] + 60).mean()  # the second
    assert orange > 5e-4
    assert blue > 5e-4


@pytest.mark.parametrize(
    ("typed", "meant"),
    [("red aple", "red apple"), ("redd aple", "red apple"), ("bananna", "banana"), ("red appl", "red apple")],
)
def test_enter_corrects_typing_errors_as_python_does_and_says_so(page, demo, typed, meant):
    ask(page, typed)
    answer = page.evaluate(
        "(({ phrase, presence, note }) => ({ phrase, presence, note }))(lexsplat.app.answers[0])"
    )
    assert str(demo.understand(typed).phrase) == f'"{meant}"'
    assert (answer["phrase"], answer["presence"]) == (meant, demo.find(typed).present) == (meant, "yes")
    wrong = [word for word in typed.split() if word not in meant.split()]
    assert all(f"“{word}” may be a typing error" in answer["note"] for word in wrong)
    assert answer["note"] in page.locator(".card .fine").first.inner_text()


def test_words_that_nobody_knows_are_named_and_well_spelled_words_stay(page, demo):
    ask(page, "blue xqzt mug")
    assert "not “xqzt”" in page.locator(".card .fine").first.inner_text()
    assert page.evaluate("lexsplat.app.answers[0].presence") in ("unsure", "no")
    assert "in this scene" not in page.locator(".card .state").inner_text()
    spelling = "lexsplat.app.source.spelling"
    for phrase in ("the handle of that blue mug", "wing", "hat", "cone you see at road works"):
        assert page.evaluate(f"{spelling}.meant('{phrase}')") == [], phrase
        assert page.evaluate(f"{spelling}.strange('{phrase}')") == [], phrase


def test_on_a_phone_nothing_is_cut_off_and_the_answer_is_not_covered(tab, address):
    page = show(tab, address, 390, 844)
    ask(page, "red apple")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    boxes = {name: page.locator(name).first.bounding_box() for name in (".search", ".sheet", ".tools")}
    for box in boxes.values():
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
        assert box["y"] + box["height"] <= 845
    assert boxes[".sheet"]["height"] < 0.42 * 844 + 1
    spot = page.evaluate("(() => lexsplat.app.stage.pixel(lexsplat.app.answers[0].places[0].center))()")
    assert boxes[".search"]["y"] + boxes[".search"]["height"] < spot["y"] < boxes[".sheet"]["y"]
    assert 0 < spot["x"] < boxes[".tools"]["x"]


def test_nothing_is_drawn_while_nothing_changes(page):
    page.evaluate("lexsplat.app.stage.settled()")
    drawn = page.evaluate(
        """async () => {
            const { stage } = lexsplat.app;
            const before = stage.renderer.info.render.frame;
            stage.draw();
            await new Promise((resolve) => setTimeout(resolve, 1500));
            return stage.renderer.info.render.frame - before;
        }"""
    )
    assert 1 <= drawn <= 2
