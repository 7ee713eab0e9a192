"""Splat formats: what we write other programs read, what they write we read, values compared."""

import csv
import struct

import numpy as np
import pytest
import torch
from safetensors import safe_open
from support.splats import make, tame

from lexsplat.codebook import Codebook
from lexsplat.geometry.boxes import Up
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.world import World
from lexsplat.language.fields import CodeField
from lexsplat.runtime.errors import BackendError, FileFormatError
from lexsplat.scenes.formats import compressed
from lexsplat.scenes.formats.compressed import COMPRESSED, read_compressed, write_compressed
from lexsplat.scenes.formats.gltf import write_glb
from lexsplat.scenes.formats.language import codebook_path, ply_columns, stored_language, write_codebook
from lexsplat.scenes.formats.ply import read_ply, write_ply
from lexsplat.scenes.formats.reading import read_splats
from lexsplat.scenes.formats.splat import write_splat
from lexsplat.scenes.formats.tables import write_labels_csv, write_points_ply


def language(count: int, codes_each: int = 3, num_codes: int = 6):
    g = torch.Generator().manual_seed(1)
    codes = torch.stack([torch.randperm(num_codes, generator=g)[:codes_each] for _ in range(count)])
    weights = torch.rand(count, codes_each, generator=g).sort(dim=1, descending=True).values
    codebook = Codebook(torch.randn(num_codes, 8, generator=g), torch.randn(num_codes, 5, generator=g))
    field = CodeField(
        codebook,
        codes.to(torch.uint8),
        weights / weights.sum(1, keepdim=True),
        torch.rand(count, generator=g),
    )
    return field, stored_language(field, {"encoder": "some/clip", "encoder_hash": "abc"})


