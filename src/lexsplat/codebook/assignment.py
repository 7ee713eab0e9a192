"""Index maps of views, and statistics of the codes in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lexsplat.codebook.settings import MAX_CODES
from lexsplat.codebook.space import Codebook
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.features import FeatureMap


def assign_code_maps(
    feature_maps: Mapping[str, FeatureMap],
    codebook: Codebook,
    names: Iterable[str] | None = None,
    *,
    listener: Listener = silent,
) -> dict[str, NDArray[np.uint8]]:
    """An index map ``[h, w]`` uint8 for every named view (default: all), in one pass."""
    chosen = list(feature_maps if names is None else names)
    code_maps = {}
    listener(Event("assign", 0, len(chosen)))
    for done, name in enumerate(chosen, start=1):
        code_maps[name] = codebook.assign(feature_maps[name])
        listener(Event("assign", done, len(chosen)))
    return code_maps


@dataclass(frozen=True)
class CodeUsage:
    """How index maps use the codes.

    Args:
        counts: Cells per code ``[K]``.
        used: Codes with at least one cell.
        perplexity: exp of the entropy of the counts, 1 to K: the effective number of codes.
    """

    counts: NDArray[np.int64]
    used: int
    perplexity: float

    def facts(self) -> dict[str, float]:
        """For the record of a stage."""
        return {"codes": len(self.counts), "codes_used": self.used, "perplexity": round(self.perplexity, 2)}


def code_usage(code_maps: Iterable[NDArray[np.uint8]], num_codes: int) -> CodeUsage:
    """Use of the codes over index maps ``[h, w]``; indices of K and above (ignored cells) do not count."""
    counts = np.zeros(num_codes, dtype=np.int64)
    for code_map in code_maps:
        counts += np.bincount(np.asarray(code_map).ravel(), minlength=MAX_CODES)[:num_codes]
    share = counts[counts > 0] / max(counts.sum(), 1)
    perplexity = float(np.exp(-(share * np.log(share)).sum())) if len(share) else 0.0
    return CodeUsage(counts, int((counts > 0).sum()), perplexity)
