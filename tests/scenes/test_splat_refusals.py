"""Texts of refused splats say what is wrong with the file, not something else that it might have been."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import pytest
import torch
from support.refusals import refused
from support.splats import tame

from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.compressed import write_compressed
from lexsplat.scenes.formats.ply import write_ply
from lexsplat.scenes.formats.reading import read_splats
from lexsplat.scenes.formats.spz import write_spz


@pytest.mark.parametrize("version", [3, 4])
def test_spz_reports_whether_its_version_degree_or_precision_is_not_supported(tmp_path, version):
    path = tmp_path / "g.spz"
    write_spz(tame(20, 2), path, version=version)
    content = path.read_bytes() if version == 4 else gzip.decompress(path.read_bytes())

    def told(place: int, value: bytes, *parts: str) -> str:
        changed = content[:place] + value + content[place + len(value) :]
        return refused(path, changed if version == 4 else gzip.compress(changed), *parts)

    degree = told(12, bytes([5]), "harmonics of degree 0 to 4", "found degree 5")
    bits = told(13, bytes([31]), "0 to 30 bits behind the point", "found 31")
    assert "version 2" not in degree + bits
    told(4, struct.pack("<I", 5), "version 2 or 3 in gzip, or 4", "found version 5")


def test_spz_reports_in_which_container_a_version_was_found(tmp_path):
    write_spz(tame(20), tmp_path / "g.spz", version=3)
    raw = gzip.decompress((tmp_path / "g.spz").read_bytes())
    refused(tmp_path / "g.spz", raw, "version 2 or 3 in gzip, or 4", "found version 3 without gzip")
    four = raw[:4] + struct.pack("<I", 4) + raw[8:]
    refused(tmp_path / "g.spz", gzip.compress(four), "found version 4 in gzip")


def test_spz_4_reports_where_its_table_cannot_begin(tmp_path):
    write_spz(tame(20, 2), tmp_path / "g.spz")
    content = (tmp_path / "g.spz").read_bytes()
    for start in (0, 16):
        changed = content[:16] + struct.pack("<I", start) + content[20:]
        told = refused(tmp_path / "g.spz", changed, f"a table of contents at byte {start}, within the header")
        assert "streams" not in told
    refused(tmp_path / "g.spz", content[:15] + bytes([5]) + content[16:], "5 streams instead of 6")


@pytest.mark.slow
@pytest.mark.parametrize("version", [3, 4])
def test_no_flipped_bit_in_the_data_of_an_spz_changes_what_is_read(tmp_path, version):
    path = tmp_path / "g.spz"
    write_spz(tame(20, 1), path, version=version)
    content, written = path.read_bytes(), read_splats(path).tensors()
    data = 32 + 16 * 6 if version == 4 else 10  # after the header and the table of contents, or gzip's header
    refusals = 0
    for place in range(data, len(content)):
        changed = bytearray(content)
        changed[place] ^= 16
        path.write_bytes(changed)
        try:
            found = read_splats(path).tensors()
        except FileFormatError:
            refusals += 1
        else:  # bits that mean nothing, such as one in the header of a zstd frame
            assert all(torch.equal(found[name], tensor) for name, tensor in written.items()), place
    assert refusals > 0.98 * (len(content) - data)


def with_axes(path: Path, version: int, number: int) -> bytes:
    """An SPZ whose extension names its axes."""
    write_spz(tame(20, 1), path, version=version)
    record = struct.pack("<III", 0xADBE0003, 4, number)
    if version == 4:
        raw = path.read_bytes()
        start = struct.pack("<I", 32 + len(record))
        return raw[:14] + bytes([raw[14] | 2]) + raw[15:16] + start + raw[20:32] + record + raw[32:]
    raw = gzip.decompress(path.read_bytes())
    return gzip.compress(raw[:14] + bytes([raw[14] | 2]) + raw[15:] + record)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(
    ("number", "places"),
    [
        (0, (1, -2, -3)),
        (4, (1, -2, -3)),
        (6, (1, 2, 3)),
        (7, (-1, -2, 3)),
        (1, (-1, 2, -3)),
        (16, (1, -3, 2)),
    ],
)
def test_spz_is_read_in_the_axes_that_its_extension_names(tmp_path, caplog, version, number, places):
    """0 is unknown, 4 RUB, 6 RDF, 7 LUF, 1 LDB, 16 RFU; places are the file's x, y, z (1 to 3) along a PLY's."""
    content = with_axes(tmp_path / "g.spz", version, number)
    plain = read_splats(tmp_path / "g.spz").means * torch.tensor([1.0, -1, -1])  # as they are in the file
    (tmp_path / "g.spz").write_bytes(content)
    expected = torch.stack([plain[:, abs(place) - 1] * (1 if place > 0 else -1) for place in places], 1)
    assert torch.allclose(read_splats(tmp_path / "g.spz").means, expected)
    assert caplog.text == ""


def test_spz_with_axes_that_mirror_or_are_unknown_is_refused(tmp_path):
    refused(
        tmp_path / "g.spz",
        with_axes(tmp_path / "g.spz", 4, 8),
        "right-handed axes",
        "found RUF, which are left",
    )
    refused(tmp_path / "g.spz", with_axes(tmp_path / "g.spz", 4, 17), "found axes number 17")


@pytest.mark.parametrize("count", [0, 19, 21])
def test_ksplat_reports_the_count_that_disagrees(tmp_path, count):
    pytest.importorskip("gaussforge")
    path = tmp_path / "g.ksplat"
    write_compressed(tame(20), path, "ksplat")
    content = path.read_bytes()
    changed = content[:16] + struct.pack("<I", count) + content[20:]
    told = refused(path, changed, f"a count of {count}, and 20 Gaussians in sections")
    assert "bytes" not in told
    refused(path, content[:-100], f"{len(content) - 100:,} bytes instead of {len(content):,}")


MESH = "a mesh or a point cloud"


def test_an_empty_or_cut_header_of_a_ply_is_reported_as_such(tmp_path):
    path = tmp_path / "g.ply"
    write_ply(tame(20), path)
    content = path.read_bytes()
    header = content[: content.index(b"end_header")]
    assert MESH not in refused(path, b"", "expected a PLY", "found an empty file", "copy the file again")
    for cut in (b"ply", b"ply\n", header[:200], header):
        assert MESH not in refused(path, cut, "found a file that ends in its header", "copy the file again")


def test_comments_of_a_ply_may_be_long_and_a_header_that_is_too_long_is_reported_as_such(tmp_path):
    path = tmp_path / "g.ply"
    write_ply(tame(20), path)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"element", b"comment " + b"x" * 3000 + b"\nelement", 1))
    assert len(read_splats(path)) == 20
    for comments in ((b"comment " + b"x" * 900 + b"\n") * 80, b"comment " + b"x" * 70_000 + b"\n"):
        lines = content.replace(b"element", comments + b"element", 1)
        assert MESH not in refused(path, lines, "a header of up to 65,536 bytes", "found more", "shorten")


def test_a_header_of_a_ply_with_line_ends_of_other_kinds_is_reported_as_such(tmp_path):
    path = tmp_path / "g.ply"
    write_ply(tame(20), path)
    head, rows = path.read_bytes().split(b"end_header\n", 1)
    old = (head + b"end_header\n").replace(b"\n", b"\r") + rows
    assert MESH not in refused(path, old, "line feeds", "carriage returns alone")
    assert MESH in refused(path, b"\x89PNG\r\n" + bytes(100), "expected a PLY")
