"""The interface of every language field, whichever method made it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.segments import Segments


@runtime_checkable
class LanguageField(Protocol):
    """The language of N Gaussians: a distribution over the K codes of a codebook for each of them.

    Queries, evaluation and export use nothing else of a field.
    """

    method: str
    codebook: Codebook
    segments: Segments | None
    """The segments of the Gaussians; None for a field without."""

    @property
    def levels(self) -> Sequence[LanguageField]:
        """The language of each level of 2D segments where it is kept apart; () for a field of one level.

        Prompts are answered by the level that fits best (`lexsplat.queries.relevancy`); the field itself is the mean
        of its levels.
        """

    @property
    def uncertainties(self) -> Tensor:
        """u_G of every Gaussian ``[N]`` in 0..1; high where the views disagree."""

    def code_probabilities(self) -> Tensor:
        """Distribution over codes of every Gaussian ``[N, K]``; rows sum to 1, or to 0 where nothing is known."""

    def scores(self, table: Tensor) -> Tensor:
        """Expected table entry of every Gaussian, the sum over codes of p_k table[k]: ``[K, P]`` to ``[N, P]``.

        ``[N, K]`` is never held.
        """

    def sums(self, places: Tensor, shares: Tensor, count: int) -> NDArray[np.float64]:
        """Weighted sums ``[count, K]`` of the distributions, one for each group of Gaussians.

        ``[N, K]`` is never held.

        Args:
            places: Group of each Gaussian ``[N]`` int64, in 0..count-1.
            shares: Its weight ``[N]``.
            count: Number of groups.
        """

    def likeliest_codes(self) -> tuple[Tensor, Tensor]:
        """The most probable code of every Gaussian ``[N]`` int64, and whether it has language ``[N]`` bool."""

    def render_code_probabilities(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """Distribution over codes at every pixel ``[H, W, K]``."""

    def render_scores(self, gaussians: Gaussians, camera: Camera, table: Tensor) -> Tensor:
        """Expected table entry at every pixel, the sum over codes of p_k table[k]: ``[K, P]`` to ``[H, W, P]``."""

    def select(self, index: Tensor) -> LanguageField:
        """The language of the Gaussians given by a mask ``[N]`` or an index ``[M]``, as `Gaussians.select`."""

    def facts(self) -> dict[str, Any]:
        """Facts stored in the build record: how its codes are used."""

    def content(self) -> tuple[Tensor, ...]:
        """The tensors on which `scores` depends, for hashes."""

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for safetensors."""

    def metadata(self) -> dict[str, str]:
        """Everything that is not a tensor, for the header of the safetensors file."""
