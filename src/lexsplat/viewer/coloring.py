"""Colors of Gaussians that show what a scene holds besides answers: language, codes, uncertainty.

Pure array arithmetic. N Gaussians, K codes.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.language.fields import LanguageField
from lexsplat.queries.heatmaps import colorize

MODES = ("language", "codes", "uncertainty")

_SAMPLE = 65_536
_ROWS = 16_384
_PLAIN = (150, 150, 158)
"""Color of Gaussians without language."""


def colors_in(mode: str, language: LanguageField) -> NDArray[np.uint8]:
    """RGB of every Gaussian ``[N, 3]``: principal components, its likeliest code, or its uncertainty.

    Raises:
        ValueError: If the mode is not one of `MODES`.
    """
    if mode == "language":
        return language_colors(language)
    if mode == "codes":
        codes, known = language.likeliest_codes()
        colors = code_palette(language.codebook.num_codes)[codes.cpu().numpy()]
        colors[~known.cpu().numpy()] = _PLAIN
        return colors
    if mode == "uncertainty":
        values = language.uncertainties.detach().cpu().numpy()
        high = max(float(np.percentile(values, 98)) if len(values) else 0.0, 1e-3)
        return colorize(values, 0.0, high)
    raise ValueError(f"mode must be one of {', '.join(MODES)}, got {mode[:40]!r}")


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
