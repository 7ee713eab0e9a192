"""Readers of splat files."""

from __future__ import annotations

import gzip
import io
import json
import shutil
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from support.hostile import mutations as mutate
from support.hostile.registry import READERS, Reader, finite, reader

SplatReader = partial(Reader, told=True)
FEWER = tuple(b"element vertex %d" % count for count in range(4))
FILES = Path(__file__).parents[2] / "data" / "splats"


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
        yield from mutate.binary(content, rng, 120, 300)
        yield from mutate.overwritten(content, rng, 120, start=end)
        for kind, changed in mutate.text(content[:end], rng, 120, 0):
            yield kind, changed + content[end:]
        for count in (5, 10**6, 10**9, 2**63, 10**30):
            yield "counts", content.replace(b"element vertex 4", b"element vertex %d" % count)
        yield from recounted(content, FEWER, b"element vertex 4")
        yield from extended(content, b"\n\0\1")
        yield "foreign", point_cloud()

    return SplatReader(
        lambda folder: write_ply(small_gaussians(), folder / "a.ply"), lambda folder: read_splats(folder / "a.ply"),
        check_gaussians, {"a.ply": headers}, exact=("a.ply",),
    )  # fmt: skip


def recounted_text(content: bytes, count: int) -> bytes:
    """A binary PLY of float properties as text, with another count in its header."""
    head, rows = content.split(b"end_header\n", 1)
    width = head.count(b"property float")
    numbers = np.frombuffer(rows, "<f4").reshape(-1, width)
    lines = "".join(" ".join(f"{number:.6g}" for number in row) + "\n" for row in numbers.tolist())
    head = head.replace(b"binary_little_endian", b"ascii")
    head = head.replace(b"element vertex %d" % len(numbers), b"element vertex %d" % count)
    return head + b"end_header\n" + lines.encode()


def recounted_glb(content: bytes, count: Callable[[int], int]) -> bytes:
    """A GLB in which accessors have other counts, by their index."""
    (length,) = struct.unpack_from("<I", content, 12)
    document, binary = json.loads(content[20 : 20 + length]), content[20 + length :]
    for index, accessor in enumerate(document["accessors"]):
        accessor["count"] = count(index)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return (
        struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(binary), len(text), b"JSON") + text + binary
    )


def recounted(content: bytes, counts: Iterable[bytes], old: bytes) -> Iterator[mutate.Mutation]:
    """The file with other words in place of the one that has its count."""
    assert content.count(old) == 1
    for word in counts:
        yield "recounted", content.replace(old, word)


def extended(content: bytes, more: bytes) -> Iterator[mutate.Mutation]:
    """The file with 1 to 100 further bytes."""
    for length in range(1, 101):
        yield "recounted", content + (more * length)[:length]


def recounted_spz(content: bytes) -> Iterator[bytes]:
    """An SPZ of 4 Gaussians, not compressed as a whole, with other counts or with more data."""
    for count in (0, 1, 2, 3, 5, 8):
        yield content[:8] + struct.pack("<I", count) + content[12:]
    for length in range(1, 101):
        yield content + bytes([length]) * length


def point_cloud() -> bytes:
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    return header.encode() + b"end_header\n" + np.zeros(6, "<f4").tobytes()


@reader
def splat() -> Reader:
    from lexsplat.scenes.formats.reading import read_splats
    from lexsplat.scenes.formats.splat import write_splat

    return SplatReader(
        lambda folder: write_splat(small_gaussians(), folder / "a.splat"),
        lambda folder: read_splats(folder / "a.splat"), check_gaussians,
        {"a.splat": lambda content, rng: mutate.binary(content, rng, 200)},
    )  # fmt: skip


