"""What a scene says: language on the Gaussians, trained as in the paper (section 3.4) or lifted from the
index maps.

`TrainedField` carries s_G in R^8 and an uncertainty on every Gaussian and decodes what is rendered (Eq. 8).
`LiftedField` carries a sparse distribution over codes on every Gaussian and renders it. Both answer the same
questions, `LanguageField`.

Geometry is deaf to language: features are rendered with geometry detached, so training a field moves no
Gaussian.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional

from lexsplat.cameras import Camera
from lexsplat.codebook import Codebook
from lexsplat.gaussians import Gaussians
from lexsplat.rendering import PreparedView, prepare, render

SEMANTIC_CHANNELS = 8
"""S, the paper's d_s."""

DECODER_WIDTHS = (128, 256)
"""Hidden layers of D_MLP (supplement, table of the decoder)."""

SMOOTHING_WIDTHS = (128, 128, 128)
"""Hidden layers of the smoothing MLP (supplement, table of PE and MLP)."""

INITIAL_UNCERTAINTY = 0.01
"""The paper starts at u = 0, which a sigmoid never is; the authors' code starts here."""

RENDER_CHANNELS = 32
"""Feature channels rendered in one pass when there are many."""

BLOCK_ROWS = 16_384
"""Pixels or Gaussians decoded at a time."""


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


