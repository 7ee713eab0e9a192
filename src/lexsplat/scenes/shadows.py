"""The light of a scene, and the shadows that things throw on surfaces.

A deleted thing leaves its shadow on the table, and on a wall far behind it. Where it lies follows from the direction
of the light, and that from the shadows of all things.

1. The photos show how bright the listed surfaces are around things (`_bright_places`).
2. A surface gets a share of its light straight from a lamp, or the sun. Things between the lamp and a place take that
   from it. The direction that explains most of the differences between places near each other is that of the lamp
   (`find_light`).
3. A lamp has a width. So shadows are soft, more so far behind a thing: `Light.hidden` tells by several rays to it.
4. Without a thing, its shadow goes, except where another thing throws one, too (`Shadows`).

A scene without clear shadows has no `Light`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from lexsplat.queries.colors import LUMINANCE
from lexsplat.scenes.surfaces import Views, across, looked_up

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
Mask = NDArray[np.bool_]

_CONTACT, _NEAR = 0.12, 7.0
"""Places nearer to things than the first are dark in any light; shadows are looked for up to the second, in sizes of
things."""
_SMOOTH, _NEIGHBORS = 0.12, 24
"""Reach of the mean of brightness, in sizes of a thing, and most places in it: patterns are no shadows."""
_TOGETHER = 5.0
"""Places of a surface in a cube of this width, in sizes of a thing, are compared with each other."""
_FAINT, _SLACK = 0.1, 0.1
"""Opacity of Gaussians that do not count, and tolerance of depth where a place is seen, in sizes of a thing."""
_PLACES, _THINGS = 4000, 20000
"""Most places of a surface, and most Gaussians of things, from which the light is found."""
_PIXEL = 0.065
"""Width of the pixels of a shadow, in sizes of a thing."""
_FAR = 1024
"""Things further than this many pixels from the center throw no shadow: a speck far away would make a huge image."""
_RAYS = 12
"""Rays from a place to the lamp."""
_DIRECTIONS, _TANGENTS = 24, (0.4, 0.8, 1.3, 2.0)
"""Directions that are tried: how many around, and tangents of their angles with up."""
_TURNS, _STRETCHES = (-10.0, -5.0, 0.0, 5.0, 10.0), (0.7, 0.85, 1.0, 1.2, 1.4)
"""Finer steps around the best of them, in degrees around, and as factors of the tangent."""
_WIDTHS, _NEARNESS = (0.03, 0.1, 0.2, 0.3), (0.0, 0.05, 0.1)
"""Half widths of the lamp in radians, and inverse distances, in sizes of a thing, that are tried."""
_SHARES = np.linspace(0, 0.7, 15)
"""Shares of a surface's brightness that may come from the lamp."""
_ALIKE, _UNLIKE = 24, 0.1
"""Places that say the same, because they are near each other, and how much the shares of surfaces differ."""
_ELSEWHERE, _CLEARLY, _LEAST = 40.0, 1.5, 0.02
"""The best direction must explain at least the last, and so many times as much as those that are so many degrees
around from it."""
_DARKEST = 0.05
"""Brightness below which differences say nothing."""


class Light(NamedTuple):
    """A lamp, or the sun.

    Args:
        toward: Unit vector to it ``[3]``.
        center: From where ``[3]``.
        nearness: Inverse of its distance, per world unit; 0 for the sun.
        width: Half of its width, radians.
        direct: The share of the brightness of each surface that it makes ``[G]``.
        size: Size of a typical thing, world units.
    """

    toward: FloatArray
    center: FloatArray
    nearness: float
    width: float
    direct: FloatArray
    size: float

    def hidden(self, things: FloatArray, places: FloatArray) -> Mask:
        """Which rays from places to the lamp meet things ``[R, M]``.

        Args:
            things: Means of the Gaussians of things ``[T, 3]``.
            places: Points of the world ``[M, 3]``.
        """
        right, ahead = across(self.toward)
        rays = []
        for number in range(_RAYS if self.width else 1):
            angle, away = number * np.pi * (3 - 5**0.5), self.width * np.sqrt((number + 0.5) / _RAYS)
            ray = self.toward + away * (np.cos(angle) * right + np.sin(angle) * ahead)
            rays.append(self._hidden(things, places, ray / np.linalg.norm(ray)))
        return np.stack(rays)

    def _hidden(self, things: FloatArray, places: FloatArray, ray: FloatArray) -> Mask:
        """The places ``[M]`` that things hide from a point of the lamp, by an image of the things' nearness to it."""
        above, (column, row, low) = (
            self._seen(each, ray) / (_PIXEL * self.size) for each in (things, places)
        )
        right, ahead, high = above[:, (np.abs(above[:2]) < _FAR).all(0)]
        if not len(high):
            return np.zeros(len(places), bool)
        left, bottom = right.min() - 2, ahead.min() - 2
        width, height = int(right.max() - left) + 3, int(ahead.max() - bottom) + 3
        nearest = np.full((width, height), -np.inf)
        np.maximum.at(nearest, ((right - left).astype(int), (ahead - bottom).astype(int)), high)
        nearest = minimum_filter(maximum_filter(nearest, 3), 3)  # Gaussians are further apart than pixels
        column, row = (column - left).clip(0, width - 1), (row - bottom).clip(0, height - 1)
        return nearest[column.astype(int), row.astype(int)] > low + 1  # the rim of the image is empty

    def _seen(self, points: FloatArray, ray: FloatArray) -> FloatArray:
        """Where points are from a point of the lamp: two coordinates in an image, and how near to it ``[3, P]``."""
        right, ahead, toward = np.stack([*across(ray), ray]) @ (points - self.center).T
        scale = (1 - toward * self.nearness).clip(0.05)
        return np.stack([right / scale, ahead / scale, toward])


