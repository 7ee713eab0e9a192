"""Readers of splat files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from support.hostile import mutations as mutate
from support.hostile.registry import READERS, Reader, finite, reader


def small_gaussians(count: int = 4, degree: int = 1) -> Any:
    import torch

    from lexsplat.geometry.gaussians import gaussians_from_points

    rng = np.random.default_rng(3)
    made = gaussians_from_points(
        rng.normal(size=(count, 3)) * 0.4, rng.random((count, 3)), sh_degree=degree, opacity=0.7
    )
    return replace(made, shN=torch.from_numpy(rng.normal(size=tuple(made.shN.shape)) * 0.1).float())


def check_gaussians(gaussians: Any) -> None:
    """Finite Gaussians that render to a finite image."""
    import torch

    from lexsplat.geometry.cameras import look_at
    from lexsplat.rendering import render

    finite(*gaussians.tensors().values())
    finite(gaussians.scales, gaussians.opacities)
    assert len(gaussians) <= 10_000, "more Gaussians than the file can hold"
    camera = look_at([0.0, -3.0, 0.5], [0, 0, 0], [0, 0, 1], 12, 9, 0.8)
    with torch.no_grad():
        image = render(gaussians, camera).image
    finite(image)


@reader
def splat_ply() -> Reader:
    from lexsplat.scenes.formats.ply import write_ply
    from lexsplat.scenes.formats.reading import read_splats

    def headers(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        end = content.index(b"end_header\n") + 11
        yield from mutate.binary(content, rng, 250, 500)
        yield from mutate.overwritten(content, rng, 250, start=end)
        for kind, changed in mutate.text(content[:end], rng, 200, 0):
            yield kind, changed + content[end:]
        for count in (5, 10**6, 10**9, 2**63, 10**30):
            yield "counts", content.replace(b"element vertex 4", b"element vertex %d" % count)
        yield "foreign", point_cloud()

    return Reader(
        lambda folder: write_ply(small_gaussians(), folder / "a.ply"), lambda folder: read_splats(folder / "a.ply"),
        check_gaussians, {"a.ply": headers}, exact=("a.ply",),
    )  # fmt: skip


def point_cloud() -> bytes:
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    return header.encode() + b"end_header\n" + np.zeros(6, "<f4").tobytes()


@reader
def splat() -> Reader:
    from lexsplat.scenes.formats.reading import read_splats
    from lexsplat.scenes.formats.splat import write_splat

    return Reader(
        lambda folder: write_splat(small_gaussians(), folder / "a.splat"),
        lambda folder: read_splats(folder / "a.splat"), check_gaussians,
        {"a.splat": lambda content, rng: mutate.binary(content, rng, 200)},
    )  # fmt: skip


def compressed(ending: str, count: int) -> Callable[[], Reader]:
    def make() -> Reader:
        from lexsplat.scenes.formats.compressed import COMPRESSED, write_compressed
        from lexsplat.scenes.formats.reading import read_splats

        return Reader(
            lambda folder: write_compressed(small_gaussians(), folder / f"a{ending}", COMPRESSED[ending]),
            lambda folder: read_splats(folder / f"a{ending}"), check_gaussians,
            {f"a{ending}": lambda content, rng: mutate.binary(content, rng, count, 150)},
        )  # fmt: skip

    return make


READERS["spz"] = compressed(".spz", 90)


READERS["compressed_ply"] = compressed(".compressed.ply", 90)


READERS["ksplat"] = compressed(".ksplat", 90)
