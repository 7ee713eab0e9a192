"""The viewer in a real browser: headless Chromium with software WebGL, on balls with known positions."""

import io
import itertools
import shutil
import time

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion
from support.viewer_scene import WORDS, ball_scene

from lexsplat.rendering import render
from lexsplat.viewer import side_panels

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
SIZE = {"width": 1000, "height": 380}

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the path")]


@pytest.fixture(scope="module")
def viewer():
    pytest.importorskip("viser")
    from lexsplat.viewer.server import ViewerConfig, ViewerServer

    scene, ground_truth = ball_scene()
    running = ViewerServer(scene, ViewerConfig(port=0))
    running.example = running.session.history.vocabulary[0]
    running.session.history.set_vocabulary(WORDS)
    running.ground_truth = ground_truth
    yield running
    running.stop()


@pytest.fixture(scope="module")
def page(viewer):
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        opened = browser.new_page(viewport=SIZE, accept_downloads=True)
        opened.set_default_timeout(120_000)
        opened.refused = []
        opened.on(
            "console", lambda m: opened.refused.append(m.text) if "Content Security" in m.text else None
        )
        opened.on("requestfailed", lambda request: opened.refused.append(request.url))
        opened.goto(viewer.url)
        opened.wait_for_selector("text=Find", timeout=120_000)
        opened.get_by_label("Close").or_(opened.locator(".mantine-Notification-closeButton")).first.click()
        until(lambda: viewer.viser.get_clients())
        until(lambda: len(np.unique(look(opened, viewer).reshape(-1, 3), axis=0)) > 200)
        yield opened
        browser.close()


def until(condition, seconds: float = 120.0):
    """Waits until a condition holds; returns its value."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, "timed out"
        time.sleep(0.1)
    return value


def client(viewer):
    (only,) = viewer.viser.get_clients().values()
    return only


def canvas(page) -> dict[str, float]:
    boxes = [box.bounding_box() for box in page.locator("canvas").all()]
    return max(filter(None, boxes), key=lambda box: box["width"] * box["height"])


def look(page, viewer) -> np.ndarray:
    """The canvas ``[H, W, 3]``."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot(clip=canvas(page)))).convert("RGB")).astype(int)


def settled(page, viewer) -> np.ndarray:
    """The canvas once it has stopped changing."""
    viewer.panels.wait()
    before = look(page, viewer)
    while True:
        time.sleep(0.4)
        after = look(page, viewer)
        if np.array_equal(before, after):
            return after
        before = after


def where_is(viewer, ball: int, shape) -> np.ndarray:
    """The coverage of a ball at each pixel of the page ``[H, W]``, by our own renderer."""
    from lexsplat.viewer.display import page_camera

    camera = page_camera(client(viewer)).resized(shape[1], shape[0])
    mask = torch.from_numpy((viewer.ground_truth.labels == ball).astype(np.float32))[:, None]
    drawn = render(viewer.session.scene.gaussians, camera, features=mask, color=False)
    return drawn.features[..., 0].numpy()


def assert_changed(before, after, share) -> None:
    """Asserts that the image differs where the object is, by its coverage ``share``, and nowhere else."""
    changed = np.abs(after - before).max(-1) > 12
    assert (share > 0.9).sum() > 200
    assert changed[binary_erosion(share > 0.9, iterations=2)].mean() > 0.97
    assert changed[~binary_dilation(share > 0.02, iterations=2)].mean() < 0.001


def ask(page, viewer, text: str) -> None:
    box = page.locator("form input").first
    box.click()
    box.fill("")
    page.wait_for_timeout(200)
    page.keyboard.type(text, delay=70)
    page.wait_for_timeout(120)
    page.keyboard.press("Enter")
    until(lambda: viewer.session.current and viewer.session.current.text == text)
    until(lambda: viewer.session.current.selection is not None)


