"""Files that other programs wrote (tests/data/splats), and values of other programs that cannot be rendered."""

from __future__ import annotations

import base64
import itertools
import json
import logging
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.splats import half_turned, largest_differences, make, tame

from lexsplat.geometry.boxes import Up
from lexsplat.geometry.world import World
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.gltf import write_glb
from lexsplat.scenes.formats.ply import read_ply, write_ply
from lexsplat.scenes.formats.reading import read_splats
from lexsplat.scenes.formats.sog_writing import _indexed, write_sog
from lexsplat.scenes.formats.splat import write_splat
from lexsplat.scenes.formats.spz import write_spz

FILES = Path(__file__).parents[1] / "data" / "splats"

GRID = np.array([[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]], float)
"""Centers that the generator of splat-transform's fixtures gives its four splats."""

# Files of other programs


@pytest.mark.parametrize("name", ["minimal-v3.spz", "minimal-v4.spz", "minimal.splat", "minimal.ksplat"])
def test_four_splats_of_splat_transform_have_the_values_of_their_generator(name):
    if name.endswith(".ksplat"):
        pytest.importorskip("gaussforge")
    found = read_splats(FILES / name)
    assert np.allclose(found.means, GRID, atol=1e-3)
    assert np.allclose(found.scales, 0.1, rtol=0.02)
    assert np.allclose(found.opacities, 230 / 255, atol=1e-3)
    assert np.allclose(found.sh0[:, 0, 0] * 0.28209479 + 0.5, [1 / 3, 2 / 3, 1 / 3, 2 / 3], atol=3e-3)


def test_spz_2_is_read_in_the_axes_that_spz_defines():
    # The generator of this file left its axes as they were; SPZ says that y is up and z is backward.
    found = read_splats(FILES / "minimal-v2.spz")
    assert np.allclose(found.means, GRID * [1, -1, -1], atol=1e-3)
    assert np.allclose(found.quats[:, 1].abs() / found.quats.norm(dim=1), 1, atol=1e-4)  # half a turn about x
    assert np.allclose(found.opacities, 230 / 255, atol=1e-3)


def cube() -> tuple[np.ndarray, np.ndarray]:
    """Centers and first colors of the cube, read as text."""
    lines = (FILES / "unitCube-ascii.ply").read_text().split("end_header\n")[1].splitlines()
    rows = np.array([[float(word) for word in line.split()] for line in lines])
    return rows[:, :3], rows[:, 3:6]


@pytest.mark.parametrize("ending", ["-ascii.ply", ".glb", ".sog", ".spz", ".compressed.ply"])
def test_the_cube_of_jsplat_is_the_same_in_every_format(ending):
    if ending == ".compressed.ply":
        pytest.importorskip("gaussforge")
    found = read_splats(FILES / f"unitCube{ending}")
    if ending == ".spz":  # splat-transform 3.7 writes the axes of PLY, against the format's definition
        found = half_turned(found, "x")
    places, colors = cube()
    distances = np.linalg.norm(places[:, None] - found.means.numpy(), axis=2)
    nearest = distances.argmin(1)
    assert len(set(nearest.tolist())) == len(found) == 20
    assert distances.min(1).max() < {".compressed.ply": 0.02}.get(ending, 0.001)
    assert np.allclose(found.sh0.numpy()[nearest, 0], colors, atol=0.03)
    assert float(found.opacities.min()) > 0.99


def test_a_compressed_ply_of_supersplat_has_all_its_harmonics():
    pytest.importorskip("gaussforge")
    found = read_splats(FILES / "supersplat.compressed.ply")
    assert (len(found), found.sh_degree) == (64, 3)
    # Worked out from the bytes: chunk bounds, 11, 10 and 11 bits a coordinate, and 8 bits a coefficient.
    content = (FILES / "supersplat.compressed.ply").read_bytes().split(b"end_header\n", 1)[1]
    low_x, _, _, high_x = struct.unpack_from("<4f", content)
    (word,) = struct.unpack_from("<I", content, 72)
    assert float(found.means[0, 0]) == pytest.approx(low_x + (word >> 21) / 2047 * (high_x - low_x), abs=1e-5)
    red = np.frombuffer(content, np.uint8, 45, 72 + 64 * 16)[:15]
    assert np.allclose(found.shN[0, :, 0], (red.astype(float) / 256 - 0.5) * 8, atol=0.02)


