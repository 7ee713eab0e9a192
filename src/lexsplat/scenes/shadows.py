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
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.colors import LUMINANCE
from lexsplat.queries.selection import Selection
from lexsplat.queries.vocabulary import is_divided
from lexsplat.runtime.progress import Event
from lexsplat.runtime.sampling import evenly
from lexsplat.scenes.materials import THING
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.surfaces import Views, across, looked_up
from lexsplat.scenes.views import training_cameras

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
_MOST_PIXELS = 2**21
"""Most pixels of a shadow; they are larger where this is not enough."""
_BEYOND = 0.9
"""Share of the way to a near lamp, from which on nothing hides it, nor is in a shadow."""
_VIEWS = 8
"""Views that show how bright surfaces are."""
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
_THICK = 0.5
"""Surfaces throw shadows on others that are further away than this, in sizes of a thing: a cloth lies on a table."""
_ELSEWHERE, _CLEARLY, _LEAST = 40.0, 1.5, 0.02
"""The best direction must explain at least the last, and so many times as much as those that are so many degrees
around from it."""
_CHANCE = 8
"""Places as alike as one, of which chance explains one: directions and shares are tried."""
_DARKEST, _LEAST_VARIANCE = 0.05, 1e-4
"""Places darker than the first say nothing. A surface has at least the second, the variance of the logarithm."""


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

    def hidden(self, things: FloatArray, places: FloatArray, away: float = 0.0) -> Mask:
        """Which rays from places to the lamp meet things ``[R, M]``.

        Args:
            things: Means of the Gaussians of things ``[T, 3]``.
            places: Points of the world ``[M, 3]``.
            away: Things nearer to a place than this do not hide the lamp from it, world units.
        """
        right, ahead = across(self.toward)
        rays = []
        for number in range(_RAYS if self.width else 1):
            angle, aside = number * np.pi * (3 - 5**0.5), self.width * np.sqrt((number + 0.5) / _RAYS)
            ray = self.toward + aside * (np.cos(angle) * right + np.sin(angle) * ahead)
            rays.append(self._hidden(things, places, ray / np.linalg.norm(ray), away))
        return np.stack(rays)

    def _hidden(self, things: FloatArray, places: FloatArray, ray: FloatArray, away: float) -> Mask:
        """The places ``[M]`` that things hide from a point of the lamp, by an image of the things' nearness to it."""
        if not len(things) or not len(places):
            return np.zeros(len(places), bool)
        pixel = _PIXEL * self.size
        above, below = (self._seen(each, ray) / pixel for each in (things, places))
        before = below[2] * pixel * self.nearness < _BEYOND  # the lamp is not behind the place
        low, high = below[:2].min(1) - 3, below[:2].max(1) + 3
        above = above[:, ((above[:2] >= low[:, None]) & (above[:2] <= high[:, None])).all(0)]
        above = above[:, above[2] * pixel * self.nearness < _BEYOND]
        if not above.size:
            return np.zeros(len(places), bool)
        low, high = above[:2].min(1), above[:2].max(1)
        coarse = max(1.0, float(np.sqrt(np.prod(high - low + 1) / _MOST_PIXELS)))
        count = np.ceil((high - low) / coarse).astype(int) + 5
        column, row = ((above[:2] - low[:, None]) / coarse).astype(int) + 2
        nearest = np.full(count, -np.inf)
        np.maximum.at(nearest, (column, row), above[2])
        nearest = minimum_filter(maximum_filter(nearest, 3), 3)  # Gaussians are further apart than pixels
        found = np.floor((below[:2] - low[:, None]) / coarse) + 2
        column, row = found.clip(0, count[:, None] - 1).astype(int)  # the rim of the image is empty
        return before & (nearest[column, row] > below[2] + max(1.0, away / pixel))

    def _seen(self, points: FloatArray, ray: FloatArray) -> FloatArray:
        """Where points are from a point of the lamp: two coordinates in an image, and how near to it ``[3, P]``."""
        right, ahead, toward = np.stack([*across(ray), ray]) @ (points - self.center).T
        scale = (1 - toward * self.nearness).clip(1 - _BEYOND)
        return np.stack([right / scale, ahead / scale, toward])


class Shadows(NamedTuple):
    """The shadows of things that go, and of what stays, where the photos show them.

    Args:
        light: The light.
        gone: Means of the Gaussians of things that go ``[D, 3]``.
        others: Those of the things that stay ``[R, 3]``.
        surfaces: Those of surfaces ``[S, 3]``.
        of: The surface that each of the latter belongs to ``[S]``.
    """

    light: Light
    gone: FloatArray
    others: FloatArray
    surfaces: FloatArray = np.zeros((0, 3))
    of: IntArray = np.zeros(0, np.intp)

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
        """How much brighter places are without the things that go ``[M]``, at least 1.

        A place that another surface hides from the lamp, such as the floor below a table, stays as it is.
        """
        factors = np.ones(len(places))
        asked = np.flatnonzero(self.light.hidden(self.gone, places).any(0) & (of >= 0))
        for surface in np.unique(of[asked]):
            here = asked[of[asked] == surface]
            others = self.surfaces[self.of != surface]
            lit = self.light.hidden(others, places[here], _THICK * self.light.size).mean(0) < 0.5
            now, then = self.at(places[here], of[here])
            factors[here] = np.where(lit, then / now, 1.0)
        return factors


