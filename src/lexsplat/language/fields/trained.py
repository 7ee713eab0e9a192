"""The paper's language field (section 3.4): s_G and an uncertainty on every Gaussian, and the decoder of Eq. 8."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields.rendering import (
    BLOCK_ROWS,
    check_table,
    codebook_tensors,
    require,
    stored_codebook,
)
from lexsplat.language.fields.smoothing import SEMANTIC_CHANNELS, SmoothingMLP, mlp, scene_box
from lexsplat.language.segments import Segments
from lexsplat.rendering import PreparedView, render

DECODER_WIDTHS = (128, 256)
"""Widths of the hidden layers of D_MLP (supplement, table of the decoder)."""

INITIAL_UNCERTAINTY = 0.01
"""Start of u in the authors' code. The paper starts at 0, which a sigmoid never reaches."""


class TrainedField(nn.Module):
    """The paper's language field: s_G and u on the Gaussians, D_MLP, and the smoothing MLP.

    Args:
        codebook: The discrete feature space S.
        semantics: s_G ``[N, 8]``.
        uncertainty_logits: Inverse sigmoid of u ``[N]``.
        smoother: The MLP of Eq. 13.
        normalize_rendering: Scale the rendered s to unit length before decoding, as the authors' code does.
        method: Name of the method that made the field.
        generator: Generator of the decoder's initial weights.
    """

    segments: Segments | None = None
    levels = ()

    def __init__(
        self,
        codebook: Codebook,
        semantics: Tensor,
        uncertainty_logits: Tensor,
        smoother: SmoothingMLP,
        *,
        normalize_rendering: bool = False,
        method: str = "trained",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        count = len(semantics)
        if semantics.shape != (count, SEMANTIC_CHANNELS) or uncertainty_logits.shape != (count,):
            raise ValueError(
                f"semantics [N, {SEMANTIC_CHANNELS}] and uncertainty_logits [N] expected, "
                f"got {list(semantics.shape)}, {list(uncertainty_logits.shape)}"
            )
        self.codebook = codebook
        self.method = method
        self.normalize_rendering = normalize_rendering
        self.semantics = nn.Parameter(semantics.detach().clone())
        self.uncertainty_logits = nn.Parameter(uncertainty_logits.detach().clone())
        self.decoder = mlp((SEMANTIC_CHANNELS, *DECODER_WIDTHS, codebook.num_codes), generator)
        self.smoother = smoother

    @classmethod
    def initial(
        cls,
        gaussians: Gaussians,
        codebook: Codebook,
        *,
        generator: torch.Generator,
        num_frequencies: int = 0,
        normalize_rendering: bool = False,
    ) -> TrainedField:
        """The field before training: s_G from N(0, 1), u = `INITIAL_UNCERTAINTY`."""
        count = len(gaussians)
        center, extent = scene_box(gaussians.means)
        field = cls(
            codebook,
            torch.randn(count, SEMANTIC_CHANNELS, generator=generator),
            torch.full((count,), math.log(INITIAL_UNCERTAINTY / (1 - INITIAL_UNCERTAINTY))),
            SmoothingMLP(center.cpu(), extent.cpu(), num_frequencies, generator=generator),
            normalize_rendering=normalize_rendering,
            generator=generator,
        )
        return field.to(gaussians.device)

    @property
    def uncertainties(self) -> Tensor:
        """u_G ``[N]`` in 0..1."""
        return self.uncertainty_logits.detach().sigmoid()

    def render_semantics(
        self, gaussians: Gaussians, camera: Camera, *, prepared: PreparedView | None = None
    ) -> tuple[Tensor, Tensor]:
        """R_s ``[H, W, 8]`` and R_u ``[H, W]`` in one pass; gradients reach s_G and u only."""
        carried = torch.cat([self.semantics, self.uncertainty_logits.sigmoid()[:, None]], dim=1)
        rendered = render(
            gaussians.detach(), camera, features=carried, color=False, prepared=prepared
        ).features
        return rendered[..., :SEMANTIC_CHANNELS], rendered[..., SEMANTIC_CHANNELS]

    def decode(self, semantics: Tensor, *, bfloat16: bool = False) -> Tensor:
        """D_MLP before its softmax (Eq. 8): ``[..., 8]`` to logits ``[..., K]``. ``bfloat16`` as in `MLP`."""
        if self.normalize_rendering:
            semantics = functional.normalize(semantics, dim=-1)
        return self.decoder(semantics, bfloat16=bfloat16)

    @torch.no_grad()
    def code_probabilities(self) -> Tensor:
        """softmax(D_MLP(s_G)): the distribution of each Gaussian by itself ``[N, K]``."""
        return self._probabilities(self.semantics)

    @torch.no_grad()
    def scores(self, table: Tensor) -> Tensor:
        """Sum over codes of p_k table[k] for every Gaussian: ``[K, P]`` to ``[N, P]``, in blocks of Gaussians."""
        check_table(table, self.codebook)
        table = table.to(self.semantics)
        return torch.cat([self._probabilities(rows) @ table for rows in self.semantics.split(4 * BLOCK_ROWS)])

    @torch.no_grad()
    def sums(self, places: Tensor, shares: Tensor, count: int) -> NDArray[np.float64]:
        """Weighted sums of the distributions at places ``[count, K]``, in blocks of Gaussians."""
        total = np.zeros((count, self.codebook.num_codes))
        for rows in torch.arange(len(self.semantics), device=self.semantics.device).split(BLOCK_ROWS):
            probabilities = self._probabilities(self.semantics[rows]).cpu().double().numpy()
            weights = shares.to(rows.device)[rows].cpu().double().numpy()
            np.add.at(total, places.to(rows.device)[rows].cpu().numpy(), weights[:, None] * probabilities)
        return total

    @torch.no_grad()
    def likeliest_codes(self) -> tuple[Tensor, Tensor]:
        """The most probable code of every Gaussian ``[N]``; each has language ``[N]``."""
        parts = [self._probabilities(rows).argmax(1) for rows in self.semantics.split(BLOCK_ROWS)]
        codes = torch.cat(parts)
        return codes, torch.ones_like(codes, dtype=torch.bool)

    def _probabilities(self, semantics: Tensor) -> Tensor:
        """Decoded distributions ``[M, K]`` of rows ``[M, 8]``."""
        return torch.cat([self.decode(rows).softmax(-1) for rows in semantics.split(BLOCK_ROWS)])

    @torch.no_grad()
    def render_code_probabilities(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """Eq. 8 ``[H, W, K]``. Every pixel sums to 1, even where no Gaussian is drawn (there s is 0)."""
        semantics, _ = self.render_semantics(gaussians, camera)
        return self._probabilities(semantics.flatten(0, 1)).unflatten(0, semantics.shape[:2])

    @torch.no_grad()
    def render_scores(self, gaussians: Gaussians, camera: Camera, table: Tensor) -> Tensor:
        """Sum over codes of Eq. 8 times ``table[K, P]``: ``[H, W, P]``, without holding ``[H, W, K]``."""
        check_table(table, self.codebook)
        semantics, _ = self.render_semantics(gaussians, camera)
        table = table.to(semantics)
        blocks = [self.decode(rows).softmax(-1) @ table for rows in semantics.flatten(0, 1).split(BLOCK_ROWS)]
        return torch.cat(blocks).unflatten(0, semantics.shape[:2])

    def select(self, index: Tensor) -> TrainedField:
        """The field of some Gaussians, with the same decoder, smoother and codebook."""
        tensors = self.tensors()
        rows = {name: tensors[name][index] for name in ("semantics", "uncertainty_logits")}
        return TrainedField.from_tensors(tensors | rows, self.metadata())

    def facts(self) -> dict[str, Any]:
        """None: the record of the stage "codebook" holds the use of its codes."""
        return {}

    def content(self) -> tuple[Tensor, ...]:
        """All its tensors."""
        return tuple(self.tensors().values())

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for safetensors; those of the codebook under ``codebook.``."""
        stored = {name: value.detach().contiguous() for name, value in self.state_dict().items()}
        return stored | codebook_tensors(self.codebook)

    def metadata(self) -> dict[str, str]:
        """Everything that is not a tensor."""
        return {
            "kind": "trained",
            "method": self.method,
            "normalize_rendering": str(self.normalize_rendering).lower(),
        }

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
    ) -> TrainedField:
        """The inverse of `tensors` and `metadata`.

        Raises:
            ValueError: If a tensor is missing or has the wrong shape.
        """
        metadata = metadata or {}
        require(tensors, ("semantics", "uncertainty_logits", "smoother.center", "smoother.layers.0.weight"))
        num_frequencies = (tensors["smoother.layers.0.weight"].shape[1] - 3) // 6
        field = cls(
            stored_codebook(tensors),
            tensors["semantics"],
            tensors["uncertainty_logits"],
            SmoothingMLP(tensors["smoother.center"], tensors["smoother.extent"], num_frequencies),
            normalize_rendering="true"
            in (metadata.get("normalize_rendering"), metadata.get("normalise_rendering")),
            method=metadata.get("method", "trained"),
        )
        own = {name: value for name, value in tensors.items() if not name.startswith("codebook.")}
        try:
            field.load_state_dict(own)
        except RuntimeError as error:
            raise ValueError(f"language field does not fit: {error}") from error
        return field.to(tensors["semantics"].device)
