"""Language in exported files: a few codes per Gaussian and the codebook that they index.

The two suffice to search without lexsplat. Given the cosine similarities r_k of a text to the codewords, the score
of a Gaussian is the sum of weight times r_code over its codes (docs/formats.md).
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
"""Number of codes stored per Gaussian."""


@dataclass(frozen=True)
class StoredLanguage:
    """The language of Gaussians as stored in a file.

    Args:
        codes: Indices into the codebook ``[N, 4]`` uint8, the most probable first.
        weights: Their probabilities ``[N, 4]`` in 0..1; the remainder to 1 belongs to other codes.
        uncertainties: u ``[N]`` in 0..1.
        codewords: CLIP part of the codebook ``[K, D]``.
        encoder: Name and content hash of the text encoder.
    """

    codes: Tensor
    weights: Tensor
    uncertainties: Tensor
    codewords: Tensor
    encoder: Mapping[str, str]

    def select(self, index: Tensor) -> StoredLanguage:
        """The rows of the given Gaussians; the codebook is shared."""
        return StoredLanguage(
            self.codes[index], self.weights[index], self.uncertainties[index], self.codewords, self.encoder
        )


@torch.no_grad()
def stored_language(field: LanguageField, encoder: Mapping[str, str]) -> StoredLanguage:
    """The `CODES` most probable codes of every Gaussian, on the CPU, computed in blocks."""
    index = torch.arange(len(field.uncertainties), device=field.uncertainties.device)
    codes, weights = [], []
    for block in index.split(1 << 16):
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
    """Additional PLY properties ``[N]`` by name: ``lang_code_i`` uchar, ``lang_weight_i`` and ``lang_u`` float."""
    columns = {f"lang_code_{i}": language.codes[:, i] for i in range(CODES)}
    columns |= {f"lang_weight_{i}": language.weights[:, i] for i in range(CODES)}
    return columns | {"lang_u": language.uncertainties}


def codebook_path(path: Path) -> Path:
    """Path of the codebook of an exported file: ``NAME.codebook.safetensors`` in the same folder."""
    return path.with_name(path.name.removesuffix(path.suffix) + ".codebook.safetensors")


def write_codebook(language: StoredLanguage, path: Path) -> None:
    """Write ``codewords`` ``[K, D]`` as safetensors, with the encoder's name and content hash as metadata."""
    save_tensors({"codewords": language.codewords.contiguous()}, path, language.encoder)


def write_field(field: LanguageField, metadata: Mapping[str, str], path: Path) -> None:
    """Write a complete language field as safetensors, in the layout of scene folders, with additional metadata."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in field.tensors().items()}
    save_tensors(tensors, path, {**field.metadata(), **metadata})


def check_language(gaussians: Gaussians, language: StoredLanguage | None) -> None:
    """Check that the language belongs to the Gaussians.

    Raises:
        ValueError: If the numbers of Gaussians differ.
    """
    if language is not None and len(language.codes) != len(gaussians):
        raise ValueError(f"language for {len(gaussians)} Gaussians expected, got {len(language.codes)}")
