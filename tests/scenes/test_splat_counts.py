"""Counts that disagree with the data: a file is never read as a silent half, nor its data at wrong places."""

from __future__ import annotations

import gzip
import io
import json
import logging
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.hostile.splats import recounted_glb, recounted_text
from support.refusals import assert_reports, refused
from support.sog_files import write_streamed
from support.splats import tame

from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.compressed import write_compressed
from lexsplat.scenes.formats.foreign import warnings_once
from lexsplat.scenes.formats.gltf import write_glb
from lexsplat.scenes.formats.ply import write_ply
from lexsplat.scenes.formats.reading import READERS, read_splats
from lexsplat.scenes.formats.sog_writing import write_sog
from lexsplat.scenes.formats.splat import write_splat
from lexsplat.scenes.formats.spz import write_spz

# SPZ


@pytest.fixture(params=[0, 2])
def spz(tmp_path, request) -> bytes:
    """The content of an SPZ of version 3 with 30 Gaussians, before compression."""
    write_spz(tame(30, request.param), tmp_path / "g.spz", version=3)
    return gzip.decompress((tmp_path / "g.spz").read_bytes())


@pytest.mark.parametrize("count", [0, 1, 15, 29])
def test_spz_with_a_smaller_count_is_refused_with_both_numbers(tmp_path, spz, count):
    bytes_each = (len(spz) - 16) // 30
    changed = spz[:8] + struct.pack("<I", count) + spz[12:]
    left = f"{bytes_each * (30 - count):,} bytes after the {count} Gaussians of its count"
    refused(tmp_path / "g.spz", gzip.compress(changed), left)


def test_spz_with_bytes_after_its_streams_or_its_end_is_refused(tmp_path, spz):
    refused(tmp_path / "g.spz", gzip.compress(spz + b"\0"), "1 bytes after the 30 Gaussians")
    refused(tmp_path / "g.spz", gzip.compress(spz) + b"abc", "3 bytes after its end")
    refused(tmp_path / "g.spz", gzip.compress(spz + bytes(3 << 20)), "1,048,576 or more bytes after")


def test_extensions_may_follow_the_streams_of_spz_if_the_header_has_their_flag(tmp_path, spz, caplog):
    flagged = spz[:14] + bytes([spz[14] | 2]) + spz[15:]
    record = struct.pack("<II3f", 0xADBE0002, 12, -0.5, 0.5, 1)  # the limits of an orbit, by Adobe
    for more in (b"", record, record + struct.pack("<II", 7, 0)):
        (tmp_path / "g.spz").write_bytes(gzip.compress(flagged + more))
        assert len(read_splats(tmp_path / "g.spz")) == 30
    assert "its extensions are ignored" in caplog.text
    refused(tmp_path / "g.spz", gzip.compress(flagged + record[:-1]), "19 bytes after the 30 Gaussians")
    fewer = flagged[:8] + struct.pack("<I", 29) + flagged[12:]
    refused(tmp_path / "g.spz", gzip.compress(fewer + record), "after the 29 Gaussians")


def test_spz_4_with_another_count_or_bytes_after_its_end_is_refused(tmp_path):
    write_spz(tame(30, 1), tmp_path / "g.spz")
    content = (tmp_path / "g.spz").read_bytes()
    changed = content[:8] + struct.pack("<I", 20) + content[12:]
    refused(tmp_path / "g.spz", changed, "270 bytes of positions instead of 180 for the 20 Gaussians")
    refused(tmp_path / "g.spz", content + b"12", "2 bytes after its end")
    # The table agrees with the smaller count, the streams do not.
    table = bytearray(changed)
    for number, size in enumerate((9, 1, 3, 3, 4, 9)):
        struct.pack_into("<Q", table, 32 + 16 * number + 8, 20 * size)
    refused(tmp_path / "g.spz", bytes(table), "other positions than those of 20 Gaussians")


# PLY


@pytest.fixture(params=["binary", "text"])
def ply(tmp_path, request) -> tuple[bytes, int, str]:
    """The content of a PLY of 20 Gaussians, the length of a row, and the unit of what is left."""
    write_ply(tame(20), tmp_path / "g.ply")
    content = (tmp_path / "g.ply").read_bytes()
    return (
        (content, 68, "bytes") if request.param == "binary" else (recounted_text(content, 20), 17, "numbers")
    )


