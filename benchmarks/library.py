"""A library of many scenes: time of the first stage of a search, bytes of a scene, and recall of an index server.

    python benchmarks/library.py [--scenes 1000 10000] [--codes 256] [--dimensions 512] [--json FILE]
    python benchmarks/library.py --index http://127.0.0.1:8000 --scenes 2000 --codes 32 --dimensions 128

Scenes are made by mixing codes of the bundled scene: each code is one of its codes, turned a little toward another.
Dimensions beyond the 128 of the bundled encoder are noise; time and bytes do not depend on the content. `open` reads
and checks all entries once; `search` is the median over texts that were embedded before, of comparing all scenes.
`recall` is the share of the ten scenes of the highest bounds that the server proposes.
"""

from __future__ import annotations

import statistics
import tempfile
import time
import unittest.mock
from pathlib import Path
from typing import Any

import numpy as np
import torch
from records import argument_parser, write_record

from lexsplat.queries.everyday import EverydayScale, everyday_words
from lexsplat.queries.phrases import Thing
from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.scenes.library import Library
from lexsplat.scenes.library.entries import Codes, Record, write_entry
from lexsplat.scenes.library.searching import candidates
from lexsplat.scenes.scene import open_scene

TEXTS = default_vocabulary("bundled")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[1000])
    parser.add_argument("--codes", type=int, default=256)
    parser.add_argument("--dimensions", type=int, default=512)
    parser.add_argument(
        "--mixed", type=int, default=2000, help="scenes whose codes are mixed; others permute them"
    )
    parser.add_argument("--index", metavar="URL")
    parser.add_argument("--folder", type=Path, help="where the libraries are written (a temporary folder)")
    options = parser.parse_args()
    rows = []
    for count in options.scenes:
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            library = mixed_library(
                Path(folder) / "library", count, options.codes, options.dimensions, options.mixed
            )
            rows.append({"scenes": count, **measured(library)})
            if options.index:
                served = Library(library.root, index=options.index)
                served.encode = library.encode  # type: ignore[method-assign]
                rows[-1] |= compared(library, served)
        print(", ".join(f"{name} {value:g}" for name, value in rows[-1].items()), flush=True)
    write_record(options.json, rows, codes=options.codes, dimensions=options.dimensions, threads=1)


def mixed_library(root: Path, count: int, codes: int, dimensions: int, mixed: int = 2000) -> Library:
    """A library of scenes that have codes but no folder; those beyond ``mixed`` are permutations of earlier ones."""
    scene, rng = open_scene("demo"), np.random.default_rng(0)
    library = Library.create(root)
    padding = torch.nn.functional.normalize(
        torch.from_numpy(rng.normal(size=(4096, dimensions))).float(), dim=1
    )

    def encode(_: str, __: str, texts: list[str]) -> torch.Tensor:
        rows = padding[[int(fingerprint(text)[:8], 16) % len(padding) for text in texts]]
        return torch.cat([scene.embed(texts), 0.1 * rows], dim=1)[:, :dimensions]

    library.encode = encode  # type: ignore[method-assign]
    words = encode("", "", list(everyday_words()))
    known = torch.nn.functional.normalize(scene.field.codebook.clip, dim=1)
    made: list[Codes] = []
    for number in range(count):
        if number < mixed:
            units = mixed_codes(known, codes, dimensions, rng)
            scale = EverydayScale.of(units, words)
            shares = torch.from_numpy(rng.dirichlet(np.ones(codes))).float().clamp_min(1e-9)
            made.append(Codes.made(units, words, scale, shares))
        entry = made[number % mixed]
        order = torch.from_numpy(rng.permutation(codes))
        shuffled = (tensor[order] for tensor in (entry.units, entry.shared, entry.limits, entry.shares))
        entry = Codes(*shuffled, entry.offset)
        record = Record(
            f"s{number}", f"/nowhere/s{number}", "", "0", "mixed", "mixed", entry.content(), codes, 0, 0
        )
        with unittest.mock.patch("os.fsync"):  # thousands of files, which nobody will miss
            write_entry(root, record, entry, None)
    return library


def mixed_codes(known: torch.Tensor, codes: int, dimensions: int, rng: np.random.Generator) -> torch.Tensor:
    """Codes ``[codes, dimensions]`` of unit length, each a known one turned toward another."""
    first, second = (known[rng.choice(len(known), codes, replace=codes > len(known))] for _ in range(2))
    turned = first + torch.from_numpy(rng.uniform(0, 0.5, (codes, 1))).float() * second
    noise = torch.from_numpy(rng.normal(size=(codes, max(0, dimensions - known.shape[1])))).float()
    mixed = torch.cat([turned, 0.1 * noise / max(1, noise.shape[1]) ** 0.5], dim=1)[:, :dimensions]
    return torch.nn.functional.normalize(mixed, dim=1)


def measured(library: Library) -> dict[str, Any]:
    """Times in seconds and bytes."""
    start = time.perf_counter()
    records = library.records()
    for record in records:
        library.codes(record)
    opened = time.perf_counter() - start
    wall, cpu = [], []
    for text in TEXTS:
        start, spent = time.perf_counter(), time.process_time()
        candidates(library, Thing(text, exact=True), {})
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - spent)
    files = [path.stat().st_size for path in library.stage.iterdir()]
    return {
        "bytes_per_scene": round(sum(files) / len(records)),
        "open_s": round(opened, 3),
        "search_ms": round(1e3 * statistics.median(wall), 1),
        "search_cpu_ms": round(1e3 * statistics.median(cpu), 1),
    }


def compared(library: Library, served: Library) -> dict[str, Any]:
    """Rate of uploading, time of a search through the server, and its recall at ten."""
    start = time.perf_counter()
    with served._changing():
        entries = [(record, codes) for record in served.records() if (codes := served.codes(record))]
        served.server.repair(entries, served.stage)
    seconds = time.perf_counter() - start
    wall, found = [], []
    for text in TEXTS:
        exact = [name for name, _ in candidates(library, Thing(text), {})[:10]]
        start = time.perf_counter()
        proposed = [name for name, _ in candidates(served, Thing(text), {})[:10]]
        wall.append(time.perf_counter() - start)
        found += [name in proposed for name in exact]
    return {
        "uploaded_codes_per_s": round(sum(len(codes.units) for _, codes in entries) / seconds),
        "served_ms": round(1e3 * statistics.median(wall), 1),
        "compared": len(found),
        "recall_at_10": round(float(np.mean(found)), 4),
    }


if __name__ == "__main__":
    main()
