"""Reading glTF and GLB files with ``KHR_gaussian_splatting``, of any program.

The extension stores activated values and rotations in xyzw order. Nodes place the splats in a world with y up; it is
turned by half a turn about z, to the axes of a 3DGS PLY. Files of lexsplat hold vertex data in the scene's own axes,
which are taken as they are.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lexsplat.geometry.gaussians import Gaussians, joined
from lexsplat.runtime.errors import FileFormatError
from lexsplat.scenes.formats.foreign import (
    Damage,
    as_tensor,
    parsing,
    read_content,
    rounded_centers,
    warn,
)
from lexsplat.scenes.formats.gltf import EXTENSION, GENERATOR
from lexsplat.scenes.transforms import transformed

_UPRIGHT = np.diag([-1.0, -1.0, 1.0, 1.0])
"""From the axes of glTF, y up and z toward the viewer's front, to those of a PLY."""

_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_UNDERSTOOD = {EXTENSION, "KHR_mesh_quantization"}


def read_gltf(path: Path) -> Gaussians:
    """Read all splats of a ``.glb`` or ``.gltf`` file, placed by their nodes.

    Raises:
        FileFormatError: If the file is damaged, requires an extension that is not supported, has no splats, or a node
            deforms them.
    """
    with parsing(path, f"glTF with {EXTENSION}"):
        document, binary = _parts(read_content(path, "glTF"))
        file = _Document(document, binary, path)
        unknown = set(document.get("extensionsRequired", [])) - _UNDERSTOOD
        if unknown:
            found = ", ".join(sorted(map(str, unknown)))
            raise FileFormatError(
                path, expected=f"{EXTENSION} alone", found=found, remedy="export it uncompressed"
            )
        own = document.get("asset", {}).get("generator") == GENERATOR
        parts = [
            _placed(file.gaussians(primitive), np.eye(4) if own else _UPRIGHT @ world, path)
            for primitive, world in file.splats()
        ]
    if not parts:
        raise FileFormatError(
            path,
            expected=f"a primitive with {EXTENSION}",
            found="none",
            remedy="export the splats with this extension; a mesh or a point cloud has no Gaussians",
        )
    return joined(parts)


