"""PLY: what we write others read, what others write we read, what is broken is refused."""

import io

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.splats import make

from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.ply import read_ply, write_ply


@settings(max_examples=25)
@given(count=st.integers(0, 20), degree=st.integers(0, 4), antialiased=st.booleans())
def test_gaussians_survive_a_round_trip_exactly(tmp_path_factory, count, degree, antialiased):
    path = tmp_path_factory.mktemp("ply") / "g.ply"
    gaussians = make(count, degree, antialiased=antialiased)
    write_ply(gaussians, path)
    back = read_ply(path)
    assert back.antialiased == antialiased
    for name, value in gaussians.tensors().items():
        assert torch.equal(getattr(back, name), value), name


def test_plyfile_reads_the_same_numbers(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    gaussians = make(7, 2)
    write_ply(gaussians, tmp_path / "g.ply")
    vertex = plyfile.PlyData.read(tmp_path / "g.ply")["vertex"]
    assert vertex.count == 7
    np.testing.assert_array_equal(vertex["opacity"], gaussians.opacity_logits.numpy())
    np.testing.assert_array_equal(vertex["scale_2"], gaussians.log_scales[:, 2].numpy())
    np.testing.assert_array_equal(vertex["rot_0"], gaussians.quats[:, 0].numpy())
    # Channel-major: f_rest_8 is the first coefficient of green when 8 are stored per channel.
    np.testing.assert_array_equal(vertex["f_rest_8"], gaussians.shN[:, 0, 1].numpy())


def test_a_ply_written_by_gsplat_is_read(tmp_path):
    exporter = pytest.importorskip("gsplat.exporter")
    g = make(5, 3)
    data = exporter.splat2ply_bytes(
        g.means, g.log_scales, g.quats, g.opacity_logits, g.sh0[:, 0], g.shN.transpose(1, 2).reshape(5, -1)
    )
    (tmp_path / "gsplat.ply").write_bytes(data)
    back = read_ply(tmp_path / "gsplat.ply")
    for name, value in g.tensors().items():
        assert torch.equal(getattr(back, name), value), name


def test_columns_in_another_order_and_extra_columns_are_read_by_name(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    gaussians = make(4, 0)
    write_ply(gaussians, tmp_path / "g.ply")
    vertex = plyfile.PlyData.read(tmp_path / "g.ply")["vertex"].data
    names = [*reversed(vertex.dtype.names), "label"]
    shuffled = np.zeros(4, dtype=[(name, "f4" if name != "label" else "u1") for name in names])
    for name in vertex.dtype.names:
        shuffled[name] = vertex[name]
    plyfile.PlyData([plyfile.PlyElement.describe(shuffled, "vertex")], byte_order="<").write(
        tmp_path / "s.ply"
    )
    back = read_ply(tmp_path / "s.ply")
    assert torch.equal(back.means, gaussians.means)
    assert torch.equal(back.quats, gaussians.quats)


def test_nan_is_not_written(tmp_path):
    gaussians = make(3, 0)
    gaussians.means[1, 0] = float("nan")
    with pytest.raises(ValueError, match="1 of 3"):
        write_ply(gaussians, tmp_path / "g.ply")


@pytest.mark.slow
def test_every_truncation_is_refused(tmp_path):
    write_ply(make(2, 0), tmp_path / "g.ply")
    data = (tmp_path / "g.ply").read_bytes()
    for length in range(len(data)):
        (tmp_path / "t.ply").write_bytes(data[:length])
        with pytest.raises(FileFormatError):
            read_ply(tmp_path / "t.ply")


def test_an_absurd_count_is_refused_without_allocating(tmp_path):
    write_ply(make(1, 0), tmp_path / "g.ply")
    data = (tmp_path / "g.ply").read_bytes().replace(b"vertex 1\n", b"vertex 99999999999999\n")
    (tmp_path / "t.ply").write_bytes(data)
    with pytest.raises(FileFormatError, match="truncated"):
        read_ply(tmp_path / "t.ply")


@pytest.mark.slow
@settings(max_examples=200)
@given(data=st.data())
def test_flipped_bytes_cause_only_typed_errors(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("flip")
    write_ply(make(2, 1), folder / "g.ply")
    content = bytearray((folder / "g.ply").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    (folder / "g.ply").write_bytes(bytes(content))
    try:
        back = read_ply(folder / "g.ply")
    except FileFormatError:
        return
    assert all(torch.isfinite(value).all() for value in back.tensors().values())


def test_files_other_than_ply_are_refused(tmp_path):
    (tmp_path / "x.ply").write_bytes(io.BytesIO(b"PK\x03\x04 pickle").getvalue())
    with pytest.raises(FileFormatError, match="PLY header"):
        read_ply(tmp_path / "x.ply")
    with pytest.raises(FileFormatError):
        read_ply(tmp_path / "missing.ply")
