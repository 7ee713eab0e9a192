"""The interface of a language field, whichever method made it."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians


@runtime_checkable
class LanguageField(Protocol):
    """Language on N Gaussians, as queries, evaluation and export use it.

    Attributes:
        method: Name of the method that made the field.
        codebook: The discrete feature space S with K codes.
    """

    method: str
    codebook: Codebook

    @property
    def uncertainties(self) -> Tensor:
        """u_G of every Gaussian ``[N]`` in 0..1; high where the views disagree."""
        ...

    def code_probabilities(self) -> Tensor:
        """Distribution over codes of every Gaussian ``[N, K]``; rows sum to 1, or to 0 for unseen Gaussians."""
        ...

    def render_code_probabilities(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """Distribution over codes at every pixel ``[H, W, K]``."""
        ...

    def scores(self, table: Tensor) -> Tensor:
        """Sum over codes of p_k table[k] for every Gaussian: ``[K, P]`` to ``[N, P]``."""
        ...

    def render_scores(self, gaussians: Gaussians, camera: Camera, table: Tensor) -> Tensor:
        """Sum over codes of p_k table[k] at every pixel: ``[K, P]`` to ``[H, W, P]``."""
        ...

    def select(self, index: Tensor) -> LanguageField:
        """The field of some Gaussians, by mask ``[N]`` or indices ``[M]``, in the order of `Gaussians.select`."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for safetensors."""
        ...

    def metadata(self) -> dict[str, str]:
        """Everything that is not a tensor, for the header of the safetensors file."""
        ...
