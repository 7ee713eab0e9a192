"""Binary glTF with ``KHR_gaussian_splatting``, the Khronos Group's extension for Gaussian splats.

The extension requires activated values: scales and opacities, and rotations in xyzw order. Language is stored in
application attributes, whose names begin with an underscore and which viewers ignore. The codebook is an accessor;
``extras.lexsplat`` of the primitive contains its index.

glTF defines y as up and the meter as the unit. The vertex data keep the scene's axes and units; the node rotates
them, and scales them if the scale is known (``lexsplat scale``).
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.geometry.world import World
from lexsplat.scenes.formats.language import StoredLanguage, check_language

EXTENSION = "KHR_gaussian_splatting"
GENERATOR = "lexsplat"
"""The program named in the files."""
_FLOAT, _BYTE = 5126, 5121
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_glb(
    gaussians: Gaussians,
    path: Path,
    *,
    language: StoredLanguage | None = None,
    world: World | None = None,
) -> None:
    """Write a ``.glb`` with one splat primitive.

    Args:
        gaussians: Gaussians to write. Spherical harmonics beyond degree 3, the extension's limit, are dropped.
        path: The file.
        language: Codes and codebook to include.
        world: Up direction and scale of the scene; by default, z is up and the unit is the meter.

    Raises:
        ValueError: If there are no Gaussians, a value is NaN or infinite, or the language has another number of
            Gaussians.
    """
    g = gaussians.detach().to("cpu")
    check_language(g, language)
    if len(g) == 0:
        raise ValueError("glTF requires at least one Gaussian")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in g.tensors().values()):
        raise ValueError("the Gaussians contain NaN or infinity")
    buffer = _Buffer()
    primitive: dict[str, Any] = {
        "attributes": _splat_attributes(g, buffer),
        "mode": 0,
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "sortingMethod": "cameraDistance",
                "projection": "perspective",
            }
        },
    }
    own: dict[str, Any] = {}
    if language is not None:
        attributes, own = _language_attributes(language, buffer)
        primitive["attributes"] |= attributes
    if g.antialiased:
        own["antialiased"] = True
    if own:
        primitive["extras"] = {"lexsplat": own}
    document = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [_node(world)],
        "meshes": [{"primitives": [primitive]}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": buffer.length}],
    }
    path.write_bytes(_container(document, buffer.chunks))


def _splat_attributes(g: Gaussians, buffer: _Buffer) -> dict[str, int]:
    """The attributes of ``KHR_gaussian_splatting``: accessor indices by name, values in the buffer."""
    color = torch.cat([g.sh0[:, 0] * SH_C0 + 0.5, g.opacities[:, None]], 1).clamp(0, 1)
    attributes = {
        "POSITION": buffer.add(g.means, bounds=True),
        "COLOR_0": buffer.add((color * 255).round().to(torch.uint8), normalized=True),
        f"{EXTENSION}:ROTATION": buffer.add(torch.nn.functional.normalize(g.quats, dim=1)[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": buffer.add(g.scales),
        f"{EXTENSION}:OPACITY": buffer.add(g.opacities[:, None]),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": buffer.add(g.sh0[:, 0]),
    }
    start = 0
    for degree in range(1, min(g.sh_degree, 3) + 1):
        for number in range(2 * degree + 1):
            name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{number}"
            attributes[name] = buffer.add(g.shN[:, start + number])
        start += 2 * degree + 1
    return attributes


def _language_attributes(language: StoredLanguage, buffer: _Buffer) -> tuple[dict[str, int], dict[str, Any]]:
    """The application attributes of the language and their description for ``extras.lexsplat``."""
    attributes = {
        "_LANGUAGE_CODES": buffer.add(language.codes),
        "_LANGUAGE_WEIGHTS": buffer.add(language.weights),
        "_LANGUAGE_UNCERTAINTY": buffer.add(language.uncertainties[:, None]),
    }
    return attributes, {
        "codebook": buffer.add(language.codewords.reshape(-1, 1), vertices=False),
        "codebookShape": list(language.codewords.shape),
        "encoder": dict(language.encoder),
    }


def _node(world: World | None) -> dict[str, Any]:
    """The node that rotates the scene upright, and scales it to meters if the scale is known."""
    up = np.array([0.0, 0.0, 1.0]) if world is None else world.up.direction
    node: dict[str, Any] = {"mesh": 0, "rotation": _upright(up)}
    if world is not None and world.meters_per_unit is not None:
        node["scale"] = [world.meters_per_unit] * 3
    return node


class _Buffer:
    """The binary chunk of a glTF file with its buffer views and accessors."""

    def __init__(self) -> None:
        self.chunks: list[bytes] = []
        self.length = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, values: torch.Tensor, *, normalized: bool = False, bounds: bool = False, vertices: bool = True
    ) -> int:
        """Append ``[N, 1 | 3 | 4]`` float32 or ``[N, 4]`` uint8; returns the index of its accessor."""
        array = np.ascontiguousarray(values.numpy())
        content = array.astype(np.uint8 if array.dtype == np.uint8 else "<f4").tobytes()
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.length, "byteLength": len(content)}
        if vertices:
            view["target"] = 34962
        self.views.append(view)
        self.chunks.append(content + bytes(-len(content) % 4))
        self.length += len(self.chunks[-1])
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _BYTE if array.dtype == np.uint8 else _FLOAT,
            "count": len(array),
            "type": _TYPES[array.shape[1]],
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor["min"] = [float(v) for v in array.min(0)]
            accessor["max"] = [float(v) for v in array.max(0)]
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _upright(up: NDArray[np.float64]) -> list[float]:
    """The shortest rotation (xyzw) that maps ``up`` to +y."""
    direction = np.asarray(up, float) / np.linalg.norm(up)
    target = np.array([0.0, 1.0, 0.0])
    if direction @ target < -1 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    quaternion = np.append(np.cross(direction, target), 1 + direction @ target)
    return [float(v) for v in quaternion / np.linalg.norm(quaternion)]


def _container(document: dict[str, Any], chunks: list[bytes]) -> bytes:
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    body = b"".join(chunks)
    total = 12 + 8 + len(text) + 8 + len(body)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, total),
            struct.pack("<I4s", len(text), b"JSON"), text,
            struct.pack("<I4s", len(body), b"BIN\0"), body,
        ]
    )  # fmt: skip
