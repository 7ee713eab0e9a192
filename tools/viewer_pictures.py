"""Make the images of docs/viewer.md: the page in headless Chromium, with three prompts, and with an edit in preview.

    python tools/viewer_pictures.py demo docs/images

Needs Chromium on the path and playwright. It draws with software WebGL and takes some minutes.
"""

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

import lexsplat
from lexsplat.viewer.server import ViewerConfig, ViewerServer

PROMPTS = "red apple, rubber duck, teddy bear"
START_VIEW = "view_033.jpg"
SIZE = {"width": 1400, "height": 640}  # wide enough that the cards cover nothing that is marked
FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


def main() -> None:
    scene, folder = lexsplat.open_scene(sys.argv[1]), Path(sys.argv[2])
    viewer = ViewerServer(scene, ViewerConfig(port=0))
    with sync_playwright() as driver:
        program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
        browser = driver.chromium.launch(executable_path=program, args=FLAGS)
        page = browser.new_page(viewport=SIZE, reduced_motion="reduce", color_scheme="dark")
        page.set_default_timeout(600_000)
        page.goto(f"{viewer.url}/#view={START_VIEW}")
        page.wait_for_selector(".search")
        page.evaluate("(prompts) => lexsplat.ready.then((app) => app.ask(prompts, false, false))", PROMPTS)
        save(page, folder / "viewer.jpg")
        page.evaluate("lexsplat.app.ask('apple next to the banana', false, false)")
        page.locator(".bench summary").click()
        page.get_by_label("Edit apple next to the banana").select_option("recolor")
        page.locator(".taken", has_text="Gaussians").wait_for()
        save(page, folder / "viewer_edit.jpg")
        browser.close()
    viewer.stop()


def save(page: Page, path: Path) -> None:
    """Save a screenshot of the finished picture."""
    page.evaluate("lexsplat.app.stage.settled()")
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    image.save(path, quality=80, optimize=True)
    print(f"{path}: {path.stat().st_size:,} bytes")


main()