def click(page, viewer, x: float, y: float) -> None:
    """Clicks on the scene like a user: move, press, release."""
    for _ in range(3):  # a page that is busy with software WebGL may miss a click
        page.mouse.move(x - 3, y)
        page.mouse.move(x, y)
        page.mouse.click(x, y, delay=80)
        end = time.monotonic() + 20
        while not viewer.session.clicked and time.monotonic() < end:
            time.sleep(0.1)
        if viewer.session.clicked:
            return
    pytest.fail("the click was not noticed")


def clear(page, viewer) -> None:
    if viewer.session.all_questions():
        page.get_by_role("button", name="Remove all").click()
        until(lambda: not viewer.session.all_questions())


def test_the_page_loads_completely_under_its_content_security_policy(page):
    assert page.refused == []
    assert page.locator("canvas").count() >= 1


def test_the_page_has_a_title_and_its_controls_have_names_and_an_example(page, viewer):
    until(lambda: page.title() == "lexsplat")
    for name in ("Recent", "Show", "Opacity", "Fade rest"):
        assert page.get_by_label(name, exact=True).count() >= 1, name
    box = page.get_by_role("textbox", name="Find", exact=True)
    assert box.get_attribute("placeholder") == f"{viewer.example}, ..."


def test_the_search_box_is_empty_after_an_answer(page, viewer):
    clear(page, viewer)
    ask(page, viewer, "ball 4")
    until(lambda: page.get_by_role("textbox", name="Find", exact=True).input_value() == "")
    page.keyboard.type("ball 2", delay=70)
    page.wait_for_timeout(120)
    page.keyboard.press("Enter")
    until(lambda: viewer.session.find("ball 2"))


def test_a_prompt_changes_the_image_at_the_object_and_nowhere_else(page, viewer):
    clear(page, viewer)
    before = settled(page, viewer)
    ask(page, viewer, "ball 4")
    after = settled(page, viewer)
    assert_changed(before, after, where_is(viewer, 4, before.shape))
    assert page.get_by_text("ball 4").count() >= 1


def test_a_click_on_a_completion_asks_it(page, viewer):
    clear(page, viewer)
    box = page.locator("form input").first
    box.fill("")
    page.wait_for_timeout(200)  # viser drops a change that comes within 50 ms of another
    box.click()
    page.keyboard.type("ba", delay=120)
    page.get_by_role("button", name="ball 1", exact=True).first.click()
    until(lambda: viewer.session.current and viewer.session.current.text == "ball 1")
    until(lambda: "ball 1" in viewer.session.history.prompts)


def test_a_click_on_the_scene_names_and_selects_the_object(page, viewer):
    clear(page, viewer)
    picture = settled(page, viewer)
    box = canvas(page)
    rows, columns = np.nonzero(binary_erosion(where_is(viewer, 2, picture.shape) > 0.9, iterations=3))
    place = len(rows) // 2
    click(page, viewer, box["x"] + columns[place] + 0.5, box["y"] + rows[place] + 0.5)
    assert np.array_equal(viewer.session.selection.mask.numpy(), viewer.ground_truth.labels == 2)
    page.get_by_role("tab", name="What is this?").click()
    page.get_by_text("splats selected").wait_for()
    after = settled(page, viewer)
    assert_changed(picture, after, where_is(viewer, 2, picture.shape))


def test_the_selection_can_be_downloaded(page, viewer, tmp_path):
    from plyfile import PlyData

    clear(page, viewer)
    ask(page, viewer, "ball 3")
    viewer.panels.wait()
    page.get_by_role("tab", name="Selection").click()
    with page.expect_download(timeout=120_000) as started:
        page.get_by_role("button", name="Download selection").click()
    started.value.save_as(tmp_path / "selection.ply")
    assert started.value.suggested_filename == "ball_3.ply"
    assert len(PlyData.read(tmp_path / "selection.ply")["vertex"]) == (viewer.ground_truth.labels == 3).sum()


