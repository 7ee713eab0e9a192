"""The discrete feature space S, and the similarity between features and codes (Eq. 2 to 4)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from lexsplat.codebook.settings import MAX_CODES
from lexsplat.runtime.device import one_thread

if TYPE_CHECKING:
    from lexsplat.features import FeatureMap

BLOCK_ROWS = 16_384
"""Feature vectors handled at a time, to bound the memory of a similarity matrix."""


def similarity(
    clip: Tensor, dino: Tensor | None, code_clip: Tensor, code_dino: Tensor | None, lambda_dino: float
) -> Tensor:
    """Eq. 4: D(F, f_i) = cos<F_CLIP, f_i_CLIP> + lambda_DINO cos<F_DINO, f_i_DINO>.

    Args:
        clip: CLIP parts of M features ``[M, Dc]`` of any length; zero vectors have cosine 0.
        dino: DINO parts ``[M, Dd]``, or None.
        code_clip: CLIP parts of the codes ``[K, Dc]``.
        code_dino: DINO parts of the codes ``[K, Dd]``, or None to compare CLIP parts only.
        lambda_dino: Weight of the DINO cosine.

    Returns:
        Similarities ``[M, K]`` in -(1 + lambda) to 1 + lambda.

    Raises:
        ValueError: If the codes have a DINO part and the features do not.
    """
    scores = functional.normalize(clip, dim=-1) @ functional.normalize(code_clip, dim=-1).T
    if code_dino is None:
        return scores
    if dino is None:
        raise ValueError("the codebook was fitted with DINO features, but the features have none")
    return scores + lambda_dino * (
        functional.normalize(dino, dim=-1) @ functional.normalize(code_dino, dim=-1).T
    )


@dataclass(frozen=True, repr=False)
class Codebook:
    """The discrete language feature space S.

    Args:
        clip: CLIP parts of the codes ``[K, Dc]``, unit length.
        dino: DINO parts ``[K, Dd]``, unit length, or None when DINO is not used.
        lambda_dino: Weight of the DINO cosine in Eq. 4.

    Raises:
        ValueError: If there are more than 256 codes, shapes disagree, or a value is NaN or infinite.
    """

    clip: Tensor
    dino: Tensor | None = None
    lambda_dino: float = 0.5

    def __post_init__(self) -> None:
        if self.clip.ndim != 2 or not 1 <= len(self.clip) <= MAX_CODES:
            raise ValueError(f"codes must be [1 to {MAX_CODES}, D], got {list(self.clip.shape)}")
        if self.dino is not None and (self.dino.ndim != 2 or len(self.dino) != len(self.clip)):
            raise ValueError(f"DINO codes must be [{len(self.clip)}, D], got {list(self.dino.shape)}")
        for part in (self.clip, self.dino):
            if part is not None and not (part.is_floating_point() and bool(torch.isfinite(part).all())):
                raise ValueError("NaN or infinity in the codebook")
        if not math.isfinite(self.lambda_dino):
            raise ValueError(f"lambda_dino must be finite, got {self.lambda_dino}")

    def __repr__(self) -> str:
        dino = "no DINO" if self.dino is None else f"DINO {self.dino.shape[1]}"
        return f"Codebook({self.num_codes} codes, CLIP {self.clip.shape[1]}, {dino})"

    @property
    def num_codes(self) -> int:
        """K."""
        return len(self.clip)

    def similarity(self, clip: Tensor, dino: Tensor | None = None) -> Tensor:
        """Eq. 4 between features ``[M, Dc]``, ``[M, Dd]`` and all codes: ``[M, K]``."""
        return similarity(clip, dino, self.clip, self.dino, self.lambda_dino)

    @torch.no_grad()
    def assign(self, feature_map: FeatureMap) -> NDArray[np.uint8]:
        """Index map M of one view: the most similar code of every cell (Eq. 4), ``[h, w]`` uint8.

        Ties go to the lower index. A cell whose CLIP feature is zero has no meaning and holds 255, unless 255 is a
        code. Computed in blocks of cells.
        """
        height, width = feature_map.clip.shape[:2]
        with one_thread():  # the last bit of a similarity can decide between two codes
            indices = []
            for clip, dino in _blocks(feature_map, self.clip.device, self.dino is not None):
                found = self.similarity(clip, dino).argmax(-1)
                if self.num_codes < MAX_CODES:
                    found[~clip.any(-1)] = MAX_CODES - 1
                indices.append(found)
        return torch.cat(indices).reshape(height, width).to(torch.uint8).cpu().numpy()

    def to(self, device: torch.device | str) -> Codebook:
        """A copy on another device."""
        return Codebook(
            self.clip.to(device), None if self.dino is None else self.dino.to(device), self.lambda_dino
        )

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for safetensors."""
        stored = {"clip": self.clip, "lambda_dino": torch.tensor(self.lambda_dino, dtype=torch.float64)}
        if self.dino is not None:
            stored["dino"] = self.dino
        return stored

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Codebook:
        """The inverse of `tensors`.

        Raises:
            ValueError: If a tensor is missing or has the wrong shape.
        """
        missing = {"clip", "lambda_dino"} - set(tensors)
        if missing:
            raise ValueError(f"codebook lacks {', '.join(sorted(missing))}")
        if tensors["lambda_dino"].numel() != 1:
            raise ValueError(f"lambda_dino must be one number, got {list(tensors['lambda_dino'].shape)}")
        return cls(tensors["clip"], tensors.get("dino"), float(tensors["lambda_dino"]))


def _blocks(feature_map: Any, device: torch.device, use_dino: bool) -> Iterator[tuple[Tensor, Tensor | None]]:
    clip = torch.as_tensor(feature_map.clip).flatten(0, 1)
    dino = (
        torch.as_tensor(feature_map.dino).flatten(0, 1) if use_dino and feature_map.dino is not None else None
    )
    for start in range(0, len(clip), BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
        yield (
            clip[rows].to(device, torch.float32),
            None if dino is None else dino[rows].to(device, torch.float32),
        )
