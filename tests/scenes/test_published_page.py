"""Published pages in a real browser: headless Chromium with software WebGL. Nothing but the folder is served."""

from __future__ import annotations

import base64
import io
import json
import shutil
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import binary_erosion
from support.encoder_folders import write_clip
from support.language_scene import CENTERS
from support.page_browser import CHROMIUM, ask, open_page, serving, until
from support.siglip_folder import siglip_folder
from support.viewer_scene import ball_scene

from lexsplat.features.encoders import load_clip
from lexsplat.geometry.cameras import Camera
from lexsplat.queries.picking import surface_at
from lexsplat.queries.vocabulary import thing_of_part
from lexsplat.rendering import render
from lexsplat.scenes.publishing import PublishOptions, publish, splat_file, vocabulary
from lexsplat.scenes.publishing.manifest import checksums
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
    "pumpkin stalk",
    "giraffe nose",
    "blue tea mug",  # compared with other things with a color
    "zebra",  # not in the scene
    "qwzx blorp",
)
SIZE = (664, 498)
"""Of a window in which nothing covers the picture's bottom, with the sides of the demo's photos."""
HOSTILE = "<img src=x onerror='window.pwned=1'></script><script>window.pwned=1</script>\"'{{TITLE}}"


@pytest.fixture(scope="module")
def demo() -> Scene:
    return open_scene("demo")


@pytest.fixture(scope="module")
def address(published_demo) -> Iterator[str]:
    with serving(published_demo) as found:
        yield found


@pytest.fixture(scope="module")
def page(browser, address) -> Iterator[Any]:
    opened = open_page(browser, address)
    yield opened
    opened.close()


@pytest.fixture
def ball_page(tmp_path, monkeypatch):
    """Publishes the scene of balls with some options; returns the folder and the ground truth."""
    words = [*(f"ball {n}" for n in range(5)), "toy", "chair", "bed"]
    monkeypatch.setattr(vocabulary, "everyday_phrases", lambda bundled: dict.fromkeys(words, "n"))
    scene, ground_truth = ball_scene()

    def write(target=tmp_path / "page", **options):
        publish(scene, target, PublishOptions(**{"words_only": True, **options}))
        return target

    write.scene, write.ground_truth = scene, ground_truth
    return write


def picture(page) -> np.ndarray:
    """The page ``[H, W, 3]`` once the scene is drawn."""
    page.evaluate("lexsplat.app.stage.settled()")
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)


def test_the_demo_with_its_text_tower_has_at_most_8_megabytes(published_demo):
    assert (published_demo / "text.safetensors").exists()
    assert sum(path.stat().st_size for path in published_demo.iterdir()) < 8e6