class Shadows(NamedTuple):
    """The shadows of things that go, and of things that stay.

    Args:
        light: The light.
        gone: Means of the Gaussians of things that go ``[D, 3]``.
        others: Those of the things that stay ``[R, 3]``.
    """

    light: Light
    gone: FloatArray
    others: FloatArray

    def at(self, places: FloatArray, of: IntArray) -> tuple[FloatArray, FloatArray]:
        """The brightness of places now ``[M]``, and without the things that go ``[M]``; 1 without any shadow.

        Args:
            places: Points of the world ``[M, 3]``.
            of: Their surfaces ``[M]``; a negative one gets no shadow.
        """
        direct = self.light.direct[of] * (of >= 0)
        others = self.light.hidden(self.others, places)
        both = others | self.light.hidden(self.gone, places)
        return 1 - direct * both.mean(0), 1 - direct * others.mean(0)

    def factors(self, places: FloatArray, of: IntArray) -> FloatArray:
        """How much brighter places are without the things that go ``[M]``, at least 1."""
        factors = np.ones(len(places))
        asked = np.flatnonzero(self.light.hidden(self.gone, places).any(0))
        now, then = self.at(places[asked], of[asked])
        factors[asked] = then / now
        return factors


def find_light(
    views: Views, kinds: IntArray, things: FloatArray, up: FloatArray, size: float
) -> Light | None:
    """The light of a scene; None if its shadows do not tell.

    Args:
        views: The scene and its views.
        kinds: What each Gaussian is of ``[N]``, as `lexsplat.scenes.materials.kinds_of_segments` says.
        things: Means of the Gaussians of things ``[T, 3]``.
        up: Unit vector ``[3]``.
        size: Size of a typical thing, world units.
    """
    surfaces = int(kinds.max(initial=-1)) + 1
    if not surfaces or not len(things) or not views.small:
        return None
    things = _thinned(things, _THINGS)
    places, brightness = _bright_places(views, kinds, things, size)
    if not len(places.at):
        return None
    right, ahead = across(up)
    center = np.median(things, 0)

    def light(angle: float, tangent: float, width: float = 0.0, nearness: float = 0.0) -> Light:
        around = np.cos(np.radians(angle)) * right + np.sin(np.radians(angle)) * ahead
        toward = (up + tangent * around) / np.hypot(1, tangent)
        return Light(toward, center, nearness / size, width, np.zeros(surfaces), size)

    def explained(*numbers: float) -> tuple[float, FloatArray]:
        hidden = light(*numbers).hidden(things, places.at).mean(0)
        return places.explained(brightness, hidden, surfaces)

    best = _best_light(lambda *numbers: explained(*numbers)[0])
    return None if best is None else light(*best)._replace(direct=explained(*best)[1])


def _best_light(explained: Callable[..., float]) -> tuple[float, ...] | None:
    """Angle in degrees, tangent, width and nearness of the light that explains most; None if others do, too.

    Args:
        explained: The share that a light explains.
    """
    angles = np.arange(_DIRECTIONS) * 360 / _DIRECTIONS
    tried = [(explained(angle, tangent), angle, tangent) for angle in angles for tangent in _TANGENTS]
    best, angle, tangent = max(tried)
    elsewhere = [score for score, other, _ in tried if abs((other - angle + 180) % 360 - 180) > _ELSEWHERE]
    if best < max(_LEAST, _CLEARLY * max(elsewhere)):
        return None

    def best_of(candidates: Iterable[tuple[float, ...]]) -> tuple[float, ...]:
        return max(candidates, key=lambda numbers: explained(*numbers))

    finer = ((angle + turn, tangent * by, _WIDTHS[2]) for turn in _TURNS for by in _STRETCHES)
    angle, tangent, _ = best_of(finer)
    found = best_of((angle, tangent, width) for width in _WIDTHS)
    return best_of((*found, nearness) for nearness in _NEARNESS)


