"""Round trips with splat-transform (`@playcanvas/splat-transform` on npm), both ways, in every format that it knows.

Skipped unless ``splat-transform`` 3 is on the path; `.ci/run` installs it, and node 20 suffices. The references are
the Gaussians themselves and the PLY that splat-transform writes, read by plyfile.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from support.sog_files import write_version_1
from support.splat_transform import program, running
from support.splats import half_turned, largest_differences, tame

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.scenes.exporting import export_gaussians
from lexsplat.scenes.formats.ply import write_ply
from lexsplat.scenes.formats.reading import read_splats

COUNT = 400
FEW = 100
"""Of SOG, for which splat-transform takes seconds to choose palettes of 400."""
EXACT = {"means": 1e-5, "log_scales": 1e-5, "opacities": 1e-6, "sh0": 1e-5, "shN": 1e-6, "rotations": 1e-6}
BYTES = {"means": 1e-6, "log_scales": 1e-5, "opacities": 0.004, "sh0": 0.014, "shN": 0, "rotations": 2e-4}
SPZ = {"means": 3e-4, "log_scales": 0.032, "opacities": 0.002, "sh0": 0.0133, "shN": 0.067, "rotations": 5e-6}
SOG = {"means": 4e-4, "log_scales": 0.03, "opacities": 0.004, "sh0": 0.03, "shN": 0.02, "rotations": 1e-4}
PACKED = {
    "means": 0.004,
    "log_scales": 0.004,
    "opacities": 0.002,
    "sh0": 0.02,
    "shN": 0.016,
    "rotations": 5e-6,
}
"""Largest differences that the precision of each format explains, of `tame` Gaussians."""

OURS = {
    ".ply": EXACT, ".splat": BYTES, ".spz": SPZ, ".v3.spz": SPZ, ".sog": SOG,
    ".compressed.ply": PACKED, ".ksplat": BYTES | {"shN": 1e-6},
}  # fmt: skip
"""Formats that lexsplat writes and splat-transform reads."""

THEIRS = {
    ".ply": EXACT, ".splat": BYTES, ".spz": SPZ, ".v3.spz": SPZ, ".sog": SOG, "meta.json": SOG,
    ".compressed.ply": PACKED, ".glb": EXACT,
}  # fmt: skip
"""Formats that splat-transform writes."""


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        program() is None,
        reason="needs splat-transform on the path (npm install -g @playcanvas/splat-transform@3.7.0)",
    ),
]


@pytest.fixture(scope="module")
def transform() -> Iterator[Callable[..., None]]:
    """Runs splat-transform with files and options; its palette of SOG is made on a GPU unless told otherwise."""
    with running() as run:
        yield functools.partial(run, "-q", "-g", "cpu", "-w")


def by_plyfile(path: Path) -> Gaussians:
    """A binary 3DGS PLY, read by plyfile."""
    plyfile = pytest.importorskip("plyfile")
    content = plyfile.PlyData.read(path)
    vertex = content["vertex"]

    def columns(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([np.asarray(vertex[name], np.float32) for name in names], 1))

    rest = [p.name for p in vertex.properties if p.name.startswith("f_rest_")]
    shN = (
        columns(*rest).reshape(len(vertex), 3, -1).transpose(1, 2) if rest else torch.zeros(len(vertex), 0, 3)
    )
    return Gaussians(
        columns("x", "y", "z"), columns(*(f"rot_{i}" for i in range(4))), columns(*(f"scale_{i}" for i in range(3))),
        columns("opacity")[:, 0], columns(*(f"f_dc_{i}" for i in range(3)))[:, None], shN,
        "SplatRenderMode: mip" in content.comments,
    )  # fmt: skip


def expected(g: Gaussians, ending: str) -> Gaussians:
    """What should arrive: .splat has no harmonics, and splat-transform takes SPZ for the axes of a PLY.

    Niantic, who defined SPZ, has y up and z backward in the file, and so has lexsplat.
    """
    if ending == ".splat":
        g = Gaussians(g.means, g.quats, g.log_scales, g.opacity_logits, g.sh0, torch.zeros(len(g), 0, 3))
    return half_turned(g, "x") if ending.endswith(".spz") else g


def check(expected: Gaussians, found: Gaussians, limits: dict[str, float]) -> None:
    assert found.sh_degree == expected.sh_degree
    differences = largest_differences(expected, found)
    assert all(differences[name] <= limit for name, limit in limits.items()), differences


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("ending", list(OURS))
def test_splat_transform_reads_what_lexsplat_writes(tmp_path, transform, ending, degree):
    if ending in (".compressed.ply", ".ksplat"):
        pytest.importorskip("gaussforge")
    g = tame(COUNT, degree, antialiased=degree == 2)
    export_gaussians(g, tmp_path / f"g{ending}")
    transform(tmp_path / f"g{ending}", tmp_path / "theirs.ply")
    found = by_plyfile(tmp_path / "theirs.ply")
    check(expected(g, ending), found, OURS[ending])
    if ending not in (".splat", ".ksplat"):  # these have no place for it
        assert found.antialiased == g.antialiased


@pytest.mark.parametrize(
    ("ending", "degree"),
    # meta.json is .sog without its archive
    [(ending, degree) for ending in THEIRS for degree in ((0, 3) if ending == "meta.json" else range(4))],
)
def test_lexsplat_reads_what_splat_transform_writes(tmp_path, transform, ending, degree):
    if ending == ".compressed.ply":
        pytest.importorskip("gaussforge")
    g = tame(FEW if THEIRS[ending] is SOG else COUNT, degree, antialiased=degree == 2)
    g.quats = torch.nn.functional.normalize(g.quats, dim=1)  # its .splat writer takes them as they are
    write_ply(g, tmp_path / "g.ply")
    (tmp_path / "out").mkdir()
    target = tmp_path / "out" / (ending if ending == "meta.json" else f"theirs{ending}")
    transform(*(["--spz-version", "3"] if ending == ".v3.spz" else []), tmp_path / "g.ply", target)
    found = read_splats(target)
    # They share a palette even where each could have an entry: the nearest, but not near.
    limits = THEIRS[ending] | ({"shN": 0.5} if THEIRS[ending] is SOG else {})
    check(expected(g, ending), found, limits)
    if ending not in (".splat", ".glb"):
        assert found.antialiased == g.antialiased


def test_the_glb_of_lexsplat_is_the_one_of_splat_transform_but_for_its_axes(tmp_path, transform):
    """splat-transform reads no glTF; this compares what both wrote, read by lexsplat."""
    g = tame(COUNT, 3)
    write_ply(g, tmp_path / "g.ply")
    transform(tmp_path / "g.ply", tmp_path / "theirs.glb")
    export_gaussians(g, tmp_path / "ours.glb")
    check(read_splats(tmp_path / "ours.glb"), read_splats(tmp_path / "theirs.glb"), EXACT)


def test_both_read_sog_of_version_1_alike(tmp_path, transform):
    write_version_1(tmp_path / "a", 40)
    transform(tmp_path / "a" / "meta.json", tmp_path / "theirs.ply")
    check(by_plyfile(tmp_path / "theirs.ply"), read_splats(tmp_path / "a"), EXACT)


def test_the_finest_level_of_its_streamed_sog_is_read(tmp_path, transform):
    g = tame(FEW, 1)
    write_ply(g, tmp_path / "fine.ply")
    write_ply(g.select(torch.arange(0, FEW, 4)), tmp_path / "coarse.ply")
    (tmp_path / "out").mkdir()
    levels = tmp_path / "fine.ply", "-l", "0", tmp_path / "coarse.ply", "-l", "1"
    transform(*levels, tmp_path / "out" / "lod-meta.json")
    check(g, read_splats(tmp_path / "out"), SOG | {"shN": 0.5})