def test_answers_are_those_of_python(page, demo):
    found = page.evaluate(
        """async (prompts) => {
            const app = await lexsplat.ready;
            const tower = await app.source.loader.load();
            const answers = [];
            for (const prompt of prompts) {
                const answer = await app.source.answer(prompt, "#fff");
                const bytes = new Uint8Array(answer.scores.buffer);
                let text = "";
                for (let i = 0; i < bytes.length; i += 4096) {
                    text += String.fromCharCode(...bytes.subarray(i, i + 4096));
                }
                await app.source.refine(answer);
                const places = answer.places;
                answers.push({ ...answer, scores: btoa(text), places: places.length,
                    marked: places.reduce((sum, place) => sum + place.splats.length, 0),
                    embedding: [...tower.embed(prompt)] });
            }
            return answers;
        }""",
        PROMPTS,
    )
    phrases = [answer["phrase"] for answer in found]
    asked = demo.ask(phrases)
    embeddings = demo.embed(PROMPTS)
    for number, answer in enumerate(found):
        scores = np.frombuffer(base64.b64decode(answer["scores"]), np.float32)
        expected, near = asked.scores[number].numpy(), 0.02
        if thing_of_part(answer["phrase"]):
            # Rounded centers have other neighbors, and the scores of a part are stretched to 0..1.
            assert np.quantile(np.abs(scores - expected), 0.999) <= 10 / 255, answer["prompt"]
            near = 0.05
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
            assert answer["marked"] == pytest.approx(len(selection), rel=near), answer["prompt"]
    assert [answer["from"] for answer in found[:3]] == ["dictionary", "dictionary", "text tower"]
    assert [answer["presence"] for answer in found[-2:]] == ["no", "no"]


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
                answers.push({ from, phrase, presence, scores: [...scores] });
            }
            return answers;
        }""",
        prompts,
    )
    assert {answer["from"] for answer in found} == {"text tower"}
    asked = demo.ask([answer["phrase"] for answer in found])
    for number, answer in enumerate(found):
        scores, expected = np.array(answer["scores"]), asked.scores[number].numpy()
        assert answer["presence"] == asked.presences[number], answer["phrase"]
        assert np.array_equal(scores >= 0.5, expected >= 0.5), answer["phrase"]
        assert np.abs(scores - expected).max() <= 1 / 255, answer["phrase"]


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


def test_an_answer_is_marked_where_it_is_and_nothing_is_marked_for_what_is_absent(browser, address, demo):
    page = open_page(browser, address + "#view=view_010.jpg", *SIZE)
    bare = "document.querySelectorAll('.bar, .tools, .title').forEach((one) => { one.style.visibility = 'hidden'; })"
    page.evaluate(bare)
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
    page.close()


def test_the_page_asks_for_nothing_but_its_folder_and_its_policy_forbids_it(page, address):
    ask(page, "the handle of that blue mug")
    assert page.requested
    assert all(url.startswith((address, "blob:", "data:")) for url in page.requested)
    assert page.complaints == []
    refused = page.evaluate("fetch('https://example.org/').then(() => 'sent', (error) => String(error))")
    assert "TypeError" in refused
    assert any("Content Security Policy" in text for text in page.complaints)


def test_asking_speaks_shows_a_card_and_is_kept_in_the_link(page, browser, address):
    ask(page, "red apple, zebra")
    cards = page.locator(".card")
    assert cards.count() == 2
    assert "here, one place" in cards.nth(0).inner_text()
    assert "not in this scene" in cards.nth(1).inner_text()
    assert "red apple: here" in page.locator("[role=status]").inner_text()
    until(page, "location.hash.includes('q=red+apple') && location.hash.includes('q=zebra')")
    link = page.evaluate("location.href")
    again = open_page(browser, link)
    assert again.locator(".card strong").all_inner_texts() == ["red apple", "zebra"]
    positions = [one.evaluate("lexsplat.app.stage.camera.position.toArray()") for one in (page, again)]
    assert np.allclose(*positions, atol=1e-3)
    again.close()


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


def test_a_typing_error_finds_the_word_and_an_unknown_phrase_is_reported_without_a_text_tower(
    browser, published_demo, ball_page
):
    with serving(ball_page()) as address:
        page = open_page(browser, address)
        assert page.evaluate("lexsplat.app.source.dictionary.similar('bal 3')[0]") == "ball 3"
        page.fill(".search input", "a green unicorn")
        page.keyboard.press("Enter")
        until(page, "document.querySelector('.status')?.textContent.includes('is not among')")
        assert page.locator(".card").count() == 0
        page.close()


def test_the_best_guess_for_what_is_absent_marks_the_place_with_the_best_scores(page):
    ask(page, "zebra")
    page.get_by_role("button", name="Show the best guess").click()
    splats = until(page, "lexsplat.app.answers[0].places?.flatMap((place) => place.splats)")
    scores = np.array(page.evaluate("[...lexsplat.app.answers[0].scores]"))
    assert 0 < len(splats) < 0.05 * len(scores)
    assert scores[splats].mean() > np.quantile(scores, 0.99)
    assert page.locator(".card .state").inner_text() == "not in this scene"
    page.keyboard.press("Escape")


def test_in_heat_two_prompts_keep_their_colors_and_the_page_says_so(browser, address):
    page = open_page(browser, address, *SIZE)
    page.evaluate("lexsplat.app.ask('red apple, banana', false, false)")
    page.keyboard.press("h")
    assert "each prompt in its own color" in page.locator(".status").inner_text()
    page.evaluate(
        "document.querySelectorAll('.bar, .tools').forEach((e) => { e.style.visibility = 'hidden'; })"
    )
    image = picture(page)
    orange = (image[..., 0] > image[..., 2] + 90).mean()  # the first color of Okabe and Ito
    blue = (image[..., 2] > image[..., 0] + 60).mean()  # the second
    assert orange > 5e-4
    assert blue > 5e-4
    page.close()


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


@pytest.mark.parametrize("ending", ["ply", "spz", "sog"])
def test_every_kind_of_splat_file_keeps_the_order_of_the_codes(browser, ball_page, monkeypatch, ending):
    if ending != "ply":
        monkeypatch.setattr(splat_file, "SMALL_BYTES", 0)
    if ending == "sog":
        monkeypatch.setattr(splat_file, "LARGE_BYTES", 0)
        monkeypatch.setattr(
            splat_file, "write_spz", lambda gaussians, path, version: path.write_bytes(b" " * 10**7)
        )
    scene = ball_page.scene
    folder = ball_page()
    assert (folder / f"scene.{ending}").exists()
    with serving(folder) as address:
        page = open_page(browser, address)
        geometry = page.evaluate(
            "(({ centers, opacities }) => [[...centers], [...opacities]])(lexsplat.app.geometry)"
        )
        ask(page, "ball 3")
        assert "here, one place" in page.locator(".card").inner_text()
        page.close()
    centers, opacities = np.array(geometry[0]).reshape(-1, 3), np.array(geometry[1])
    assert np.abs(centers - scene.gaussians.means.numpy()).max() < 2e-3
    assert np.abs(opacities - scene.gaussians.opacities.numpy()).max() < 0.01


@pytest.mark.parametrize("family", ["clip", "siglip"])
def test_the_text_tower_of_another_encoder_answers_in_the_page_as_in_python(
    browser, ball_page, tmp_path, family
):
    model = tmp_path / family
    model.mkdir()
    if family == "siglip":
        pytest.importorskip("sentencepiece", reason="needs the extra `siglip`")
        siglip_folder(model, width=32)
    else:
        write_clip(model, width=32)
    ball_page.scene.clip = str(model)
    texts = ["A Car!", "the wooden table", "red mug, blue books and an apple on the table", "Ünknown 42"]
    with serving(ball_page(words_only=False)) as address:
        page = open_page(browser, address)
        ask(page, "ball 3")
        needed = [url for url in page.requested if url.endswith(("text.safetensors", "tokenizer.json"))]
        assert not needed, "a phrase of the dictionary needs no text tower"
        found = page.evaluate(
            """async (texts) => {
                const tower = await lexsplat.app.source.loader.load();
                return texts.map((text) => [...tower.embed(text)]);
            }""",
            texts,
        )
        ask(page, "a green unicorn")
        assert page.locator(".card strong").inner_text() == "a green unicorn"
        page.close()
    expected = load_clip(str(model)).encode_text(texts)
    cosines = torch.nn.functional.cosine_similarity(torch.tensor(found), expected, dim=1)
    assert float(cosines.min()) > 1 - 1e-3


def test_a_large_text_tower_is_loaded_only_after_its_size_was_reported(browser, ball_page, tmp_path):
    model = tmp_path / "siglip"
    model.mkdir()
    siglip_folder(model, width=32)
    ball_page.scene.clip = str(model)
    folder = ball_page(words_only=False)
    path = folder / "text.safetensors"
    manifest = json.loads((folder / "manifest.json").read_text())
    content = path.read_bytes() + bytes(12_000_000 - path.stat().st_size)  # safetensors end before
    path.write_bytes(content)
    manifest["files"][path.name] = checksums(content)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with serving(folder) as address:
        page = open_page(browser, address)
        page.fill(".search input", "a green unicorn")
        page.keyboard.press("Enter")
        button = page.get_by_role("button", name="Load the text model (12 MB) to ask anything")
        button.wait_for()
        assert not [url for url in page.requested if url.endswith(path.name)]
        button.click()
        until(page, "Boolean(document.querySelector('.card'))")
        assert [url for url in page.requested if url.endswith(path.name)]
        page.close()


def test_a_click_names_the_thing(browser, ball_page):
    with serving(ball_page()) as address:
        page = open_page(browser, address + "#view=view0")
        centers = list(CENTERS)
        pixels = page.evaluate(
            """(points) => points.map((point) => {
                const at = lexsplat.app.stage.camera.position.clone().fromArray(point);
                const hit = lexsplat.app.stage.pixel(at);
                return [hit.x, hit.y];
            })""",
            [center.tolist() for center in centers],
        )
        camera = ball_page.scene.camera("view0")
        nearest = int(np.argmin([np.linalg.norm(center - camera.position) for center in centers]))
        page.evaluate("(at) => lexsplat.app.whatIs(at[0], at[1]).then(() => null)", pixels[nearest])
        assert page.locator(".status .examples button").first.inner_text() == f"ball {nearest}"
        page.close()


def test_two_clicks_measure_the_distance_between_the_surfaces_there(browser, ball_page):
    scene = ball_page.scene
    with serving(ball_page()) as address:
        page = open_page(browser, address + "#view=view0", 720, 480)
        lens = page.evaluate("lexsplat.app.stage.lens()")
        width, height, focal, x, y = lens["lens"]
        K = np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])
        camera = Camera(width, height, K, np.array(lens["viewmat"]).reshape(4, 4))
        places = (camera.viewmat[:3, :3] @ CENTERS.T).T + camera.viewmat[:3, 3]
        pixels = (places @ K.T)[:, :2] / places[:, 2:]
        free = [at for at in pixels if 60 < at[0] < width - 100 and 70 < at[1] < height - 60][:2]
        first, second = (surface_at(scene.gaussians, camera, *at).point for at in free)
        page.keyboard.press("m")
        for at in free:
            page.mouse.click(*at)
        until(page, "document.querySelector('.distance').textContent !== ''")
        told = page.locator(".distance").inner_text()
        assert told.endswith(" units")
        until(
            page, "document.querySelector('.status').textContent.endsWith('units (the scale is not known)')"
        )
        marks = [one.bounding_box() for one in page.locator(".mark").all()]
        label = page.locator(".distance").bounding_box()
        assert label["y"] + label["height"] <= min(mark["y"] for mark in marks), "the text hides no point"
        assert float(told.split()[0]) == pytest.approx(np.linalg.norm(first - second), rel=0.03)
        page.close()


def test_names_titles_and_prompts_of_others_run_no_script(browser, ball_page, tmp_path, monkeypatch):
    scene = ball_page.scene
    scene.views = {HOSTILE if name == "view0" else name: view for name, view in scene.views.items()}
    words = vocabulary.everyday_phrases(False)
    vocabulary.everyday_phrases = lambda bundled: {HOSTILE.lower(): "a", **words}  # undone by the fixture
    monkeypatch.setattr(vocabulary, "_is_thing", lambda phrase: True)
    for single in (False, True):
        target = tmp_path / ("hostile.html" if single else "hostile")
        ball_page(target, title=HOSTILE, description=HOSTILE, start_view=HOSTILE, single_file=single)
    with serving(tmp_path / "hostile") as address:
        for place in (address, f"{address}#q={HOSTILE}&view={HOSTILE}", (tmp_path / "hostile.html").as_uri()):
            page = open_page(browser, place)
            page.keyboard.press("v")
            page.fill(".search input", "<img")
            until(page, "document.querySelectorAll('#completions li').length > 0")
            ask(page, HOSTILE.replace(",", ""))
            assert page.evaluate("window.pwned") is None
            assert page.title() == " ".join(HOSTILE.split())
            assert page.locator("h1").inner_text() == " ".join(HOSTILE.split())
            assert page.locator("main img").count() == 0
            page.close()


def test_on_a_phone_nothing_is_cut_off_and_the_answer_is_not_covered(browser, address):
    page = open_page(browser, address, 390, 844)
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
    page.close()


def test_a_single_file_opens_by_double_click_and_a_folder_says_what_to_do(browser, ball_page, tmp_path):
    single = ball_page(tmp_path / "balls.html", single_file=True)
    page = open_page(browser, single.as_uri())
    ask(page, "ball 3")
    assert "here" in page.locator(".card").inner_text()
    assert not [url for url in page.requested if not url.startswith(("file:", "blob:", "data:"))]
    page.close()
    page = open_page(browser, (ball_page() / "index.html").as_uri())
    assert "python -m http.server" in page.locator(".failure").inner_text()
    page.close()


def test_the_picture_comes_before_the_words_and_what_is_typed_meanwhile_is_answered(browser, ball_page):
    hold = """
        const own = window.fetch;
        const held = (name) => name === "words.bin" ? new Promise((go) => (window.go = go)) : Promise.resolve();
        window.fetch = (name, ...rest) => held(name).then(() => own(name, ...rest));
    """
    with serving(ball_page()) as address:
        page = browser.new_page(viewport={"width": 480, "height": 360}, reduced_motion="reduce")
        page.set_default_timeout(60_000)
        page.add_init_script(hold)
        page.requested = []
        page.on("request", lambda request: page.requested.append(request.url.rpartition("/")[2]))
        page.goto(address)
        until(page, "Boolean(window.go)")
        assert {"codes.bin", "words.txt", "words.bin"}.isdisjoint(
            page.requested[: page.requested.index("scene.ply") + 1]
        )
        assert page.evaluate("document.querySelector('.progress')") is None
        page.fill(".search input", "ball 3")
        page.keyboard.press("Enter")
        until(page, "document.querySelector('.status').textContent.includes('loading')")
        assert page.locator(".card").count() == 0
        page.evaluate("window.go()")
        until(page, "Boolean(document.querySelector('.card'))")
        assert "here, one place" in page.locator(".card").inner_text()
        page.close()


def test_of_too_many_gaussians_those_that_cover_most_from_the_camera_are_drawn_and_it_is_reported(
    browser, ball_page, monkeypatch
):
    """The importance of each is worked out here from the scene: opacity times area over squared depth."""
    monkeypatch.setattr("lexsplat.scenes.publishing.writing.DRAWN_SPLATS", 400)
    gaussians = ball_page.scene.gaussians
    with serving(ball_page()) as address:
        page = open_page(browser, address + "#view=view0", 720, 480)
        told = page.locator(".title").inner_text()
        assert "The page leaves out 1,100 of 1,500: those that cover least of the picture from here." in told
        assert "leaves out 1,100" in page.locator("dialog p.fine").first.text_content()
        drawn = {}
        for view in ("view0", "view3"):
            page.evaluate(
                "(name) => lexsplat.app.jump(lexsplat.app.manifest.views.find((v) => v.name === name))", view
            )
            page.evaluate("lexsplat.app.stage.settled()")
            assert page.evaluate("lexsplat.app.stage.drawn") == 400
            drawn[view] = 1 - np.array(page.evaluate("[...lexsplat.app.budget.out]"))
            viewmat = ball_page.scene.camera(view).viewmat
            seen = gaussians.means.numpy() @ viewmat[:3, :3].T + viewmat[:3, 3]
            scales = np.sort(gaussians.scales.numpy(), 1)
            covers = gaussians.opacities.numpy() * scales[:, 1] * scales[:, 2]
            worth = np.where(seen[:, 2] > 0.01, covers / seen[:, 2] ** 2, 0)
            own = drawn[view].astype(bool)
            anywhere = np.argsort(-covers)[:100]
            rest = np.setdiff1d(np.flatnonzero(own), anywhere)
            assert own.sum() == 400
            left = np.flatnonzero(
                ~own & (np.abs(seen[:, :2]) < 0.2 * seen[:, 2:]).all(1)
            )  # in the picture's middle
            assert worth[rest].min() > 0.9 * worth[left].max(), (
                "none in the picture is left out for a lesser one"
            )
        assert (drawn["view0"] != drawn["view3"]).sum() > 50
        ask(page, "ball 3")
        assert "here, one place" in page.locator(".card").inner_text(), "answers know all Gaussians"
        page.close()


COUNTING = """
    const own = HTMLCanvasElement.prototype.getContext;
    window.calls = [];
    HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
        const gl = own.call(this, kind, ...rest);
        if (kind === "webgl2" && gl && !gl.counted) {
            gl.counted = true;
            for (const name of ["drawElementsInstanced", "readPixels"]) {
                const plain = gl[name].bind(gl);
                gl[name] = (...given) => (window.calls.push([name, this.width, given.at(-1)]), plain(...given));
            }
        }
        return gl;
    };