def test_an_unbundled_sog_is_read_from_its_folder_or_its_meta_json():
    found = read_splats(FILES / "playbot")
    meta = json.loads((FILES / "playbot" / "meta.json").read_text())
    assert (len(found), found.sh_degree) == (meta["count"], meta["shN"]["bands"]) == (1873, 2)
    assert torch.equal(read_splats(FILES / "playbot" / "meta.json").means, found.means)
    # Gaussian 700 from the pictures, after the format's description.
    low, high, scales, sh0 = (
        np.asarray(Image.open(FILES / "playbot" / f"{name}.webp").convert("RGBA")).reshape(-1, 4)[700].astype(int)
        for name in ("means_l", "means_u", "scales", "sh0")
    )  # fmt: skip
    for axis in range(3):
        first, last = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
        value = first + (low[axis] + 256 * high[axis]) / 65535 * (last - first)
        place = np.sign(value) * (np.exp(abs(value)) - 1)
        assert float(found.means[700, axis]) == pytest.approx(place, abs=1e-5)
        assert float(found.log_scales[700, axis]) == pytest.approx(meta["scales"]["codebook"][scales[axis]])
        assert float(found.sh0[700, 0, axis]) == pytest.approx(meta["sh0"]["codebook"][sh0[axis]])
    assert float(found.opacities[700]) == pytest.approx(sh0[3] / 255, abs=1e-5)


# glTF of other programs


def gltf_of(g, node: dict, **changes) -> dict:
    """A glTF document as another program would write it: quantized rotations, interleaved, data in the document."""
    quats = torch.nn.functional.normalize(g.quats, dim=1)[:, [1, 2, 3, 0]].numpy()
    layout = [("place", "<f4", 3), ("turn", "<i2", 4), ("size", "<f4", 3), ("opacity", "<u2"), ("gap", "<u2")]
    table = np.zeros(len(g), [*layout, ("color", "<f4", 3)])
    table["place"], table["turn"] = g.means, np.round(quats * 32767)
    table["size"], table["opacity"] = g.scales, np.round(g.opacities.numpy() * 65535)
    table["color"] = g.sh0[:, 0]
    columns = {
        "POSITION": ("place", 5126, "VEC3"), "KHR_gaussian_splatting:ROTATION": ("turn", 5122, "VEC4"),
        "KHR_gaussian_splatting:SCALE": ("size", 5126, "VEC3"),
        "KHR_gaussian_splatting:OPACITY": ("opacity", 5123, "SCALAR"),
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": ("color", 5126, "VEC3"),
    }  # fmt: skip
    accessors = [
        {"bufferView": 0, "byteOffset": table.dtype.fields[name][1], "componentType": kind, "type": shape,
         "count": len(g), "normalized": kind != 5126}
        for name, kind, shape in columns.values()
    ]  # fmt: skip
    uri = "data:application/octet-stream;base64," + base64.b64encode(table.tobytes()).decode()
    extension = {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    primitive = {"mode": 0, "attributes": {n: i for i, n in enumerate(columns)}, "extensions": extension}
    document = {
        "asset": {"version": "2.0", "generator": "another"}, "extensionsUsed": ["KHR_gaussian_splatting"],
        "scenes": [{"nodes": [1]}], "nodes": [{"mesh": 0, **node}, {"children": [0], "translation": [0, 0, 5]}],
        "meshes": [{"primitives": [{"mode": 4, "attributes": {}}, primitive]}], "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": table.nbytes, "byteStride": table.dtype.itemsize}],
        "buffers": [{"byteLength": table.nbytes, "uri": uri}],
    }  # fmt: skip
    return document | changes