def distances_of_rotations(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    a, b = (torch.nn.functional.normalize(q, dim=1) for q in (a, b))
    return 1 - (a * b).sum(1).abs()


# .splat


def test_a_splat_file_has_the_bytes_computed_by_hand(tmp_path):
    one = Gaussians(
        torch.tensor([[1.0, -2.0, 3.0]]), torch.tensor([[2.0, 0.0, 0.0, -2.0]]),
        torch.log(torch.tensor([[0.5, 1, 2]])),
        torch.tensor([0.0]), torch.tensor([[[0.0, 10.0, -10.0]]]), torch.zeros(1, 0, 3),
    )  # fmt: skip
    write_splat(one, tmp_path / "g.splat")
    found = struct.unpack("<6f4B4B", (tmp_path / "g.splat").read_bytes())
    assert found[:6] == pytest.approx((1, -2, 3, 0.5, 1, 2))
    assert found[6:10] == (128, 255, 0, 128)
    assert found[10:] == (219, 128, 128, 37)  # 128 + 128 / sqrt(2) = 218.5, rounded; 128 - 90.5


def test_gsplat_writes_the_same_splats_in_a_different_order(tmp_path):
    exporter = pytest.importorskip("gsplat.exporter")
    g = tame(300)
    write_splat(g, tmp_path / "ours.splat")
    (tmp_path / "theirs.splat").write_bytes(
        exporter.splat2splat_bytes(g.means, g.log_scales, g.quats, g.opacity_logits, g.sh0[:, 0])
    )
    layout = np.dtype([("place", "<f4", 6), ("bytes", "u1", 8)])
    ours, theirs = (
        np.sort(np.fromfile(tmp_path / f"{name}.splat", dtype=layout), order="place")
        for name in ("ours", "theirs")
    )
    assert np.array_equal(ours["place"], theirs["place"])
    # gsplat rounds down, we round to the nearest.
    apart = ours["bytes"].astype(int) - theirs["bytes"]
    assert apart.min() >= 0
    assert apart.max() <= 1


def test_a_splat_file_of_gsplat_is_read(tmp_path):
    exporter = pytest.importorskip("gsplat.exporter")
    g = tame(200)
    data = exporter.splat2splat_bytes(g.means, g.log_scales, g.quats, g.opacity_logits, g.sh0[:, 0])
    (tmp_path / "g.splat").write_bytes(data)
    back = read_splats(tmp_path / "g.splat")
    order, back_order = g.means[:, 0].argsort(), back.means[:, 0].argsort()
    g, back = g.select(order), back.select(back_order)
    assert torch.equal(back.means, g.means)
    assert torch.allclose(back.log_scales, g.log_scales, atol=1e-5)
    assert torch.allclose(back.opacities, g.opacities, atol=1.01 / 255)
    assert distances_of_rotations(back.quats, g.quats).max() < 1e-3


@pytest.mark.parametrize("content", [b"", b"x" * 33, np.full(8, np.nan, "<f4").tobytes()])
def test_files_other_than_splats_are_refused(tmp_path, content):
    (tmp_path / "g.splat").write_bytes(content)
    with pytest.raises(FileFormatError):
        read_splats(tmp_path / "g.splat")


# Compressed PLY and ksplat


@pytest.mark.parametrize("ending", list(COMPRESSED))
def test_compressed_files_preserve_values_within_their_precision(tmp_path, ending):
    pytest.importorskip("gaussforge")
    g = tame(500, 2)
    path = tmp_path / f"g{ending}"
    write_compressed(g, path, COMPRESSED[ending])
    back = read_splats(path)
    # The formats may sort: match by position.
    nearest = torch.cdist(g.means, back.means).argmin(1)
    assert len(set(nearest.tolist())) == 500
    back = back.select(nearest)
    assert (back.means - g.means).abs().max() < 5e-3
    assert (back.log_scales - g.log_scales).abs().max() < 0.04
    assert (back.opacities - g.opacities).abs().max() < 0.01
    assert distances_of_rotations(back.quats, g.quats).max() < 1e-3
    assert (back.sh0 - g.sh0).abs().median() < 0.02


def test_a_compressed_ply_is_recognized_by_its_content(tmp_path):
    pytest.importorskip("gaussforge")
    write_compressed(tame(50), tmp_path / "plain_name.ply", "compressed.ply")
    assert len(read_splats(tmp_path / "plain_name.ply")) == 50


def test_plyfile_reads_the_header_and_the_mip_filter_of_a_compressed_ply(tmp_path):
    pytest.importorskip("gaussforge")
    plyfile = pytest.importorskip("plyfile")
    write_compressed(tame(300, 1, antialiased=True), tmp_path / "g.compressed.ply", "compressed.ply")
    content = plyfile.PlyData.read(tmp_path / "g.compressed.ply")
    assert {element.name: element.count for element in content}["vertex"] == 300
    assert content["vertex"]["packed_position"].dtype == np.uint32
    assert "SplatRenderMode: mip" in content.comments
    assert read_splats(tmp_path / "g.compressed.ply").antialiased


def test_a_crash_of_the_library_is_a_refused_file(tmp_path, monkeypatch):
    pytest.importorskip("gaussforge")
    (tmp_path / "g.ksplat").write_bytes(b"anything")
    monkeypatch.setattr(compressed, "_CONVERT", "import os; os.abort()")
    with pytest.raises(FileFormatError, match=r"g\.ksplat: expected a ksplat file, found damaged content"):
        read_splats(tmp_path / "g.ksplat")


@pytest.mark.parametrize("ending", list(COMPRESSED))
def test_damaged_compressed_files_are_refused(tmp_path, ending):
    pytest.importorskip("gaussforge")
    (tmp_path / f"g{ending}").write_bytes(b"\x1f\x8bnot really" * 20)
    with pytest.raises(FileFormatError, match=r"g\."):
        read_splats(tmp_path / f"g{ending}")
    with pytest.raises(FileFormatError, match="No such file"):
        read_splats(tmp_path / f"absent{ending}")


def test_a_missing_library_is_reported_with_its_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    (tmp_path / "g.ksplat").write_bytes(b"anything")
    with pytest.raises(BackendError, match="pip install"):
        read_compressed(tmp_path / "g.ksplat", "ksplat")


def test_infinite_opacity_logits_of_other_programs_become_opacities_0_and_1(tmp_path):
    g = make(4, 0)
    write_ply(g, tmp_path / "g.ply")
    content = bytearray((tmp_path / "g.ply").read_bytes())
    where = content.index(struct.pack("<f", float(g.opacity_logits[2])))
    content[where : where + 4] = struct.pack("<f", float("inf"))
    (tmp_path / "g.ply").write_bytes(content)
    assert float(read_splats(tmp_path / "g.ply").opacities[2]) == pytest.approx(1)
    with pytest.raises(FileFormatError, match="NaN or Inf"):
        read_ply(tmp_path / "g.ply")


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(FileFormatError, match="ends in"):
        read_splats(tmp_path / "g.obj")


# Language


def test_stored_language_contains_the_most_probable_codes(tmp_path):
    field, stored = language(40)
    dense = field.code_probabilities()
    for row, codes, weights in zip(dense, stored.codes, stored.weights):
        known = weights > 0
        assert torch.allclose(row[codes[known].long()], weights[known])
        assert weights.sum() == pytest.approx(1, abs=1e-5)
        assert (weights.diff() <= 0).all()
    write_codebook(stored, tmp_path / "x.safetensors")
    with safe_open(tmp_path / "x.safetensors", "np") as file:
        assert np.array_equal(file.get_tensor("codewords"), field.codebook.clip.numpy())
        assert file.metadata() == {"encoder": "some/clip", "encoder_hash": "abc"}


def test_plyfile_reads_the_language_and_read_ply_the_rest(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    g, (_, stored) = make(30, 1), language(30)
    write_ply(g, tmp_path / "g.ply", further=ply_columns(stored))
    vertex = plyfile.PlyData.read(tmp_path / "g.ply")["vertex"]
    for i in range(4):
        assert np.array_equal(vertex[f"lang_code_{i}"], stored.codes[:, i].numpy())
        assert np.array_equal(vertex[f"lang_weight_{i}"], stored.weights[:, i].numpy())
    assert np.array_equal(vertex["lang_u"], stored.uncertainties.numpy())
    assert np.array_equal(vertex["x"], g.means[:, 0].numpy())
    back = read_ply(tmp_path / "g.ply")
    assert all(torch.equal(getattr(back, name), value) for name, value in g.tensors().items())


def test_the_codebook_is_written_next_to_the_file(tmp_path):
    assert codebook_path(tmp_path / "mug.ply").name == "mug.codebook.safetensors"


# glTF


def accessor(document, number: int) -> np.ndarray:
    """The values of an accessor, decoded after the glTF specification."""
    a = document.accessors[number]
    view = document.bufferViews[a.bufferView]
    kind = {5126: "<f4", 5121: "u1"}[a.componentType]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[a.type]
    start = view.byteOffset + (a.byteOffset or 0)
    flat = np.frombuffer(document.binary_blob(), kind, count=a.count * width, offset=start)
    return flat.reshape(a.count, width)


def test_pygltflib_reads_the_splats_and_the_language(tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    g, (field, stored) = tame(25, 3), language(25)
    write_glb(g, tmp_path / "g.glb", language=stored, world=World(Up(np.array([0.0, 0.6, 0.8]), True)))
    document = pygltflib.GLTF2().load(str(tmp_path / "g.glb"))
    primitive = document.meshes[0].primitives[0]
    values = {name: accessor(document, n) for name, n in vars(primitive.attributes).items() if n is not None}
    own = "KHR_gaussian_splatting:"
    assert primitive.mode == 0
    assert document.extensionsUsed == ["KHR_gaussian_splatting"]
    assert primitive.extensions["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    assert np.array_equal(values["POSITION"], g.means.numpy())
    assert document.accessors[primitive.attributes.POSITION].max == pytest.approx(g.means.amax(0).tolist())
    assert values[own + "SCALE"] == pytest.approx(np.exp(g.log_scales.numpy()), rel=1e-5)
    assert values[own + "OPACITY"][:, 0] == pytest.approx(
        1 / (1 + np.exp(-g.opacity_logits.numpy())), rel=1e-5
    )
    quats = g.quats.numpy() / np.linalg.norm(g.quats.numpy(), axis=1, keepdims=True)
    assert values[own + "ROTATION"] == pytest.approx(quats[:, [1, 2, 3, 0]], abs=1e-6)
    assert np.array_equal(values[own + "SH_DEGREE_0_COEF_0"], g.sh0[:, 0].numpy())
    coefficients = [f"SH_DEGREE_{d}_COEF_{n}" for d in (1, 2, 3) for n in range(2 * d + 1)]
    for number, name in enumerate(coefficients):
        assert np.array_equal(values[own + name], g.shN[:, number].numpy())
    assert np.array_equal(values["_LANGUAGE_CODES"], stored.codes.numpy())
    assert np.array_equal(values["_LANGUAGE_WEIGHTS"], stored.weights.numpy())
    extras = primitive.extras["lexsplat"]
    codebook = accessor(document, extras["codebook"]).reshape(extras["codebookShape"])
    assert np.array_equal(codebook, field.codebook.clip.numpy())
    assert document.nodes[0].scale is None, "the scale is not known"
    x, y, z, w = document.nodes[0].rotation
    up = np.array([0.0, 0.6, 0.8])
    turned = up + 2 * np.cross([x, y, z], np.cross([x, y, z], up) + w * up)
    assert turned == pytest.approx([0, 1, 0], abs=1e-6)


def test_every_chunk_of_a_glb_is_aligned(tmp_path):
    write_glb(tame(7), tmp_path / "g.glb")
    content = (tmp_path / "g.glb").read_bytes()
    magic, version, total, length, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, total, kind) == (b"glTF", 2, len(content), b"JSON")
    assert length % 4 == 0
    binary, kind = struct.unpack_from("<I4s", content, 20 + length)
    assert (binary % 4, kind, 28 + length + binary) == (0, b"BIN\0", len(content))


def test_writers_refuse_nan_and_infinity(tmp_path):
    g = make(3, 0)
    g.means[1, 0] = float("nan")
    for write in (write_splat, write_glb):
        with pytest.raises(ValueError, match="NaN or infinity"):
            write(g, tmp_path / "x")
    with pytest.raises(ValueError, match="expected, got"):
        write_glb(make(4, 0), tmp_path / "x", language=language(5)[1])


# Tables


def test_labels_in_csv_are_read_by_the_standard_library(tmp_path):
    g = tame(5)
    labels, scores = torch.tensor([1, -1, 0, 0, 1]), torch.linspace(0, 1, 5)
    write_labels_csv(g, labels, scores, ["red mug", 'a "quoted", one'], tmp_path / "l.csv")
    with open(tmp_path / "l.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["label"] for row in rows] == ['a "quoted", one', "", "red mug", "red mug", 'a "quoted", one']
    assert [float(row["y"]) for row in rows] == pytest.approx(g.means[:, 1].tolist(), rel=1e-5)
    assert [float(row["score"]) for row in rows] == [0, 0.25, 0.5, 0.75, 1]


def test_plyfile_reads_the_point_cloud_without_transparent_gaussians(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    g = tame(50)
    write_points_ply(g, tmp_path / "p.ply")
    vertex = plyfile.PlyData.read(tmp_path / "p.ply")["vertex"]
    shown = g.opacities.numpy() >= 0.1
    assert vertex.count == shown.sum()
    assert np.array_equal(vertex["z"], g.means[:, 2].numpy()[shown])
    green = np.clip(g.sh0[:, 0, 1].numpy() * 0.28209479177387814 + 0.5, 0, 1) * 255
    assert np.abs(vertex["green"] - green[shown]).max() <= 0.5 + 1e-4
