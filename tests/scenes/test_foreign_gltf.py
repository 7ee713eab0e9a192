"""glTF of other programs: padded views, harmonics that lack a part, nodes that mirror or lie far out."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.refusals import refused
from support.splats import tame

from lexsplat.scenes.formats.gltf import write_glb
from lexsplat.scenes.formats.reading import read_splats

PREFIX = "KHR_gaussian_splatting:"


def glb(document: dict, binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    parts = [
        struct.pack("<I4s", len(text), b"JSON"),
        text,
        struct.pack("<I4s", len(binary), b"BIN\0"),
        binary,
    ]
    return head + b"".join(parts)


def of_another(path: Path, count: int, degree: int = 0) -> tuple[dict, bytes]:
    """Document and data of a GLB as another program would write it, of the Gaussians ``tame(count, degree)``."""
    write_glb(tame(count, degree), path)
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    document["asset"]["generator"] = "another"
    document["nodes"] = [{"mesh": 0}]
    document["scenes"] = [{"nodes": [0]}]
    return document, content[28 + length :]


def padded(document: dict, binary: bytes, filled: Callable[[bytes], bytes]) -> tuple[dict, bytes]:
    """The same with other lengths of its views."""
    document, out = json.loads(json.dumps(document)), b""
    for view in document["bufferViews"]:
        start = view.get("byteOffset", 0)
        data = filled(binary[start : start + view["byteLength"]])
        view["byteOffset"], view["byteLength"] = len(out), len(data)
        out += data + bytes(-len(data) % 16)
    document["buffers"][0]["byteLength"] = len(out)
    return document, out


@pytest.mark.parametrize("alignment", [8, 16, 64, 256, 4096])
def test_views_padded_to_an_alignment_have_no_further_gaussians(tmp_path, alignment):
    path = tmp_path / "g.glb"
    document, binary = of_another(path, 500, 1)
    path.write_bytes(glb(*padded(document, binary, lambda data: data)))
    expected = read_splats(path)
    path.write_bytes(glb(*padded(document, binary, lambda data: data + bytes(-len(data) % alignment))))
    found = read_splats(path)
    assert len(found) == 500
    assert found.means.tolist() == expected.means.tolist()
    assert found.shN.tolist() == expected.shN.tolist()


@pytest.mark.parametrize("count", [511, 500, 0])
def test_further_gaussians_within_an_alignment_are_still_found(tmp_path, count):
    document, binary = of_another(tmp_path / "g.glb", 512)  # every view is a multiple of 2048 bytes
    for accessor in document["accessors"]:
        accessor["count"] = count
    refused(
        tmp_path / "g.glb", glb(document, binary), f"a count of {count} Gaussians, and {512 - count} more"
    )


@pytest.mark.parametrize("missing", [(2, 0), (2, 4), (1, 0), (1, 2)])
def test_harmonics_that_lack_a_coefficient_are_refused_with_its_name(tmp_path, missing):
    document, binary = of_another(tmp_path / "g.glb", 5, 2)
    name = "SH_DEGREE_{}_COEF_{}".format(*missing)
    del document["meshes"][0]["primitives"][0]["attributes"][PREFIX + name]
    refused(tmp_path / "g.glb", glb(document, binary), f"no attribute {PREFIX}{name}")


def test_harmonics_beyond_the_degree_of_the_extension_are_dropped_with_a_warning(tmp_path, caplog):
    document, binary = of_another(tmp_path / "g.glb", 5, 1)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    attributes[PREFIX + "SH_DEGREE_4_COEF_2"] = attributes[PREFIX + "SH_DEGREE_1_COEF_2"]
    (tmp_path / "g.glb").write_bytes(glb(document, binary))
    assert read_splats(tmp_path / "g.glb").sh_degree == 1
    assert (
        "g.glb: attributes that are no harmonics of degree 0 to 3 are ignored: SH_DEGREE_4_COEF_2"
        in caplog.text
    )


@pytest.mark.parametrize("scale", [[-1, 1, 1], [-1, -1, -1]])
def test_a_node_that_mirrors_is_refused_with_what_to_do(tmp_path, scale):
    document, binary = of_another(tmp_path / "g.glb", 5)
    document["nodes"][0]["scale"] = scale
    told = refused(
        tmp_path / "g.glb", glb(document, binary), "found a node that mirrors", "apply its transformation"
    )
    assert "copy the file" not in told
    document["nodes"][0]["scale"] = [1, 2, 1]
    refused(
        tmp_path / "g.glb", glb(document, binary), "found a node that deforms", "apply its transformation"
    )


def test_a_node_at_coordinates_of_a_map_is_reported(tmp_path, caplog):
    document, binary = of_another(tmp_path / "g.glb", 40)
    document["nodes"][0]["translation"] = [4e5, 5.6e6, 0]
    (tmp_path / "g.glb").write_bytes(glb(document, binary))
    means = read_splats(tmp_path / "g.glb").means.double().numpy()
    exact = (tame(40).means.double().numpy() + np.array([4e5, 5.6e6, 0])) * [-1, -1, 1]
    assert np.abs(means - exact).max() <= 0.25
    assert "g.glb: centers are rounded by up to 0.2" in caplog.text
