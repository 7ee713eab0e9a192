"""Color words for a set of Gaussians, and which words light and shade turn into which."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from lexsplat.queries.vocabulary import QUALITIES

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
_XYZ = np.array(
    [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of red, green and blue in the brightness of a color."""
_DAYLIGHT = np.array([0.95047, 1.0, 1.08883])
_LIGHTNESS = 0.5
"""Weight of the difference of lightness; that of hue and chroma is 1. Shading changes lightness most."""
NEAR = (
    "white gray", "white yellow", "gray black", "red pink", "red orange", "red brown", "orange yellow",
    "orange brown", "yellow brown", "yellow green", "green blue", "blue purple", "purple pink", "brown black",
)  # fmt: skip
"""Pairs of colors of which one may be seen as the other in another light."""
SEEN = 0.1
"""A thing is seen in a color that has this share of its visible weight."""
METALS = {
    "gold": "yellow orange brown", "golden": "yellow orange brown",
    "silver": "gray white", "copper": "orange brown red",
}  # fmt: skip
"""The colors in which things of a metal are seen. So are other things: a yellow ring may be of wood."""
_ARTICLES = frozenset({"a", "an", "the", "my", "your"})
_LEAST = 0.2
"""A word stands for at least this share of the visible weight, except for the first word."""


def color_words(colors: NDArray[np.float64], weights: NDArray[np.float64]) -> list[str]:
    """The words nearest in CIELAB to most of the colors, at most two, the more frequent first; see `color_shares`."""
    first, *others = sorted(color_shares(colors, weights).items(), key=lambda entry: -entry[1])
    return [first[0], *(word for word, share in others[:1] if share >= _LEAST)]


def color_shares(colors: NDArray[np.float64], weights: NDArray[np.float64]) -> dict[str, float]:
    """The share of the weight of the colors that are nearest to each word, in 0..1.

    Args:
        colors: sRGB ``[M, 3]`` in 0..1, M > 0.
        weights: Weight of each color ``[M]``, not negative.
    """
    scale = np.array([_LIGHTNESS, 1.0, 1.0])
    known = cielab(np.array([example for _, example in _EXAMPLES], float) / 255) * scale
    places = np.array([COLOR_WORDS.index(word) for word, _ in _EXAMPLES])
    apart = np.linalg.norm((cielab(np.clip(colors, 0, 1)) * scale)[:, None] - known, axis=-1)
    shares = np.bincount(places[apart.argmin(1)], weights, len(COLOR_WORDS))
    return dict(zip(COLOR_WORDS, (shares / max(float(weights.sum()), 1e-12)).tolist()))


def cielab(colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIELAB of sRGB ``[..., 3]`` in 0..1, for daylight (D65). The import of scikit-image takes a second."""
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    x, y, z = np.moveaxis(linear @ _XYZ.T / _DAYLIGHT, -1, 0)
    x, y, z = (np.where(v > 216 / 24389, np.cbrt(v), (24389 / 27 * v + 16) / 116) for v in (x, y, z))
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def color_told(phrase: str) -> set[str]:
    """The colors that a phrase tells of a thing: "red" of "red mug", but not that of an orange."""
    before = phrase.lower().replace("grey", "gray").split()[:-1]
    return set(before) & set(COLOR_WORDS)


def colors_expected(phrase: str) -> set[str]:
    """The colors of which a thing shows one if a phrase is right: those that it tells, and those of its metals."""
    before = phrase.lower().split()[:-1]
    return color_told(phrase).union(*(METALS.get(word, "").split() for word in before))


def without_color(phrase: str) -> str:
    """A phrase without the colors that it tells: "mug" of "red mug", "striped mug" of "red and blue striped mug"."""
    return _without(phrase, color_told(phrase))


def is_qualified(phrase: str) -> bool:
    """Whether a phrase tells a color, a material or the like of a thing."""
    before = phrase.lower().replace("grey", "gray").split()[:-1]
    return not QUALITIES.isdisjoint(before)


def unqualified(phrase: str) -> str:
    """A phrase without articles, and without colors, materials and the like: "duck" of "the metal duck"."""
    return _without(phrase, QUALITIES | _ARTICLES)


def _without(phrase: str, left_out: Collection[str]) -> str:
    """A phrase without some words before its last one, and without what joins them."""
    *before, last = phrase.split() or [""]
    small = [word.lower().rstrip(",").replace("grey", "gray") for word in before]
    gone = [word in left_out for word in small]
    around = [any(gone[max(0, place - 1) : place + 2]) for place in range(len(gone))]
    kept = [
        word
        for word, plain, out, beside in zip(before, small, gone, around)
        if not out and not (beside and plain in ("and", "or", ""))
    ]
    return " ".join([*kept, last])


def may_be(told: set[str], seen: set[str]) -> bool:
    """Whether a thing seen in some colors may have one of the colors that a phrase tells, in another light."""
    pairs = [set(pair.split()) for pair in NEAR]
    return bool(told & seen) or any(pair & told and pair & seen for pair in pairs)