@pytest.mark.parametrize("count", [0, 1, 10, 19])
def test_ply_with_a_smaller_count_is_refused_with_both_numbers(tmp_path, ply, count):
    content, row, unit = ply
    changed = content.replace(b"element vertex 20", b"element vertex %d" % count)
    refused(
        tmp_path / "g.ply", changed, f"the {count} Gaussians", f"{row * (20 - count):,} {unit} after the last"
    )


def test_less_than_a_row_after_the_last_gaussian_is_a_warning_that_says_how_much(tmp_path, ply, caplog):
    content, row, unit = ply
    more = {"bytes": b"\n" * (row - 1), "numbers": b"1 " * (row - 1)}[unit]
    (tmp_path / "g.ply").write_bytes(content + more)
    assert len(read_splats(tmp_path / "g.ply")) == 20
    assert f"g.ply: {row - 1} {unit} after the last Gaussian are ignored" in caplog.text


def test_elements_after_the_gaussians_are_no_data_left_over(tmp_path, ply, caplog):
    content, row, unit = ply
    further = b"element camera 2\nproperty uchar id\nproperty list uchar short ids\nelement size 1\nproperty int w\n"
    data = {
        "bytes": struct.pack("<BBhhBBi", 9, 2, 5, 6, 9, 0, 640),
        "numbers": b"9 2 5 6\n9 0\n640\n",
    }[unit]
    extended = content.replace(b"end_header", further + b"end_header")
    (tmp_path / "g.ply").write_bytes(extended + data)
    assert len(read_splats(tmp_path / "g.ply")) == 20
    assert "after the last" not in caplog.text
    assert "'camera' of length 2, 'size' of length 1" in caplog.text
    changed = extended.replace(b"element vertex 20", b"element vertex 21")
    refused(tmp_path / "g.ply", changed + data * row, "21 Gaussians")
    refused(tmp_path / "g.ply", extended, "20 Gaussians", f"fewer {unit} in its other elements")
    absurd = extended.replace(b"element camera 2", b"element camera 999999999999")
    refused(tmp_path / "g.ply", absurd + data, f"fewer {unit} in its other elements")


def test_text_that_is_no_number_in_a_ply_is_refused(tmp_path):
    write_ply(tame(20), tmp_path / "g.ply")
    content = recounted_text((tmp_path / "g.ply").read_bytes(), 20)
    refused(tmp_path / "g.ply", content + b"end\n", "found text that is no number")


# SOG


def sog(path: Path, count: int, farthest: float | None = None, **changed: bytes) -> bytes:
    """A SOG of 20 Gaussians, or the one that is there, with another count, bound of positions or pictures."""
    if not path.exists():
        write_sog(tame(20, 1), path)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(parts["meta.json"]) | {"count": count}
    if farthest is not None:
        meta["means"]["maxs"] = [farthest] * 3
    parts["meta.json"] = json.dumps(meta).encode()
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, part in (parts | {f"{name}.webp": part for name, part in changed.items()}).items():
            archive.writestr(name, part)
    return content.getvalue()


@pytest.mark.parametrize("count", [0, 1, 10, 19, 21, 24])
def test_sog_with_another_count_than_its_pictures_is_refused_with_both_numbers(tmp_path, count):
    refused(
        tmp_path / "g.sog",
        sog(tmp_path / "g.sog", count),
        f"the {count} Gaussians",
        "found 20 in its images",
    )


FILLS = {"zeros": 0, "opaque black": (0, 0, 0, 255), "white": 255, "unturned": (128, 128, 128, 252)}


def repainted(path: Path, shape: tuple[int, int], fill: object, parts: tuple[str, ...]) -> dict[str, bytes]:
    """Pictures of 20 Gaussians in another shape and with another fill; without one, with copies of the last."""
    pictures = {}
    with zipfile.ZipFile(path) as archive:
        for name in ("means_l", "means_u", "quats", "scales", "sh0", "shN_labels"):
            picture = Image.open(io.BytesIO(archive.read(f"{name}.webp"))).convert("RGBA")
            first = np.asarray(picture).reshape(-1, 4)[:20]
            pixels = np.zeros((shape[0] * shape[1], 4), np.uint8)
            pixels[:20] = first
            pixels[20:] = (first[19] if fill is None else fill) if name in parts else 0
            content = io.BytesIO()
            Image.fromarray(pixels.reshape(*shape, 4)).save(content, "WEBP", lossless=True, exact=True)
            pictures[name] = content.getvalue()
    return pictures


