"""The controls of a published page in headless Chromium: phones, sliders under the hand, quick questions, links."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from support.page_browser import CHROMIUM, HALF, ask, covered_tools, open_page, serving, show, until
from support.viewer_scene import ball_scene

from lexsplat.scenes.publishing import PublishOptions, publish, vocabulary
from lexsplat.viewer.history import MAX_LENGTH

PIXEL_SCALE = HALF
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path")]

SMALL = ((667, 375), (740, 360), (800, 360), (390, 667), (360, 640), (390, 844))
"""Phones, in pixels."""
LIST = """() => {
    const { center } = lexsplat.app.geometry.bounds();
    lexsplat.app.manifest.objects = [{ name: "ball 0", center: center.toArray(), size: [0.3, 0.3, 0.3] }];
}"""
"""The list of objects gets one, which this scene without everyday things lacks."""


@pytest.fixture(scope="module")
def address(tmp_path_factory) -> Iterator[str]:
    target = tmp_path_factory.mktemp("balls") / "page"
    words = [*(f"ball {n}" for n in range(5)), "chair"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vocabulary, "everyday_phrases", lambda bundled: dict.fromkeys(words, "n"))
        title = "A very long title of a scene " * 12
        publish(ball_scene()[0], target, PublishOptions(words_only=True, title=title, description=title))
    with serving(target) as found:
        yield found


@pytest.fixture(scope="module")
def opened(browser, address) -> Iterator[Any]:
    page = open_page(browser, address, 720, 480, scale=HALF)
    yield page
    page.close()


@pytest.fixture
def cleared(opened) -> Any:
    """A page without answers and open lists."""
    opened.evaluate("lexsplat.app.clear()")
    opened.locator(".search input").fill("")
    for tool in opened.locator(".tools > button[aria-pressed=true]").all():
        tool.click()
    return opened


def test_on_a_phone_the_keyboard_and_the_panels_go_away_after_a_choice(browser, address):
    page = open_page(browser, address, 390, 844, phone=True, scale=HALF)
    until(page, "lexsplat.app.source !== null")
    focused = "document.activeElement.tagName"
    page.tap(".search input")
    page.keyboard.type("ball 2")
    assert page.evaluate(focused) == "INPUT"
    page.keyboard.press("Enter")
    until(page, "document.querySelector('.card strong')?.textContent === 'ball 2'")
    assert page.evaluate(focused) != "INPUT"
    page.tap(".search input")
    page.keyboard.type("ball 3")
    page.tap("#completions li")
    until(page, "document.querySelector('.card strong')?.textContent === 'ball 3'")
    assert page.evaluate(focused) != "INPUT"
    page.evaluate(LIST)
    for name, panel in (("Objects in this scene", ".objects"), ("Where the photos were taken", ".views")):
        tool = page.locator(".tools").get_by_label(name)
        tool.tap()
        shown = page.locator(panel).filter(visible=True)
        shown.locator("li button").first.tap()
        assert shown.count() == 0
        assert tool.get_attribute("aria-pressed") == "false"
    page.get_by_label("Remove ball 3").tap()
    assert page.evaluate(focused) != "INPUT"
    page.close()


def test_on_a_computer_the_box_and_the_panels_stay(cleared):
    ask(cleared, "ball 2")
    assert cleared.evaluate("document.activeElement.tagName") == "INPUT"
    cleared.evaluate(LIST)
    cleared.locator(".tools").get_by_label("Objects in this scene").click()
    cleared.locator(".objects li button").first.click()
    assert cleared.locator(".objects").is_visible()


def test_opening_one_list_closes_the_other(cleared):
    cleared.evaluate(LIST)
    objects, views = (
        cleared.locator(".tools").get_by_label(name) for name in ("Objects in", "Where the photos")
    )
    for opened, other in ((objects, views), (views, objects), (objects, views)):
        opened.click()
        assert (opened.get_attribute("aria-pressed"), other.get_attribute("aria-pressed")) == (
            "true",
            "false",
        )
        assert cleared.locator("aside.views").filter(visible=True).count() == 1


def test_the_threshold_is_dragged_with_a_pause_and_the_color_stays_under_the_hand(cleared):
    ask(cleared, "ball 2")
    slider = cleared.locator(".threshold input")
    cleared.evaluate("window.before = [...document.querySelectorAll('.threshold input, .swatch')]")
    box = slider.bounding_box()
    y = box["y"] + box["height"] / 2
    cleared.mouse.move(box["x"] + 0.5 * box["width"], y)
    cleared.mouse.down()
    cleared.mouse.move(box["x"] + 0.7 * box["width"], y)
    until(cleared, "lexsplat.app.answers[0].places !== null && lexsplat.app.answers[0].threshold > 0.6")
    cleared.wait_for_timeout(400)
    cleared.mouse.move(box["x"] + 0.2 * box["width"], y)
    cleared.mouse.up()
    assert 0.1 < cleared.evaluate("lexsplat.app.answers[0].threshold") < 0.3
    until(cleared, "lexsplat.app.answers[0].places !== null")
    cleared.locator(".swatch").fill("#112233")
    cleared.wait_for_timeout(300)
    assert cleared.evaluate("window.before.every((one) => one.isConnected)")
    cleared.get_by_role("button", name="Automatic").click()
    assert cleared.evaluate("lexsplat.app.answers[0].threshold === lexsplat.app.answers[0].automatic")
    cleared.get_by_label("Hide ball 2").click()
    assert cleared.locator(".threshold").is_hidden()
    cleared.get_by_label("Show ball 2").click()
    assert cleared.locator(".threshold").is_visible()


def test_of_two_quick_questions_the_later_one_stays_whichever_is_answered_first(cleared):
    until(cleared, "lexsplat.app.source !== null")
    slow = """async (slow) => {
        const { source } = lexsplat.app;
        const answer = source.constructor.prototype.answer;
        source.answer = async (prompt, color) => {
            if (prompt === slow) await new Promise((resolve) => setTimeout(resolve, 400));
            return answer.call(source, prompt, color);
        };
        await Promise.all([lexsplat.app.ask("ball 1"), lexsplat.app.ask("ball 2")]);
        const shown = [...document.querySelectorAll(".card strong")].map((one) => one.textContent);
        await Promise.all([lexsplat.app.ask("ball 3", true), lexsplat.app.ask("ball 4", true)]);
        const { answers } = lexsplat.app;
        return [shown, answers.map((one) => one.prompt), new Set(answers.map((one) => one.color)).size];
    }"""
    for late in ("ball 1", "ball 2"):
        assert cleared.evaluate(slow, late) == [["ball 2"], ["ball 2", "ball 3", "ball 4"], 3]


def test_every_tool_can_be_pressed_on_small_windows_also_with_answers(tab, address):
    page = show(tab, address, 390, 844)
    ask(page, "ball 1, ball 2, ball 3")
    until(page, "document.querySelectorAll('.card').length === 3")
    for width, height in SMALL:
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(100)
        assert covered_tools(page) == [], (width, height)
        title = page.locator(".title").bounding_box()
        assert title["height"] < 0.3 * height, "a long title leaves the picture free"


def test_links_that_ask_for_heat_press_its_tool_and_far_cameras_still_see_the_scene(tab, address):
    page = show(tab, f"{address}#q=ball+2&show=heat", 720, 480)
    heat = page.locator(".tools").get_by_label("Show heat instead of marks")
    assert heat.get_attribute("aria-pressed") == "true"
    heat.click()
    assert heat.get_attribute("aria-pressed") == "false"
    for camera in ("1e300,1e300,1e300,0,0,0,50", "1e300,0,0,1e300,0,0,50", "0,0,0,0,0,0,0"):
        show(page, f"{address}#camera={camera}", 720, 480)
        ask(page, "ball 2")
        reach = "lexsplat.app.stage.camera.position.length() / lexsplat.app.geometry.bounds().radius"
        assert page.evaluate(reach) < 100
        assert page.evaluate("lexsplat.app.answers[0].presence") == "yes"


def test_a_page_that_draws_nothing_answers_all_the_same(browser, address):
    """A page in a tab behind others draws no picture."""
    page = open_page(browser, address, script="window.requestAnimationFrame = () => 0", scale=HALF)
    assert (
        page.evaluate("lexsplat.app.ask('ball 2', false, false).then(() => lexsplat.app.answers.length)") == 1
    )
    page.close()


def test_the_closed_completions_are_no_stop_of_the_tab_key_and_the_box_takes_what_the_server_takes(cleared):
    until(cleared, "lexsplat.app.source !== null")
    cleared.locator(".search input").focus()
    cleared.keyboard.type("ball")
    cleared.keyboard.press("Tab")
    assert cleared.evaluate("document.activeElement.tagName") == "BUTTON"
    assert cleared.locator(".search input").get_attribute("maxlength") == str(MAX_LENGTH)