def test_gltf_nodes_place_their_splats_in_a_world_with_y_up(tmp_path):
    g = tame(30)
    turn = [0, 0, 1, 0]  # half a turn about z, which the turn from glTF to PLY takes back
    document = gltf_of(g, {"rotation": turn, "scale": [2, 2, 2], "translation": [0, 0, 1]})
    (tmp_path / "g.gltf").write_text(json.dumps(document))
    found = read_splats(tmp_path / "g.gltf")
    assert np.allclose(found.means, g.means * 2 + torch.tensor([0, 0, 6.0]), atol=1e-5)
    assert np.allclose(found.scales, g.scales * 2, rtol=1e-5)
    same = g.map(torch.clone)
    same.means, same.log_scales = found.means, found.log_scales
    differences = largest_differences(same, found)
    assert differences["rotations"] < 1e-6
    assert differences["opacities"] < 1e-5
    assert differences["sh0"] == 0


def test_a_buffer_beside_the_gltf_is_read_and_one_outside_the_folder_is_not(tmp_path):
    g = tame(5)
    document = gltf_of(g, {})
    data = base64.b64decode(document["buffers"][0]["uri"].partition(",")[2])
    (tmp_path / "in").mkdir()
    for folder, name, uri in (("in", "my data.bin", "my%20data.bin"), (".", "out.bin", "../out.bin")):
        (tmp_path / folder / name).write_bytes(data)
        document["buffers"][0]["uri"] = uri
        (tmp_path / "in" / f"{name}.gltf").write_text(json.dumps(document))
    assert len(read_splats(tmp_path / "in" / "my data.bin.gltf")) == 5
    with pytest.raises(FileFormatError, match="outside the folder"):
        read_splats(tmp_path / "in" / "out.bin.gltf")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"extensionsRequired": ["KHR_gaussian_splatting_compression_spz_2"]}, "spz_2; export it uncompressed"),
        ({"nodes": [{"mesh": 0, "scale": [1, 2, 1]}], "scenes": [{"nodes": [0]}]}, "a node that deforms"),
        ({"nodes": [{"mesh": 0, "scale": [-1, 1, 1]}], "scenes": [{"nodes": [0]}]}, "a node that mirrors"),
        ({"nodes": [{"mesh": 0, "children": [0]}], "scenes": [{"nodes": [0]}]}, "two parents"),
        ({"nodes": []}, "damaged content"),
        ({"scenes": [{"nodes": []}]}, "expected a primitive with KHR_gaussian_splatting, found none"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0, "_SCALE": 2, "_ROTATION": 1},
          "extensions": {"KHR_gaussian_splatting": {}}}]}]}, "no attribute KHR_gaussian_splatting:"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 9, "extensions": {"EXT_meshopt_compression": {}}}]},
         "EXT_meshopt_compression is not supported, export it uncompressed"),
        ({"meshes": [{"primitives": [{"attributes": {},
          "extensions": {"KHR_gaussian_splatting": {"extensions": {"KHR_spz_2": {}}}}}]}]},
         "KHR_spz_2 is not supported, export it uncompressed"),
    ],
)  # fmt: skip
def test_gltf_that_cannot_be_read_rightly_is_refused_with_its_reason(tmp_path, change, words):
    (tmp_path / "g.gltf").write_text(json.dumps(gltf_of(tame(3), {}, **change)))
    with pytest.raises(FileFormatError, match=words):
        read_splats(tmp_path / "g.gltf")


def test_a_glb_of_lexsplat_comes_back_in_the_axes_of_its_scene(tmp_path):
    g = tame(40, 3, antialiased=True)
    write_glb(g, tmp_path / "g.glb", world=World(Up(np.array([0.0, 0.6, 0.8]), True), 0.5))
    found = read_splats(tmp_path / "g.glb")
    assert found.antialiased
    assert max(largest_differences(g, found).values()) < 1e-5


