"""Images of all formats that cameras, phones and programs write: their pixels are read correctly."""

from __future__ import annotations

import shutil
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lexsplat.captures.images.bands import ArrayRows, resized, whole
from lexsplat.captures.images.reading import PhotoRows, image_size, open_image, read_mask
from lexsplat.runtime.errors import CaptureError

WIDTH, HEIGHT = 24, 16


def read_image(path: Path, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    return whole(PhotoRows(path, background))


def painted() -> np.ndarray:
    """A smooth image ``[H, W, 3]`` uint8 without symmetry, to reveal rotations, reflections and swapped channels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([x * 10, y * 15, 255 - x * 5 - y * 5], -1).astype(np.uint8)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png16(pixels: np.ndarray) -> bytes:
    """A PNG of 16 bits per channel ``[H, W]`` or ``[H, W, 3]`` or ``[H, W, 4]``, by the specification: Pillow writes
    none in color."""
    height, width = pixels.shape[:2]
    kind = {2: 0, 3: {3: 2, 4: 6}.get(pixels.shape[-1])}[pixels.ndim]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def test_an_opaque_png_is_exact(tmp_path):
    Image.fromarray(painted()).save(tmp_path / "a.png")
    np.testing.assert_array_equal(
        read_image(tmp_path / "a.png"), painted().astype(np.float32) / np.float32(255)
    )


def test_alpha_is_composited_on_the_background(tmp_path):
    alpha = np.linspace(0, 255, WIDTH).round().astype(np.uint8)[None].repeat(HEIGHT, 0)
    Image.fromarray(np.dstack([painted(), alpha])).save(tmp_path / "a.png")
    share = alpha[..., None] / 255.0
    expected = painted() / 255.0 * share + np.array([1.0, 0.5, 0.0]) * (1 - share)
    np.testing.assert_allclose(read_image(tmp_path / "a.png", (1.0, 0.5, 0.0)), expected, atol=1e-6)


def test_gray_with_alpha(tmp_path):
    gray, alpha = painted()[..., 0], painted()[..., 1]
    Image.merge("LA", [Image.fromarray(gray), Image.fromarray(alpha)]).save(tmp_path / "a.png")
    share = alpha / 255.0
    expected = (gray / 255.0 * share + (1 - share))[..., None].repeat(3, 2)
    np.testing.assert_allclose(read_image(tmp_path / "a.png", (1.0, 1.0, 1.0)), expected, atol=1e-6)


def test_16_bit_gray_keeps_its_steps(tmp_path):
    values = (np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) * 170).astype(np.uint16)
    (tmp_path / "a.png").write_bytes(png16(values))
    found = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(found, (values / 65535.0)[..., None].repeat(3, 2), atol=1e-6)
    assert len(np.unique(found)) > 256, "more steps than 8 bits have"


@pytest.mark.parametrize("channels", [3, 4])
def test_16_bit_color(tmp_path, channels):
    values = painted().astype(np.uint16) * 257
    if channels == 4:
        values = np.dstack([values, np.full((HEIGHT, WIDTH), 65535, np.uint16)])
    (tmp_path / "a.png").write_bytes(png16(values))
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), painted() / 255.0, atol=1 / 255)


def test_16_bit_tiff(tmp_path):
    values = (np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) * 170).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "a.tif")
    np.testing.assert_allclose(read_image(tmp_path / "a.tif")[..., 1], values / 65535.0, atol=1e-6)


def test_gray_is_the_same_in_all_channels(tmp_path):
    Image.fromarray(painted()[..., 2]).save(tmp_path / "a.png")
    np.testing.assert_allclose(
        read_image(tmp_path / "a.png"), (painted()[..., 2:] / 255.0).repeat(3, 2), atol=1e-6
    )


def test_black_and_white(tmp_path):
    bits = painted()[..., 0] > 100
    Image.fromarray(bits).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[..., 0], bits.astype(np.float32))
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png"), bits)


def test_a_palette_and_its_transparent_color(tmp_path):
    picture = Image.fromarray((painted()[..., 0] > 100).astype(np.uint8), mode=None).convert("P")
    picture.putpalette([200, 100, 50, 10, 20, 30] + [0] * 762)
    picture.save(tmp_path / "a.png")
    second = painted()[..., 0] > 100
    expected = np.where(second[..., None], [10, 20, 30], [200, 100, 50]) / 255.0
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), expected, atol=1e-6)
    picture.save(tmp_path / "b.png", transparency=1)
    expected = np.where(second[..., None], 1.0, expected)
    np.testing.assert_allclose(read_image(tmp_path / "b.png", (1.0, 1.0, 1.0)), expected, atol=1e-6)


def test_a_cmyk_jpeg_shows_its_colors(tmp_path):
    blocks = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    blocks[:, : WIDTH // 2], blocks[:, WIDTH // 2 :] = (220, 40, 30), (30, 60, 200)
    Image.fromarray(blocks).convert("CMYK").save(tmp_path / "a.jpg", quality=100)
    with open_image(tmp_path / "a.jpg") as image:
        assert image.mode == "CMYK"
    np.testing.assert_allclose(
        read_image(tmp_path / "a.jpg")[2:-2, 2:8], 1 / 255 * blocks[2:-2, 2:8], atol=0.03
    )
    np.testing.assert_allclose(
        read_image(tmp_path / "a.jpg")[2:-2, -8:-2], 1 / 255 * blocks[2:-2, -8:-2], atol=0.03
    )


@pytest.mark.parametrize("options", [{"progressive": True}, {"progressive": False}, {"subsampling": 2}])
def test_jpegs_of_all_kinds(tmp_path, options):
    Image.fromarray(painted()).save(tmp_path / "a.jpg", quality=98, **options)
    np.testing.assert_allclose(read_image(tmp_path / "a.jpg"), painted() / 255.0, atol=0.06)


@pytest.mark.parametrize("ending", [".webp", ".tif", ".bmp"])
def test_other_formats(tmp_path, ending):
    Image.fromarray(painted()).save(
        tmp_path / f"a{ending}", **({"lossless": True} if ending == ".webp" else {})
    )
    np.testing.assert_allclose(read_image(tmp_path / f"a{ending}"), painted() / 255.0, atol=1e-6)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_taken_as_they_are_stored(tmp_path, orientation):
    """Cameras that come with a capture belong to the stored pixels; photos without cameras are turned on the way to
    structure from motion (test_scenes_photos.py)."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(painted()).save(tmp_path / "a.png", exif=exif)
    assert image_size(tmp_path / "a.png") == (WIDTH, HEIGHT)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), painted() / 255.0, atol=1e-6)


