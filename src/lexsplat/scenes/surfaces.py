"""The surface that a thing stands on, as the photos show it: a plane, and an image of it from above.

1. A plane is fitted to the Gaussians around the thing's foot.
2. The Gaussians near it are drawn from far above, in the mean color that the cameras see.
3. Each pixel of this image is looked up in the views: how many see the surface there, or through it, and how many the
   thing before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import PreparedView, measure_weights, prepare, render
from lexsplat.rendering.pairs import TilePairs
from lexsplat.runtime.sampling import evenly
from lexsplat.scenes.completing import mean_around

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FOOT = 0.15
"""The foot of a thing: its lowest share by height."""
_RING, _WIDE = 1.0, 3.0
"""Width of the ring around the foot whose Gaussians make the plane, in radii of the foot: of all, and of those of
surfaces only, where that is not enough."""
_LEVELS = (0.1, 0.2)
"""Gaussians of the ring within this distance of the plane belong to it, in radii of the foot. The second is taken
where too few are within the first: wood has few Gaussians."""
THICK = 0.3
"""Gaussians within this distance of the plane are the surface that is seen from above, in radii of the foot."""
_STEEPEST = 0.8
"""Least cosine of the plane's normal with up."""
FEWEST = 30
"""Fewest Gaussians that make a plane, and fewest pixels that make a fill."""
_PIXELS = (64, 112, 224)
"""Width of the image from above: at least, without views, and at most."""
REACH, TALL = 3.0, 1.5
"""Half of its width: at least so many radii of the foot, or heights of the thing and a radius, for its shadow."""
_VIEWS, _LONG_SIDE = 16, 240
"""Number and longer side of the views that are looked at."""
_BEFORE = 0.2
"""Share of a pixel from which the thing in it hides what lies behind."""
_EMPTY = 0.5
"""Coverage of a pixel below which nothing is seen in it."""
_PREPARED_BYTES = 2**28
"""Memory for prepared views, which are looked at several times."""


class Surface(NamedTuple):
    """The plane that a thing stands on.

    Args:
        origin: A point of it ``[3]``.
        axes: Two unit vectors in it, and its normal, which points up ``[3, 3]`` in rows.
        foot: Center of the thing's foot in the two vectors ``[2]``.
        radius: Radius of the foot, world units.
        reach: Half of the width of the image from above, world units.
    """

    origin: FloatArray
    axes: FloatArray
    foot: FloatArray
    radius: float
    reach: float


def surface_below(
    own: FloatArray, others: FloatArray, up: FloatArray, listed: FloatArray | None = None
) -> Surface | None:
    """The plane around the foot of a thing; None if there is none.

    Args:
        own: Means of the Gaussians of the thing ``[M, 3]``.
        others: Those of the Gaussians around it ``[R, 3]``.
        up: Unit vector ``[3]``.
        listed: Those of listed surfaces ``[S, 3]``. Where too few of the others are near, these make the plane.
    """
    if len(own) < 4:
        return None
    right, ahead = across(up)
    heights = own @ up
    low, high = np.quantile(heights, [0.02, 0.98])
    foot = own[heights <= low + _FOOT * (high - low)]
    flat = foot @ np.stack([right, ahead]).T
    center = np.median(flat, 0)
    radius = max(float(np.quantile(np.linalg.norm(flat - center, axis=1), 0.9)), 1e-9)
    plane = None
    for points, width, below in (
        (others, _RING, 0.5),
        (others[:0] if listed is None else listed, _WIDE, 1.0),
    ):
        apart = np.linalg.norm(points @ np.stack([right, ahead]).T - center, axis=1)
        above = points @ up - low
        near = (above >= -below * radius) & (above <= 0.5 * radius)
        ring = points[near & (apart <= (1 + width) * radius)]
        planes = (_fitted_plane(ring, up, level * radius) for level in _LEVELS) if len(ring) >= FEWEST else ()
        plane = plane or next((each for each in planes if each is not None), None)
    if plane is None:
        return None
    origin, normal = plane
    axes = np.stack([*across(normal), normal])
    middle = np.median((foot - origin) @ axes[:2].T, 0)
    return Surface(origin, axes, middle, radius, max(REACH * radius, TALL * (high - low) + radius))


