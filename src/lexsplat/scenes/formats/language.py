"""Language in files of other programs: a few codes for each Gaussian, and the codebook they point into.

Whoever has both can search without lexsplat: with the text's cosines r_k to the codewords, the score of a
Gaussian is the sum of weight times r_code (docs/formats.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.runtime.files import save_tensors

CODES = 4
"""Codes of each Gaussian that go into files."""


@dataclass(frozen=True)
class StoredLanguage:
    """What a file says about the language of Gaussians.

    Args:
        codes: Indices into the codebook ``[N, 4]`` uint8, the likeliest first.
        weights: Their probabilities ``[N, 4]`` in 0..1; what is missing to 1 belongs to other codes.
        uncertainties: u ``[N]`` in 0..1.
        codewords: CLIP part of the codebook ``[K, D]``.
        encoder: The encoder of the texts: its name and content hash.
    """

    codes: Tensor
    weights: Tensor
    uncertainties: Tensor
    codewords: Tensor
    encoder: Mapping[str, str]

    def select(self, index: Tensor) -> StoredLanguage:
        """The rows of some Gaussians."""
        return StoredLanguage(
            self.codes[index], self.weights[index], self.uncertainties[index], self.codewords, self.encoder
        )


@torch.no_grad()
def stored_language(field: LanguageField, encoder: Mapping[str, str], rows: int = 1 << 16) -> StoredLanguage:
    """The likeliest `CODES` codes of every Gaussian, on the CPU."""
    index = torch.arange(len(field.uncertainties), device=field.uncertainties.device)
    codes, weights = [], []
    for block in index.split(rows):
        probabilities = field.select(block).code_probabilities()
        kept = min(CODES, probabilities.shape[1])
        best, where = probabilities.topk(kept, dim=1)
        pad = (0, CODES - kept)
        weights.append(torch.nn.functional.pad(best, pad).cpu())
        codes.append(torch.nn.functional.pad(where, pad).to(torch.uint8).cpu())
    empty = torch.zeros(0, CODES)
    return StoredLanguage(
        torch.cat(codes) if codes else empty.to(torch.uint8),
        torch.cat(weights) if weights else empty,
        field.uncertainties.detach().float().cpu(),
        field.codebook.clip.detach().float().cpu(),
        dict(encoder),
    )


def ply_columns(language: StoredLanguage) -> dict[str, Tensor]:
    """Further PLY properties by name, ``[N]`` each: ``lang_code_i`` uchar, ``lang_weight_i`` and ``lang_u`` float."""
    columns = {f"lang_code_{i}": language.codes[:, i] for i in range(CODES)}
    columns |= {f"lang_weight_{i}": language.weights[:, i] for i in range(CODES)}
    return columns | {"lang_u": language.uncertainties}


def codebook_path(path: Path) -> Path:
    """Where the codebook of an exported file goes: ``NAME.codebook.safetensors`` beside it."""
    return path.with_name(path.name.removesuffix(path.suffix) + ".codebook.safetensors")


def write_codebook(language: StoredLanguage, path: Path) -> None:
    """Write ``codewords`` ``[K, D]`` as safetensors, with the encoder's name and hash as metadata."""
    save_tensors({"codewords": language.codewords.contiguous()}, path, language.encoder)


def write_field(field: LanguageField, metadata: Mapping[str, str], path: Path) -> None:
    """Write a whole language field as safetensors, as scene folders hold it, with further metadata."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in field.tensors().items()}
    save_tensors(tensors, path, {**field.metadata(), **metadata})


def check_language(gaussians: Gaussians, language: StoredLanguage | None) -> None:
    """Refuse language of another number of Gaussians.

    Raises:
        ValueError: If the numbers differ.
    """
    if language is not None and len(language.codes) != len(gaussians):
        raise ValueError(f"language of {len(language.codes)} Gaussians does not fit {len(gaussians)}")
