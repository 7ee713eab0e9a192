"""Peak memory and time of the feature stage on many large views, with one process per memory setting.

    python benchmarks/memory.py [--views 300] [--size 1297x840] [--memory 1GB 4GB] [--json FILE]

The views are images of noise (number and size of crops do not depend on the content) with cameras on a line; the
encoders are the bundled ones. `photos` is the size of all photos as float32 and `maps` that of all maps on disk:
neither may be held in memory. `peak` is the peak of the process, including Python, torch and weights; `bare` is that
of a process that has only loaded the encoders.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image
from records import argument_parser, write_record

GIB = 1 << 30


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--views", type=int, default=300)
    parser.add_argument("--size", default="1297x840")
    parser.add_argument("--memory", nargs="+", default=["1GB", "4GB"])
    parser.add_argument("--child", nargs=2, metavar=("CAPTURE", "MEMORY"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(extract(Path(options.child[0]), options.child[1])))
        return
    width, height = map(int, options.size.split("x"))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        make_capture(Path(folder), options.views, width, height)
        print(f"photos {options.views * width * height * 12 / GIB:.1f} GiB as float32")
        for memory in options.memory:
            command = [sys.executable, __file__, "--child", folder, memory]
            result = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
            rows.append({"memory": memory, **json.loads(result.stdout.splitlines()[-1])})
            print(
                "memory {memory}: peak {peak:.2f} GiB (bare {bare:.2f}), maps {maps:.2f} GiB, "
                "{seconds:.0f} s".format(**rows[-1])
            )
    write_record(options.json, rows, views=options.views, size=options.size)


def make_capture(folder: Path, views: int, width: int, height: int) -> None:
    """JPEGs of blurred noise. All differ: equal photos would be encoded once."""
    (folder / "images").mkdir()
    rng = np.random.default_rng(0)
    frames = []
    for number in range(views):
        small = Image.fromarray(rng.integers(0, 256, (24, 36, 3), dtype=np.uint8))
        name = f"images/{number:04d}.jpg"
        small.resize((width, height), Image.Resampling.BICUBIC).save(folder / name, quality=90)
        pose = np.eye(4)
        pose[0, 3] = number / views
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    intrinsics = {"fl_x": width, "fl_y": width, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))


def extract(capture: Path, memory: str) -> dict[str, float]:
    """Run the feature stage at full size; memory in GiB, time in seconds."""
    from lexsplat.captures import load_capture
    from lexsplat.features.encoders import load_clip, load_dino
    from lexsplat.pipeline.config import BuildConfig
    from lexsplat.pipeline.encoding import Encoders, feature_maps

    load_clip("bundled"), load_dino("bundled")
    bare = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    scene = load_capture(capture)
    view = next(iter(scene.views.values()))
    config = BuildConfig(clip="bundled", dino="bundled", memory=memory, downscale=1.0)
    config = config.resolved("cpu", view.capture_size)
    with tempfile.TemporaryDirectory() as cache:
        start = time.perf_counter()
        encoders = Encoders(config.clip, config.dino, "cpu")
        maps = feature_maps(scene, config, encoders, Path(cache))
        for name in maps:
            maps[name]
        seconds = time.perf_counter() - start
        size = sum(path.stat().st_size for path in Path(cache).rglob("*") if path.is_file())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"bare": bare, "peak": peak, "maps": size / GIB, "seconds": seconds}


if __name__ == "__main__":
    main()