def test_heic_photos_are_read(tmp_path):
    pytest.importorskip("pi_heif", reason="HEIC needs pi-heif")
    # Made by data/make_heic.py; an iPhone's suffix is in capitals.
    shutil.copyfile(Path(__file__).parents[1] / "data" / "quadrants.heic", tmp_path / "a.HEIC")
    assert image_size(tmp_path / "a.HEIC") == (48, 32)
    image = read_image(tmp_path / "a.HEIC")
    assert image.shape == (32, 48, 3)
    middles = image[8::16, 12::24] * 255
    expected = [[(220, 40, 40), (40, 200, 60)], [(50, 60, 210), (230, 220, 90)]]
    np.testing.assert_allclose(middles, expected, atol=8)


def test_heic_without_the_library_names_the_extra_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic")
    with pytest.raises(CaptureError, match=r'pip install "lexsplat\[heic\]"'):
        image_size(tmp_path / "a.heic")


def test_a_damaged_heic_is_reported(tmp_path):
    pytest.importorskip("pi_heif", reason="HEIC needs pi-heif")
    for content in (b"", b"\0\0\0\x18ftypheic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + b"\xff" * 200):
        (tmp_path / "a.heic").write_bytes(content)
        with pytest.raises(CaptureError, match=r"a\.heic"):
            read_image(tmp_path / "a.heic")


@pytest.mark.parametrize("size", [(24, 16), (12, 8), (7, 5), (23, 15), (1, 1), (24, 3)])
@pytest.mark.parametrize("mode", ["RGB", "L", "RGBA", "P", "CMYK", "I;16"])
def test_reducing_large_photos_in_bands_equals_reducing_them_whole(tmp_path, monkeypatch, size, mode):
    image = Image.fromarray(painted())
    if mode == "I;16":
        image = Image.fromarray(painted()[..., 0].astype(np.uint16) * 257)
    elif mode == "RGBA":
        image.putalpha(Image.fromarray(painted()[..., 1]))
    name = "a.tif" if mode == "CMYK" else "a.png"
    (image if mode == "I;16" else image.convert(mode)).save(tmp_path / name)
    at_once = resized(ArrayRows(read_image(tmp_path / name)), size)
    np.testing.assert_array_equal(resized(PhotoRows(tmp_path / name), size), at_once)
    monkeypatch.setattr("lexsplat.captures.images.bands.LARGE_PIXELS", 0)
    monkeypatch.setattr("lexsplat.captures.images.bands.BAND_PIXELS", 4 * 48)
    np.testing.assert_allclose(resized(PhotoRows(tmp_path / name), size), at_once, atol=1e-6)


# -- images that claim to be larger than they are


def bomb(width: int, height: int) -> bytes:
    """A PNG of a few bytes that claims to be huge."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 1000))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(60_000, 60_000), (2**31 - 1, 1), (2**31 - 1, 2**31 - 1), (0, 5), (5, 0)])
def test_gigantic_and_empty_images_are_refused_by_their_headers(tmp_path, size):
    (tmp_path / "a.png").write_bytes(bomb(*size))
    with pytest.raises(CaptureError, match=r"a\.png"):
        read_image(tmp_path / "a.png")


def test_a_damaged_length_allocates_no_memory(tmp_path):
    import tracemalloc

    Image.fromarray(painted()).save(tmp_path / "a.png")
    data = bytearray((tmp_path / "a.png").read_bytes())
    place = data.index(b"IDAT") - 4
    data[place : place + 4] = b"\x7f\xff\xff\xff"
    (tmp_path / "a.png").write_bytes(bytes(data))
    tracemalloc.start()
    found = read_image(tmp_path / "a.png")  # all of the pixels are there, only the length after them is not
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(found, painted() / 255.0, atol=1e-6)
    assert peak < 10_000_000


def test_a_mask_in_dark_colors_is_refused(tmp_path):
    """Labeling tools save classes as palette colors; the first is a dark red."""
    mask = Image.new("P", (8, 8))
    mask.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    mask.paste(1, (0, 0, 4, 8))
    mask.save(tmp_path / "red apple.png")
    with pytest.raises(CaptureError, match="black and white"):
        read_mask(tmp_path / "red apple.png")
    assert read_mask(tmp_path / "red apple.png", nonzero=True).mean() == 0.5
    for noise in (0, 1, 9):
        Image.fromarray(np.full((8, 8), 255 * (noise == 1) + noise * (noise > 1), np.uint8)).save(
            tmp_path / "m.png"
        )
        assert read_mask(tmp_path / "m.png").all() == (noise == 1)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "PA"])
def test_transparent_pixels_are_outside_a_mask(tmp_path, mode):
    """Matting programs save white images whose shape is in the alpha channel."""
    pixels = np.full((4, 6, 4), 255, np.uint8)
    pixels[:, 2:, 3] = 0
    Image.fromarray(pixels).convert(mode).save(
        tmp_path / "mask.png" if mode != "PA" else tmp_path / "mask.tif"
    )
    mask = read_mask(tmp_path / ("mask.png" if mode != "PA" else "mask.tif"))
    np.testing.assert_array_equal(mask, pixels[..., 3] > 0)
