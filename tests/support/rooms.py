"""A textured room with many SIFT features, and photos of it."""

from __future__ import annotations

import functools

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

from lexsplat.geometry.cameras import look_at


@functools.cache
def texture() -> np.ndarray:
    """Blobs of many sizes and colors ``[256, 256, 3]``, which yield many SIFT features."""
    rng = np.random.default_rng(0)
    layers = [gaussian_filter(rng.normal(size=(256, 256, 3)), (s, s, 0)) * s for s in (1.0, 2.0, 4.0, 8.0)]
    image = np.sum(layers, axis=0)
    return np.clip(0.5 + 0.25 * image / image.std(), 0, 1)


def textures() -> list[np.ndarray]:
    """The textures of the planes x = 0, y = 0 and z = 0."""
    return [texture(), np.flip(texture(), 0), np.roll(texture(), 1, 2)]


SIZE = (240, 180)
COUNT = 9
FEW = 400
"""Features of a photo that suffice to register all photos, in half of the time that all features take."""


def room_cameras() -> list:
    return [
        look_at(
            [1.0 + 0.5 * np.cos(a), 0.9 + 0.3 * np.sin(2 * a), 1.0 + 0.5 * np.sin(a)],
            [0.2, 0.2, 0.2],
            [0, 1, 0],
            *SIZE,
            0.9,
        )
        for a in np.linspace(-0.6, 2.0, COUNT)
    ]


def room_photo(camera) -> np.ndarray:
    """A corner of a room: the planes x = 0, y = 0 and z = 0, each with its texture over 2 units."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.K).T @ camera.viewmat[:3, :3]
    with np.errstate(divide="ignore"):
        distance = -camera.position / rays
    distance[distance <= 0] = np.inf
    wall = distance.argmin(-1)
    hit = camera.position + rays * distance.min(-1)[..., None]
    image = np.zeros((SIZE[1], SIZE[0], 3))
    for axis, pattern in enumerate(textures()):
        on_axis = wall == axis
        u, v = np.abs(np.delete(hit, axis, -1)[on_axis].T) * 128
        low_u, low_v = np.minimum(u.astype(int), 254), np.minimum(v.astype(int), 254)
        fu, fv = np.clip(u - low_u, 0, 1)[:, None], np.clip(v - low_v, 0, 1)[:, None]
        rows = [pattern[low_v + d, low_u] * (1 - fu) + pattern[low_v + d, low_u + 1] * fu for d in (0, 1)]
        image[on_axis] = rows[0] * (1 - fv) + rows[1] * fv
    return image


def assert_same_up_to_a_similarity(found: list, ground_truth: list) -> None:
    for a in range(COUNT):
        for b in range(a):
            turns = [c[a].viewmat[:3, :3] @ c[b].viewmat[:3, :3].T for c in (ground_truth, found)]
            cosine = (np.trace(turns[0].T @ turns[1]) - 1) / 2
            assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 1.0
    distances = [
        np.array([np.linalg.norm(c[a].position - c[b].position) for a in range(COUNT) for b in range(a)])
        for c in (ground_truth, found)
    ]
    ratio = distances[1] / distances[0]
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=0.1)


FOCAL_35 = 36
"""EXIF focal length as 35 mm equivalent."""


def save_as_phone(path, image: np.ndarray, orientation: int, focal: float | None = FOCAL_35) -> None:
    """A JPEG stored rotated, as by a phone, with its EXIF orientation."""
    # The inverse of each turn, by Pillow: orientations 6 and 8 undo each other, all others themselves.
    turns = {
        1: None, 2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM, 5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_90,
        7: Image.Transpose.TRANSVERSE, 8: Image.Transpose.ROTATE_270,
    }  # fmt: skip
    pixels = Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8))
    stored = pixels if turns[orientation] is None else pixels.transpose(turns[orientation])
    exif = Image.Exif()
    exif[0x0112] = orientation
    if focal is not None:
        exif.get_ifd(0x8769)[0xA405] = focal
    path.parent.mkdir(parents=True, exist_ok=True)
    stored.save(path, quality=98, subsampling=0, exif=exif)
