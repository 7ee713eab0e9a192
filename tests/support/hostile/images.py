"""Readers of images of every format, and the image files of other readers."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from support.hostile import mutations as mutate
from support.hostile.registry import READERS, Reader, finite


def picture(path: Path, width: int = 64, height: int = 48, value: int = 90, mode: str = "RGB") -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    ramp = np.linspace(0, value, width * height).reshape(height, width).astype(np.uint8)
    image = Image.fromarray(ramp if mode == "L" else np.stack([ramp] * 3, -1))
    image.save(path)


def png(content: bytes, rng: np.random.Generator, count: int) -> Iterator[mutate.Mutation]:
    """Mutations of a PNG, including headers with wrong sizes, depths and color types under valid checksums."""
    yield from mutate.binary(content, rng, count)
    for number in range(count):
        data = bytearray(content)
        if number % 2:
            data[16 + 4 * (number % 4 // 2) : 20 + 4 * (number % 4 // 2)] = [
                b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\0\0\xff\xff", b"\0\1\0\0", b"\0\0\0\1",
            ][number // 4 % 6]  # fmt: skip
        else:
            data[24 + number // 2 % 5] = int(rng.integers(256))
        data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
        yield "sizes", bytes(data)


def pictures_of(ending: str, **options: Any) -> Callable[[], Reader]:
    def make(folder: Path) -> None:
        from PIL import Image

        values = np.random.default_rng(0).integers(256, size=(12, 16, 3), dtype=np.uint8)
        Image.fromarray(values).save(folder / f"a{ending}", **options)

    def read(folder: Path) -> Any:
        from lexsplat.captures.images.bands import whole
        from lexsplat.captures.images.reading import PhotoRows, image_size, read_mask

        image_size(folder / f"a{ending}")
        read_mask(folder / f"a{ending}")
        return whole(PhotoRows(folder / f"a{ending}", (1.0, 1.0, 1.0)))

    def check(image: Any) -> None:
        finite(image)
        assert image.ndim == 3
        assert image.shape[2] == 3
        assert image.min() >= 0
        assert image.max() <= 1

    return lambda: Reader(
        make, read, check,
        {f"a{ending}": lambda c, r: png(c, r, 150) if ending == ".png" else mutate.binary(c, r, 150, 150)},
    )  # fmt: skip


READERS["png"] = pictures_of(".png")


READERS["jpeg"] = pictures_of(".jpg", progressive=True)


READERS["webp"] = pictures_of(".webp")


READERS["tiff"] = pictures_of(".tif")


READERS["bmp"] = pictures_of(".bmp")