ALL = ("means_l", "means_u", "quats", "scales", "sh0", "shN_labels")


@pytest.mark.parametrize("shape", [(8, 8), (3, 7)])
@pytest.mark.parametrize("parts", [ALL, ("quats",)])
@pytest.mark.parametrize("fill", [*FILLS, "the last"])
def test_what_fills_up_the_pictures_of_a_sog_are_no_gaussians(tmp_path, fill, parts, shape):
    if fill == "the last" and parts != ALL:
        pytest.skip("a copy is one in every picture")
    path = tmp_path / "g.sog"
    write_sog(tame(20, 1), path)
    pictures = repainted(path, shape, FILLS.get(fill), parts)
    path.write_bytes(sog(path, 20, **pictures))
    assert len(read_splats(path)) == 20
    for count in (10, 18, 19):
        refused(path, sog(path, count, **pictures), f"the {count} Gaussians", "found 20 in its images")


@pytest.mark.parametrize("count", [5, 18, 19])
def test_unturned_gaussians_that_the_count_of_a_sog_leaves_out_are_found(tmp_path, count):
    path = tmp_path / "g.sog"
    g = tame(20, 1)
    g.quats[:] = torch.tensor([1.0, 0, 0, 0])
    write_sog(g, path)
    pictures = repainted(path, (4, 5), 0, ())
    refused(path, sog(path, count, **pictures), f"the {count} Gaussians", "found 20 in its images")


def test_positions_of_a_sog_beyond_all_numbers_are_refused_without_a_warning_of_numpy(tmp_path, recwarn):
    path = tmp_path / "g.sog"
    for farthest in (90, 1e6):
        refused(path, sog(path, 20, farthest), "of 20 Gaussians")
    assert not [str(warning.message) for warning in recwarn]


def test_gaussians_of_a_streamed_sog_that_no_region_has_are_counted(tmp_path, caplog):
    levels = {"0": {"file": 0, "offset": 4, "count": 5}, "1": {"file": 0, "offset": 0, "count": 2}}
    write_streamed(tmp_path, {"0_0": 10}, {"lods": levels})
    assert len(read_splats(tmp_path)) == 5
    assert "3 of 10 Gaussians of 0_0/meta.json are in no region" in caplog.text


# Through GaussForge


@pytest.mark.parametrize(("ending", "kind"), [(".ksplat", "ksplat"), (".compressed.ply", "compressed.ply")])
@pytest.mark.parametrize("count", [20, 299])
def test_chunks_and_sections_with_a_smaller_count_are_refused(tmp_path, caplog, ending, kind, count):
    pytest.importorskip("gaussforge")
    path = tmp_path / f"g{ending}"
    write_compressed(tame(300, 1), path, kind)
    content = path.read_bytes()
    assert len(read_splats(path)) == 300
    if kind == "ksplat":
        header = content[:16] + struct.pack("<I", count) + content[20:]
        refused(path, header, "300 Gaussians in sections")
        section = header[:4096] + struct.pack("<I", count) + header[4100:]
        refused(path, section, f"a section of {count} Gaussians with data of 300")
        both = section[:4100] + struct.pack("<I", count) + section[4104:]
        refused(path, both, f"{count} Gaussians in sections, and {len(content):,} bytes instead of")
    else:
        changed = content.replace(b"vertex 300", b"vertex %d" % count)
        refused(path, changed, f"expected {count} Gaussians", "bytes after them")
        refused(path, changed.replace(b"sh 300", b"sh %d" % count), f"expected {count} Gaussians")
    refused(path, content + bytes(100))
    if kind == "ksplat":
        path.write_bytes(content + b"\n")
        assert len(read_splats(path)) == 300
        assert "1 bytes after the last Gaussian are ignored" in caplog.text


# glTF


@pytest.mark.parametrize("count", [1, 29])
def test_glb_with_smaller_counts_is_refused_with_both_numbers(tmp_path, count):
    write_glb(tame(30, 1), tmp_path / "g.glb")
    content = (tmp_path / "g.glb").read_bytes()
    more = f"a count of {count} Gaussians, and {30 - count} more in the data"
    refused(tmp_path / "g.glb", recounted_glb(content, lambda index: count), more)
    one = recounted_glb(content, lambda index: count if index == 0 else 30)
    refused(tmp_path / "g.glb", one, f"attributes of {count} and of 30 Gaussians")


