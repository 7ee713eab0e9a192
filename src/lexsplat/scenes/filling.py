"""Fills the hole that a deleted thing leaves in the surface under it, which no photo shows.

1. A thing stands on a surface: a plane is fitted to the Gaussians around its foot.
2. The surface without the thing is rendered from above. Where the picture is bare, it takes the colors around. A
   pattern does not go on there.
3. Each painted pixel becomes a flat Gaussian. It keeps the language of its nearest neighbor in the surface.

Where no plane is found, such as below a hanging lamp, nothing is filled.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.queries.selection import Selection
from lexsplat.rendering import render

FloatArray = NDArray[np.float64]

_FAINT = 0.1
_FOOT = 0.15
"""The foot of a thing: its lowest share by height."""
_RING = 1.0
"""Width of the ring around the foot whose Gaussians make the plane, in radii of the foot."""
_LEVEL = 0.1
"""Gaussians of the ring within this distance of the plane belong to it, in radii of the foot."""
_THICK = 0.3
"""The same for the Gaussians that are seen from above."""
_STEEPEST = 0.8
"""Least cosine of the plane's normal with up."""
_FEWEST = 30
_PIXELS = 112
"""Width of the picture from above."""
_REACH = 3.0
"""Half of its width, in radii of the foot."""
_BARE = 0.6
"""Coverage below which a pixel is bare."""
_SIZES = (0.7, 0.7, 0.1)
"""Standard deviations of a disk along its axes, in pixels."""
_OPAQUE = 3.0
_COLUMNS = 13
_MOST = 1 << 20
_MARGIN = 10
"""Width of the rim of the hole whose colors are taken, in pixels."""


class Surface(NamedTuple):
    """The plane that a thing stands on.

    Args:
        origin: A point of it ``[3]``.
        axes: Two unit vectors in it, and its normal, which points up ``[3, 3]`` in rows.
        foot: Center of the thing's foot in the two vectors ``[2]``.
        radius: Radius of the foot, world units.
    """

    origin: FloatArray
    axes: FloatArray
    foot: FloatArray
    radius: float


def inside_hull(means: FloatArray, thing: NDArray[np.bool_], grown: float = 1.05) -> NDArray[np.bool_]:
    """Which Gaussians lie in the convex hull of a thing, grown about its center ``[N]``."""
    points = means[thing]
    try:
        corners = points[ConvexHull(points).vertices] if len(points) > 3 else points
        center = corners.mean(0)
        return np.asarray(Delaunay(center + grown * (corners - center)).find_simplex(means) >= 0)
    except (QhullError, ValueError, IndexError):  # flat or too few
        return thing.copy()


def surface_below(own: FloatArray, others: FloatArray, up: FloatArray) -> Surface | None:
    """The plane around the foot of a thing; None if there is none.

    Args:
        own: Means of the Gaussians of the thing ``[M, 3]``.
        others: Those of the Gaussians around it ``[R, 3]``.
        up: Unit vector ``[3]``.
    """
    if len(own) < 4:
        return None
    right, ahead = _across(up)
    heights = own @ up
    low, high = np.quantile(heights, [0.02, 0.98])
    foot = own[heights <= low + _FOOT * (high - low)]
    flat = foot @ np.stack([right, ahead]).T
    center = np.median(flat, 0)
    radius = max(float(np.quantile(np.linalg.norm(flat - center, axis=1), 0.9)), 1e-9)
    apart = np.linalg.norm(others @ np.stack([right, ahead]).T - center, axis=1)
    near = np.abs(others @ up - low) <= 0.5 * radius
    ring = others[near & (apart <= (1 + _RING) * radius)]
    plane = _fitted_plane(ring, up, _LEVEL * radius) if len(ring) >= _FEWEST else None
    if plane is None:
        return None
    origin, normal = plane
    axes = np.stack([*_across(normal), normal])
    middle = np.median((foot - origin) @ axes[:2].T, 0)
    return Surface(origin, axes, middle, radius)


