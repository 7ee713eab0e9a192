"""Build the bundled finished scene: ``python tools/demo_scene/ship.py``.

Builds the demo scene as ``lexsplat demo`` does, but with spherical harmonics of degree 1 in place of 3, which
halves the file, and keeps what questions need: cameras, Gaussians, language. ``--record`` builds nothing: it
writes the scene.json that is there again, under the present names of its keys and without settings that are gone.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

from lexsplat.cli.progress import ProgressBars
from lexsplat.evaluation.demo import DEMO_CONFIG, demo_capture
from lexsplat.evaluation.scenes import evaluate_scene
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.files import to_json
from lexsplat.scenes.folder import BUNDLED_SCENE
from lexsplat.scenes.kept import keep
from lexsplat.scenes.records import read_record
from lexsplat.scenes.scene import open_scene

KEPT = ("cameras.json", "gaussians.ply", "language.safetensors")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--work", type=Path, default=None, help="where to build; none takes a temporary folder"
    )
    parser.add_argument("--record", action="store_true", help="only write scene.json again")
    options = parser.parse_args()
    if options.record:
        path = BUNDLED_SCENE / "scene.json"
        write_record(read_record(json.loads(path.read_text()), path))
        return
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary) / "scene"
        config = replace(
            DEMO_CONFIG, device="cpu", reconstruction=replace(DEMO_CONFIG.reconstruction, sh_degree=1)
        )
        with ProgressBars() as bars:
            folder = build(demo_capture(), work, config, listener=bars)
            scene = open_scene(work, device="cpu")
            keep(scene)
            quality = evaluate_scene(scene, listener=bars)
            scene.ask("red apple", checked=True)  # asks for the names of its things in all colors
            scene.write_texts()
        BUNDLED_SCENE.mkdir(parents=True, exist_ok=True)
        texts = (
            Path("checkpoints") / "texts"
        )  # embeddings of everyday words: a question needs no other encoding
        shutil.copytree(work / texts, BUNDLED_SCENE / texts, dirs_exist_ok=True)
        for name in ("checkpoints/seen.safetensors", "checkpoints/objects.safetensors"):
            shutil.copyfile(work / name, BUNDLED_SCENE / name)
        for name in KEPT:
            shutil.copyfile(work / name, BUNDLED_SCENE / name)
        write_record(folder.record)
        size = sum(file.stat().st_size for file in BUNDLED_SCENE.iterdir())
        strict = quality["language"]["strict"]
        print(f"{BUNDLED_SCENE}: {size / 1e6:.2f} MB, PSNR {quality['quality']['psnr']:.2f} dB, "
              f"mIoU {strict['auto']['mIoU']:.3f}, mAP {strict['mAP']:.3f}")  # fmt: skip


def write_record(record: dict) -> None:
    """Write scene.json without the place of the photos, which is that of the machine that built it."""
    config = known(record["config"], to_json(BuildConfig()))
    content = {**record, "capture": None, "config": config}
    (BUNDLED_SCENE / "scene.json").write_text(json.dumps(content, indent=1) + "\n")


def known(config: dict, settings: dict) -> dict:
    """The part of a configuration that the settings still have."""
    kept = {name: value for name, value in config.items() if name in settings}
    parts = {name: known(kept[name], part) for name, part in settings.items() if isinstance(part, dict)}
    return {**kept, **parts}


if __name__ == "__main__":
    main()