class SmoothingMLP(nn.Module):
    """Eq. 13: s_MLP = MLP(PE(p)), three hidden layers of 128 with ReLU, then a linear layer to 8.

    A coordinate MLP learns low frequencies first, which is what smooths. Positions are mapped to -1..1 over
    the scene's box, which the paper leaves open (its code feeds raw coordinates); what lies outside is
    clamped to -2..2.

    Args:
        center: Middle of the box ``[3]``, world units.
        extent: Half of its longest side, world units.
        num_frequencies: L of NeRF's encoding (x, sin(2^l pi x), cos(2^l pi x) for l < L). The paper's table
            has 0: x alone.
        generator: Of the initial weights.
    """

    center: Tensor
    extent: Tensor

    def __init__(
        self,
        center: Tensor,
        extent: Tensor,
        num_frequencies: int = 0,
        *,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if num_frequencies < 0:
            raise ValueError(f"num_frequencies must not be negative, got {num_frequencies}")
        self.num_frequencies = num_frequencies
        self.register_buffer("center", center.detach().clone())
        self.register_buffer("extent", extent.detach().clone())
        self.layers = _mlp((3 + 6 * num_frequencies, *SMOOTHING_WIDTHS, SEMANTIC_CHANNELS), generator)

    def forward(self, means: Tensor) -> Tensor:
        """s_MLP ``[N, 8]`` at positions ``[N, 3]``; the positions get no gradient."""
        unit = ((means.detach() - self.center) / self.extent).clamp(-2, 2)
        return self.layers(positional_encoding(unit, self.num_frequencies))


def positional_encoding(positions: Tensor, num_frequencies: int) -> Tensor:
    """NeRF's encoding with the identity: ``[N, 3]`` to ``[N, 3 + 6 L]``, all sines before the cosines."""
    if num_frequencies == 0:
        return positions
    octaves = 2.0 ** torch.arange(num_frequencies, device=positions.device) * math.pi
    angles = (positions[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat([positions, angles.sin(), angles.cos()], dim=-1)


class TrainedField(nn.Module):
    """The paper's language field: s_G and u on the Gaussians, D_MLP, and the smoothing MLP.

    Args:
        codebook: The discrete feature space S.
        semantics: s_G ``[N, 8]``.
        uncertainty_logits: Inverse sigmoid of u ``[N]``.
        smoother: The MLP of Eq. 13.
        normalise_rendering: Scale the rendered s to unit length before decoding, as the authors' code does.
        method: Name under which results are reported, "trained" or "lifted+tuned".
        generator: Of the decoder's initial weights.
    """

    def __init__(
        self,
        codebook: Codebook,
        semantics: Tensor,
        uncertainty_logits: Tensor,
        smoother: SmoothingMLP,
        *,
        normalise_rendering: bool = False,
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
        self.normalise_rendering = normalise_rendering
        self.semantics = nn.Parameter(semantics.detach().clone())
        self.uncertainty_logits = nn.Parameter(uncertainty_logits.detach().clone())
        self.decoder = _mlp((SEMANTIC_CHANNELS, *DECODER_WIDTHS, codebook.num_codes), generator)
        self.smoother = smoother

    @classmethod
    def initial(
        cls,
        gaussians: Gaussians,
        codebook: Codebook,
        *,
        generator: torch.Generator,
        num_frequencies: int = 0,
        normalise_rendering: bool = False,
    ) -> TrainedField:
        """The start of training: s_G from N(0, 1), u almost zero (`INITIAL_UNCERTAINTY`)."""
        count = len(gaussians)
        center, extent = scene_box(gaussians.means)
        field = cls(
            codebook,
            torch.randn(count, SEMANTIC_CHANNELS, generator=generator),
            torch.full((count,), math.log(INITIAL_UNCERTAINTY / (1 - INITIAL_UNCERTAINTY))),
            SmoothingMLP(center.cpu(), extent.cpu(), num_frequencies, generator=generator),
            normalise_rendering=normalise_rendering,
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
        """R_s and R_u: ``[H, W, 8]`` and ``[H, W]``, in one pass, with gradients to s_G and u only."""
        carried = torch.cat([self.semantics, self.uncertainty_logits.sigmoid()[:, None]], dim=1)
        rendered = render(
            gaussians.detach(), camera, features=carried, color=False, prepared=prepared
        ).features
        return rendered[..., :SEMANTIC_CHANNELS], rendered[..., SEMANTIC_CHANNELS]

    def decode(self, semantics: Tensor) -> Tensor:
        """D_MLP before its softmax (Eq. 8): ``[..., 8]`` to logits ``[..., K]``."""
        if self.normalise_rendering:
            semantics = functional.normalize(semantics, dim=-1)
        return self.decoder(semantics)

    @torch.no_grad()
    def code_probabilities(self) -> Tensor:
        """softmax(D_MLP(s_G)): what each Gaussian would show alone ``[N, K]``."""
        return torch.cat([self.decode(rows).softmax(-1) for rows in self.semantics.split(BLOCK_ROWS)])

    @torch.no_grad()
    def render_code_probabilities(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """Eq. 8 ``[H, W, K]``; sums to 1 at every pixel, also where nothing is drawn (there s is 0)."""
        semantics, _ = self.render_semantics(gaussians, camera)
        blocks = [self.decode(rows).softmax(-1) for rows in semantics.flatten(0, 1).split(BLOCK_ROWS)]
        return torch.cat(blocks).unflatten(0, semantics.shape[:2])

    @torch.no_grad()
    def render_scores(self, gaussians: Gaussians, camera: Camera, table: Tensor) -> Tensor:
        """Sum over codes of Eq. 8 times ``table[K, P]``: ``[H, W, P]``, without holding ``[H, W, K]``."""
        _check_table(table, self.codebook)
        semantics, _ = self.render_semantics(gaussians, camera)
        table = table.to(semantics)
        blocks = [self.decode(rows).softmax(-1) @ table for rows in semantics.flatten(0, 1).split(BLOCK_ROWS)]
        return torch.cat(blocks).unflatten(0, semantics.shape[:2])

    def select(self, index: Tensor) -> TrainedField:
        """The rows of some Gaussians; decoder, smoother and codebook are the same."""
        tensors = self.tensors()
        rows = {name: tensors[name][index] for name in ("semantics", "uncertainty_logits")}
        return TrainedField.from_tensors(tensors | rows, self.metadata())

    def tensors(self) -> dict[str, Tensor]:
        """Everything by name, for safetensors; the codebook under ``codebook.``."""
        stored = {name: value.detach().contiguous() for name, value in self.state_dict().items()}
        return stored | _codebook_tensors(self.codebook)

    def metadata(self) -> dict[str, str]:
        """What is not a tensor."""
        return {
            "kind": "trained",
            "method": self.method,
            "normalise_rendering": str(self.normalise_rendering).lower(),
        }

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
    ) -> TrainedField:
        """The inverse of `tensors` and `metadata`.

        Raises:
            ValueError: If a tensor is missing or of the wrong shape.
        """
        metadata = metadata or {}
        _require(tensors, ("semantics", "uncertainty_logits", "smoother.center", "smoother.layers.0.weight"))
        num_frequencies = (tensors["smoother.layers.0.weight"].shape[1] - 3) // 6
        field = cls(
            _stored_codebook(tensors),
            tensors["semantics"],
            tensors["uncertainty_logits"],
            SmoothingMLP(tensors["smoother.center"], tensors["smoother.extent"], num_frequencies),
            normalise_rendering=metadata.get("normalise_rendering") == "true",
            method=metadata.get("method", "trained"),
        )
        own = {name: value for name, value in tensors.items() if not name.startswith("codebook.")}
        try:
            field.load_state_dict(own)
        except RuntimeError as error:
            raise ValueError(f"language field does not fit: {error}") from error
        return field.to(tensors["semantics"].device)


class LiftedField:
    """A sparse distribution over codes on every Gaussian; rendering it is linear and needs no decoder.

    Where a view is not covered, the probabilities of its pixels sum to the coverage: the rest is nothing.

    Args:
        codebook: The discrete feature space S.
        codes: Code indices ``[N, T]`` uint8, the likeliest first (T = 4 by default).
        weights: Their probabilities ``[N, T]``; rows sum to 1, or to 0 for a Gaussian about which nothing is
            known.
        uncertainties: u_G ``[N]`` in 0..1.
        method: Name under which results are reported.
    """

    def __init__(
        self,
        codebook: Codebook,
        codes: Tensor,
        weights: Tensor,
        uncertainties: Tensor,
        *,
        method: str = "lifted",
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
        self.codebook = codebook
        self.codes = codes
        self.weights = weights.float()
        self._uncertainties = uncertainties.float()
        self.method = method

    @property
    def uncertainties(self) -> Tensor:
        """u_G ``[N]`` in 0..1."""
        return self._uncertainties

    def code_probabilities(self) -> Tensor:
        """The distributions without their sparsity ``[N, K]``."""
        return self._dense(slice(0, self.codebook.num_codes))

    @torch.no_grad()
    def render_code_probabilities(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """Blended distributions ``[H, W, K]``, rendered `RENDER_CHANNELS` codes at a time."""
        return _render_chunks(gaussians, camera, self.codebook.num_codes, self._dense)

    def scores(self, table: Tensor) -> Tensor:
        """Sum over codes of p_k table[k] for every Gaussian: ``[K, P]`` to ``[N, P]``."""
        _check_table(table, self.codebook)
        table = table.to(self.weights)
        total = self.weights.new_zeros(len(self.codes), table.shape[1])
        for column in range(self.codes.shape[1]):
            total.addcmul_(self.weights[:, column, None], table[self.codes[:, column].long()])
        return total

    @torch.no_grad()
    def render_scores(self, gaussians: Gaussians, camera: Camera, table: Tensor) -> Tensor:
        """The rendering of `scores`: ``[K, P]`` to ``[H, W, P]``, one channel a prompt."""
        scores = self.scores(table)
        return _render_chunks(
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

    def select(self, index: Tensor) -> LiftedField:
        """The rows of some Gaussians; the codebook is the same."""
        return LiftedField(
            self.codebook,
            self.codes[index],
            self.weights[index],
            self._uncertainties[index],
            method=self.method,
        )

    def tensors(self) -> dict[str, Tensor]:
        """Everything by name, for safetensors; the codebook under ``codebook.``."""
        own = {"codes": self.codes, "weights": self.weights, "uncertainties": self._uncertainties}
        return {name: value.contiguous() for name, value in own.items()} | _codebook_tensors(self.codebook)

    def metadata(self) -> dict[str, str]:
        """What is not a tensor."""
        return {"kind": "lifted", "method": self.method}

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
    ) -> LiftedField:
        """The inverse of `tensors` and `metadata`.

        Raises:
            ValueError: If a tensor is missing or of the wrong shape.
        """
        _require(tensors, ("codes", "weights", "uncertainties"))
        return cls(
            _stored_codebook(tensors),
            tensors["codes"],
            tensors["weights"],
            tensors["uncertainties"],
            method=(metadata or {}).get("method", "lifted"),
        )


def field_from_tensors(
    tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> TrainedField | LiftedField:
    """The field that was stored, whichever kind it is.

    Raises:
        ValueError: If the tensors are of neither kind, do not fit each other, or hold a number that is not finite.
    """
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"NaN or infinity in {name}")
    try:
        if "semantics" in tensors:
            return TrainedField.from_tensors(tensors, metadata)
        if "codes" in tensors:
            return LiftedField.from_tensors(tensors, metadata)
    except (IndexError, TypeError, RuntimeError) as error:  # a tensor with fewer axes than it must have
        raise ValueError(f"language field does not fit: {error}") from error
    raise ValueError("neither semantics (trained) nor codes (lifted) among the tensors of the language field")


def scene_box(means: Tensor) -> tuple[Tensor, Tensor]:
    """Middle ``[3]`` and half the longest side ``[]`` of the box that holds all but the outermost 2 % on
    every axis.

    A few far floaters would otherwise squeeze the scene into a corner of the encoding.
    """
    points = means.detach().float()
    if len(points) > 1_000_000:  # torch.quantile has an upper limit, and a sample says as much
        points = points[:: len(points) // 1_000_000 + 1]
    ends = torch.quantile(points, torch.tensor([0.02, 0.98], device=points.device), dim=0)
    extent = ((ends[1] - ends[0]).max() / 2).clamp_min(1e-6)
    return ends.mean(0), extent


def _mlp(widths: tuple[int, ...], generator: torch.Generator | None) -> nn.Sequential:
    """Linear layers with ReLU between them, initialised like nn.Linear but from the given generator only."""
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        linear = nn.utils.skip_init(nn.Linear, inputs, outputs)
        bound = 1 / math.sqrt(inputs)
        with torch.no_grad():
            linear.weight.uniform_(-bound, bound, generator=generator)
            linear.bias.uniform_(-bound, bound, generator=generator)
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def _render_chunks(
    gaussians: Gaussians, camera: Camera, count: int, columns_of: Callable[[slice], Tensor]
) -> Tensor:
    """Render ``count`` channels, `RENDER_CHANNELS` at a time: ``[H, W, count]``."""
    prepared = prepare(gaussians, camera)
    image = torch.empty(camera.height, camera.width, count, device=gaussians.device)
    for start in range(0, count, RENDER_CHANNELS):
        columns = slice(start, min(start + RENDER_CHANNELS, count))
        features = columns_of(columns)
        image[..., columns] = render(
            gaussians, camera, features=features, color=False, prepared=prepared
        ).features
    return image


def _check_table(table: Tensor, codebook: Codebook) -> None:
    if table.ndim != 2 or len(table) != codebook.num_codes:
        raise ValueError(f"table must be [{codebook.num_codes}, P], got {list(table.shape)}")


def _codebook_tensors(codebook: Codebook) -> dict[str, Tensor]:
    return {f"codebook.{name}": value.contiguous() for name, value in codebook.tensors().items()}


def _stored_codebook(tensors: Mapping[str, Tensor]) -> Codebook:
    prefix = "codebook."
    return Codebook.from_tensors(
        {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}
    )


def _require(tensors: Mapping[str, Tensor], names: tuple[str, ...]) -> None:
    missing = [name for name in names if name not in tensors]
    if missing:
        raise ValueError(f"language field lacks {', '.join(missing)}")
