"""A color for every Gaussian in each mode: photo, relevancy, language, codes, uncertainty, depth.

Pure array arithmetic that takes milliseconds. N Gaussians, K codes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import CodeField, LanguageField
from lexsplat.queries.heatmaps import PEAK_FLOOR, colorize
from lexsplat.queries.thresholds import automatic_threshold
from lexsplat.scenes.formats.tables import colors_of

Mode = Literal["photo", "relevancy", "language", "codes", "uncertainty", "depth"]
MODES: tuple[Mode, ...] = get_args(Mode)

PROMPT_COLORS: tuple[tuple[int, int, int], ...] = (
    (230, 57, 70),
    (0, 119, 182),
    (42, 157, 80),
    (244, 140, 6),
    (131, 56, 180),
    (0, 150, 150),
    (214, 51, 132),
    (120, 90, 40),
)
"""Colors of prompts when several are shown; distinct on a light background."""

_FADED = 236.0
_SAMPLE = 65_536
_ROWS = 16_384
_PLAIN = (150, 150, 158)
"""Color of Gaussians without language."""


@dataclass
class Layer:
    """A prompt as it is drawn.

    Args:
        text: The prompt.
        scores: Relevancy of every Gaussian ``[N]`` float32 in 0..1.
        threshold: Minimum relevancy of a marked Gaussian.
        color: RGB bytes, used when several prompts are shown.
        mask: The marked Gaussians ``[N]`` bool; None marks those at or above the threshold.
        shown: Whether the prompt is drawn.
    """

    text: str
    scores: NDArray[np.float32]
    threshold: float
    color: tuple[int, int, int] = PROMPT_COLORS[0]
    mask: NDArray[np.bool_] | None = None
    shown: bool = True
    peak: float = field(init=False)

    def __post_init__(self) -> None:
        self.peak = peak_of(self.scores)

    def set_scores(self, scores: NDArray[np.float32]) -> None:
        """Replace the relevancies, for example by those of a parsed phrase."""
        self.scores, self.peak = scores, peak_of(scores)

    @property
    def high(self) -> float:
        """The relevancy drawn in full color."""
        return max(self.peak, self.threshold + PEAK_FLOOR)

    def marked(self) -> NDArray[np.int64]:
        """Indices of the marked Gaussians ``[M]``."""
        mask = self.scores >= self.threshold if self.mask is None else self.mask
        return np.flatnonzero(mask)

    def amount(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """Relevancy of the Gaussians ``index``, scaled to 0 at the threshold and 1 at `high`."""
        span = self.high - self.threshold
        return np.clip((self.scores[index] - self.threshold) / span, 0, 1).astype(np.float32)


def peak_of(scores: NDArray[np.float32]) -> float:
    """The 99.9th percentile of the relevancies, a maximum without stray Gaussians."""
    if len(scores) == 0:
        return 0.0
    position = min(len(scores) - 1, int(0.999 * len(scores)))
    return float(np.partition(scores, position)[position])


def quick_threshold(scores: NDArray[np.float32], opacities: NDArray[np.float32]) -> float:
    """A provisional threshold from the scores of the Gaussians alone, in milliseconds.

    It is shown until the automatic threshold, which needs rendered views, is known.

    Args:
        scores: Relevancy of every Gaussian ``[N]``.
        opacities: Opacity of every Gaussian ``[N]``, used as its weight.
    """
    step = max(1, len(scores) // _SAMPLE)
    values, weights = torch.from_numpy(scores[::step].copy()), torch.from_numpy(opacities[::step].copy())
    return float(automatic_threshold(values[None], weights)[0])


class Coloring:
    """Colors of all Gaussians of a scene in every mode."""

    def __init__(self, gaussians: Gaussians, language: LanguageField) -> None:
        self.photo = colors_of(gaussians)
        self._means = gaussians.means.detach().cpu().numpy()
        self._language = language
        self._fixed: dict[str, NDArray[np.uint8]] = {}
        self.scale = (0.0, 1.0)
        """The values of the darkest and the brightest color of the last depth or uncertainty image."""

    def colors(
        self,
        mode: Mode,
        layers: Sequence[Layer] = (),
        *,
        opacity: float = 0.9,
        fade: float = 0.0,
        eye: NDArray | None = None,
    ) -> NDArray[np.uint8]:
        """The color of every Gaussian.

        Args:
            mode: What the colors mean.
            layers: The prompts, for ``"relevancy"``.
            opacity: Opacity of the marks over the photo colors, 0..1.
            fade: Blend of unmarked Gaussians towards light gray, 0..1.
            eye: Camera position ``[3]``, for ``"depth"``; None takes the mean of the Gaussians.

        Returns:
            A new array ``[N, 3]`` of RGB bytes.

        Raises:
            ValueError: If the mode is unknown.
        """
        if mode == "photo":
            return self.photo.copy()
        if mode == "relevancy":
            return self._relevancy(layers, opacity, fade)
        if mode == "depth":
            return self._depth(eye)
        if mode not in MODES:
            raise ValueError(f"mode must be one of {', '.join(MODES)}, got {mode!r}")
        if mode not in self._fixed:
            make = {"codes": self._codes, "uncertainty": self._uncertainty}.get(mode)
            self._fixed[mode] = make() if make else language_colors(self._language)
        return self._fixed[mode].copy()

    def _relevancy(self, layers: Sequence[Layer], opacity: float, fade: float) -> NDArray[np.uint8]:
        result = _faded(self.photo, fade)
        shown = [layer for layer in layers if layer.shown]
        best = np.zeros(len(result), dtype=np.float32) if len(shown) > 1 else None
        for layer in shown:
            index = layer.marked()
            amount = layer.amount(index)
            if best is None:
                marks = colorize(0.3 + 0.7 * amount)
            else:
                # If two prompts mark the same Gaussian, the one with the larger amount is drawn.
                wins = amount + 1e-3 > best[index]
                index, amount = index[wins], amount[wins]
                best[index] = amount + 1e-3
                marks = np.broadcast_to(np.array(layer.color, dtype=np.uint8), (len(index), 3))
            weight = (opacity * (0.55 + 0.45 * amount))[:, None]
            result[index] = np.round((1 - weight) * self.photo[index] + weight * marks).astype(np.uint8)
        return result

    def _codes(self) -> NDArray[np.uint8]:
        codes, known = likeliest_codes(self._language)
        colors = code_palette(self._language.codebook.num_codes)[codes]
        colors[~known] = _PLAIN
        return colors

    def _uncertainty(self) -> NDArray[np.uint8]:
        values = self._language.uncertainties.detach().cpu().numpy()
        high = max(float(np.percentile(values, 98)) if len(values) else 0.0, 1e-3)
        self.scale = (0.0, high)
        return colorize(values, 0.0, high)

    def _depth(self, eye: NDArray | None) -> NDArray[np.uint8]:
        center = self._means.mean(0) if eye is None else np.asarray(eye, dtype=np.float32)
        distances = np.linalg.norm(self._means - center, axis=1)
        low, high = (float(v) for v in np.percentile(distances, [1, 95])) if len(distances) else (0.0, 1.0)
        self.scale = (low, max(high, low + 1e-6))
        return colorize(-distances, -self.scale[1], -self.scale[0])


def _faded(colors: NDArray[np.uint8], fade: float) -> NDArray[np.uint8]:
    if fade <= 0:
        return colors.copy()
    gray = colors @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
    target = 0.75 * _FADED + 0.25 * gray
    return np.round((1 - fade) * colors + fade * target[:, None]).astype(np.uint8)


# -- language


def likeliest_codes(language: LanguageField) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The most probable code of every Gaussian ``[N]``, and whether the Gaussian has language ``[N]``."""
    if isinstance(language, CodeField):
        weights, place = language.weights.max(1)
        codes = language.codes.gather(1, place[:, None])[:, 0].long()
        return codes.cpu().numpy(), (weights > 0).cpu().numpy()
    count = len(language.uncertainties)
    index = torch.arange(count, device=language.uncertainties.device)
    parts = [language.select(rows).code_probabilities().max(1) for rows in index.split(_ROWS)]
    likeliest = torch.cat([part.indices for part in parts]).cpu().numpy()
    return likeliest, (torch.cat([part.values for part in parts]) > 0).cpu().numpy()