def _fitted_plane(points: FloatArray, up: FloatArray, level: float) -> tuple[FloatArray, FloatArray] | None:
    """The plane through most points near a level, as origin and normal; None if too few lie in it."""
    heights = points @ up
    ordered = np.sort(heights)
    counts = np.searchsorted(ordered, heights + level, "right") - np.searchsorted(ordered, heights - level)
    fits = np.abs(heights - heights[int(np.argmax(counts))]) <= level
    origin, normal = points.mean(0), up
    for _ in range(5):
        if fits.sum() < FEWEST:
            return None
        origin = points[fits].mean(0)
        normal = np.linalg.svd(points[fits] - origin, full_matrices=False)[2][2]
        normal = normal if normal @ up > 0 else -normal
        fits = np.abs((points - origin) @ normal) <= level
    return (origin, normal) if normal @ up >= _STEEPEST else None


def across(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors that are square to ``up`` and to each other."""
    right = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    right /= np.linalg.norm(right)
    return right, np.cross(up, right)


class Views:
    """Some of the views of a scene, small; those that memory allows are projected and sorted once.

    Args:
        gaussians: The scene.
        cameras: Its views, of which `_VIEWS` are taken.
    """

    def __init__(self, gaussians: Gaussians, cameras: Sequence[Camera]) -> None:
        self.gaussians, self.of = gaussians, cameras
        self.small = [camera.within(_LONG_SIDE) for camera in evenly(cameras, _VIEWS)]
        self._prepared: dict[int, PreparedView] = {}
        self._bytes = 0

    def prepared(self, number: int) -> PreparedView:
        """One of the small views."""
        if number in self._prepared:
            return self._prepared[number]
        view = prepare(self.gaussians, self.small[number])
        if self._bytes + view.nbytes <= _PREPARED_BYTES:
            self._prepared[number] = view
            self._bytes += view.nbytes
        return view

    def at(self, number: int, pixels: NDArray[np.int64]) -> PreparedView:
        """One of the small views for `render`, of which only these pixels (x, y) ``[P, 2]`` are read."""
        view = self.prepared(number)
        if not isinstance(view.pairs, TilePairs):
            return view
        return replace(view, pairs=view.pairs.narrowed(view.pairs.tiles_at(pixels)))

    def depth_without(self, number: int, gone: Mask, pixels: NDArray[np.int64]) -> FloatArray:
        """Depth ``[H, W]`` in one of the small views without some Gaussians ``[N]``; infinite where nothing is left.

        Only these pixels (x, y) ``[P, 2]`` are right.
        """
        gaussians, prepared = self.gaussians, self.prepared(number)
        if isinstance(prepared.pairs, TilePairs):
            pairs = prepared.pairs.narrowed(prepared.pairs.tiles_at(pixels), gone)
            view = replace(prepared, pairs=pairs)
        else:
            gaussians = gaussians.select(torch.from_numpy(~gone).to(gaussians.device))
            view = prepare(gaussians, self.small[number])
        with torch.no_grad():
            found = render(gaussians, self.small[number], color=False, depth=True, prepared=view)
        depth = cast(torch.Tensor, found.depth)
        empty = found.alpha.reshape(depth.shape) < _EMPTY
        return torch.where(empty, torch.inf, depth).cpu().double().numpy()

    def weights(self, places: NDArray[np.int64], gone: Mask) -> tuple[FloatArray, FloatArray]:
        """Visible weights of some Gaussians ``[P]``, in pixels: now, and without others ``[N]``."""
        now, then = np.zeros(len(places)), np.zeros(len(places))
        asked = np.zeros(len(gone), bool)
        asked[places] = True
        others: Gaussians | None = None
        for number, camera in enumerate(self.small):
            view = self.prepared(number)
            if isinstance(view.pairs, TilePairs):
                tiles = view.pairs.tiles_of(asked)
                with_it, without = (
                    replace(view, pairs=view.pairs.narrowed(tiles, by)) for by in (None, gone)
                )
                now += _measured(self.gaussians, camera, with_it)[places]
                then += _measured(self.gaussians, camera, without)[places]
            else:
                others = others or self.gaussians.select(torch.from_numpy(~gone).to(self.gaussians.device))
                now += _measured(self.gaussians, camera, view)[places]
                then += _measured(others, camera, None)[(np.cumsum(~gone) - 1)[places]]
        return now, then


def _measured(gaussians: Gaussians, camera: Camera, prepared: PreparedView | None) -> FloatArray:
    return measure_weights(gaussians, camera, prepared=prepared).cpu().double().numpy()


class Orthophoto(NamedTuple):
    """A surface from far above; rows and columns run along its axes.

    Args:
        cells: Places of the pixels in the two vectors of the plane ``[P, P, 2]``.
        size: Width of a pixel, world units.
        colors: RGB ``[P, P, 3]``, divided by the coverage.
        coverage: How opaque the surface is there ``[P, P]``.
        shown: Share of the views that see the surface there, or nothing in its place ``[P, P]``.
        covered: Share of the views that have the thing before it ``[P, P]``.
        revealed: Share of the views that have nothing but the thing before it ``[P, P]``.
    """

    cells: FloatArray
    size: float
    colors: FloatArray
    coverage: FloatArray
    shown: FloatArray
    covered: FloatArray
    revealed: FloatArray

    def at(self, image: NDArray, points: FloatArray) -> NDArray:
        """The pixels ``[N]`` of an image ``[P, P]`` in which points ``[N, 2]`` of the plane lie; 0 outside."""
        (first, *_), count = self.cells[0], len(image)
        columns = np.round((points[:, 0] - first[0]) / self.size).astype(int)
        rows = np.round((first[1] - points[:, 1]) / self.size).astype(int)
        inside = (columns >= 0) & (columns < count) & (rows >= 0) & (rows < count)
        return image[rows.clip(0, count - 1), columns.clip(0, count - 1)] * inside


def photographed(views: Views, gone: Mask, surface: Surface, members: Mask) -> Orthophoto:
    """An image of the surface under a thing from above, and what the views see of it.

    Args:
        views: The scene with the thing; without any views, the surface is shown everywhere.
        gone: The Gaussians of the thing and of others that go with it ``[N]``.
        surface: The plane.
        members: The Gaussians that are drawn ``[N]``.
    """
    cells, size = _cells(surface, views.of)
    colors, coverage, _ = from_above(views.gaussians, surface, members, cells)
    places = (surface.origin + cells @ surface.axes[:2]).reshape(-1, 3)
    *shares, seen = looked_up(views, gone, places, THICK * surface.radius)
    shown, covered, revealed = (share.reshape(cells.shape[:2]) for share in shares)
    seen = seen.reshape(colors.shape)
    known = (coverage > 0.5) & seen.any(-1)
    width = surface.radius / size / 2
    gain = np.ones(3)
    if known.any():
        there, drawn = (mean_around(image, known.astype(float), width, 4.0) for image in (seen, colors))
        gain = (there / np.maximum(drawn, 0.02)).clip(0.5, 2)
    shown = shown if views.of else np.ones_like(shown)
    return Orthophoto(cells, size, colors * gain, coverage, shown, covered, revealed)


def looked_up(
    views: Views, gone: Mask, places: FloatArray, slack: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Visibility and color of places ``[M, 3]`` in the views.

    Args:
        views: The scene and its views.
        gone: The Gaussians of a thing ``[N]``.
        places: Points of the world.
        slack: Depth tolerance, world units: a surface up to this far before a place is taken for it.

    Returns:
        The share of the views that see each place, or through it ``[M]``, the share that have the thing there or
        before it ``[M]``, the share that have nothing else before it ``[M]``, and the mean color in those
        of the first that see something ``[M, 3]``, 0 without any.
    """
    counts, shown, covered, revealed, colored = (np.zeros(len(places)) for _ in range(5))
    colors = np.zeros((len(places), 3))
    thing = torch.from_numpy(gone)[:, None].to(views.gaussians.means)
    for number, camera in enumerate(views.small):
        found, depth, inside = camera.project(places)
        here = np.flatnonzero(inside)
        asked = found[here].astype(int)
        with torch.no_grad():
            looked = views.at(number, asked)
            view = render(views.gaussians, camera, features=thing, depth=True, prepared=looked)
        pixels = tuple(found[here, ::-1].astype(int).T)
        empty = view.alpha.cpu().numpy().reshape(camera.height, camera.width)[pixels] < _EMPTY
        nearest = np.where(empty, np.inf, cast(torch.Tensor, view.depth).cpu().numpy()[pixels])
        there = nearest > depth[here] - slack
        before = view.features[..., 0].cpu().numpy()[pixels] > _BEFORE
        counts[here] += 1
        covered[here] += before
        shown[here] += there & ~before
        if before.any():
            left = views.depth_without(number, gone, asked[before])[tuple(asked[before, ::-1].T)]
            revealed[here[before]] += left > depth[here[before]] - slack
        clear = there & ~before & ~empty
        colored[here] += clear
        colors[here] += clear[:, None] * view.image.cpu().double().numpy()[pixels]
    colors /= np.maximum(colored, 1)[:, None]
    counts = np.maximum(counts, 1)
    return shown / counts, covered / counts, revealed / counts, colors


def covering(views: Views, gone: Mask, places: FloatArray) -> FloatArray:
    """The share of the views that have a thing at a place or before it ``[M]``: the second of `looked_up`."""
    counts, covered = np.zeros(len(places)), np.zeros(len(places))
    thing = torch.from_numpy(gone)[:, None].to(views.gaussians.means)
    for number, camera in enumerate(views.small):
        found, _, inside = camera.project(places)
        here = np.flatnonzero(inside)
        looked = views.at(number, found[here].astype(int))
        with torch.no_grad():
            view = render(views.gaussians, camera, features=thing, color=False, prepared=looked)
        counts[here] += 1
        covered[here] += view.features[..., 0].cpu().numpy()[tuple(found[here, ::-1].astype(int).T)] > _BEFORE
    return covered / np.maximum(counts, 1)


def from_above(
    gaussians: Gaussians, surface: Surface, members: Mask, cells: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Colors ``[P, P, 3]``, coverage and heights over the plane ``[P, P]`` of some Gaussians from far above."""
    local = (gaussians.means.detach().cpu().double().numpy() - surface.origin) @ surface.axes[2]
    image, alpha, heights = _drawn(gaussians, surface, members, cells, local[:, None])
    safe = np.maximum(alpha, 1e-6)
    return image / safe[..., None], alpha, heights[..., 0] / safe


def covers(
    gaussians: Gaussians, surface: Surface, members: Mask, cells: FloatArray, groups: Mask
) -> FloatArray:
    """How much of each pixel ``[P, P, G]`` some Gaussians cover from far above, by their groups ``[N, G]``."""
    return _drawn(gaussians, surface, members, cells, groups)[2]


def _drawn(
    gaussians: Gaussians, surface: Surface, members: Mask, cells: FloatArray, values: FloatArray | Mask
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """RGB ``[P, P, 3]``, coverage ``[P, P]`` and values ``[P, P, C]`` of some Gaussians from far above.

    Args:
        gaussians: The scene.
        surface: The plane.
        members: The Gaussians that are drawn ``[N]``.
        cells: Places of the pixels ``[P, P, 2]``.
        values: The values of all Gaussians ``[N, C]``.
    """
    count, reach = len(cells), surface.reach
    away = 100 * surface.radius
    rotation = surface.axes * np.array([[1.0], [-1.0], [-1.0]])
    eye = surface.origin + surface.foot @ surface.axes[:2] + away * surface.axes[2]
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    focal = count / 2 * away / reach
    K = np.array([[focal, 0, count / 2], [0, focal, count / 2], [0, 0, 1]])
    drawn = gaussians.select(torch.from_numpy(members).to(gaussians.device))
    drawn = replace(drawn, shN=torch.zeros_like(drawn.shN))
    with torch.no_grad():
        features = torch.from_numpy(values[members]).to(drawn.means)
        found = render(drawn, Camera(count, count, K, viewmat), features=features)
    image, alpha, drawn_values = (
        one.cpu().double().numpy() for one in (found.image, found.alpha, found.features)
    )
    return image, alpha.reshape(count, count), drawn_values


def _cells(surface: Surface, cameras: Sequence[Camera]) -> tuple[FloatArray, float]:
    """The pixels of an image from above, about as fine as the views, and their width."""
    reach = surface.reach
    least, count, most = _PIXELS
    place = surface.origin + surface.foot @ surface.axes[:2]
    depths = [(camera.viewmat[2, :3] @ place + camera.viewmat[2, 3], camera.K[0, 0]) for camera in cameras]
    sizes = [depth / focal for depth, focal in depths if depth > 0]
    if sizes:
        count = int(np.clip(2 * reach / np.median(sizes), least, most))
    side = (np.arange(count) + 0.5) / count * 2 - 1
    return surface.foot + reach * np.stack(np.meshgrid(side, -side), -1), 2 * reach / count