# Precision, order and the flag of the mip filter


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("ending", [".v3.spz", ".spz", ".sog"])
def test_compressed_files_of_lexsplat_keep_order_flag_and_values(tmp_path, ending, degree):
    g = tame(300, degree, antialiased=degree == 1)
    writers = {
        ".v3.spz": lambda: write_spz(g, tmp_path / "g.v3.spz", version=3),
        ".spz": lambda: write_spz(g, tmp_path / "g.spz"),
        ".sog": lambda: write_sog(g, tmp_path / "g.sog"),
    }
    writers[ending]()
    found = read_splats(tmp_path / f"g{ending}")
    assert found.antialiased == g.antialiased
    assert torch.allclose(found.means, g.means, atol=1e-4)
    differences = largest_differences(g, found)
    limits = {"means": 1e-4, "log_scales": 1 / 31, "opacities": 1 / 509, "sh0": 0.0133, "shN": 1 / 15}
    assert all(differences[name] <= limit for name, limit in limits.items()), differences
    assert differences["rotations"] < 5e-5


@pytest.mark.parametrize(("far", "warned"), [(10.0, False), (1e6, True)])
def test_spz_that_rounds_centers_more_than_they_bear_says_so(tmp_path, caplog, far, warned):
    g = tame(50, 0)
    g.means[3] = far
    write_spz(g, tmp_path / "g.spz")
    assert ("coarse for these Gaussians" in caplog.text) == warned
    assert not warned or "rounded to 0.125 units" in caplog.text


def test_spz_of_both_versions_holds_the_same_bytes_in_other_containers(tmp_path):
    import gzip

    import zstandard

    g = tame(50, 2, antialiased=True)
    write_spz(g, tmp_path / "3.spz", version=3)
    write_spz(g, tmp_path / "4.spz")
    old, new = gzip.decompress((tmp_path / "3.spz").read_bytes()), (tmp_path / "4.spz").read_bytes()
    magic, version, count, degree, bits, flags, streams, table = struct.unpack_from("<4sIIBBBBI", new)
    assert (magic, version, count, degree, flags, streams, table) == (b"NGSP", 4, 50, 2, 1, 6, 32)
    assert old[:4] + old[8:15] == new[:4] + new[8:15]
    sizes = np.frombuffer(new, "<u8", 12, 32).reshape(6, 2)
    starts = [128 + int(sizes[:i, 0].sum()) for i in range(7)]
    parts = [zstandard.decompress(new[a:b]) for a, b in itertools.pairwise(starts)]
    assert [len(part) for part in parts] == sizes[:, 1].tolist() == [450, 50, 150, 150, 200, 1200]
    assert b"".join(parts) == old[16:]
    # y and z of the first center run the other way; three bytes a coordinate, little endian.
    word = int.from_bytes(old[19:22], "little", signed=True)
    assert word / 2**bits == pytest.approx(-float(g.means[0, 1]), abs=2.0**-bits)


def test_more_gaussians_than_indices_share_a_palette(tmp_path, monkeypatch):
    from lexsplat.scenes.formats import sog_writing

    monkeypatch.setattr(sog_writing, "_MOST_INDICES", 100)
    monkeypatch.setattr(sog_writing, "_ENTRIES", 64)
    groups = make(16, 1).shN.repeat(20, 1, 1)
    g = tame(320, 1)
    g.shN = groups + 0.01 * g.shN
    write_sog(g, tmp_path / "g.sog")
    with zipfile.ZipFile(tmp_path / "g.sog") as archive:
        assert json.loads(archive.read("meta.json"))["shN"]["count"] == 64
    assert float((read_splats(tmp_path / "g.sog").shN - g.shN).abs().mean()) < 0.02


@pytest.mark.parametrize(
    ("line", "flag"),
    [("SplatRenderMode: mip", True), ("antialiased 1", True), ("SplatRenderMode: default", False),
     ("SplatRenderMode: mip\ncomment antialiased 0", False), ("mip", False)],
)  # fmt: skip
def test_both_spellings_of_the_mip_filter_are_read_and_the_last_one_counts(tmp_path, line, flag):
    write_ply(make(2, 0), tmp_path / "g.ply")
    content = (tmp_path / "g.ply").read_bytes()
    (tmp_path / "g.ply").write_bytes(content.replace(b"element", b"comment %b\nelement" % line.encode(), 1))
    assert read_ply(tmp_path / "g.ply").antialiased is flag


