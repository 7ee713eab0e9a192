"""A library of many scenes: time of the first stage of a search, bytes of a scene, and recall of an index server.

    python benchmarks/library.py [--scenes 1000 10000] [--codes 256] [--dimensions 512] [--json FILE]
    python benchmarks/library.py --scenes 10 --copies
    python benchmarks/library.py --index http://127.0.0.1:8000 --scenes 2000 --codes 32 --dimensions 128

Scenes are made by mixing codes of the bundled scene: each code is one of its codes, turned a little toward another.
Dimensions beyond the 128 of the bundled encoder are noise; time and bytes do not depend on the content. Segments,
objects and pictures are those of the bundled scene, with the mixed codes (with 256 codes).

`open` reads and checks all entries once. `bounds` is the median over texts that were embedded before, of comparing
all scenes (stage 1). `answer` is that of a whole search for ten scenes: presence, count, places, sizes and a picture
of each hit. With `--copies`, scenes are copies of the bundled scene, and `confirmed` is the same by opening them.
`recall` is the share of the ten scenes of the highest bounds that the server proposes.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import shutil
import statistics
import tempfile
import time
import unittest.mock
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from records import argument_parser, write_record

from lexsplat.queries.everyday import EverydayScale, everyday_words
from lexsplat.queries.phrases import Thing
from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.runtime.files import write_json
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.scenes.folder import BUNDLED_SCENE
from lexsplat.scenes.library import Library
from lexsplat.scenes.library.contents import Contents
from lexsplat.scenes.library.entries import Codes, write_entry
from lexsplat.scenes.library.records import Record, stamp_of
from lexsplat.scenes.library.searching import candidates
from lexsplat.scenes.scene import open_scene

TEXTS = default_vocabulary("bundled")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[1000])
    parser.add_argument("--codes", type=int, default=256)
    parser.add_argument("--dimensions", type=int, default=512)
    parser.add_argument(
        "--mixed", type=int, default=2000, help="scenes whose codes are mixed; others have the same codes"
    )
    parser.add_argument("--texts", type=int, default=len(TEXTS), help="number of texts that are asked")
    parser.add_argument(
        "--copies", action="store_true", help="copies of the bundled scene, which can be opened"
    )
    parser.add_argument("--index", metavar="URL")
    parser.add_argument("--folder", type=Path, help="where the libraries are written (a temporary folder)")
    options = parser.parse_args()
    del TEXTS[options.texts :]
    rows = []
    for count in options.scenes:
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            root = Path(folder) / "library"
            library = (
                copied_library(root, count)
                if options.copies
                else mixed_library(root, count, options.codes, options.dimensions, options.mixed)
            )
            rows.append({"scenes": count, **measured(library)})
            if options.copies:
                rows[-1] |= timed("confirmed", functools.partial(answered, library, confirm=True))
            if options.index:
                served = Library(library.root, index=options.index)
                served.encode = library.encode  # type: ignore[method-assign]
                rows[-1] |= compared(library, served)
        print(", ".join(f"{name} {value:g}" for name, value in rows[-1].items()), flush=True)
    write_record(options.json, rows, codes=options.codes, dimensions=options.dimensions, threads=1)


def mixed_library(root: Path, count: int, codes: int, dimensions: int, mixed: int = 2000) -> Library:
    """A library of scenes that have codes but no folder; those beyond ``mixed`` are as earlier ones."""
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
    whole = Contents.of(scene) if codes == len(known) else None
    stages = {name: {"fingerprint": name, "seconds": 0.0} for name in ("reconstruct", "features", "language")}
    made: list[Record] = []
    for number in range(count):
        folder = root.parent / f"s{number}"
        with unittest.mock.patch("os.fsync"):  # thousands of files, which nobody will miss
            write_json(folder / "scene.json", {"format_version": 1, "stages": stages})
            if number >= mixed:
                copy_entry(library.stage, made[number % mixed], f"s{number}", folder)
                continue
            places, units = mixed_codes(known, codes, dimensions, rng)
            scale = EverydayScale.of(units, words)
            shares = torch.from_numpy(rng.dirichlet(np.ones(codes))).float().clamp_min(1e-9)
            contents = whole and with_codes(whole, torch.from_numpy(places).argsort(), scale)
            entry = Codes.made(units, words, scale, shares)
            made.append(Record(
                f"s{number}", str(folder), "", fingerprint(stages), "mixed", "mixed", entry.content(), codes, 0, 0,
                "" if contents is None else contents.content(), entry.checksum(), stamp_of(folder),
            ))  # fmt: skip
            write_entry(root, made[-1], entry, contents)
    return library


def copy_entry(stage: Path, first: Record, name: str, folder: Path) -> None:
    """Enter a scene with the codes of another one; its codes are a file of its own, which a search has to read."""
    record = dataclasses.replace(first, name=name, path=str(folder), stamp=stamp_of(folder))
    shutil.copyfile(stage / first.codes_file, stage / record.codes_file)
    if record.contents:  # a link: only those of hits are read
        os.link(stage / first.contents_file, stage / record.contents_file)
    write_json(stage / f"{name}.json", record.sealed())


def with_codes(contents: Contents, numbers: torch.Tensor, scale: EverydayScale) -> Contents:
    """The same segments with code k called ``numbers[k]``."""
    places = torch.zeros_like(contents.places)
    places[:, numbers] = contents.places
    return dataclasses.replace(
        contents,
        columns=numbers[contents.columns.long()].short(),
        places=places,
        mean=scale.mean,
        best=scale.best,
        best_colored=scale.best.clone(),
        peak=torch.tensor([scale.peak]),
    )


def mixed_codes(
    known: torch.Tensor, codes: int, dimensions: int, rng: np.random.Generator
) -> tuple[np.ndarray, torch.Tensor]:
    """Codes ``[codes, dimensions]`` of unit length, each a known one turned toward another, and which it was."""
    first, second = (rng.choice(len(known), codes, replace=codes > len(known)) for _ in range(2))
    turned = known[first] + torch.from_numpy(rng.uniform(0, 0.5, (codes, 1))).float() * known[second]
    noise = torch.from_numpy(rng.normal(size=(codes, max(0, dimensions - known.shape[1])))).float()
    mixed = torch.cat([turned, 0.1 * noise / max(1, noise.shape[1]) ** 0.5], dim=1)[:, :dimensions]
    return first, torch.nn.functional.normalize(mixed, dim=1)


def copied_library(root: Path, count: int) -> Library:
    """A library of copies of the bundled scene."""
    library = Library.create(root)
    for number in range(count):
        folder = shutil.copytree(BUNDLED_SCENE, root.parent / f"copy{number}")
        start = time.process_time()
        library.add(folder)
    print(f"added the last one in {time.process_time() - start:.2f} s of CPU time")
    return library


def answered(library: Library, text: str, confirm: bool = False) -> int:
    """Search, and make all that is shown of the hits; their number."""
    hits = library.search(f'"{text}"', confirm=confirm).hits
    for hit in hits:
        hit.to_dict()
        hit.picture()
    return len(hits)


def timed(name: str, search: Callable[[str], Any]) -> dict[str, float]:
    """Medians and the longest time over texts, in milliseconds."""
    wall, cpu = [], []
    for text in TEXTS:
        start, spent = time.perf_counter(), time.process_time()
        search(text)
        wall.append(1e3 * (time.perf_counter() - start))
        cpu.append(1e3 * (time.process_time() - spent))
    return {
        f"{name}_ms": round(statistics.median(wall), 1),
        f"{name}_cpu_ms": round(statistics.median(cpu), 1),
        f"{name}_longest_cpu_ms": round(max(cpu), 1),
    }


def measured(library: Library) -> dict[str, Any]:
    """Times in seconds and bytes."""
    start, spent = time.perf_counter(), time.process_time()
    records = library.records()
    for record in records:
        library.codes(record)
    opened, opened_cpu = time.perf_counter() - start, time.process_time() - spent
    hits = [answered(library, text) for text in TEXTS]  # embeds the texts, and reads what hits show
    bounds = timed("bounds", lambda text: candidates(library, Thing(text, exact=True)))
    answers = timed("answer", lambda text: answered(library, text))
    files = [path.stat().st_size for path in library.stage.iterdir()]
    return {
        "bytes_per_scene": round(sum(files) / len(records)),
        "open_s": round(opened, 3),
        "open_cpu_s": round(opened_cpu, 3),
        "hits": statistics.mean(hits),
        **bounds,
        **answers,
    }


def compared(library: Library, served: Library) -> dict[str, Any]:
    """Rate of uploading, time of a search through the server, and its recall at ten."""
    start = time.perf_counter()
    with served.changing():
        entries = [(record, codes) for record in served.records() if (codes := served.codes(record))]
        served.server.repair(entries, served.stage)
    seconds = time.perf_counter() - start
    wall, found = [], []
    for text in TEXTS:
        exact = [name for name, _ in candidates(library, Thing(text)).ranked[:10]]
        start = time.perf_counter()
        proposed = [name for name, _ in candidates(served, Thing(text)).ranked[:10]]
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
