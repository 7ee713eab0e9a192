"""What queries, evaluation and export need of a language field, whatever made it."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians


@runtime_checkable
class LanguageField(Protocol):
    """What queries, evaluation and export need of a field, whatever made it."""

    method: str
    codebook: Codebook

    @property
    def uncertainties(self) -> Tensor:
        """u_G of every Gaussian ``[N]`` in 0..1; high where the views disagree."""
        ...

    def code_probabilities(self) -> Tensor:
        """Distribution over codes of every Gaussian ``[N, K]``: rows sum to 1, or 0 if nothing is known."""
        ...

    def render_code_probabilities(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """Distribution over codes at every pixel ``[H, W, K]``."""
        ...

    def render_scores(self, gaussians: Gaussians, camera: Camera, table: Tensor) -> Tensor:
        """Per pixel sum over codes of p_k table[k]: ``[K, P]`` to ``[H, W, P]``."""
        ...

    def select(self, index: Tensor) -> LanguageField:
        """The language of the Gaussians named by a mask or an index ``[M]``, as `Gaussians.select` orders them."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """Everything by name, for safetensors."""
        ...

    def metadata(self) -> dict[str, str]:
        """What is not a tensor, for the header of the safetensors file."""
        ...