def test_the_mode_changes_the_colors(page, viewer):
    from lexsplat.viewer.search_panel import MODE_LABELS

    clear(page, viewer)
    colored = settled(page, viewer)
    show = page.locator("input[aria-haspopup=listbox]").nth(2)  # after viser's own and "Recent"
    show.click()
    page.get_by_role("option", name=MODE_LABELS["codes"], exact=True).click()
    until(lambda: viewer.session.mode == "codes")
    assert np.abs(settled(page, viewer) - colored).mean() > 0.5


def test_jumping_to_a_view_shows_what_that_view_shows(page, viewer):
    from lexsplat.viewer.display import page_camera

    view = viewer.session.scene.views["view3"]
    viewer.display.jump(client(viewer), view.camera)
    until(lambda: np.allclose(client(viewer).camera.position, view.camera.position, atol=1e-3))
    found = page_camera(client(viewer))
    assert np.allclose(found.forward, view.camera.forward, atol=1e-3)
    assert 2 * np.arctan(found.height / 2 / found.K[1, 1]) == pytest.approx(0.75, abs=1e-3)
    settled(page, viewer)


def test_a_screenshot_is_downloaded_and_shows_the_scene(page, viewer, tmp_path):
    clear(page, viewer)
    page.get_by_role("tab", name="Save").click()
    with page.expect_download(timeout=120_000) as started:
        page.get_by_role("button", name="Screenshot").click()
    started.value.save_as(tmp_path / "shot.png")
    picture = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB")).astype(int)
    assert started.value.suggested_filename == "lexsplat.png"
    shown = sum(where_is(viewer, ball, picture.shape) for ball in range(5))
    assert np.ptp(picture[shown < 0.01].reshape(-1, 3), axis=0).max() < 10  # the background, without frustums
    assert np.abs(picture[shown > 0.95] - picture[shown < 0.01][0]).max(-1).min() > 25


def test_a_click_on_a_frustum_jumps_to_its_view(page, viewer):
    from lexsplat.geometry.cameras import Camera

    clear(page, viewer)
    view = viewer.session.scene.views["view1"].camera
    viewmat = view.viewmat.copy()
    viewmat[2, 3] += 0.8  # a step back puts the frustum in the center of the image
    behind = Camera(view.width, view.height, view.K, viewmat)
    viewer.display.jump(client(viewer), behind)
    until(lambda: np.allclose(client(viewer).camera.position, behind.position, atol=1e-3))
    page.get_by_role("tab", name="Cameras").click()
    page.get_by_label("Show cameras").check()
    until(lambda: viewer.display._frustums[0].visible)
    asked = viewer.session.clicked
    box = canvas(page)
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    settled(page, viewer)
    page.mouse.move(middle[0] - 3, middle[1])
    page.mouse.move(*middle)
    page.wait_for_timeout(300)
    page.mouse.click(*middle, delay=80)
    until(lambda: np.allclose(client(viewer).camera.position, view.position, atol=1e-3), seconds=30)
    assert viewer.session.clicked is asked, "the object behind the frustum was not asked about"
    page.get_by_label("Show cameras").uncheck()
    until(lambda: not viewer.display._frustums[0].visible)


def test_an_orbit_video_is_downloaded_with_every_frame(page, viewer, tmp_path, monkeypatch):
    av = pytest.importorskip("av")
    monkeypatch.setitem(side_panels._ORBIT, "frames", 8)
    monkeypatch.setitem(side_panels._ORBIT, "height", 120)
    clear(page, viewer)
    page.get_by_role("tab", name="Save").click()
    with page.expect_download(timeout=120_000) as started:
        page.get_by_role("button", name="Orbit video").click()
    started.value.save_as(tmp_path / "orbit.mp4")
    assert started.value.suggested_filename == "orbit.mp4"
    with av.open(str(tmp_path / "orbit.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in video.decode(video=0)]
    assert len(frames) == 8
    assert {frame.shape[0] for frame in frames} == {120}
    assert all(np.abs(a - b).max() > 30 for a, b in itertools.pairwise(frames)), "the camera moves"
