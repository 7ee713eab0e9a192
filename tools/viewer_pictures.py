"""Make the images of docs/viewer.md: the viewer in headless Chromium, with three prompts and after a click.

python tools/viewer_pictures.py demo docs/images

Needs Chromium on the path and playwright. It draws with software WebGL and takes a minute or two.
"""

import io
import shutil
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

import lexsplat
from lexsplat.viewer.display import page_camera
from lexsplat.viewer.server import ViewerConfig, ViewerServer

PROMPTS = ("red apple", "rubber duck", "teddy bear")
CLICKED = "teddy bear"
START_VIEW = "view_033"
SIZE = {"width": 1400, "height": 760}
WIDTH = 1120
FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]


def main() -> None:
    scene, folder = lexsplat.open_scene(sys.argv[1]), Path(sys.argv[2])
    viewer = ViewerServer(scene, ViewerConfig(port=0))
    viewer.panels.wait()
    with sync_playwright() as driver:
        program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
        browser = driver.chromium.launch(executable_path=program, args=FLAGS)
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(300_000)
        page.goto(viewer.url)
        page.wait_for_selector("text=Find")
        page.locator(".mantine-Notification-closeButton").first.click()
        while not viewer.viser.get_clients():
            time.sleep(0.1)
        (client,) = viewer.viser.get_clients().values()
        viewer.display.jump(client, scene.view(START_VIEW).camera)
        for prompt in PROMPTS:
            viewer.panels.ask(prompt)
        save(page, viewer, folder / "viewer.jpg")
        page.get_by_role("button", name="Remove all").click()
        page.get_by_role("tab", name="What is this?").click()
        camera = page_camera(client)
        place = camera.K @ (camera.viewmat @ np.append(scene.select(CLICKED).center, 1))[:3]
        viewer.panels.click.what_is(camera, float(place[0] / place[2]), float(place[1] / place[2]))
        save(page, viewer, folder / "viewer_click.jpg")
        browser.close()
    viewer.stop()


def save(page: Page, viewer: ViewerServer, path: Path) -> None:
    """Save a screenshot once the page has stopped changing."""
    viewer.panels.wait()
    page.wait_for_timeout(3000)
    before = page.screenshot()
    while True:
        page.wait_for_timeout(1500)
        after = page.screenshot()
        if before == after:
            break
        before = after
    image = Image.open(io.BytesIO(after)).convert("RGB")
    size = WIDTH, WIDTH * image.height // image.width
    image.resize(size, Image.Resampling.LANCZOS).save(path, quality=80, optimize=True)
    print(f"{path}: {path.stat().st_size:,} bytes")


main()