"""


def test_software_draws_coarsely_at_first_and_a_prompt_computes_and_sorts_no_splat(browser, ball_page):
    with serving(ball_page()) as address:
        page = open_page(browser, address + "#view=view0", 720, 480, COUNTING)
        page.evaluate("lexsplat.app.stage.settled()")
        drawn = [call for call in page.evaluate("calls") if call[0] == "drawElementsInstanced"]
        assert drawn[0][1] == 360, "half the resolution"
        assert drawn[-1][1] == 720
        assert all(instances == 12 for _, _, instances in drawn), "1,500 splats, 128 to an instance"
        assert "readPixels" in {name for name, *_ in page.evaluate("calls")}, "the splats were sorted"
        before = picture(page)
        page.evaluate("window.calls.length = 0")
        page.evaluate("lexsplat.app.ask('ball 3', false, false)")
        after = picture(page)
        assert np.abs(after - before)[:, 330:].max() > 60
        assert {name for name, *_ in page.evaluate("calls")} == {"drawElementsInstanced"}
        page.close()


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


def test_a_damaged_file_and_a_browser_without_webgl_are_reported_in_one_line(browser, ball_page, tmp_path):
    folder = ball_page()
    damaged = tmp_path / "damaged"
    shutil.copytree(folder, damaged)
    content = bytearray((damaged / "codes.bin").read_bytes())
    content[100] ^= 1
    (damaged / "codes.bin").write_bytes(content)
    with serving(damaged) as address:
        page = open_page(browser, address)
        until(page, "Boolean(document.querySelector('.failure'))")
        assert page.locator(".failure").inner_text().startswith("codes.bin: expected the")
        page.close()
    (damaged / "page.wasm").write_bytes(b"damaged")
    with serving(damaged) as address:
        page = open_page(browser, address)
        assert page.locator(".failure").inner_text().startswith("page.wasm: expected WebAssembly")
        page.close()
    with serving(folder) as address:
        page = open_page(browser, address, script="HTMLCanvasElement.prototype.getContext = () => null")
        assert "needs WebGL 2" in page.locator(".failure").inner_text()
        page.close()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda m: m.pop("views"), "a list of cameras in views"),
        (lambda m: m["scene"].pop("rotation"), "4 numbers in scene.rotation"),
        (lambda m: m["scene"].update(gaussians="many"), "a number in scene.gaussians"),
        (lambda m: m["views"][0].update(viewmat=[1]), "a list of cameras in views"),
        (lambda m: m.update(language=None), "language or a server"),
        (
            lambda m: m["language"].update(segments="s", segment_rule=None),
            "5 numbers in language.segment_rule",
        ),
        (
            lambda m: m["language"].update(
                segments="s",
                segment_rule=dict.fromkeys(("lowest", "border", "own_share", "steepness", "threshold"), 1),
            ),
            "18 numbers in language.part_rule",
        ),
        (lambda m: m["selection_rule"].pop("link"), "11 numbers in selection_rule"),
        (lambda m: m.pop("grammar"), "an object in grammar"),
        (lambda m: m["files"].pop("scene.ply"), "scene.ply in files"),
        (lambda m: m.clear(), "version 6 of a lexsplat page"),
    ],
)
def test_a_manifest_that_lacks_a_field_is_refused_by_its_name(browser, ball_page, change, told):
    folder = ball_page()
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with serving(folder) as address:
        page = open_page(browser, address)
        line = page.locator(".failure").inner_text().strip()
        page.close()
    assert line.startswith(f"manifest.json: expected {told}, found ")
    assert "\n" not in line
