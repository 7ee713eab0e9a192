"""Views of random photos for feature extraction."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from PIL import Image

from lexsplat.geometry.cameras import Camera

WIDTH, HEIGHT = 48, 32


@dataclasses.dataclass(frozen=True)
class FakeLens:
    params: tuple[float, ...] = (40.0, 24.0, 16.0)
    width: int = WIDTH
    height: int = HEIGHT


@dataclasses.dataclass(frozen=True)
class FakeView:
    name: str
    image_path: Path
    camera: Camera
    loads: list
    lens: FakeLens = FakeLens()
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ignore_path: Path | None = None
    ignores_transparent: bool = False

    @property
    def is_masked(self):
        return self.ignore_path is not None or self.ignores_transparent

    @property
    def stem(self):
        return self.name.rsplit(".", 1)[0]

    @property
    def capture_size(self):
        with Image.open(self.image_path) as image:
            return image.size

    def load_image(self, size=None):
        self.loads.append(self.name)
        with Image.open(self.image_path) as image:
            resized = (
                image if size is None or image.size == size else image.resize(size, Image.Resampling.BOX)
            )
            return np.asarray(resized, dtype=np.float32) / 255


def make_capture(folder: Path, count: int = 5):
    rng = np.random.default_rng(0)
    K = np.array([[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]])
    views, loads = {}, []
    for index in range(count):
        name = f"left/{index}.png"
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(path)
        views[name] = FakeView(name, path, Camera(WIDTH, HEIGHT, K, np.eye(4)), loads)
    return SimpleNamespace(views=views, loads=loads)