@reader
def splat_text_ply() -> Reader:
    from lexsplat.scenes.formats.ply import write_ply
    from lexsplat.scenes.formats.reading import read_splats

    def make(folder: Path) -> None:
        write_ply(small_gaussians(), folder / "a.ply")
        (folder / "a.ply").write_bytes(recounted_text((folder / "a.ply").read_bytes(), 4))

    def mutations(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.text(content, rng, 300, 300)
        for count in (5, 10**6, 10**9, 2**63, 10**30):
            yield "counts", content.replace(b"element vertex 4", b"element vertex %d" % count)
        yield from recounted(content, FEWER, b"element vertex 4")
        yield from extended(content, b"1 ")

    return SplatReader(
        make, lambda folder: read_splats(folder / "a.ply"), check_gaussians, {"a.ply": mutations}
    )


def spz(version: int) -> Callable[[], Reader]:
    """SPZ, damaged as it is and, of versions 2 and 3, before it is compressed."""

    def make_reader() -> Reader:
        from lexsplat.scenes.formats.reading import read_splats
        from lexsplat.scenes.formats.spz import write_spz

        def make(folder: Path) -> None:
            if version == 2:  # no program here writes it
                shutil.copy(FILES / "minimal-v2.spz", folder / "a.spz")
            else:
                write_spz(small_gaussians(), folder / "a.spz", version=version)

        def mutations(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
            yield from mutate.binary(content, rng, 400, 500)
            raw = gzip.decompress(content) if version < 4 else content
            for changed in recounted_spz(raw):
                yield "recounted", gzip.compress(changed, 1) if version < 4 else changed
            if version < 4:
                for kind, changed in mutate.binary(gzip.decompress(content), rng, 200, 500):
                    # Cut before it is compressed, the file is complete and too short.
                    yield "moved" if kind == "truncated" else kind, gzip.compress(changed, 1)

        return SplatReader(
            make, lambda folder: read_splats(folder / "a.spz"), check_gaussians, {"a.spz": mutations},
            exact=("a.spz",),
        )  # fmt: skip

    return make_reader


READERS["spz_2"] = spz(2)
READERS["spz"] = spz(3)
READERS["spz_4"] = spz(4)


@reader
def sog() -> Reader:
    from lexsplat.scenes.formats.reading import read_splats
    from lexsplat.scenes.formats.sog_writing import write_sog

    def mutations(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.binary(content, rng, 250, 300)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            parts = {name: archive.read(name) for name in archive.namelist()}
        document = json.loads(parts["meta.json"])
        for count in (0, 1, 2, 3, 5, 6):
            changed = io.BytesIO()
            with zipfile.ZipFile(changed, "w") as archive:
                for name, part in (parts | {"meta.json": json.dumps(document | {"count": count})}).items():
                    archive.writestr(name, part)
            yield "recounted", changed.getvalue()

    return SplatReader(
        lambda folder: write_sog(small_gaussians(), folder / "a.sog"),
        lambda folder: read_splats(folder / "a.sog"), check_gaussians,
        {"a.sog": mutations},
    )  # fmt: skip


@reader
def sog_folder() -> Reader:
    """Unbundled: the pictures have no checksums."""
    from lexsplat.scenes.formats.reading import read_splats
    from lexsplat.scenes.formats.sog_writing import write_sog

    def make(folder: Path) -> None:
        write_sog(small_gaussians(), folder / "a.sog")
        with zipfile.ZipFile(folder / "a.sog") as archive:
            archive.extractall(folder)

    def picture(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.binary(content, rng, 12, 16)

    names = ("means_l", "means_u", "quats", "scales", "sh0", "shN_centroids", "shN_labels")
    parts = {f"{name}.webp": picture for name in names}
    parts["meta.json"] = lambda content, rng: mutate.json_file(content, rng, 40, 150)
    return SplatReader(make, read_splats, check_gaussians, parts)


@reader
def sog_version_1() -> Reader:
    from lexsplat.scenes.formats.reading import read_splats
    from support.sog_files import write_version_1

    parts = {
        f"{name}.webp": lambda content, rng: mutate.binary(content, rng, 20, 20)
        for name in ("means_u", "sh0", "shN_centroids", "shN_labels")
    }

    def counts(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.json_file(content, rng, 40, 150)
        document = json.loads(content)
        for count in (*range(10), 11, 12):
            document["means"]["shape"] = [count, 3]
            yield "recounted", json.dumps(document).encode()

    parts["meta.json"] = counts
    return SplatReader(write_version_1, read_splats, check_gaussians, parts)


@reader
def sog_streamed() -> Reader:
    """The tree of levels is damaged, and the names of the files in it."""
    from lexsplat.scenes.formats.reading import read_splats
    from support.sog_files import write_streamed

    fine, coarse = ({"file": number, "offset": 0, "count": count} for number, count in enumerate((10, 5)))
    tree = {"children": [{"lods": {"0": fine, "1": coarse}}, {"lods": {"1": coarse}}]}
    return SplatReader(
        lambda folder: write_streamed(folder, {"0_0": 10, "1_0": 5}, tree),
        read_splats, check_gaussians,
        {"lod-meta.json": lambda content, rng: mutate.json_file(content, rng, 80, 350)},
    )  # fmt: skip


@reader
def glb() -> Reader:
    from lexsplat.scenes.formats.gltf import write_glb
    from lexsplat.scenes.formats.reading import read_splats

    def mutations(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
        yield from mutate.binary(content, rng, 120, 200)
        (length,) = struct.unpack_from("<I", content, 12)
        document, binary = json.loads(content[20 : 20 + length]), content[20 + length :]
        document["asset"]["generator"] = "another"  # so that its nodes count
        for kind, text in mutate.structure(document, rng, 400):
            text += b" " * (-len(text) % 4)
            head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(binary), len(text), b"JSON")
            yield kind, head + text + binary
        for count in range(4):
            yield "recounted", recounted_glb(content, lambda _, count=count: count)
            for number in range(len(document["accessors"])):
                yield "counts", recounted_glb(content, lambda i, n=number, c=count: c if i == n else 4)

    return SplatReader(
        lambda folder: write_glb(small_gaussians(), folder / "a.glb"),
        lambda folder: read_splats(folder / "a.glb"), check_gaussians, {"a.glb": mutations},
        exact=("a.glb",),
    )  # fmt: skip


@reader
def gltf() -> Reader:
    """glTF as text: its buffer is a file beside it, which is damaged too."""
    from lexsplat.scenes.formats.gltf import write_glb
    from lexsplat.scenes.formats.reading import read_splats

    def make(folder: Path) -> None:
        write_glb(small_gaussians(), folder / "a.glb")
        content = (folder / "a.glb").read_bytes()
        (length,) = struct.unpack_from("<I", content, 12)
        document = json.loads(content[20 : 20 + length])
        document["buffers"][0]["uri"] = "a.bin"
        document["asset"]["generator"] = "another"
        (folder / "a.gltf").write_text(json.dumps(document))
        (folder / "a.bin").write_bytes(content[28 + length :])
        (folder / "a.glb").unlink()

    parts = {
        "a.gltf": lambda content, rng: mutate.json_file(content, rng, 60, 250),
        "a.bin": lambda content, rng: mutate.binary(content, rng, 60, 100),
    }
    return SplatReader(make, lambda folder: read_splats(folder / "a.gltf"), check_gaussians, parts)


def compressed(ending: str, count: int) -> Callable[[], Reader]:
    def make() -> Reader:
        from lexsplat.scenes.formats.compressed import COMPRESSED, write_compressed
        from lexsplat.scenes.formats.reading import read_splats

        def mutations(content: bytes, rng: np.random.Generator) -> Iterator[mutate.Mutation]:
            yield from mutate.binary(content, rng, count, 40)
            if ending == ".ksplat":
                for fewer in range(4):
                    number = struct.pack("<I", fewer)
                    header = content[:16] + number + content[20:]
                    yield "recounted", header
                    yield "recounted", header[:4096] + number * 2 + header[4104:]
            else:
                yield from recounted(content, FEWER, b"element vertex 4")
            yield "recounted", content + bytes(50)

        return SplatReader(
            lambda folder: write_compressed(small_gaussians(), folder / f"a{ending}", COMPRESSED[ending]),
            lambda folder: read_splats(folder / f"a{ending}"), check_gaussians,
            {f"a{ending}": mutations},
        )  # fmt: skip

    return make


# Each input starts a process, so there are few.
READERS["compressed_ply"] = compressed(".compressed.ply", 20)


READERS["ksplat"] = compressed(".ksplat", 20)
