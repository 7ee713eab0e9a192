"""PLY of other programs: what its elements, lines and numbers may be, and what is refused or told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.hostile.splats import recounted_text
from support.refusals import refused
from support.splats import tame

from lexsplat.scenes.formats.compressed import write_compressed
from lexsplat.scenes.formats.ply import write_ply
from lexsplat.scenes.formats.reading import read_splats

SHARP = {
    "extrinsic": 16,
    "intrinsic": 9,
    "image_size": 2,
    "frame": 2,
    "disparity": 2,
    "color_space": 1,
    "version": 3,
}
"""Elements that SHARP writes after the Gaussians, and their counts."""


@pytest.fixture
def binary(tmp_path) -> bytes:
    """The content of a binary PLY of 20 Gaussians, of 68 bytes each."""
    write_ply(tame(20), tmp_path / "g.ply")
    return (tmp_path / "g.ply").read_bytes()


@pytest.fixture
def text(binary) -> bytes:
    """The same as text."""
    return recounted_text(binary, 20)


# Elements


@pytest.mark.parametrize("encoding", ["binary", "text"])
def test_a_second_element_of_the_same_name_is_refused(tmp_path, request, encoding):
    content = request.getfixturevalue(encoding)
    head, rows = content.split(b"end_header\n")
    columns = head[head.index(b"property") :]
    twice = head.replace(b"vertex 20", b"vertex 10") + b"element vertex 10\n" + columns
    refused(
        tmp_path / "g.ply", twice + b"end_header\n" + rows, "one element of each name", "two named 'vertex'"
    )


def test_a_second_list_of_vertices_in_a_compressed_ply_is_refused(tmp_path):
    pytest.importorskip("gaussforge")
    path = tmp_path / "g.compressed.ply"
    write_compressed(tame(20), path, "compressed.ply")
    content = path.read_bytes()
    columns = b"".join(
        b"property uint packed_%b\n" % name for name in (b"position", b"rotation", b"scale", b"color")
    )
    twice = content.replace(b"vertex 20", b"vertex 10").replace(
        b"end_header", b"element vertex 10\n" + columns + b"end_header"
    )
    refused(path, twice, "two named 'vertex'")
    path.write_bytes(content)
    assert len(read_splats(path)) == 20


def test_elements_with_data_that_is_ignored_are_named_in_a_warning(tmp_path, binary, caplog):
    junk = b"element junk %d\nproperty uchar a\nelement none 0\nproperty uchar a\nend_header" % (10 * 68)
    content = binary.replace(b"vertex 20", b"vertex 10").replace(b"end_header", junk)
    (tmp_path / "g.ply").write_bytes(content)
    assert len(read_splats(tmp_path / "g.ply")) == 10
    assert "g.ply: elements other than the 10 Gaussians are ignored: 'junk' of length 680" in caplog.text
    assert "'none'" not in caplog.text


def test_elements_of_programs_that_put_no_gaussians_there_are_ignored_without_a_warning(
    tmp_path, binary, caplog
):
    def written(counts: dict[str, int]) -> None:
        header = "".join(f"element {name} {count}\nproperty uint {name}\n" for name, count in counts.items())
        rows = bytes(4 * sum(counts.values()))
        (tmp_path / "g.ply").write_bytes(
            binary.replace(b"end_header", header.encode() + b"end_header") + rows
        )

    written(SHARP)
    assert len(read_splats(tmp_path / "g.ply")) == 20
    assert caplog.text == ""
    written(SHARP | {"frame": 170})  # too many to be a frame
    assert len(read_splats(tmp_path / "g.ply")) == 20
    assert "'frame' of length 170" in caplog.text


# Lines of text


def changed_line(text: bytes, number: int, change) -> bytes:
    """The text with a line of the data changed; the first is 0."""
    lines = text.split(b"\n")
    place = lines.index(b"end_header") + 1 + number
    lines[place] = change(lines[place])
    return b"\n".join(lines)


def test_rows_of_text_that_are_shifted_are_refused_with_the_number_of_their_line(tmp_path, text):
    first = (
        text[: text.index(b"end_header\n")].count(b"\n") + 2
    )  # the line of the first Gaussian, counted from 1
    shifted = changed_line(text, 5, lambda line: line.rsplit(b" ", 1)[0])
    shifted = changed_line(shifted, 9, lambda line: line + b" 0.5")
    found = f"16 numbers in line {first + 5}"
    refused(tmp_path / "g.ply", shifted, "the 17 numbers of a Gaussian in each line", found)
    shifted = shifted.replace(b"end_header\n", b"end_header\n\n  \n")
    refused(tmp_path / "g.ply", shifted, f"16 numbers in line {first + 7}")
    refused(tmp_path / "g.ply", shifted.replace(b"\n", b"\r\n"), f"16 numbers in line {first + 7}")


def test_lines_are_counted_alike_however_they_are_divided(tmp_path, text, monkeypatch):
    for size in (1, 2, 7, 100):
        monkeypatch.setattr("lexsplat.scenes.formats.ply_elements._BLOCK", size)
        (tmp_path / "g.ply").write_bytes(text)
        assert len(read_splats(tmp_path / "g.ply")) == 20
        refused(tmp_path / "g.ply", changed_line(text, 3, lambda line: b"0.5 " + line), "18 numbers in line")


@pytest.mark.parametrize("change", [(b"\n", b"\r\n"), (b" ", b"\t"), (b" ", b"   "), (b"\n", b" \n\n")])
def test_blanks_between_the_numbers_of_a_text_do_not_matter(tmp_path, text, change):
    head, rows = text.split(b"end_header\n")
    (tmp_path / "g.ply").write_bytes(head + b"end_header\n" + rows.replace(*change))
    found = read_splats(tmp_path / "g.ply")
    (tmp_path / "g.ply").write_bytes(text)
    assert found.means.tolist() == read_splats(tmp_path / "g.ply").means.tolist()


def test_a_text_without_a_last_line_end_is_read_with_a_warning(tmp_path, text, caplog):
    (tmp_path / "g.ply").write_bytes(text)
    whole = read_splats(tmp_path / "g.ply")
    assert caplog.text == ""
    (tmp_path / "g.ply").write_bytes(text.rstrip())
    assert read_splats(tmp_path / "g.ply").quats.tolist() == whole.quats.tolist()
    assert "g.ply: no line end after the last number, which may lack digits" in caplog.text
    rows = text.rstrip().rsplit(b" ", 1)[0]
    refused(tmp_path / "g.ply", rows, "340 numbers", "found 339", "truncated")
    refused(tmp_path / "g.ply", rows + b" -", "no number")
    refused(tmp_path / "g.ply", rows + b" 1e", "no number")


# Coordinates of a map


def doubled(path: Path, gaussians, offset: tuple[float, float, float]) -> None:
    """A PLY whose properties are doubles, moved by an offset."""
    write_ply(gaussians, path)
    head, rows = path.read_bytes().split(b"end_header\n", 1)
    table = np.frombuffer(rows, "<f4").reshape(len(gaussians), -1).astype("<f8")
    table[:, :3] += offset
    path.write_bytes(head.replace(b"property float", b"property double") + b"end_header\n" + table.tobytes())


def test_doubles_that_are_rounded_coarsely_are_reported_with_the_error_and_a_remedy(tmp_path, caplog):
    g = tame(40)
    g.log_scales[:] = -3  # sizes of 0.05
    doubled(tmp_path / "g.ply", g, (4e5, 5.6e6, 0))
    exact = g.means.double().numpy() + np.array([4e5, 5.6e6, 0])
    found = read_splats(tmp_path / "g.ply")
    error = np.abs(found.means.double().numpy() - exact).max()
    assert 0.1 < error <= 0.25
    assert f"g.ply: centers are rounded by up to {error:.2g} units" in caplog.text
    assert "Gaussians of size 0.05" in caplog.text
    assert "subtract 400,000, 5,600,000, 0 from x, y, z before exporting" in caplog.text


@pytest.mark.parametrize("offset", [(0, 0, 0), (100, 2000, 0)])
def test_doubles_that_are_rounded_by_little_are_read_without_a_warning(tmp_path, caplog, offset):
    g = tame(40)
    doubled(tmp_path / "g.ply", g, offset)
    assert np.allclose(read_splats(tmp_path / "g.ply").means, g.means.numpy() + offset, atol=1e-3)
    assert caplog.text == ""


def test_digits_of_a_text_that_are_rounded_coarsely_are_reported(tmp_path, text, caplog):
    head, rows = text.split(b"end_header\n")
    rows = b"".join(
        b"5600000.%02d %b\n" % (5 * n, row.split(b" ", 1)[1]) for n, row in enumerate(rows.splitlines())
    )
    (tmp_path / "g.ply").write_bytes(head + b"end_header\n" + rows)
    read_splats(tmp_path / "g.ply")
    assert "centers are rounded by up to 0.25 units" in caplog.text
    assert "subtract 5,600,000, 0, 0 from" in caplog.text


def test_nan_and_infinity_among_doubles_do_not_hide_how_others_are_rounded(tmp_path, caplog):
    g = tame(40)
    g.log_scales[:] = -3
    doubled(tmp_path / "g.ply", g, (4e5, 5.6e6, 0))
    content = bytearray((tmp_path / "g.ply").read_bytes())
    start = content.index(b"end_header\n") + len(b"end_header\n")
    content[start : start + 16] = np.array([np.nan, 1e300]).tobytes()
    content[-8 * 11 : -8 * 4] = np.full(7, np.nan).tobytes()  # opacity and sizes and colors, of the last
    (tmp_path / "g.ply").write_bytes(content)
    assert len(read_splats(tmp_path / "g.ply")) == 38
    assert "centers are rounded by up to 0.2" in caplog.text