def _parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the binary chunk, empty in a ``.gltf``."""
    if content[:4] != b"glTF":
        return _object(json.loads(content.decode("utf-8-sig"))), b""
    if len(content) < 20:
        raise Damage(f"{len(content)} bytes")
    _, version, total, length, kind = struct.unpack_from("<4sIII4s", content)
    if version != 2 or kind != b"JSON" or 20 + length > total:
        raise Damage(f"version {version} with {length:,} bytes of JSON in {total:,}")
    if total != len(content):
        raise Damage(f"{len(content):,} bytes, expected {total:,} by the header")
    binary, start = b"", 20 + length
    if start + 8 <= total:
        size, kind = struct.unpack_from("<I4s", content, start)
        if kind == b"BIN\0":
            binary = content[start + 8 : start + 8 + size]
    return _object(json.loads(content[20 : 20 + length])), binary


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise Damage("a list or a value in place of a JSON object")
    return value


def _index(value: Any) -> int:
    """An index of a list; negative ones would count from the end."""
    if type(value) is not int or value < 0:
        raise Damage(f"an index {str(value)[:40]!r}")
    return value


class _Document:
    """A glTF document with its buffers."""

    def __init__(self, document: dict[str, Any], binary: bytes, path: Path) -> None:
        self.document, self.path, self.folder = document, path, path.parent
        self.buffers: dict[int, bytes] = {0: binary} if binary else {}

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """An object of one of the document's lists."""
        return _object(self.document[kind][_index(index)])

    def splats(self) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
        """Every splat primitive of the scene with its transformation ``[4, 4]`` to the world."""
        nodes = self.document.get("nodes", [])
        if "scenes" in self.document:
            roots = list(self.item("scenes", self.document.get("scene", 0)).get("nodes", []))
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        waiting, seen = [(root, np.eye(4)) for root in roots], set()
        while waiting:
            index, parent = waiting.pop(0)
            if _index(index) in seen:
                raise Damage(f"node {index} has two parents")
            seen.add(index)
            node = self.item("nodes", index)
            world = parent @ _matrix(node)
            waiting += [(child, world) for child in node.get("children", [])]
            if "mesh" in node:
                for primitive in self.item("meshes", node["mesh"])["primitives"]:
                    if EXTENSION in _object(primitive).get("extensions", {}):
                        yield primitive, world

    def gaussians(self, primitive: dict[str, Any]) -> Gaussians:
        """The splats of a primitive in the axes of its node."""
        settings = _object(primitive["extensions"][EXTENSION])
        _refuse_compression(settings)
        if settings.get("kernel", "ellipse") != "ellipse":
            raise Damage(f"kernel {str(settings['kernel'])[:40]!r} instead of 'ellipse'")
        if settings.get("colorSpace") == "lin_rec709_display":
            warn("%s: colors are linear light and are taken as sRGB: they look too dark", self.path)
        attributes = _object(primitive["attributes"])

        def values(name: str, width: int, semantic: str = f"{EXTENSION}:") -> NDArray[np.float32]:
            if semantic + name not in attributes:
                raise Damage(f"no attribute {semantic}{name}")
            used.append(attributes[semantic + name])
            return self.accessor(used[-1], width)

        used: list[Any] = []
        degree = self.degree(attributes)
        rest = [values(f"SH_DEGREE_{d}_COEF_{n}", 3) for d in range(1, degree + 1) for n in range(2 * d + 1)]
        means = values("POSITION", 3, "")
        opacities = values("OPACITY", 1)[:, 0]
        scales = values("SCALE", 3)
        if (scales < 0).any() or (opacities < 0).any() or (opacities > 1).any():
            raise Damage("negative sizes, or opacities outside 0..1")
        quats, sh0 = values("ROTATION", 4)[:, [3, 0, 1, 2]], values("SH_DEGREE_0_COEF_0", 3)
        self.check_counts(used, attributes[f"{EXTENSION}:ROTATION"])
        own = primitive.get("extras", {}).get("lexsplat", {})
        return Gaussians(
            means=as_tensor(means),
            quats=as_tensor(quats),
            log_scales=as_tensor(scales).log(),
            opacity_logits=as_tensor(opacities).logit(),
            sh0=as_tensor(sh0)[:, None],
            shN=as_tensor(np.stack(rest, 1)) if rest else torch.zeros(len(means), 0, 3),
            antialiased=own.get("antialiased") is True,
        )

    def degree(self, attributes: dict[str, Any]) -> int:
        """The highest degree of which the harmonics have a coefficient."""
        names = [name.removeprefix(f"{EXTENSION}:") for name in attributes if f"{EXTENSION}:SH_" in name]
        known = {f"SH_DEGREE_{d}_COEF_{n}": d for d in range(4) for n in range(2 * d + 1)}
        if others := [name for name in names if name not in known]:
            listed = ", ".join(others)[:200]
            warn("%s: attributes that are no harmonics of degree 0 to 3 are ignored: %s", self.path, listed)
        return max((known[name] for name in names if name in known), default=0)

    def check_counts(self, indices: list[Any], rotations: Any) -> None:
        """Refuse attributes of different counts, and counts that leave out elements of all attributes.

        Zeros that pad the views are no Gaussians, since no rotation is four zeros.
        """
        counts = sorted({self.item("accessors", index)["count"] for index in indices})
        if len(counts) > 1:
            raise Damage(f"attributes of {counts[0]:,} and of {counts[-1]:,} Gaussians")
        views = [self.item("accessors", index)["bufferView"] for index in indices]
        left = min(len(rest) // step for rest, step in map(self._rest, views))
        rest, _ = self._rest(self.item("accessors", rotations)["bufferView"])
        if left and np.frombuffer(rest, np.uint8).any():
            raise Damage(f"a count of {counts[0]:,} Gaussians, and {left:,} more in the data")

    def _rest(self, number: int) -> tuple[memoryview, int]:
        """The bytes of a buffer view after the last element of all accessors, and the bytes of an element."""
        view, end, step = self.item("bufferViews", number), 0, 1
        for accessor in self.document["accessors"]:
            if accessor.get("bufferView") == number:
                size = np.dtype(_TYPES[accessor["componentType"]]).itemsize * _WIDTHS[accessor["type"]]
                stride = view.get("byteStride", size)
                last = accessor.get("byteOffset", 0) + (accessor["count"] - 1) * stride + size
                end, step = max(end, last), max(step, stride)
        return self.view(number)[end:], step

    def view(self, number: Any) -> memoryview:
        """The bytes of a buffer view, fewer if its buffer ends before."""
        view = self.item("bufferViews", number)
        start, length = _index(view.get("byteOffset", 0)), _index(view["byteLength"])
        return memoryview(self.buffer(_index(view["buffer"])))[start : start + length]

    def accessor(self, index: Any, width: int) -> NDArray[np.float32]:
        """The numbers ``[count, width]`` of an accessor; normalized integers are fractions."""
        accessor = self.item("accessors", index)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise Damage("a sparse accessor")
        view = self.item("bufferViews", accessor["bufferView"])
        _refuse_compression(view)
        kind = np.dtype(_TYPES[accessor["componentType"]])
        if _WIDTHS[accessor["type"]] != width:
            raise Damage(f"an accessor of {accessor['type']}")
        count, step = _index(accessor["count"]), _index(view.get("byteStride", kind.itemsize * width))
        inside, length = _index(accessor.get("byteOffset", 0)), _index(view["byteLength"])
        data = self.view(accessor["bufferView"])
        last = inside + max(count - 1, 0) * step + kind.itemsize * width
        if len(data) < length or step < kind.itemsize * width or (count and last > length):
            raise Damage(f"an accessor of {count} elements beyond its {len(data)} bytes")
        if count == 0:
            return np.zeros((0, width), np.float32)
        strides = (step, kind.itemsize)
        values = np.ndarray((count, width), kind, data, inside, strides).astype(np.float32)
        if kind.kind == "f" or not accessor.get("normalized"):
            return values
        return np.maximum(values / np.iinfo(kind).max, -1)

    def buffer(self, index: int) -> bytes:
        """A buffer: the binary chunk, data in the document, or a file beside it."""
        if index not in self.buffers:
            uri = self.item("buffers", index)["uri"]
            if uri.startswith("data:"):
                try:
                    self.buffers[index] = base64.b64decode(uri.partition(",")[2], validate=True)
                except binascii.Error as error:
                    raise Damage(f"a buffer: {error}") from error
            else:
                beside = (self.folder / unquote(uri)).resolve()
                if "://" in uri or not beside.is_relative_to(self.folder.resolve()):
                    raise Damage(f"a buffer outside the folder: {uri[:80]!r}")
                self.buffers[index] = beside.read_bytes()
        return self.buffers[index]


def _refuse_compression(part: dict[str, Any]) -> None:
    """Refuse data in another form, such as meshopt or SPZ; files need not list it as required."""
    if part.get("extensions"):
        raise Damage(f"{', '.join(part['extensions'])} is not supported, export it uncompressed")


def _matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    """The transformation ``[4, 4]`` of a node to its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    turn = Rotation.from_quat(np.array(node.get("rotation", [0, 0, 0, 1]), np.float64).reshape(4)).as_matrix()
    matrix[:3, :3] = turn * np.array(node.get("scale", [1, 1, 1]), np.float64).reshape(3)
    matrix[:3, 3] = np.array(node.get("translation", [0, 0, 0]), np.float64).reshape(3)
    return matrix


def _placed(gaussians: Gaussians, world: NDArray[np.float64], path: Path) -> Gaussians:
    """The Gaussians after a transformation of turn, uniform scale and translation."""
    linear = world[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    even = np.allclose(linear @ linear.T, scale**2 * np.eye(3), atol=1e-4 * scale**2)
    if not scale > 0 or not even:
        raise FileFormatError(
            path,
            expected="nodes that turn, scale evenly and move their splats",
            found="a node that mirrors them" if scale < 0 else "a node that deforms them",
            remedy="apply its transformation to the splats in the program that wrote the file, and export again",
        )
    placed = transformed(gaussians, rotation=linear / scale, scale=scale, translation=world[:3, 3])
    exact = gaussians.means.double().numpy() @ linear.T + world[:3, 3]
    return replace(placed, means=rounded_centers(exact, placed.log_scales, path))