def test_the_mip_filter_is_written_as_other_programs_spell_it(tmp_path):
    write_ply(make(2, 0, antialiased=True), tmp_path / "g.ply")
    assert b"\ncomment SplatRenderMode: mip\n" in (tmp_path / "g.ply").read_bytes()


# Values that cannot be rendered


def test_a_few_invalid_gaussians_are_dropped_with_a_warning(tmp_path, caplog):
    g = tame(40)
    g.means[3, 1], g.log_scales[7, 0] = float("nan"), float("inf")
    table = g.map(torch.nan_to_num)
    write_ply(table, tmp_path / "g.ply")
    content = (tmp_path / "g.ply").read_bytes()
    start = content.index(b"end_header\n") + 11
    rows = np.frombuffer(content[start:], "<f4").reshape(40, 17).copy()
    rows[3, 1], rows[7, 10] = np.nan, np.inf
    (tmp_path / "g.ply").write_bytes(content[:start] + rows.tobytes())
    with caplog.at_level(logging.WARNING):
        found = read_splats(tmp_path / "g.ply")
    assert "2 of 40 Gaussians dropped: NaN or Inf in means" in caplog.text
    kept = [i for i in range(40) if i not in (3, 7)]
    assert torch.equal(found.means, table.means[kept])
    rows[:5] = np.nan
    (tmp_path / "g.ply").write_bytes(content[:start] + rows.tobytes())
    with pytest.raises(FileFormatError, match=r"found 6 of 40 Gaussians that cannot be rendered"):
        read_splats(tmp_path / "g.ply")


def test_sizes_of_zero_and_missing_rotations_are_read_as_what_they_look_like(tmp_path):
    g = tame(3)
    g.log_scales[1] = -200
    write_splat(g, tmp_path / "g.splat")
    content = bytearray((tmp_path / "g.splat").read_bytes())
    content[28:32] = bytes([128] * 4)
    (tmp_path / "g.splat").write_bytes(content)
    found = read_splats(tmp_path / "g.splat")
    assert found.quats[0].tolist() == [1, 0, 0, 0]
    assert np.allclose(found.scales[1], 1e-12)


@pytest.mark.parametrize("ending", [".ply", ".spz", ".sog", ".glb"])
def test_one_gaussian_is_a_file_and_none_is_not(tmp_path, ending):
    from lexsplat.scenes.exporting import export_gaussians

    export_gaussians(tame(1, 1), tmp_path / f"one{ending}")
    assert len(read_splats(tmp_path / f"one{ending}")) == 1
    if ending in (".ply", ".spz"):
        (write_ply if ending == ".ply" else write_spz)(make(0, 1), tmp_path / f"none{ending}")
        with pytest.raises(FileFormatError, match="expected at least one Gaussian, found none"):
            read_splats(tmp_path / f"none{ending}")


def test_other_peoples_extra_properties_are_ignored(tmp_path):
    text = (FILES / "unitCube-ascii.ply").read_text()
    head, rows = text.split("end_header\n")
    more = "property uchar segment\nelement camera 1\nproperty list uchar int ids\nend_header\n"
    rows = "\n".join(line + " 7" for line in rows.splitlines())
    (tmp_path / "g.ply").write_text(head + more + rows + "\n3 1 2 3\n")
    assert np.allclose(read_splats(tmp_path / "g.ply").means, cube()[0])


