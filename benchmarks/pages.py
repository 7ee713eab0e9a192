"""The published demo beside @playcanvas/supersplat-viewer, which shows the same scene without search, in one run.

    python benchmarks/pages.py [--repeats 5] [--copies N] [--json FILE]

Headless Chromium with software WebGL opens both pages in turn, each in a fresh browser, from a server of the
standard library on this machine. The first picture is the first presented frame that is closer to the finished one
than to an empty page. The first answer is the first frame after Enter that differs from the frame before. "cpu" is
processor time of all processes of the browser, which depends less on other programs than wall time does. Bytes are
those of the files, compressed as most web servers do (gzip). The viewer is fetched from npm into a temporary folder.
Without npm or Chromium nothing is measured, and the reason is told.

With ``--copies`` the scene is laid side by side that many times (25 copies of the demo have a million Gaussians), and
only this page is opened: it says what a new prompt costs in software.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import gzip
import http.server
import io
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from asking import copied
from PIL import Image
from records import argument_parser, write_record

import lexsplat
from lexsplat.scenes.exporting import export_gaussians
from lexsplat.scenes.publishing import publish

VIEWER = "@playcanvas/supersplat-viewer@1.36.2"
PROMPT = "red apple"
SIZE = {"width": 960, "height": 600}
FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
FIRST_BYTE = "(performance.timeOrigin + performance.getEntriesByType('navigation')[0].responseStart) / 1000"
"""When the page's first byte came, seconds since 1970."""
_PACKED = {".js", ".css", ".html", ".json", ".txt", ".bin", ".ply", ".safetensors", ".wasm"}
"""Endings that web servers compress; the others are compressed already."""


class Recorder:
    """The frames that a page presents.

    Args:
        browser: Of Playwright.
        address: What to open.
    """

    def __init__(self, browser: Any, address: str) -> None:
        self._system = browser.new_browser_cdp_session()
        self.context = browser.new_context(viewport=SIZE, reduced_motion="reduce", color_scheme="dark")
        self.page = self.context.new_page()
        self.page.set_default_timeout(120_000)
        self.frames: list[tuple[float, float, np.ndarray]] = []
        """When each was presented (seconds since 1970), processor seconds until then, and its pixels."""
        self.files: dict[str, float] = {}
        """When each file was asked for."""
        self.page.on("request", lambda request: self.files.setdefault(request.url, time.time()))
        self._session = self.context.new_cdp_session(self.page)
        self._session.on("Page.screencastFrame", self._take)
        self._used = self._processor_seconds()
        self._session.send("Page.startScreencast", {"format": "jpeg", "quality": 60, "everyNthFrame": 1})
        self.page.goto(address, wait_until="commit")
        self.start = self.page.evaluate(FIRST_BYTE)

    def _processor_seconds(self) -> float:
        return sum(one["cpuTime"] for one in self._system.send("SystemInfo.getProcessInfo")["processInfo"])

    def _take(self, frame: dict[str, Any]) -> None:
        self._session.send("Page.screencastFrameAck", {"sessionId": frame["sessionId"]})
        picture = Image.open(io.BytesIO(base64.b64decode(frame["data"]))).convert("RGB").resize((240, 150))
        self.frames.append((frame["metadata"]["timestamp"], self.used, np.asarray(picture, np.float32)))

    def wait_until_quiet(self, seconds: float = 3.0, most: float = 25.0) -> None:
        """Wait until no frame came for some seconds, at most ``most``."""
        end, seen, since = time.monotonic() + most, -1, time.monotonic()
        while time.monotonic() < min(end, since + seconds):
            self.page.wait_for_timeout(100)
            if len(self.frames) != seen:
                seen, since = len(self.frames), time.monotonic()

    @property
    def used(self) -> float:
        """Processor seconds of the browser since the start."""
        return self._processor_seconds() - self._used

    def first_near_the_last(self) -> tuple[float, float, float]:
        """When the first frame was presented that is nearer to the last one than to a flat one.

        Returns:
            Seconds since the page's first byte, processor seconds since the start, and the time since 1970.
        """
        *_, last = self.frames[-1]
        far = np.abs(last - last.mean((0, 1))).mean()
        for at, used, picture in self.frames:
            if np.abs(picture - last).mean() < far / 2:
                return at - self.start, used, at
        raise RuntimeError("no picture")

    def bytes_until(self, moment: float, folder: Path) -> int:
        """Compressed bytes of the files that were asked for before a moment."""
        addresses = [url for url, at in self.files.items() if at <= moment and url.startswith("http")]
        names = [urlsplit(url).path.strip("/") or "index.html" for url in addresses]
        return sum(_size(folder / name) for name in names if (folder / name).is_file())