def code_palette(count: int) -> NDArray[np.uint8]:
    """Colors ``[count, 3]`` for codes: hues in steps of the golden angle, in three lightnesses."""
    import colorsys

    colors = [
        colorsys.hls_to_rgb((0.61803398875 * i) % 1.0, (0.45, 0.6, 0.72)[i % 3], 0.65) for i in range(count)
    ]
    return np.round(np.array(colors, dtype=np.float64).reshape(count, 3) * 255).astype(np.uint8)


def language_colors(language: LanguageField) -> NDArray[np.uint8]:
    """The first three principal components of the Gaussians' language features as RGB bytes ``[N, 3]``.

    The feature of a Gaussian is linear in its code probabilities, F = p S with the codewords S. Its coordinates
    along the principal directions V are therefore p (S V). The directions come from a sample of the Gaussians; the
    projection covers all of them. Gaussians without language are gray.
    """
    codewords = language.codebook.clip.double().cpu()
    count = len(language.uncertainties)
    colors = np.tile(np.array(_PLAIN, dtype=np.uint8), (count, 1))
    ones = torch.ones(len(codewords), 1, device=language.uncertainties.device)
    known = language.scores(ones)[:, 0].cpu().numpy() > 0.5
    places = np.flatnonzero(known)
    if len(places) < 2:
        return colors
    sample = torch.from_numpy(places[:: max(1, len(places) // _SAMPLE)])
    shares = language.select(sample.to(ones.device)).code_probabilities().double().cpu()
    centered = shares - shares.mean(0)
    # The covariance of F is S^T cov(p) S, and cov(p) is only K x K.
    covariance = codewords.T @ (centered.T @ centered) @ codewords
    directions = torch.linalg.eigh(covariance).eigenvectors[:, -3:].flip(-1)
    signs = directions.gather(0, directions.abs().argmax(0, keepdim=True)).sign()
    table = (codewords @ (directions * signs)).float().to(ones.device)
    coordinates = language.scores(table).cpu().numpy()[known]
    low, high = np.percentile(coordinates, [2, 98], axis=0)
    spread = np.where(high - low > 1e-9, high - low, np.inf)
    unit = np.clip((coordinates - low) / spread, 0, 1)
    colors[known] = np.round(unit * 255).astype(np.uint8)
    return colors
