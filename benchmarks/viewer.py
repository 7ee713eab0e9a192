"""Response time of the viewer's server, from a prompt to the last byte of its answer, and bytes sent.

    python benchmarks/viewer.py output/demo             # a scene folder
    python benchmarks/viewer.py --synthetic 3000000     # random Gaussians with language

"cpu" is processor time of all threads of the process, which hardly depends on other programs on the machine.
"""

from __future__ import annotations

import http.client
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
from lexsplat.scenes.publishing.index import page_file
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.views import StoredView
from lexsplat.viewer.server import ViewerConfig, ViewerServer

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


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("scene", nargs="?")
    parser.add_argument("--synthetic", type=int)
    parser.add_argument("--splats", type=int, default=1_000_000)
    options = parser.parse_args()
    scene = synthetic(options.synthetic) if options.synthetic else lexsplat.open_scene(options.scene)
    started = time.perf_counter()
    viewer = ViewerServer(scene, ViewerConfig(port=0, splats=options.splats))
    start = time.perf_counter() - started
    viewer.session.warm_up()
    scene.embed(PROMPTS)  # not timed: the cost of new words is that of the encoder
    connection = http.client.HTTPConnection("127.0.0.1", viewer.port)
    own = {"Origin": f"http://127.0.0.1:{viewer.port}"}
    answered, spent, sent = [], [], []
    for prompt in PROMPTS:
        busy, started = time.process_time(), time.perf_counter()
        connection.request("POST", "/ask", json.dumps({"prompt": prompt, "version": 1}), own)
        response = connection.getresponse()
        content = response.read()
        assert response.status == 200, content
        answered.append(time.perf_counter() - started)
        spent.append(time.process_time() - busy)
        sent.append(len(content))
    files = viewer.session.content.files
    result = {
        "gaussians": len(scene.gaussians),
        "drawn": len(viewer.session.content.drawn),
        "start_s": round(start, 2),
        "first_page_bytes": sum(map(len, files.values()))
        + sum(len(page_file(name)) for name in ("page.js", "page.wasm")),
        "answer_median_ms": round(1e3 * statistics.median(answered), 1),
        "answer_max_ms": round(1e3 * max(answered), 1),
        "answer_cpu_median_ms": round(1e3 * statistics.median(spent), 1),
        "answer_bytes_max": max(sent),
        "load_average": round(os.getloadavg()[0], 1),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }
    print(json.dumps(result, indent=2), flush=True)
    write_record(options.json, [result])
    viewer.stop()


if __name__ == "__main__":
    main()
