"""A field of codes: each Gaussian carries a sparse distribution over the codebook, which is rendered directly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.codebook import Codebook, code_usage
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields.rendering import (
    check_table,
    codebook_tensors,
    render_chunks,
    require,
    stored_codebook,
)
from lexsplat.language.segments import Segments

_STEPS = 255
"""Steps between 0 and 1 of what is stored in 8 bits."""


class CodeField:
    """A sparse distribution over codes on every Gaussian. Rendering it is linear and needs no decoder.

    The probabilities of a pixel sum to its coverage: uncovered parts of a view have no language.

    Args:
        codebook: The discrete feature space S.
        codes: Code indices ``[N, T]`` uint8, most likely first (T = 4 by default).
        weights: Their probabilities ``[N, T]``; rows sum to 1, or to 0 for a Gaussian that no training view shows.
        uncertainties: u_G ``[N]`` in 0..1.
        method: Name of the method that made the field.
        segments: The segments of the Gaussians; None for a field without.
        num_levels: Number L of levels of 2D segments whose language is kept apart. Each level has T / L of the codes,
            one level after the other, and 1 / L of the weight.
    """

    def __init__(
        self,
        codebook: Codebook,
        codes: Tensor,
        weights: Tensor,
        uncertainties: Tensor,
        *,
        method: str = "averaged",
        segments: Segments | None = None,
        num_levels: int = 1,
    ) -> None:
        if codes.ndim != 2 or codes.dtype != torch.uint8 or weights.shape != codes.shape:
            raise ValueError(
                f"codes [N, T] uint8 and weights [N, T] expected, got {codes.dtype} {list(codes.shape)}, "
                f"{list(weights.shape)}"
            )
        if not weights.is_floating_point() or not uncertainties.is_floating_point():
            raise ValueError(
                f"weights and uncertainties must be floats, got {weights.dtype}, {uncertainties.dtype}"
            )
        if uncertainties.shape != codes.shape[:1]:
            raise ValueError(f"uncertainties must be [{len(codes)}], got {list(uncertainties.shape)}")
        if codes.numel() and int(codes.max()) >= codebook.num_codes:
            raise ValueError(f"code {int(codes.max())} is not in a codebook of {codebook.num_codes}")
        if segments is not None and len(segments.labels) != len(codes):
            raise ValueError(f"segments of {len(codes)} Gaussians expected, got {len(segments.labels)}")
        if num_levels < 1 or codes.shape[1] % num_levels:
            raise ValueError(f"{codes.shape[1]} codes of a Gaussian cannot be those of {num_levels} levels")
        self.codebook = codebook
        self.segments = segments
        self.num_levels = num_levels
        self.codes = codes
        self.weights = weights.float()
        self.uncertainties = uncertainties.float()
        self.method = method

    def __repr__(self) -> str:
        count, kept = self.codes.shape
        return (
            f"CodeField({count:,} Gaussians, {kept} of {self.codebook.num_codes} codes each, {self.method!r})"
        )

    @property
    def levels(self) -> tuple[CodeField, ...]:
        """The field of each level of 2D segments; () where there is one level."""
        if self.num_levels == 1:
            return ()
        parts = zip(self.codes.chunk(self.num_levels, 1), self.weights.chunk(self.num_levels, 1))
        return tuple(
            CodeField(
                self.codebook,
                codes,
                torch.nn.functional.normalize(weights, p=1, dim=1),
                self.uncertainties,
                method=self.method,
                segments=self.segments,
            )
            for codes, weights in parts
        )

    @property
    def unseen(self) -> int:
        """Number of Gaussians that no training view shows; they have no code, and selections leave them out."""
        return int((self.weights.sum(1) == 0).sum())

    def code_probabilities(self) -> Tensor:
        """The distributions as a dense array ``[N, K]``."""
        return self._dense(slice(0, self.codebook.num_codes))

    @torch.no_grad()
    def render_code_probabilities(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """Blended distributions ``[H, W, K]``, rendered `RENDER_CHANNELS` codes at a time."""
        return render_chunks(gaussians, camera, self.codebook.num_codes, self._dense)

    def scores(self, table: Tensor) -> Tensor:
        """Sum over codes of p_k table[k] for every Gaussian: ``[K, P]`` to ``[N, P]``."""
        check_table(table, self.codebook)
        shares = self.weights
        if not len(shares):
            return shares.new_zeros(0, table.shape[1])
        return torch.nn.functional.embedding_bag(
            self.codes.int(), table.to(shares), per_sample_weights=shares, mode="sum"
        )

    def sums(self, places: Tensor, shares: Tensor, count: int) -> NDArray[np.float64]:
        """Weighted sums of the distributions at places ``[count, K]``, in float64; see `LanguageField`."""
        codes = self.codebook.num_codes
        first, weights = places.cpu().numpy() * codes, shares.cpu().double().numpy()
        total = np.zeros(count * codes)
        for column in range(self.codes.shape[1]):
            values = weights * self.weights[:, column].cpu().numpy()
            total += np.bincount(first + self.codes[:, column].cpu().numpy(), values, len(total))
        return total.reshape(count, codes)

    def likeliest_codes(self) -> tuple[Tensor, Tensor]:
        """The most probable code of every Gaussian ``[N]``, and whether a training view shows it ``[N]``."""
        # Levels may share a code.
        shared = [
            torch.where(self.codes == self.codes[:, [column]], self.weights, 0.0).sum(1)
            for column in range(self.codes.shape[1])
        ]
        weights, place = torch.stack(shared, 1).max(1)
        return self.codes.gather(1, place[:, None])[:, 0].long(), weights > 0

    @torch.no_grad()
    def render_scores(self, gaussians: Gaussians, camera: Camera, table: Tensor) -> Tensor:
        """The rendering of `scores`: ``[K, P]`` to ``[H, W, P]``, one channel a prompt."""
        scores = self.scores(table)
        return render_chunks(
            gaussians, camera, scores.shape[1], lambda columns: scores[:, columns].contiguous()
        )

    def _dense(self, codes: slice) -> Tensor:
        """Columns of the distribution for a range of codes ``[N, k]``."""
        width = codes.stop - codes.start
        dense = self.weights.new_zeros(len(self.codes), width + 1)
        for column in range(self.codes.shape[1]):
            index = self.codes[:, column].long() - codes.start
            index = torch.where((index >= 0) & (index < width), index, width)
            dense.scatter_add_(1, index[:, None], self.weights[:, column, None])
        return dense[:, :width].contiguous()

    def select(self, index: Tensor) -> CodeField:
        """The field of some Gaussians, with the same codebook."""
        return CodeField(
            self.codebook,
            self.codes[index],
            self.weights[index],
            self.uncertainties[index],
            method=self.method,
            segments=self.segments.select(index) if self.segments else None,
            num_levels=self.num_levels,
        )

    def facts(self) -> dict[str, Any]:
        """Use of the likeliest codes, and numbers of Gaussians without a code, of segments and of levels."""
        first = torch.cat([codes[:, 0] for codes in self.codes.chunk(self.num_levels, 1)]).cpu().numpy()
        used = code_usage([first], self.codebook.num_codes).facts()
        segments = {} if self.segments is None else {"segments": self.segments.levels.shape[1]}
        levels = {"levels": self.num_levels} if self.num_levels > 1 else {}
        return {**used, "unseen": self.unseen, **levels, **segments}

    def content(self) -> tuple[Tensor, ...]:
        """Codes, weights and codewords."""
        return self.codes, self.weights, self.codebook.clip

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, for safetensors; those of the codebook under ``codebook.``.

        Weights and uncertainties have 8 bits: 9 bytes a Gaussian with four codes, and 8 for each further level.
        """
        uncertainties = (self.uncertainties.clamp(0, 1) * _STEPS).round().to(torch.uint8)
        own = {"codes": self.codes, "weights": _in_steps(self.weights), "uncertainties": uncertainties}
        own |= self.segments.tensors() if self.segments else {}
        return {name: value.contiguous() for name, value in own.items()} | codebook_tensors(self.codebook)

    def metadata(self) -> dict[str, str]:
        """Everything that is not a tensor."""
        levels = {"levels": str(self.num_levels)} if self.num_levels > 1 else {}
        return {"kind": "codes", "method": self.method} | levels

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
    ) -> CodeField:
        """The inverse of `tensors` and `metadata`.

        Files of earlier versions hold floats; they may have the kind "lifted" and name the method "lifted".

        Raises:
            ValueError: If a tensor is missing or has the wrong shape.
        """
        require(tensors, ("codes", "weights", "uncertainties"))
        return cls(
            stored_codebook(tensors),
            tensors["codes"],
            _as_floats(tensors["weights"]),
            _as_floats(tensors["uncertainties"]),
            method=(metadata or {}).get("method", "averaged"),
            segments=Segments.from_tensors(tensors),
            num_levels=int((metadata or {}).get("levels", "1")),
        )


def _in_steps(weights: Tensor) -> Tensor:
    """Weights ``[N, T]`` in 0..1 as uint8, each row with its sum: the largest remainders are rounded up."""
    scaled = weights.double().clamp(0, 1) * _STEPS
    whole = scaled.floor()
    missing = scaled.sum(1, keepdim=True).round() - whole.sum(1, keepdim=True)
    rank = (whole - scaled).argsort(dim=1, stable=True).argsort(dim=1)
    return (whole + (rank < missing)).clamp(max=_STEPS).to(torch.uint8)


def _as_floats(stored: Tensor) -> Tensor:
    return stored.float() / _STEPS if stored.dtype == torch.uint8 else stored
