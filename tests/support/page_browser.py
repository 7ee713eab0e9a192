"""Published pages in a headless Chromium with software WebGL, served by the standard library's server."""

from __future__ import annotations

import contextlib
import functools
import http.server
import io
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
"""The first draws the same without the windows of a browser, which take a sixth of the processor time."""
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
FLAGS = [
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    # Only WebGL needs the emulated graphics card, which draws the rest of a page slowly.
    "--disable-gpu-compositing",
    # Each window loads two pages for its address bar, which take longer than most pages of the tests.
    "--disable-features=WebUIOmniboxPopup,WebUIOmniboxAimPopup,HttpsUpgrades,OptimizationHints,PaintHolding",
]


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[str]:
    """The address of a server of a folder."""
    handler = functools.partial(_Quiet, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


@contextlib.contextmanager
def chromium() -> Iterator:
    """A running browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


HALF = 0.5
"""Pixels of the screen for one of the page, where nothing depends on it: software draws a quarter of them."""


def blank_page(
    browser, width: int = 480, height: int = 360, script: str = "", phone: bool = False, scale: float = 1.0
):
    """An empty page for `show`; ``page.requested`` and ``page.complaints`` are filled."""
    size = {"width": width, "height": height}
    page = browser.new_page(
        viewport=size,
        device_scale_factor=scale,
        reduced_motion="reduce",
        color_scheme="dark",
        has_touch=phone,
        is_mobile=phone,
    )
    page.set_default_timeout(60_000)
    page.requested, page.complaints = [], []
    page.on("request", lambda request: page.requested.append(request.url))
    page.on("requestfailed", lambda request: page.complaints.append(request.url))
    page.on("console", lambda m: page.complaints.append(m.text) if _complains(m) else None)
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    if script:
        page.add_init_script(script)
    return page


def show(page, address: str, width: int = 480, height: int = 360):
    """Load an address in a page, faster than in a new one; returns the page when it has started or failed."""
    page.goto("about:blank")  # another place in the same page would load nothing
    page.requested.clear()
    page.complaints.clear()
    page.set_viewport_size({"width": width, "height": height})
    page.goto(address)
    until(page, "Boolean(window.lexsplat?.app || document.querySelector('.failure'))")
    return page


def open_page(
    browser,
    address: str,
    width: int = 480,
    height: int = 360,
    script: str = "",
    phone: bool = False,
    scale: float = 1.0,
):
    """A new page that has started or failed; see `blank_page`."""
    page = blank_page(browser, width, height, script, phone, scale)
    page.goto(address)
    until(page, "Boolean(window.lexsplat?.app || document.querySelector('.failure'))")
    return page


def _complains(message) -> bool:
    """Whether a message is an error or a warning; the browser itself reads slowly where no card composes pages."""
    return message.type in ("error", "warning") and "GPU stall due to ReadPixels" not in message.text


def until(page, condition: str, seconds: float = 60.0):
    """Wait until an expression of the page is true; its policy forbids Playwright's own way of waiting."""
    end = time.monotonic() + seconds
    while not (value := page.evaluate(condition)):
        assert time.monotonic() < end, f"timed out: {condition}"
        page.wait_for_timeout(50)
    return value


def ask(page, text: str) -> None:
    """Ask in the search bar and wait for the answer."""
    page.evaluate("document.querySelector('.answers').replaceChildren()")
    page.fill(".search input", text)
    page.keyboard.press("Enter")
    until(page, "Boolean(document.querySelector('.card'))")


def picture(page) -> np.ndarray:
    """The page ``[H, W, 3]`` once the scene is drawn."""
    page.evaluate("lexsplat.app.stage.settled()")
    return np.asarray(Image.open(io.BytesIO(page.screenshot(scale="css"))).convert("RGB")).astype(int)


def covered_tools(page) -> list[str]:
    """Names of the tools whose middle, or one of whose corners, is not theirs at that point of the page."""
    return page.evaluate(
        """() => [...document.querySelectorAll(".tools > button")].filter((tool) => {
            const { left, right, top, bottom } = tool.getBoundingClientRect();
            const points = [[(left + right) / 2, (top + bottom) / 2], [left + 3, top + 3], [right - 3, bottom - 3]];
            return !points.every(([x, y]) => tool.contains(document.elementFromPoint(x, y)));
        }).map((tool) => tool.ariaLabel)"""
    )
