"""Response time of the viewer, from a prompt to the last byte sent to the page, and bytes sent.

    python benchmarks/viewer.py output/demo                             # a scene folder
    python benchmarks/viewer.py --synthetic 3000000 --quick             # random Gaussians with language
    python benchmarks/viewer.py --synthetic 3000000 --quick --browser   # until Chromium (software WebGL) drew them

"cpu" is processor time of all threads of the process, which hardly depends on other programs on the machine.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import time

import numpy as np
import torch
from records import argument_parser, write_record

import lexsplat
from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import CodeField
from lexsplat.scenes.folder import StoredView
from lexsplat.scenes.scene import Scene
from lexsplat.viewer.server import ViewerConfig, ViewerServer
from lexsplat.viewer.splats import BYTES_PER_SPLAT

PROMPTS = (
    "red apple",
    "blue mug",
    "yellow duck",
    "green plant",
    "lamp",
    "something to sit on",
    "fruit",
    "wood",
)


class Synthetic(Scene):
    """Random Gaussians on the walls of a room; each text is a fixed random direction."""

    def encode_text(self, texts: list[str]) -> torch.Tensor:
        rows = [torch.randn(512, generator=torch.Generator().manual_seed(sum(t.encode()))) for t in texts]
        return torch.stack(rows)

    def preload(self) -> None:
        pass


def synthetic(count: int) -> Scene:
    g = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=g) * 10 - 5
    wall = torch.randint(0, 3, (count,), generator=g)
    points[torch.arange(count), wall] = torch.where(torch.rand(count, generator=g) < 0.5, -5.0, 5.0)
    gaussians = Gaussians(
        means=points,
        quats=torch.randn(count, 4, generator=g),
        log_scales=torch.randn(count, 3, generator=g) * 0.7 - 4.5,
        opacity_logits=torch.randn(count, generator=g) * 2,
        sh0=torch.randn(count, 1, 3, generator=g),
        shN=torch.zeros(count, 0, 3),
    )
    codebook = Codebook(torch.randn(128, 512, generator=g), torch.randn(128, 384, generator=g))
    cell = ((points[:, 0] + 5) * 12.7).long().clamp(0, 127)
    codes = torch.stack([cell, (cell + 1) % 128, (cell + 2) % 128, (cell + 3) % 128], 1).to(torch.uint8)
    weights = torch.tensor([0.7, 0.1, 0.1, 0.1]).expand(count, 4).contiguous()
    field = CodeField(codebook, codes, weights, torch.rand(count, generator=g))
    cameras = [
        look_at(np.array([np.cos(a), np.sin(a), 0.2]), np.array([4 * np.cos(a), 4 * np.sin(a), 0]),
                np.array([0, 0, 1.0]), 320, 240, 0.9)
        for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ]  # fmt: skip
    views = {f"view{n}": StoredView(f"view{n}", camera, "train") for n, camera in enumerate(cameras)}
    return Synthetic(gaussians, field, views, "none")


def browser_seconds(viewer: ViewerServer) -> dict[str, float]:
    """Seconds until a page shows its controls, and until it has drawn the scene."""
    import shutil

    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        flags = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        page = browser.new_page(viewport={"width": 900, "height": 500})
        started = time.perf_counter()
        page.goto(viewer.url)
        page.wait_for_selector("text=Find", timeout=300_000)
        controls = time.perf_counter() - started
        while not viewer.viser.get_clients():
            time.sleep(0.1)
        (client,) = viewer.viser.get_clients().values()
        while True:  # an empty page responds, too: wait until the image is not uniform
            picture = viewer.display.image(client, 240)
            if np.ptp(picture.reshape(-1, picture.shape[-1]), axis=0).max() > 30:
                break
            if time.perf_counter() - started > 500:
                raise SystemExit("the page drew nothing in 500 s")
        drawn = time.perf_counter() - started
        browser.close()
    return {"browser_controls_s": round(controls, 2), "browser_drawn_s": round(drawn, 2)}


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("scene", nargs="?")
    parser.add_argument("--synthetic", type=int)
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--quick", action="store_true", help="skip thresholds and selections")
    parser.add_argument("--browser", action="store_true")
    options = parser.parse_args()
    scene = synthetic(options.synthetic) if options.synthetic else lexsplat.open_scene(options.scene)
    started = time.perf_counter()
    viewer = ViewerServer(scene, ViewerConfig(port=0, splats=options.splats))
    result: dict[str, object] = {
        "gaussians": len(scene.gaussians),
        "drawn": viewer.display.splats.drawn,
        "start_s": round(time.perf_counter() - started, 2),
        "first_page_bytes": viewer.display.splats.drawn * BYTES_PER_SPLAT,
    }
    viewer.panels.wait()  # until the text encoder and the vocabulary are loaded
    scene.embed(PROMPTS)  # not timed: the cost of new words is that of the encoder
    if options.browser:
        result |= browser_seconds(viewer)
        print(json.dumps(result, indent=2), flush=True)
    asked, spent, refined, sent = [], [], [], []
    draw = viewer.display.draw
    viewer.display.draw = lambda colors: sent.append(draw(colors)) or sent[-1]  # type: ignore[method-assign]
    for prompt in PROMPTS:
        for question in viewer.session.all_questions():
            viewer.session.remove(question)
        busy = time.process_time()
        viewer.panels.ask(prompt)
        spent.append(time.process_time() - busy)
        asked.append(viewer.panels.seconds["ask"])
        if not options.quick:
            viewer.panels.wait()
            refined.append(viewer.panels.seconds["refine"])
    result |= {
        "recolor_median_ms": round(1e3 * statistics.median(asked), 1),
        "recolor_max_ms": round(1e3 * max(asked), 1),
        "recolor_cpu_median_ms": round(1e3 * statistics.median(spent), 1),
        "recolor_bytes_max": max(sent),
        "threshold_and_selection_median_ms": round(1e3 * statistics.median(refined), 1) if refined else None,
        "load_average": round(os.getloadavg()[0], 1),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }
    print(json.dumps(result, indent=2), flush=True)
    write_record(options.json, [result])
    os._exit(0)  # do not wait for the worker, which still refines the last prompt


if __name__ == "__main__":
    main()
