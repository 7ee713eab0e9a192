"""Entries of a library: the files that it keeps for each scene.

::

    library.json                       format_version and the library's own name on a server
    scenes/NAME.json                   the record: where the scene is, which version of it, its encoder
    scenes/NAME.CONTENT.safetensors    the codes, named after their hash, and the record again
    scenes/NAME.CONTENTS.objects.safetensors    segments, objects and images, of scenes with segments
    texts/                             embeddings of the texts that were asked

The record is written last and replaced as a whole: a scene is in the library when its record is. Codes of earlier
versions of a scene were left by a killed writer; the next one removes them. Codes without any record stay
(`lexsplat.scenes.library.mending`).
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import os
import zlib
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.queries.everyday import OFFSET, EverydayScale, everyday_words
from lexsplat.runtime.device import one_thread
from lexsplat.runtime.files import write_tensors
from lexsplat.runtime.fingerprints import digest
from lexsplat.scenes.library.contents import Contents
from lexsplat.scenes.library.records import (
    BUNDLED,
    Record,
    damaged,
    mapped_tensors,
    stamp_of,
    state_of,
    write_record,
)
from lexsplat.scenes.scene import Scene

_RIDGE = 0.1
"""Weight of the squared length of the estimate of the offset; the everyday words have about a thousand terms."""
_GAUSSIANS = 1 << 16  # Gaussians per block, so that [N, K] is never held


@dataclasses.dataclass(frozen=True, eq=False)
class Codes:
    """Codes of a scene, which decide whether it may hold a text (`lexsplat.queries.everyday`).

    Args:
        units: Codewords of unit length ``[K, D]``, float16.
        shared: Their cosines with the mean of the everyday words ``[K]``.
        limits: Square root of the best height of an everyday word at each code times that of the scene ``[K]``.
        shares: Share of the visible weight that each code stands for ``[K]``; 0 for codes that nothing shows.
        offset: For index servers: a linear estimate of the offset of a text t, offset[:D].t - offset[D], fitted to
            the everyday words ``[D + 1]``.
    """

    units: Tensor
    shared: Tensor
    limits: Tensor
    shares: Tensor
    offset: Tensor

    @functools.cached_property
    def full(self) -> NDArray[np.float32]:
        """Heights at the strength 1 ``[K]``; infinite for codes that nothing shows."""
        return torch.where(self.shares > 0, self.limits, math.inf).numpy()

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def content(self) -> str:
        """A hash of all values."""
        return digest(bytes(tensor.contiguous().numpy().data) for tensor in self.tensors().values())

    def checksum(self) -> str:
        """CRC-32 of all values, eight hex digits: it detects damage faster than `content`."""
        found = 0
        for tensor in self.tensors().values():
            found = zlib.crc32(tensor.contiguous().numpy().data, found)
        return f"{found:08x}"

    @classmethod
    @torch.no_grad()
    def of(cls, scene: Scene) -> Codes:
        """The codes of a scene.

        Raises:
            ModelError: If the everyday words are new to its folder and its encoder cannot be loaded.
        """
        field, count = scene.field, len(scene.field.codebook.clip)
        masses = field.segments.masses if field.segments else scene.gaussians.opacities
        weights, seen = torch.zeros(count, dtype=torch.float64), torch.zeros(count, dtype=torch.bool)
        for rows in torch.arange(len(masses), device=masses.device).split(_GAUSSIANS):
            probabilities = field.select(rows).code_probabilities().cpu()
            weights += masses[rows].cpu().double() @ probabilities.double()
            # Even where next to nothing is visible: the bound holds for any place.
            seen |= (probabilities > 0).any(0)
        shares = (weights / weights.sum().clamp_min(1e-12)).clamp_min(1e-9) * seen
        words = scene.embed(everyday_words()).cpu()
        return cls.made(field.codebook.clip.cpu(), words, scene.everyday_scale, shares.float())

    @classmethod
    @one_thread()
    def made(cls, codewords: Tensor, words: Tensor, scale: EverydayScale, shares: Tensor) -> Codes:
        """The codes of a codebook ``[K, D]``, from unit embeddings of the everyday words ``[W, D]``."""
        units, mean = torch.nn.functional.normalize(codewords.float(), dim=-1), scale.mean.cpu()
        centered = words - mean
        offsets = (units @ centered.T).quantile(OFFSET, dim=0)
        ridge = _RIDGE * torch.eye(units.shape[1])
        fitted = torch.linalg.solve(centered.T @ centered + ridge, centered.T @ offsets)
        limits = (scale.best.cpu() * scale.peak).sqrt()
        return cls(units.half(), units @ mean, limits, shares, torch.cat([fitted, (fitted @ mean)[None]]))


def record_of(
    root: Path, name: str, path: str, scene: Scene, codes: Codes, contents: Contents | None
) -> Record:
    """The record of an open scene.

    Args:
        root: The library.
        name: The scene's name in it.
        path: The scene's folder, absolute, or `BUNDLED`.
        scene: The scene, from a folder.
        codes: Its codes.
        contents: Its segments and objects.
    """
    if scene.folder is None:
        raise ValueError("a scene of a library has a folder")
    return Record(
        name=name,
        path=path,
        beside="" if path == BUNDLED else os.path.relpath(path, root.resolve()),
        state=state_of(scene.folder),
        encoder=scene.encoder_identity().get("encoder_hash", ""),
        clip=scene.clip,
        content=codes.content(),
        codes=len(codes.units),
        gaussians=len(scene.gaussians),
        views=len(scene.views),
        contents="" if contents is None else contents.content(),
        checksum=codes.checksum(),
        stamp="" if path == BUNDLED else stamp_of(scene.folder.root),
    )


def write_entry(root: Path, record: Record, codes: Codes, contents: Contents | None) -> None:
    """Write or replace the entry of a scene; the record comes last.

    Raises:
        OSError: If it cannot be written; the earlier entry stays.
    """
    stage = root / "scenes"
    if contents is not None:
        write_tensors(stage / record.contents_file, contents.tensors(), {})
    write_tensors(stage / record.codes_file, codes.tensors(), {"record": json.dumps(record.sealed())})
    write_record(record, stage / f"{record.name}.json")


def map_codes(path: Path, record: Record, by_hash: bool = False) -> Codes:
    """The codes of a scene, mapped from their file.

    Args:
        path: The file.
        record: The record of the scene.
        by_hash: Compare the hash of the values, not their checksum.

    Raises:
        FileFormatError: If the file is missing, or its content is not that of the record.
    """
    expected, names = "the codes that were written", {field.name for field in dataclasses.fields(Codes)}
    tensors = mapped_tensors(path, expected)
    if tensors.keys() != names:
        raise damaged(path, expected, f"{len(tensors)} other tensors")
    codes = Codes(**tensors)
    if by_hash or not record.checksum:
        what, sound = "hash", codes.content() == record.content
    else:
        what, sound = "checksum", codes.checksum() == record.checksum
    if not sound or len(codes.units) != record.codes:
        raise damaged(path, expected, f"damaged content (the {what} differs)")
    return codes
