"""The page of lexsplat view in headless Chromium with software WebGL, on balls with known names."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData
from support.page_browser import CHROMIUM, HALF, ask, covered_tools, open_page, show, until
from support.viewer_scene import WORDS, ball_scene

from lexsplat.viewer.history import MAX_LENGTH, History
from lexsplat.viewer.server import ViewerConfig, ViewerServer

PIXEL_SCALE = HALF
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path")]

PIXELS = """(points) => points.map((point) => {
    const hit = lexsplat.app.stage.pixel(lexsplat.app.stage.camera.position.clone().fromArray(point));
    return [hit.x, hit.y];
})"""


@contextlib.contextmanager
def serving_balls() -> Iterator[ViewerServer]:
    scene, ground_truth = ball_scene()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(History, "load", lambda *_: History(prompts=["ball 4"], vocabulary=[*WORDS, "spoon"]))
        running = ViewerServer(scene, ViewerConfig(port=0))
    running.scene, running.ground_truth = scene, ground_truth
    try:
        yield running
    finally:
        running.stop()


@pytest.fixture
def viewer() -> Iterator[ViewerServer]:
    with serving_balls() as running:
        yield running


@pytest.fixture(scope="module")
def shared_viewer() -> Iterator[ViewerServer]:
    """The viewer of `shared_page`."""
    with serving_balls() as running:
        yield running


@pytest.fixture(scope="module")
def shared_page(browser, shared_viewer) -> Iterator[Any]:
    """A page for tests that edit nothing."""
    opened = open_page(browser, f"{shared_viewer.url}/#view=view0", 720, 480, scale=HALF)
    yield opened
    opened.close()


@pytest.fixture
def page(tab, viewer) -> Iterator[Any]:
    show(tab, f"{viewer.url}/#view=view0", 720, 480)  # wider than a phone
    yield tab
    tab.goto("about:blank")  # nothing is asked of the server once it has stopped


def test_a_prompt_is_answered_by_the_server_with_its_scores_and_places(page, viewer):
    assert page.get_by_role("combobox").get_attribute("placeholder").startswith("Search this place: ball 4")
    ask(page, "ball 2, ball 4 and ball 0")
    cards = page.locator(".card")
    assert "here, one place" in cards.nth(0).inner_text()
    assert "here, 2 places" in cards.nth(1).inner_text()
    marked = page.evaluate("lexsplat.app.answers.map((one) => one.places.flatMap((place) => place.splats))")
    labels = viewer.ground_truth.labels
    assert sorted(marked[0]) == np.flatnonzero(labels == 2).tolist()
    assert sorted(marked[1]) == np.flatnonzero(np.isin(labels, [0, 4])).tolist()
    scores = np.array(page.evaluate("[...lexsplat.app.answers[0].scores]"))
    assert np.abs(scores - viewer.scene.ask("ball 2").scores[0].numpy()).max() <= 1 / 255
    assert viewer.session.history.prompts[:2] == ["ball 4 and ball 0", "ball 2"]
    assert page.evaluate("lexsplat.app.search.input.value") == ""
    assert page.complaints == []
    assert all(url.startswith((viewer.url, "blob:", "data:")) for url in page.requested)


def test_a_card_reports_how_a_question_was_understood_and_what_was_not(shared_page):
    page = shared_page
    ask(page, "where can I find the ball 4 next to the ball 0?")
    assert page.locator(".card .understood").inner_text() == "as “ball 4 next to ball 0”"
    ask(page, "why is ball 2 so round")
    assert 'not understood ("why")' in page.locator(".card .fine").first.inner_text()
    assert page.locator(".card .understood").count() == 0, "asked in these words"
    ask(page, "ball 2")
    assert page.locator(".card .understood").count() == 0


def test_an_error_of_the_server_is_reported_in_one_line(shared_page):
    page = shared_page
    page.fill(".search input", 'ball "1')
    page.keyboard.press("Enter")
    until(page, "document.querySelector('.status')?.textContent.includes('quotation marks in pairs')")


def test_a_threshold_by_hand_is_asked_of_the_server(shared_page):
    page = shared_page
    ask(page, "ball 2")
    page.locator(".threshold input").fill("0")
    until(page, f"lexsplat.app.answers[0].places?.flatMap((one) => one.splats).length > {300}")
    page.get_by_role("button", name="Automatic").click()
    until(page, "lexsplat.app.answers[0].places?.flatMap((one) => one.splats).length === 300")


def test_a_click_names_and_selects_the_object(page, viewer):
    centers = [viewer.scene.select(word).center for word in WORDS]
    eye = viewer.scene.camera("view0").position
    nearest = int(np.argmin([np.linalg.norm(center - eye) for center in centers]))
    x, y = page.evaluate(PIXELS, [centers[nearest].tolist()])[0]
    page.mouse.click(x, y)
    until(page, "document.querySelectorAll('.status .examples button').length > 0")
    assert page.locator(".status .examples button").first.inner_text() == f"ball {nearest}"
    splats = page.evaluate("lexsplat.app.answers[0].places.flatMap((one) => one.splats)")
    assert sorted(splats) == np.flatnonzero(viewer.ground_truth.labels == nearest).tolist()


def test_a_selection_is_described_and_downloaded(shared_page, shared_viewer, tmp_path):
    page = shared_page
    ask(page, "ball 3")
    page.locator(".bench summary").click()
    until(page, "document.querySelector('.bench .examples')?.textContent.includes('view')")
    size = shared_viewer.scene.select("ball 3").size
    assert f"{size[0]:.3g}"[:4] in page.locator(".bench .fine:not(.taken)").inner_text()
    with page.expect_download() as started:
        page.get_by_role("button", name="Download").click()
    started.value.save_as(tmp_path / started.value.suggested_filename)
    vertices = PlyData.read(tmp_path / "ball_3.ply")["vertex"]
    assert len(vertices) == 300


def test_an_edit_is_shown_before_it_is_done_and_undone_and_redone(page, viewer):
    ask(page, "ball 2")
    page.locator(".bench summary").click()
    page.get_by_label("Edit ball 2").select_option("delete")
    until(page, "document.querySelector('.taken').textContent.includes('300 Gaussians')")
    page.evaluate("lexsplat.app.stage.settled()")
    assert viewer.session.version == 1, "a preview changes nothing"
    said, inert = page.evaluate(
        """() => {
            [...document.querySelectorAll("button")].find((one) => one.textContent === "Apply").click();
            const inert = [".search", ".answers", ".tools"].map((name) => document.querySelector(name).inert);
            const press = () => {  // undo, again and again until the edit is done: nothing else is done meanwhile
                if (document.querySelector(".status")?.textContent.startsWith("Done")) return;
                dispatchEvent(new KeyboardEvent("keydown", { key: "z" }));
                window.pressed = (window.pressed ?? 0) + 1;
                setTimeout(press);
            };
            press();
            return [document.querySelector(".status").textContent, inert];
        }"""
    )
    assert said == "Deleting …"
    assert inert == [True, True, True]
    until(page, "lexsplat.app.server.entry.version >= 2")
    until(page, "document.querySelector('.status').textContent.startsWith('Done: deleted')")
    assert page.evaluate("[lexsplat.app.server.entry.version, pressed > 1]") == [2, True]
    assert viewer.session.editor.steps[0].phrase == "ball 2"
    until(page, "lexsplat.app.answers[0]?.places !== undefined")
    assert page.evaluate("lexsplat.app.geometry.count") == 1200
    page.keyboard.press("Escape")
    page.keyboard.press("z")
    until(page, "lexsplat.app.server.entry.version === 3")
    assert page.evaluate("lexsplat.app.geometry.count") == 1500
    page.keyboard.press("y")
    until(page, "lexsplat.app.server.entry.version === 4")
    assert page.evaluate("lexsplat.app.geometry.count") == 1200


def test_a_moved_object_looks_in_the_preview_as_it_does_afterwards(page, viewer):
    def colors() -> np.ndarray:
        page.evaluate("lexsplat.app.stage.settled()")
        hide = "document.querySelectorAll('.bar, .tools, .title').forEach((e) => { e.style.visibility = 'hidden'; })"
        page.evaluate(hide)
        taken = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(float)
        page.evaluate(hide.replace("hidden", ""))
        return taken

    page.evaluate("lexsplat.app.ask('ball 2', false, false)")
    before = colors()
    page.locator(".bench summary").click()
    until(page, "document.querySelector('.bench .fine').textContent !== ''")
    page.get_by_label("Edit ball 2").select_option("move")
    page.get_by_label("Shift along z, units of the scene").fill("0.6")
    page.get_by_label("Turn, degrees").fill("40")
    page.get_by_label("Size, factor").fill("1.2")
    preview = colors()
    page.get_by_role("button", name="Apply").click()
    until(page, "lexsplat.app.server.entry.version === 2 && lexsplat.app.answers[0]?.places")
    page.evaluate("lexsplat.app.clear()")
    after = colors()
    assert np.abs(preview - before).max() > 60
    assert np.abs(preview - after).mean() < 0.3 * np.abs(preview - before).mean()


def test_a_page_that_shows_an_earlier_scene_is_reported_and_shows_the_present_one(page, viewer):
    from lexsplat.viewer.requests import Asked

    viewer.session.edit("delete", Asked("ball 0"), {})
    page.fill(".search input", "ball 1")
    page.keyboard.press("Enter")
    until(page, "lexsplat.app.server.entry.version === 2")
    assert page.evaluate("lexsplat.app.geometry.count") == 1200
    until(page, "document.querySelector('.status')?.textContent.includes('edited elsewhere')")
    assert page.locator(".card strong").all_inner_texts() == ["ball 1"], "what was typed is asked again"
    assert "here, one place" in page.locator(".card").inner_text()
    assert page.evaluate("lexsplat.app.search.input.value") == ""


def test_objects_are_listed_and_other_colors_shown(page, viewer):
    page.keyboard.press("o")
    until(page, "document.querySelector('.objects strong').textContent.includes('object')")
    assert page.locator(".objects li").count() == len(viewer.scene.objects)
    page.keyboard.press("c")
    until(page, "document.querySelector('.status').textContent.includes('Colors: language')")


def test_a_video_is_recorded(shared_page):
    kind, size = shared_page.evaluate(
        "lexsplat.app.stage.record(1).then((made) => [made.suffix, made.video.size])"
    )
    assert kind in (".mp4", ".webm")
    assert size > 500


def test_a_video_without_a_picture_is_reported_and_not_saved(shared_page):
    page = shared_page
    told = page.evaluate(
        """async () => {
            const record = MediaRecorder.prototype.start;
            MediaRecorder.prototype.start = function () { setTimeout(() => this.dispatchEvent(new Event("error"))); };
            try {
                return await lexsplat.app.stage.record(0.2).then(() => "saved", (error) => error.message);
            } finally {
                MediaRecorder.prototype.start = record;
            }
        }"""
    )
    assert told.startswith("The browser recorded no picture")


def test_a_video_has_many_pictures_also_where_they_take_long(shared_page):
    page = shared_page
    drawn = page.evaluate(
        """async () => {
            const { stage } = lexsplat.app;
            const own = stage.renderer.render;
            let count = 0;
            stage.renderer.render = function (...given) {
                const end = performance.now() + 300;
                while (performance.now() < end);
                count++;
                return own.apply(this, given);
            };
            try {
                for (let tries = 1; ; tries++) {
                    count = 0;
                    try {
                        await stage.record(1);
                        return count;
                    } catch (error) {  // a busy machine may starve the recorder, which says so
                        if (tries === 3 || !error.message.includes("try again")) throw error;
                    }
                }
            } finally {
                stage.renderer.render = own;
            }
        }"""
    )
    assert drawn >= 5


def test_what_the_server_did_not_understand_is_not_denied_and_long_texts_stay_in_the_box(shared_page):
    page = shared_page
    ask(page, "why is qwer so round")
    assert page.locator(".card .state").inner_text() != "not in this scene"
    assert page.evaluate("lexsplat.app.answers[0].unknown")
    page.keyboard.press("Escape")
    page.fill(".search input", 'ball "1')
    page.keyboard.press("Enter")
    until(page, "document.querySelector('.status')?.textContent.includes('quotation marks in pairs')")
    assert page.locator(".search input").input_value() == 'ball "1'
    page.evaluate("lexsplat.app.clear()")
    page.locator(".search input").fill("")
    page.locator(".search input").focus()
    page.keyboard.insert_text("ball " * 60)  # obeys the length of the box, as keys do
    page.keyboard.press("Enter")
    until(page, "Boolean(document.querySelector('.card'))")
    assert len(page.evaluate("lexsplat.app.answers[0].prompt")) <= MAX_LENGTH


def test_a_hidden_answer_leaves_no_preview_in_the_picture_and_after_an_edit_the_keyboard_goes_on(
    page, viewer
):
    ask(page, "ball 2")

    def shown() -> np.ndarray:
        page.evaluate("lexsplat.app.stage.settled()")
        page.evaluate("document.querySelectorAll('.bar').forEach((e) => { e.style.opacity = '0'; })")
        taken = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(float)
        page.evaluate("document.querySelectorAll('.bar').forEach((e) => { e.style.opacity = ''; })")
        return taken

    page.get_by_label("Hide ball 2").click()
    plain = shown()
    page.get_by_label("Show ball 2").click()
    page.locator(".bench summary").click()
    page.get_by_label("Edit ball 2").select_option("delete")
    until(page, "document.querySelector('.taken').textContent.includes('300 Gaussians')")
    assert np.abs(shown() - plain).max() > 40
    page.get_by_label("Hide ball 2").click()
    assert np.abs(shown() - plain).max() < 12
    page.get_by_label("Show ball 2").click()
    page.locator(".bench summary").click()
    page.get_by_label("Edit ball 2").select_option("delete")
    page.get_by_role("button", name="Apply").click()
    until(page, "lexsplat.app.server.entry.version === 2")
    until(page, "document.activeElement.tagName === 'CANVAS'", 10)
    page.keyboard.press("z")
    until(page, "lexsplat.app.server.entry.version === 3")


def test_every_tool_can_be_pressed_on_small_windows(shared_page):
    page = shared_page
    ask(page, "ball 1, ball 2, ball 3")
    until(page, "document.querySelectorAll('.card').length === 3")
    for width, height in ((667, 375), (740, 360), (800, 360), (390, 667), (360, 640), (390, 844), (720, 480)):
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(100)
        assert covered_tools(page) == [], (width, height)


def test_a_link_with_a_phrase_that_is_refused_shows_the_scene_and_says_why(tab, viewer):
    show(tab, f"{viewer.url}/#q=%22&view=view0", 720, 480)
    assert "quotation marks in pairs" in tab.locator(".status").inner_text()
    ask(tab, "ball 1")
    assert "here, one place" in tab.locator(".card").inner_text()
    tab.goto("about:blank")