def test_glb_with_bytes_after_its_end_is_refused(tmp_path):
    write_glb(tame(3), tmp_path / "g.glb")
    content = (tmp_path / "g.glb").read_bytes()
    found = f"{len(content) + 5:,} bytes, expected {len(content):,} by the header"
    refused(tmp_path / "g.glb", content + b"12345", found)


# Numbers that cannot be worked with, remedies, and warnings


@pytest.mark.parametrize(
    ("size", "factor"), [(1e10, "0.0000000001"), (3e6, "0.000001"), (1e15, "0.000000000000001")]
)
def test_splats_too_far_away_for_cameras_are_refused_with_a_factor_to_scale_by(tmp_path, size, factor):
    g = tame(40)
    g.means = torch.nn.functional.normalize(g.means.sign() + 0.1, dim=1) * size * 1.8
    write_ply(g, tmp_path / "g.ply")
    words = (
        "within 10,000,000 units",
        "of 40 Gaussians farther out",
        f"splat-transform g.ply --scale {factor} ",
    )
    refused(tmp_path / "g.ply", (tmp_path / "g.ply").read_bytes(), *words)


def test_coordinates_of_a_map_are_read(tmp_path, caplog):
    g = tame(40)
    g.means += torch.tensor([4e5, 5.6e6, 300])
    write_ply(g, tmp_path / "g.ply")
    assert torch.equal(read_splats(tmp_path / "g.ply").means, g.means)
    assert caplog.text == ""


def test_a_few_gaussians_too_far_or_too_large_are_dropped_with_a_warning(tmp_path, caplog):
    g = tame(40)
    g.means[3, 1], g.log_scales[7, 0] = -1e7, 20.0
    write_ply(g, tmp_path / "g.ply")
    found = read_splats(tmp_path / "g.ply")
    assert torch.equal(found.means, g.means[[i for i in range(40) if i not in (3, 7)]])
    assert (
        "2 of 40 Gaussians dropped: expected centers and sizes that cameras within 10,000,000 units"
        in caplog.text
    )


@pytest.mark.parametrize("ending", [ending for ending in READERS if ending != "lod-meta.json"])
@pytest.mark.parametrize(
    "content",
    [b"", b"ply\n", b"{}", b"[]", b"\x1f\x8b\x08", b"NGSP", b"NGSP" + bytes(50), b"glTF" + bytes(9)],
)
def test_whatever_is_refused_has_a_remedy_and_no_text_of_python(tmp_path, ending, content):
    if ending == ".ksplat":
        pytest.importorskip("gaussforge")
    path = tmp_path / (ending if ending.endswith("json") else f"g{ending}")
    path.write_bytes(content)
    with pytest.raises(FileFormatError) as caught:
        read_splats(path)
    assert_reports(caught.value)
    for text in (
        "requires a buffer",
        "Expecting value",
        "object is not",
        "object has",
        "index out of range",
        "b'",
        "Error",
    ):
        assert text not in str(caught.value)


def test_rotations_of_four_zeros_are_a_warning_that_says_what_becomes_of_them(tmp_path, caplog):
    g = tame(30)
    g.quats[:10] = 0
    write_ply(g, tmp_path / "g.ply")
    found = read_splats(tmp_path / "g.ply")
    assert "g.ply: 10 of 30 Gaussians have a rotation of four zeros, read as no rotation" in caplog.text
    assert found.quats[:10].tolist() == [[1, 0, 0, 0]] * 10
    assert torch.equal(found.quats[10:], g.quats[10:])


def test_what_is_read_again_in_a_block_is_warned_of_once(tmp_path, caplog):
    g = tame(30)
    g.log_scales[:10, 0] = -200
    for name in ("a", "b"):
        write_splat(g, tmp_path / f"{name}.splat")
    with caplog.at_level(logging.WARNING):
        with warnings_once():
            for name in ("a", "b", "a"):
                read_splats(tmp_path / f"{name}.splat")
        assert len(caplog.records) == 2
        read_splats(tmp_path / "a.splat")
    assert len(caplog.records) == 3