def _size(path: Path) -> int:
    content = path.read_bytes()
    return len(gzip.compress(content, 9)) if path.suffix in _PACKED else len(content)


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[str]:
    """The address of a server of a folder."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *arguments: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


def ours(browser: Any, folder: Path) -> dict[str, float]:
    """Open the published page and ask."""
    with serving(folder) as address:
        recorder = Recorder(browser, address)
        page = recorder.page
        page.wait_for_selector(".search")
        page.evaluate("lexsplat.ready.then(() => lexsplat.app.stage.settled())")
        recorder.wait_until_quiet()
        picture, used, at = recorder.first_near_the_last()
        row = {
            "picture_s": picture,
            "picture_cpu_s": used,
            "picture_mb": recorder.bytes_until(at, folder) / 1e6,
        }
        page.fill(".search input", PROMPT)
        page.keyboard.press("End")
        recorder.wait_until_quiet()
        before, shown = len(recorder.frames), recorder.frames[-1][2]
        used = recorder.used
        asked = time.time()
        page.keyboard.press("Enter")
        page.wait_for_selector(".card")
        page.evaluate("lexsplat.app.stage.settled()")
        recorder.wait_until_quiet()
        changed = [frame for frame in recorder.frames[before:] if np.abs(frame[2] - shown).mean() > 4]
        row |= {
            "answer_s": changed[0][0] - asked,
            "answer_cpu_s": changed[0][1] - used,
            "answer_mb": recorder.bytes_until(changed[0][0], folder) / 1e6,
        }
        recorder.context.close()
        return row


def theirs(browser: Any, folder: Path) -> dict[str, float]:
    """Open the viewer without search."""
    with serving(folder) as address:
        recorder = Recorder(browser, f"{address}?content=scene.sog&webgl&noanim")
        recorder.page.wait_for_selector("canvas")
        recorder.wait_until_quiet(8.0, 40.0)
        picture, used, at = recorder.first_near_the_last()
        row = {
            "picture_s": picture,
            "picture_cpu_s": used,
            "picture_mb": recorder.bytes_until(at, folder) / 1e6,
        }
        recorder.context.close()
        return row


def write_viewer(scene: Any, folder: Path, work: Path) -> None:
    """The viewer of npm with the scene as SOG, its recommended format, from the same camera."""
    subprocess.run(
        ["npm", "pack", "--silent", VIEWER], cwd=work, check=True, capture_output=True, timeout=120
    )
    shutil.unpack_archive(next(work.glob("*.tgz")), work / "npm")
    shutil.copytree(work / "npm" / "package" / "public", folder, ignore=shutil.ignore_patterns("*.map"))
    export_gaussians(scene.gaussians, folder / "scene.sog")
    camera = scene.camera(min(scene.views))
    position = camera.position
    target = position + 5 * np.asarray(camera.viewmat)[2, :3]
    turned = [[-float(x), -float(y), float(z)] for x, y, z in (position, target)]  # it turns splats about z
    fov = float(np.degrees(2 * np.arctan(camera.height / 2 / camera.K[1, 1])))
    settings = {
        "version": 2, "tonemapping": "none", "highPrecisionRendering": False, "background": {"color": [0, 0, 0]},
        "postEffectSettings": {
            "sharpness": {"enabled": False, "amount": 0}, "bloom": {"enabled": False, "intensity": 1, "blurLevel": 2},
            "grading": {"enabled": False, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
            "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": {"enabled": False, "intensity": 0.5},
        },
        "animTracks": [], "annotations": [], "startMode": "default",
        "cameras": [{"initial": {"position": turned[0], "target": turned[1], "fov": fov}}],
    }  # fmt: skip
    (folder / "settings.json").write_text(json.dumps(settings))


def main() -> None:
    """Measure both pages in turn and print the medians."""
    parser = argument_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--copies", type=int, default=1)
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="save the last picture of each page there"
    )
    options = parser.parse_args()
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    alone = options.copies > 1
    if program is None or (shutil.which("npm") is None and not alone):
        print(f"skipped: no {'Chromium' if program is None else 'npm'} on the path")
        return
    from playwright.sync_api import sync_playwright

    scene = lexsplat.open_scene("demo")
    pages = [("lexsplat publish", ours, "page"), (VIEWER, theirs, "viewer")][: 1 if alone else 2]
    rows: dict[str, list[dict[str, float]]] = {title: [] for title, _, _ in pages}
    with tempfile.TemporaryDirectory() as name, sync_playwright() as driver:
        work = Path(name)
        if alone:
            copied(scene, options.copies, work / "scene")
            scene = lexsplat.open_scene(work / "scene")
        else:
            try:
                write_viewer(scene, work / "viewer", work)
            except (subprocess.SubprocessError, OSError) as error:
                print(f"skipped: npm did not give {VIEWER}: {error}")
                return
        publish(scene, work / "page")
        for repeat in range(options.repeats + 1):
            for title, measure, folder in pages:
                browser = driver.chromium.launch(executable_path=program, args=FLAGS)
                row = measure(browser, work / folder)
                browser.close()
                print(f"round {repeat}: {title} {row}", file=sys.stderr, flush=True)
                if repeat:  # the first round fills the caches of files
                    rows[title].append(row)
    medians = [
        {"page": title, **{key: round(statistics.median(row[key] for row in own), 3) for key in own[0]}}
        for title, own in rows.items()
    ]
    for row in medians:
        print(row)
    print(f"{options.repeats} repeats, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    write_record(options.json, medians, load=os.getloadavg()[0], repeats=options.repeats)


if __name__ == "__main__":
    main()
