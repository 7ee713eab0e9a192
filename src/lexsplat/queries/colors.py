"""Color words for a set of Gaussians."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_EXAMPLES = (
    ("black", (25, 25, 25)), ("gray", (125, 125, 125)), ("white", (225, 225, 220)), ("red", (175, 40, 35)),
    ("red", (90, 15, 15)), ("orange", (220, 115, 35)), ("yellow", (225, 195, 60)), ("green", (60, 120, 50)),
    ("green", (25, 60, 25)), ("blue", (45, 80, 165)), ("blue", (20, 35, 85)), ("purple", (115, 65, 145)),
    ("pink", (225, 130, 165)), ("brown", (115, 75, 45)), ("blue", (0, 0, 255)), ("blue", (0, 0, 110)),
    ("blue", (130, 195, 240)), ("blue", (40, 190, 220)), ("green", (0, 120, 110)), ("purple", (140, 45, 225)),
    ("purple", (75, 5, 120)), ("purple", (60, 30, 80)),
)  # fmt: skip
"""sRGB of words, in 0..255, in light and in shade; blues and purples also vivid ones."""
COLOR_WORDS = tuple(dict.fromkeys(word for word, _ in _EXAMPLES))
"""Every color that `color_words` can tell."""
_LIGHTNESS = 0.5
"""Weight of the difference of lightness; that of hue and chroma is 1. Shading changes lightness most."""
_LEAST = 0.2
"""A word stands for at least this share of the visible weight, except for the first word."""


def color_words(colors: NDArray[np.float64], weights: NDArray[np.float64]) -> list[str]:
    """The words nearest in CIELAB to most of the colors, at most two, the more frequent first.

    Args:
        colors: sRGB ``[M, 3]`` in 0..1, M > 0.
        weights: Weight of each color ``[M]``, not negative.
    """
    from skimage.color import rgb2lab  # a second of imports that questions without colors do not wait for

    scale = np.array([_LIGHTNESS, 1.0, 1.0])
    known = rgb2lab(np.array([example for _, example in _EXAMPLES], float) / 255) * scale
    places = np.array([COLOR_WORDS.index(word) for word, _ in _EXAMPLES])
    apart = np.linalg.norm((rgb2lab(np.clip(colors, 0, 1)) * scale)[:, None] - known, axis=-1)
    shares = np.bincount(places[apart.argmin(1)], weights, len(COLOR_WORDS)) / max(
        float(weights.sum()), 1e-12
    )
    order = np.argsort(-shares, kind="stable")[:2]
    return [
        COLOR_WORDS[place] for number, place in enumerate(order) if number == 0 or shares[place] >= _LEAST
    ]
