"""What a question costs in an open scene: the first one, new words, a known word, an inventory.

    python benchmarks/asking.py [SCENE] [--copies 25] [--folder FOLDER] [--json FILE]

With ``--copies`` the scene is laid side by side that many times, with every fifth view of each copy, in a
folder of its own: 25 copies of the bundled scene have a million Gaussians. "fresh" opens it with an empty
cache of the user; "kept" opens it again, in a process of its own. Processor seconds of
all threads: they hardly depend on other programs on the machine.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from records import argument_parser, write_record

import lexsplat
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import CodeField
from lexsplat.language.segments import Segments
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.language import write_field
from lexsplat.scenes.kept import keep
from lexsplat.scenes.scene import Scene

APART = 8.0
"""Distance of the copies, in scene units: the table of the bundled scene is 4 long."""
WORDS = ("vase", "teddy bear", "pumpkin", "is there a bottle?", "where is the toy car?", "unicorn")
"""What `Scene.find` is asked: with places, boxes and best views."""
ASKED = ("duck", "banana", "lamp", "blue mug", "book", "griffin")
"""What `Scene.ask` is asked: scores, threshold and presence."""
PARTS = ("mug handle", "lamp shade", "duck beak", "bear nose", "car wheel")
KINDS = ("red thing", "purple thing", "yellow thing", "metal thing", "wooden thing", "plastic thing")
"""Parts are cut within their thing. The first kinds of color and of material in a process take longer."""


def copied(scene: Scene, copies: int, root: Path) -> None:
    """Write a scene folder with copies of a scene with segments side by side."""
    field, source = scene.field, scene.folder
    if not isinstance(field, CodeField) or field.segments is None or source is None:
        raise SystemExit("copies are made of scenes with codes and segments")
    side = int(np.ceil(copies**0.5))
    offsets = np.array([[APART * (n % side), APART * (n // side), 0.0] for n in range(copies)])
    tensors = {
        name: torch.cat([getattr(scene.gaussians, name)] * copies)
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
    }
    tensors["means"] += torch.from_numpy(offsets).float().repeat_interleave(len(scene.gaussians), 0)
    known, lowest = field.segments, field.segments.levels.shape[1]
    segments = Segments(
        torch.cat([known.labels + n * lowest for n in range(copies)]),
        known.masses.repeat(copies),
        torch.cat([known.levels + n * lowest for n in range(copies)], 1),
    )
    repeated = CodeField(
        field.codebook,
        *(values.repeat(copies, *[1] * (values.ndim - 1)) for values in (field.codes, field.weights)),
        field.uncertainties.repeat(copies),
        segments=segments,
    )
    views = {}
    for n in range(copies):
        for name, view in list(scene.views.items())[::5]:
            matrix = view.camera.viewmat.copy()
            matrix[:3, 3] -= matrix[:3, :3] @ offsets[n]
            views[f"{n}/{name}"] = (dataclasses.replace(view.camera, viewmat=matrix), view.split)
    folder = SceneFolder(root)
    folder.record = json.loads(json.dumps(source.record))
    root.mkdir(parents=True)
    folder.write_cameras(views)
    folder.write_gaussians(Gaussians(**tensors, antialiased=scene.gaussians.antialiased))
    made_for = folder.record["stages"].get("reconstruct", {}).get("fingerprint")
    write_field(repeated, {"reconstruction": str(made_for)}, folder.language_path)
    folder.save()


def measure(path: str, kept: str) -> dict[str, Any]:
    """One row, in this process."""
    demo = lexsplat.open_scene("demo")
    demo.render(next(iter(demo.views)))  # loads the compiled kernels
    row: dict[str, Any] = {"caches": kept}

    def timed(name: str, what: Callable[[], Any]) -> Any:
        before, started = time.process_time(), time.perf_counter()
        found = what()
        row[name] = round(time.process_time() - before, 4)
        row[f"{name}_wall"] = round(time.perf_counter() - started, 4)
        return found

    scene = timed("open", lambda: lexsplat.open_scene(path))
    row["gaussians"] = len(scene.gaussians)
    timed("first", lambda: scene.find("where is the red apple?").to_dict())

    def median(name: str, words: tuple[str, ...], what: Callable[[str], Any]) -> None:
        spent = []
        for word in words:
            timed(name, lambda word=word: what(word))
            spent.append((row[name], row[f"{name}_wall"]))
        row[name], row[f"{name}_wall"] = (sorted(values)[len(values) // 2] for values in zip(*spent))
        row[f"{name}_worst"] = max(cpu for cpu, _ in spent)

    median("asked", ASKED, scene.ask)
    median("part", PARTS, scene.ask)
    median("kind", KINDS, scene.ask)
    median("new", WORDS, lambda word: scene.find(word).to_dict())
    timed("known", lambda: [scene.find(word).to_dict() for word in WORDS])
    row["known"] = round(row["known"] / len(WORDS), 5)
    timed("objects", lambda: scene.objects)
    timed("relation", lambda: scene.find("what is left of the vase?").to_dict())
    row["load"] = round(os.getloadavg()[0], 1)
    return row


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("scene", nargs="?", default="demo")
    parser.add_argument("--copies", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where the copies are written, and stay")
    parser.add_argument("--one", choices=("fresh", "kept"), help="(inside) print one row")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.scene, options.one)))
        return
    with tempfile.TemporaryDirectory() as temporary:
        path = options.scene
        if options.copies > 1:
            path = options.folder or Path(temporary) / "copies"
            if not path.exists():
                copied(lexsplat.open_scene(options.scene), options.copies, path)
                before = time.process_time()
                keep(lexsplat.open_scene(path))  # as a build does
                print(f"kept with the scene: {time.process_time() - before:.1f} s", flush=True)
        rows = []
        for kept in ("fresh", "kept"):
            done = subprocess.run(
                [sys.executable, __file__, str(path), "--one", kept],
                env={**os.environ, "XDG_CACHE_HOME": f"{temporary}/cache"},
                stdout=subprocess.PIPE,
                check=True,
            )
            rows.append(json.loads(done.stdout))
            print(json.dumps(rows[-1]), flush=True)
    write_record(options.json, rows)


if __name__ == "__main__":
    main()
