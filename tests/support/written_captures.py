"""Small captures on disk, and a smooth image for tests of lenses."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lexsplat.geometry.cameras import OPENGL_TO_OPENCV, look_at

WIDTH, HEIGHT = 64, 48
FOCAL = 60.0
NAMES = [f"{index:04d}.png" for index in range(1, 18)]


def shared_data(name: str) -> Path:
    """A development data set next to the repository; skips the test if it is absent."""
    root = os.environ.get("LEXSPLAT_TEST_DATA", Path(__file__).parents[2].parent / "shared" / "data")
    folder = Path(root) / name
    if not folder.is_dir():
        pytest.skip(f"development data {name} is not here (set LEXSPLAT_TEST_DATA)")
    return folder


def picture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth RGB pattern at ray slopes x / z and y / z, values within 0.1..0.9."""
    return np.stack(
        [0.5 + 0.4 * np.sin(4 * x + 1), 0.5 + 0.4 * np.cos(5 * y), 0.5 + 0.4 * np.sin(3 * (x + y))], axis=-1
    )


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8)).save(path)


def cameras_around(count: int) -> list:
    """Cameras on a circle that look at the origin."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        look_at([3 * np.cos(a), 3 * np.sin(a), 1.0], [0, 0, 0], [0, 0, 1], WIDTH, HEIGHT, 0.8) for a in angles
    ]


def write_images(folder: Path, names: list[str], size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    for index, name in enumerate(names):
        image = np.full((size[1], size[0], 3), 0.1 + 0.8 * index / max(1, len(names)))
        save(folder / name, image)


def write_transforms(
    root: Path, names: list[str], *, file: str = "transforms.json", images: bool = True, **top: object
) -> dict:
    """A transforms.json with cameras around the origin; returns the document for modification."""
    frames = []
    for name, camera in zip(names, cameras_around(len(names))):
        pose = np.linalg.inv(camera.viewmat) @ OPENGL_TO_OPENCV
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    document = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    document = {**document, **top, "frames": frames}
    root.mkdir(parents=True, exist_ok=True)
    (root / file).write_text(json.dumps(document))
    if images:
        write_images(root / "images", names)
    return document


def write_json(root: Path, document: object, file: str = "transforms.json") -> None:
    (root / file).write_text(json.dumps(document))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz of a rotation matrix, by scipy."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])


def colmap_bytes(names: list[str], *, model: int = 1, params: tuple = (FOCAL, FOCAL, 32.0, 24.0)) -> dict:
    """The three binary files of a COLMAP model as bytes, written from the description of the format."""
    cameras = struct.pack("<QIiQQ", 1, 1, model, WIDTH, HEIGHT) + struct.pack(f"<{len(params)}d", *params)
    images = struct.pack("<Q", len(names))
    for index, (name, camera) in enumerate(zip(names, cameras_around(len(names)))):
        q, t = quaternion(camera.viewmat[:3, :3]), camera.viewmat[:3, 3]
        images += struct.pack("<I4d3dI", index + 1, *q, *t, 1) + name.encode() + b"\0"
        images += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.0, 2.0, 1, 3.0, 4.0, -1)
    points = struct.pack("<Q", 3)
    for index in range(3):
        points += struct.pack("<Q3d3Bd", index + 1, 0.1 * index, 0.2, -0.3, 255, 128, 0, 0.5)
        points += struct.pack("<Q", 1) + struct.pack("<II", 1, 0)
    return {"cameras.bin": cameras, "images.bin": images, "points3D.bin": points}


def write_colmap(root: Path, names: list[str], *, images: bool = True, **camera: object) -> Path:
    """A capture with a binary COLMAP model in sparse/0; returns the model's folder."""
    model = root / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    for file, content in colmap_bytes(names, **camera).items():
        (model / file).write_bytes(content)
    if images:
        write_images(root / "images", names)
    return model