def test_big_endian_numbers_are_read(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    g = make(9, 1)
    write_ply(g, tmp_path / "g.ply")
    content = plyfile.PlyData.read(tmp_path / "g.ply")
    for name, options in (("big", {"byte_order": ">"}), ("text", {"text": True})):
        plyfile.PlyData(content.elements, **options).write(tmp_path / f"{name}.ply")
        found = read_splats(tmp_path / f"{name}.ply")
        assert max(largest_differences(g, found).values()) < 1e-5


# Damage


def test_a_text_ply_cut_anywhere_is_refused(tmp_path):
    content = (FILES / "unitCube-ascii.ply").read_bytes()
    for length in range(0, len(content), 7):
        (tmp_path / "g.ply").write_bytes(content[:length])
        with pytest.raises(FileFormatError):
            read_splats(tmp_path / "g.ply")


@pytest.mark.parametrize("version", [3, 4])
def test_an_absurd_count_in_spz_takes_no_memory(tmp_path, version):
    import gzip

    write_spz(tame(5), tmp_path / "g.spz", version=version)
    content = (tmp_path / "g.spz").read_bytes()
    raw = bytearray(gzip.decompress(content) if version == 3 else content)
    raw[8:12] = struct.pack("<I", 4_000_000_000)
    (tmp_path / "g.spz").write_bytes(gzip.compress(raw) if version == 3 else raw)
    with pytest.raises(FileFormatError, match="found a count of 4,000,000,000"):
        read_splats(tmp_path / "g.spz")


def sog_with(path: Path, **changed: bytes) -> None:
    """A SOG with some of its parts replaced; None leaves a part out."""
    write_sog(tame(20, 1), path)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    parts |= {name.replace("__", "."): content for name, content in changed.items()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            if content is not None:
                archive.writestr(name, content)


def picture(width: int, height: int) -> bytes:
    import io

    content = io.BytesIO()
    Image.new("RGBA", (width, height)).save(content, "WEBP", lossless=True)
    return content.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"means_l__webp": bytes(200 << 20)}, r"means_l\.webp has more than"),
        ({"quats__webp": picture(4000, 4000)}, r"quats\.webp of 4000 x 4000 pixels for 20"),
        ({"scales__webp": picture(2, 2)}, r"scales\.webp of 2 x 2 pixels for 20"),
        ({"sh0__webp": b"\x89PNG\r\n\x1a\n"}, r"sh0\.webp"),
        ({"shN_labels__webp": None}, r"no shN_labels\.webp in the archive; copy"),
        ({"meta__json": b'{"version": 3}'}, "expected SOG of version 1 or 2, found version 3"),
        (
            {"meta__json": b'{"means": {"shape": [3, 3]}}'},
            "version 1 or 2, found damaged content: no 'quats'",
        ),
    ],
)
def test_zip_bombs_and_missing_parts_of_sog_are_refused(tmp_path, changed, words):
    sog_with(tmp_path / "g.sog", **changed)
    with pytest.raises(FileFormatError, match=words):
        read_splats(tmp_path / "g.sog")


def test_parts_of_an_unbundled_sog_lie_in_its_folder(tmp_path):
    meta = json.loads((FILES / "playbot" / "meta.json").read_text())
    meta["quats"]["files"] = ["../quats.webp"]
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(FileFormatError, match="found damaged content"):
        read_splats(tmp_path)


def test_the_tables_of_sog_are_those_of_k_means_over_every_value():
    values = np.random.default_rng(0).normal(size=(400, 3)).astype(np.float32) ** 3
    flat = np.sort(values.astype(np.float64).ravel())
    even = np.linspace(flat[0], flat[-1], 128)
    centers = np.sort(np.append(np.quantile(flat, np.linspace(0, 1, 128)), even))
    for _ in range(20):
        nearest = np.abs(flat[:, None] - centers).argmin(1)
        means = [flat[nearest == k].mean() if (nearest == k).any() else centers[k] for k in range(256)]
        centers = np.sort(means)
    indices, table = _indexed(values)
    np.testing.assert_allclose(table, centers, atol=1e-6)
    distances = np.abs(values[..., None] - centers)
    chosen = np.take_along_axis(distances, indices[..., None].astype(int), 2)[..., 0]
    assert (chosen <= distances.min(2) + 1e-6).all()