def _fitted_plane(points: FloatArray, up: FloatArray, level: float) -> tuple[FloatArray, FloatArray] | None:
    """The plane through most points near a level, as origin and normal; None if too few lie in it."""
    heights = points @ up
    counts = [(np.abs(heights - height) <= level).sum() for height in heights]
    fits = np.abs(heights - heights[int(np.argmax(counts))]) <= level
    origin, normal = points.mean(0), up
    for _ in range(5):
        if fits.sum() < _FEWEST:
            return None
        origin = points[fits].mean(0)
        normal = np.linalg.svd(points[fits] - origin, full_matrices=False)[2][2]
        normal = normal if normal @ up > 0 else -normal
        fits = np.abs((points - origin) @ normal) <= level
    return (origin, normal) if normal @ up >= _STEEPEST else None


def _across(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors that are square to ``up`` and to each other."""
    right = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    right /= np.linalg.norm(right)
    return right, np.cross(up, right)


class Fill(NamedTuple):
    """Gaussians that close a hole.

    Args:
        sources: The Gaussian whose language each takes ``[F]``.
        disks: Means, rotations (wxyz), logarithms of sizes, and RGB ``[F, 13]`` float32.
    """

    sources: NDArray[np.int32]
    disks: NDArray[np.float32]

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        raw = zlib.compress(self.sources.tobytes() + self.disks.tobytes(), 6)
        return {"gaussians": len(self.sources), "disks": base64.b64encode(raw).decode("ascii")}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Fill:
        """The inverse of `to_json`.

        Raises:
            ValueError: If the data are not a fill.
        """
        try:
            count = data["gaussians"]
            if type(count) is not int or not 0 <= count <= _MOST:
                raise ValueError(f"not a fill of {count!r} Gaussians"[:100])
            size = count * 4 * (1 + _COLUMNS)
            raw = zlib.decompressobj().decompress(base64.b64decode(data["disks"]), size + 1)
        except (KeyError, TypeError, binascii.Error, zlib.error) as error:
            raise ValueError(f"not a fill: {error!r}") from error
        if len(raw) != size:
            raise ValueError(f"not a fill: {len(raw)} bytes for {count} Gaussians")
        disks = np.frombuffer(raw, "<f4", offset=4 * count).reshape(count, _COLUMNS)
        return cls(np.frombuffer(raw, "<i4", count), disks)

    def gaussians(self, scene: Gaussians) -> Gaussians:
        """The Gaussians, with as many coefficients as those of a scene.

        Raises:
            ValueError: If a source is not in the scene, or a number is not finite or too large.
        """
        if len(self.sources) and not 0 <= self.sources.min() <= self.sources.max() < len(scene):
            raise ValueError("the fill is for another number of Gaussians")
        like = scene.select(torch.from_numpy(self.sources.astype(np.int64)).to(scene.device))
        means, quats, sizes, colors = (
            torch.from_numpy(self.disks.copy()).to(like.means).split([3, 4, 3, 3], 1)
        )
        found = replace(
            like,
            means=means.contiguous(),
            quats=quats.contiguous(),
            log_scales=sizes.contiguous(),
            opacity_logits=torch.full_like(like.opacity_logits, _OPAQUE),
            sh0=((colors - 0.5) / SH_C0)[:, None].contiguous(),
            shN=torch.zeros_like(like.shN),
        )
        if found.find_invalid():
            raise ValueError(f"the fill has {found.find_invalid()}")
        return found


def hidden_inside(chosen: Selection, hidden: Tensor) -> Tensor:
    """The hidden Gaussians inside the instances of a selection ``[N]`` bool."""
    means, inside = chosen.gaussians.means.detach().cpu().double().numpy(), np.zeros(len(chosen.mask), bool)
    for each in chosen.instances:
        inside |= inside_hull(means, each.mask.cpu().numpy())
    return torch.from_numpy(inside).to(hidden.device) & hidden


def fill_for(chosen: Selection) -> Fill | None:
    """What closes the surfaces under the instances of a selection once it is gone; None if there is nothing."""
    found = [fill for each in chosen.instances if (fill := _fill_below(each, chosen.mask)) is not None]
    if not found:
        return None
    return Fill(*(np.concatenate(rows)[:_MOST] for rows in zip(*found)))


def _fill_below(thing: Selection, gone: Tensor) -> Fill | None:
    """What closes the surface under one thing, where all Gaussians of ``gone [N]`` are gone."""
    gaussians = thing.gaussians
    means = gaussians.means.detach().cpu().double().numpy()
    own, away = thing.mask.cpu().numpy(), gone.cpu().numpy()
    opacities = gaussians.opacities.detach().cpu().double().numpy()
    firm = np.flatnonzero(~away & (opacities >= _FAINT))
    surface = surface_below(means[own & (opacities >= _FAINT)], means[firm], thing.up.direction)
    if surface is None:
        return None
    local = (means - surface.origin) @ surface.axes.T
    reach = _REACH * surface.radius
    near = np.asarray((np.abs(local[:, :2] - surface.foot) <= reach).all(1))
    members = firm[near[firm] & (np.abs(local[firm, 2]) <= _THICK * surface.radius)]
    picture, coverage = _seen_from_above(gaussians.select(torch.from_numpy(members).to(gone.device)), surface)
    side = (np.arange(_PIXELS) + 0.5) / _PIXELS * 2 - 1
    cells = surface.foot + reach * np.stack(np.meshgrid(side, -side), -1)
    low = own & near & (local[:, 2] <= 2 * surface.radius)
    bare = coverage < _BARE
    hole, known = bare & _below(local[low, :2], cells), ~bare
    if not hole.any() or known.sum() < _FEWEST:
        return None
    colors = painted_hole(picture / np.maximum(coverage, 1e-6)[..., None], hole, known)
    _, nearest = cKDTree(local[members, :2]).query(cells[hole])
    x, y, z, w = Rotation.from_matrix(surface.axes.T).as_quat()
    sizes = np.log(2 * reach / _PIXELS * np.array(_SIZES))
    same = np.tile([w, x, y, z, *sizes], (len(colors), 1))
    places = surface.origin + cells[hole] @ surface.axes[:2]
    disks = np.concatenate([places, same, colors], 1).astype("<f4")
    return Fill(members[nearest].astype("<i4"), disks)


def _seen_from_above(members: Gaussians, surface: Surface) -> tuple[FloatArray, FloatArray]:
    """A picture ``[P, P, 3]`` of a surface from far above, its columns and rows along its axes, and its coverage."""
    away, reach = 100 * surface.radius, _REACH * surface.radius
    rotation = surface.axes * np.array([[1.0], [-1.0], [-1.0]])
    eye = surface.origin + surface.foot @ surface.axes[:2] + away * surface.axes[2]
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    focal = _PIXELS / 2 * away / reach
    K = np.array([[focal, 0, _PIXELS / 2], [0, focal, _PIXELS / 2], [0, 0, 1]])
    plain = replace(members, shN=torch.zeros_like(members.shN))
    with torch.no_grad():
        found = render(plain, Camera(_PIXELS, _PIXELS, K, viewmat))
    image, alpha = (one.cpu().double().numpy() for one in (found.image, found.alpha))
    return image, alpha.reshape(_PIXELS, _PIXELS)


def _below(points: FloatArray, cells: FloatArray) -> NDArray[np.bool_]:
    """Which cells ``[P, P, 2]`` lie in the convex hull of points ``[M, 2]``."""
    try:
        return np.asarray(Delaunay(points).find_simplex(cells) >= 0)
    except (QhullError, ValueError):
        return np.zeros(cells.shape[:2], bool)


def painted_hole(picture: FloatArray, hole: NDArray[np.bool_], known: NDArray[np.bool_]) -> FloatArray:
    """Colors ``[F, 3]`` in 0..1 for the F pixels of a hole: those around, weighted by inverse squared distance.

    Args:
        picture: RGB ``[H, W, 3]``.
        hole: Pixels to paint ``[H, W]``.
        known: Pixels whose color is known ``[H, W]``, at least one; none is in the hole.
    """
    rim = np.asarray(known & binary_dilation(hole, iterations=_MARGIN))
    points, places = np.argwhere(rim if rim.any() else known), np.argwhere(hole)
    weights = 1 / ((places[:, None] - points[None]) ** 2).sum(-1)
    colors = picture[tuple(points.T)]
    return np.asarray((weights @ colors / weights.sum(1, keepdims=True)).clip(0, 1))