class _Places(NamedTuple):
    """Places of surfaces.

    Args:
        at: Points of the world ``[M, 3]``.
        of: The surface of each ``[M]``.
        groups: Those of a group are near to each other ``[M]``.
        weights: How many views show each ``[M]``.
    """

    at: FloatArray
    of: IntArray
    groups: IntArray
    weights: FloatArray

    def explained(
        self, brightness: FloatArray, hidden: FloatArray, surfaces: int
    ) -> tuple[float, FloatArray]:
        """The share of the differences in groups that shadows explain, and the lamp's share of surfaces ``[G]``.

        Args:
            brightness: Logarithm of the brightness of the places ``[M]``.
            hidden: The share of the lamp that is hidden from them ``[M]``.
            surfaces: Number of surfaces.
        """
        left = np.ones((surfaces, len(_SHARES)))
        for surface in range(surfaces):
            own = self.of == surface
            if hidden[own].any():
                weights, actual = self.weights[own], self._apart(brightness[own], own)
                models = (self._apart(np.log(1 - share * hidden[own]), own) for share in _SHARES)
                left[surface] = [(weights * (actual - model) ** 2).sum() for model in models]
        evidence = (
            np.bincount(self.of, minlength=surfaces)[:, None] / _ALIKE * left / left.min(1, keepdims=True)
        )
        usual = _SHARES[int(evidence.sum(0).argmin())]
        chosen = (evidence + ((_SHARES - usual) / _UNLIKE) ** 2).argmin(1)
        explained = 1 - left[np.arange(surfaces), chosen] / left[:, 0].clip(1e-12)
        weights = np.bincount(self.of, self.weights, surfaces)
        return float((weights * explained).sum() / weights.sum()), _SHARES[chosen]

    def _apart(self, values: FloatArray, own: Mask) -> FloatArray:
        """Values less their mean in each group."""
        weights, groups = self.weights[own], self.groups[own]
        sums = np.bincount(groups, weights * values) / np.maximum(np.bincount(groups, weights), 1e-12)
        return np.asarray(values - sums[groups])


def _bright_places(
    views: Views, kinds: IntArray, things: FloatArray, size: float
) -> tuple[_Places, FloatArray]:
    """Places of surfaces around things, and the logarithm of their brightness in the views ``[M]``."""
    means = views.gaussians.means.detach().cpu().double().numpy()
    solid = views.gaussians.opacities.detach().cpu().numpy() >= _FAINT
    asked = np.flatnonzero((kinds >= 0) & solid)
    away = cKDTree(things).query(means[asked], distance_upper_bound=_NEAR * size)[0]
    asked = asked[(away >= _CONTACT * size) & (away < _NEAR * size)]
    asked = np.concatenate(
        [_thinned(asked[kinds[asked] == each], _PLACES) for each in range(kinds.max() + 1)]
    )
    seen, _, _, colors = looked_up(views, np.zeros(len(means), bool), means[asked], _SLACK * size)
    clear = colors.any(1)
    asked, seen, bright = asked[clear], seen[clear], colors[clear] @ LUMINANCE
    at, of = means[asked], kinds[asked]
    cubes = np.column_stack([np.floor(at / (_TOGETHER * size)).astype(int), of])
    groups = np.unique(cubes, axis=0, return_inverse=True)[1].ravel()
    for surface in np.unique(of):
        own = of == surface
        bright[own] = _smooth(bright[own], seen[own], at[own], _SMOOTH * size)
    return _Places(at, of, groups, seen), np.log(bright.clip(_DARKEST))


def _smooth(values: FloatArray, weights: FloatArray, at: FloatArray, reach: float) -> FloatArray:
    """Weighted means of values around points ``[M]``."""
    near = range(1, _NEIGHBORS + 1)
    apart, which = cKDTree(at).query(at, k=near, distance_upper_bound=2 * reach)
    kernel = np.exp(-((apart / reach) ** 2) / 2) * np.append(weights, 0)[which]
    return np.asarray((kernel * np.append(values, 0)[which]).sum(1) / kernel.sum(1))


def _thinned(rows: NDArray, most: int) -> NDArray:
    """At most so many rows, evenly taken."""
    return rows[:: max(-(-len(rows) // most), 1)]