def light_of(scene: Scene, kinds: IntArray) -> Light | None:
    """The light of a built scene; None if its shadows do not tell, or its things are no longer where they threw them.

    Args:
        scene: The scene.
        kinds: What each Gaussian is of ``[N]``, as `lexsplat.scenes.materials.kinds_of_segments` says.
    """
    things = [each for each in scene.objects if not is_divided(each.phrase)]
    edits = scene.folder.record.get("edits", ()) if scene.folder is not None else ()
    if not things or any(str(edit).startswith(("move", "duplicate")) for edit in edits):
        return None
    standing = torch.from_numpy(kinds == THING) & ~scene.hidden.cpu()
    means = scene.gaussians.means.detach().cpu()[standing].double().numpy()
    views = Views(scene.gaussians, evenly(training_cameras(scene.views), _VIEWS))
    size = float(np.median([np.median(each.size) for each in things]))
    scene.listener(Event("light", 0, 1))
    try:
        return find_light(views, kinds, means, things[0].up.direction, size)
    finally:  # a viewer goes on after an error, and its bar ends
        scene.listener(Event("light", 1, 1))


def shadows_of(light: Light, before: Gaussians, chosen: Selection, kinds: IntArray) -> Shadows:
    """The shadows of a selection and of what stays. What edits moved or copied threw none where it is now.

    Args:
        light: The light.
        before: The scene as the photos show it.
        chosen: The selection, in the scene as it is now.
        kinds: What each of its Gaussians is of ``[N]``.
    """
    means, known = (each.means.detach().cpu().numpy() for each in (chosen.gaussians, before))
    own, solid = chosen.mask.cpu().numpy(), chosen.gaussians.opacities.detach().cpu().numpy() >= _FAINT
    asked = np.flatnonzero(solid & ((kinds == THING) | (own & (kinds < 0))))
    throws = np.zeros(len(means), bool)
    throws[asked] = np.isin(_rows(means[asked]), _rows(known))
    of = np.flatnonzero(solid & ~own & (kinds >= 0))
    gone, others, surfaces = (means[each].astype(float) for each in (throws & own, throws & ~own, of))
    return Shadows(light, gone, others, surfaces, kinds[of])


def _rows(points: NDArray[np.float32]) -> NDArray:
    """Points ``[M, 3]`` as values ``[M]`` that are equal where they are."""
    return np.ascontiguousarray(points + np.float32(0)).view("V12")[:, 0]  # -0 and 0 are equal


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

    least = max(_LEAST, _CHANCE * _ALIKE / len(places.at))
    best = _best_light(lambda *numbers: explained(*numbers)[0], least)
    return None if best is None else light(*best)._replace(direct=explained(*best)[1])


def _best_light(explained: Callable[..., float], least: float) -> tuple[float, ...] | None:
    """Angle in degrees, tangent, width and nearness of the light that explains most; None if others do, too.

    Args:
        explained: The share that a light explains.
        least: The share that it must explain.
    """
    angles = np.arange(_DIRECTIONS) * 360 / _DIRECTIONS
    tried = [(explained(angle, tangent), angle, tangent) for angle in angles for tangent in _TANGENTS]
    best, angle, tangent = max(tried)
    elsewhere = [score for score, other, _ in tried if abs((other - angle + 180) % 360 - 180) > _ELSEWHERE]
    if best < max(least, _CLEARLY * max(elsewhere)):
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
                least = _LEAST_VARIANCE * weights.sum()
                left[surface] = [least + (weights * (actual - model) ** 2).sum() for model in models]
        evidence = (
            np.bincount(self.of, minlength=surfaces)[:, None] / _ALIKE * left / left.min(1, keepdims=True)
        )
        usual = _SHARES[int(evidence.sum(0).argmin())]
        chosen = (evidence + ((_SHARES - usual) / _UNLIKE) ** 2).argmin(1)
        explained = 1 - left[np.arange(surfaces), chosen] / left[:, 0]
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
    asked = _of_each(np.flatnonzero((kinds >= 0) & solid), kinds, 20 * _PLACES)
    away = cKDTree(things).query(means[asked], distance_upper_bound=_NEAR * size)[0]
    asked = asked[(away >= _CONTACT * size) & (away < _NEAR * size)]
    asked = _of_each(asked, kinds, _PLACES)
    seen, _, _, colors = looked_up(views, np.zeros(len(means), bool), means[asked], _SLACK * size)
    bright = colors @ LUMINANCE
    clear = bright > _DARKEST
    asked, seen, bright = asked[clear], seen[clear], bright[clear]
    at, of = means[asked], kinds[asked]
    cubes = np.column_stack([np.floor(at / (_TOGETHER * size)).astype(int), of])
    groups = np.unique(cubes, axis=0, return_inverse=True)[1].ravel()
    for surface in np.unique(of):
        own = of == surface
        bright[own] = _smooth(bright[own], seen[own], at[own], _SMOOTH * size)
    return _Places(at, of, groups, seen), np.log(bright)


def _smooth(values: FloatArray, weights: FloatArray, at: FloatArray, reach: float) -> FloatArray:
    """Weighted means of values around points ``[M]``."""
    near = range(1, _NEIGHBORS + 1)
    apart, which = cKDTree(at).query(at, k=near, distance_upper_bound=2 * reach)
    kernel = np.exp(-((apart / reach) ** 2) / 2) * np.append(weights, 0)[which]
    return np.asarray((kernel * np.append(values, 0)[which]).sum(1) / kernel.sum(1))


def _of_each(index: IntArray, kinds: IntArray, most: int) -> IntArray:
    """At most so many Gaussians of each surface."""
    return np.concatenate([_thinned(index[kinds[index] == each], most) for each in range(kinds.max() + 1)])


def _thinned(rows: NDArray, most: int) -> NDArray:
    """At most so many rows, evenly taken."""
    return rows[:: max(-(-len(rows) // most), 1)]
