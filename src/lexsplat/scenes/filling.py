"""Fills the hole that a deleted thing leaves in the surface under it, which no photo shows.

1. A thing stands on a surface (`lexsplat.scenes.surfaces`). The hole is the part of the surface that hardly any view
   sees, because the thing hides it.
2. Gaussians of the reconstruction in the hole are deleted, because no photo shows them. So are those near the thing
   that show mostly without it: few pixels of the photos told their colors.
3. The pattern of the surface is continued in the hole (`lexsplat.scenes.completing`), in an image from above. Each
   painted pixel becomes a flat Gaussian. It takes the language of what it continues: of a neighbor in the surface,
   near by and of a like color (`_sources`). Under a thing at the edge of a cloth, a part of the fill is cloth and the
   rest is table.
4. The surface around the hole keeps the shadow of the thing. Its Gaussians there are brightened
   (`lexsplat.scenes.completing.light`), and the fill continues what they are then.

Where no plane is found, such as below a hanging lamp, nothing is filled.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import SH_C0, Gaussians
from lexsplat.geometry.hulls import GROWN, inside_hull
from lexsplat.language.segments import Segments
from lexsplat.queries.colors import cielab
from lexsplat.queries.selection import Selection
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.scenes.completing import completed, light
from lexsplat.scenes.surfaces import (
    FEWEST,
    REACH,
    THICK,
    Orthophoto,
    Views,
    covering,
    from_above,
    photographed,
    surface_below,
)

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FAINT = 0.1
_HIDDEN = 0.88
"""Share of the views in which the thing hides a place, above which the Gaussians there are deleted."""
_STUFFED = 0.5
"""Share of the views in which the thing hides a Gaussian within its hull, above which that is deleted too."""
_REVEALED, _AROUND = 3.0, 1.3
"""Growth of a Gaussian's visible weight without the thing, above which it is deleted if it lies in the thing's hull,
enlarged by the other factor. Both are chosen on the second scene."""
_BORDER, _OVERLAP, _RIM = 3, 4, 3
"""Pixels around such places in which Gaussians are deleted, the fill overlaps the rest, and colors do not count."""
_NEAR = 8
"""Gaussians of a thing, nearest from above, that tell its height at a place."""
_BARE = 0.6
"""Coverage below which a pixel is bare."""
_UNSEEN = 0.3
"""Trust in a pixel that no view sees. Another one gains the share of the views that see it."""
_SIZES = (0.8, 0.8, 0.1)
"""Standard deviations of a disk along its axes, in pixels."""
_SHEET = 0.5
"""A thing lower than this share of its radius carries others."""
_WAVES = 0.1
"""Largest height of waves of the surface, in radii of the foot: what is higher around it are things."""
_ALIKE = 50.0
"""Difference of colors in CIELAB that is as far as a radius of the foot, where a fill takes its language."""
_OPAQUE = 3.0
_FLAT, _LARGE = 0.5, 0.25
"""A segment of which less is flat rises from the surface, unless it is this share of the scene, as a group is."""
_COLUMNS = 13
_BRIGHTEST = 100.0
_LEAST_LIGHT = 0.01
"""Change of brightness below which a Gaussian stays as it is: nobody sees it, and a step lists each that changes."""
_MOST = 1 << 20


class Fill(NamedTuple):
    """Gaussians that close a hole, and those around it that lose the shadow of a thing.

    Args:
        sources: The Gaussian whose language each takes ``[F]``.
        disks: Means, rotations (wxyz), logarithms of sizes, and RGB ``[F, 13]`` float32.
        lit: Gaussians of the scene that are brightened ``[L]``.
        factors: By how much ``[L]`` float32.
    """

    sources: NDArray[np.int32]
    disks: NDArray[np.float32]
    lit: NDArray[np.int32] = np.zeros(0, "<i4")
    factors: NDArray[np.float32] = np.zeros(0, "<f4")

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "gaussians": len(self.sources),
            "disks": _packed(self.sources, self.disks),
            "lit": len(self.lit),
            "light": _packed(self.lit, self.factors),
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Fill:
        """The inverse of `to_json`; earlier versions brighten nothing.

        Raises:
            ValueError: If the data are not a fill.
        """
        try:
            sources, disks = _unpacked(data["disks"], data["gaussians"], _COLUMNS)
            if "lit" not in data:
                return cls(sources, disks)
            lit, factors = _unpacked(data["light"], data["lit"], 1)
        except (KeyError, TypeError, binascii.Error, zlib.error) as error:
            raise ValueError(f"not a fill: {error!r}") from error
        return cls(sources, disks, lit, factors[:, 0])

    def relit(self, scene: Gaussians) -> Gaussians:
        """The scene with its brightened Gaussians; one that is listed twice takes the larger factor.

        Raises:
            ValueError: If a Gaussian is not in the scene, or a factor is not in 0..100.
        """
        if not len(self.lit):
            return scene
        if not 0 <= self.lit.min() <= self.lit.max() < len(scene):
            raise ValueError("the fill is for another number of Gaussians")
        if not ((self.factors > 0) & (self.factors <= _BRIGHTEST)).all():
            raise ValueError(f"the fill brightens by a factor that is not in 0..{_BRIGHTEST:g}")
        factors = np.zeros(len(scene), np.float32)
        np.maximum.at(factors, self.lit, self.factors)
        by = torch.from_numpy(np.where(factors > 0, factors, np.float32(1)))[:, None, None].to(scene.sh0)
        unlit = (by == 1)[:, 0]
        sh0 = ((scene.sh0 * SH_C0 + 0.5) * by - 0.5) / SH_C0
        sh0[unlit] = scene.sh0[unlit]  # to the last bit
        return replace(scene, sh0=sh0, shN=scene.shN * by)

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


def _packed(numbers: NDArray[np.int32], rows: NDArray[np.float32]) -> str:
    """Integers ``[F]`` and rows ``[F]`` or ``[F, C]`` as text."""
    raw = zlib.compress(numbers.tobytes() + rows.tobytes(), 6)
    return base64.b64encode(raw).decode("ascii")


def _unpacked(text: Any, count: Any, columns: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The inverse of `_packed`.

    Raises:
        ValueError: If the text is not so many rows.
    """
    if type(count) is not int or not 0 <= count <= _MOST:
        raise ValueError(f"not a fill of {count!r} Gaussians"[:100])
    size = count * 4 * (1 + columns)
    raw = zlib.decompressobj().decompress(base64.b64decode(text), size + 1)
    if len(raw) != size:
        raise ValueError(f"not a fill: {len(raw)} bytes for {count} Gaussians")
    return np.frombuffer(raw, "<i4", count), np.frombuffer(raw, "<f4", offset=4 * count).reshape(
        count, columns
    )


def fill_for(
    chosen: Selection,
    cameras: Sequence[Camera] = (),
    listener: Listener = silent,
    hidden: Tensor | None = None,
    segments: Segments | None = None,
) -> tuple[Fill | None, Tensor]:
    """What closes the surfaces under a deleted selection, and the Gaussians that are deleted with it.

    Args:
        chosen: The selection.
        cameras: The views that the scene was made from.
        listener: Receives events of stage "fill", one unit a thing.
        hidden: Which Gaussians are hidden ``[N]`` bool; others that stand on a thing stay. None takes all as hidden.
        segments: The segments of the scene: the fill takes no language from things that stand on the surface.

    Returns:
        The fill, None if there is nothing to fill, and the selection with the remains under its things ``[N]`` bool.
    """
    gone = chosen.mask.cpu().numpy().copy()
    shown = np.zeros_like(gone) if hidden is None else ~hidden.cpu().numpy()
    things, found, views = chosen.instances, list[Fill](), Views(chosen.gaussians, cameras)
    try:
        for done, thing in enumerate(things):
            listener(Event("fill", done, len(things)))
            fill = _fill_below(thing, gone, shown, views, segments)
            found += [] if fill is None else [fill]
    finally:  # a viewer goes on after an error, and its bar ends
        listener(Event("fill", len(things), len(things)))
    mask = torch.from_numpy(gone).to(chosen.mask.device)
    if not found:
        return None, mask
    return Fill(*(np.concatenate(rows)[:_MOST] for rows in zip(*found))), mask


def _fill_below(
    thing: Selection, gone: Mask, shown: Mask, views: Views, segments: Segments | None
) -> Fill | None:
    """The Gaussians that close the surface under one thing; remains there are added to ``gone [N]``.

    Those that are shown and stand on the thing are no remains: things on a cloth, on a table.
    """
    gaussians = thing.gaussians
    means = gaussians.means.detach().cpu().double().numpy()
    own, solid = thing.mask.cpu().numpy(), gaussians.opacities.detach().cpu().numpy() >= _FAINT
    surface = surface_below(means[own & solid], means[~gone & solid], thing.up.direction)
    if surface is None:
        return None
    local = (means - surface.origin) @ surface.axes.T
    flat = ~gone & solid & (np.abs(local[:, 2]) <= THICK * surface.radius)
    photo = photographed(views, gone, surface, flat)
    unseen = binary_dilation(photo.covered > _HIDDEN, iterations=_BORDER)
    inside = _at(unseen, local[:, :2], photo) & (np.abs(local[:, 2]) <= THICK * surface.radius)
    inside &= ~_standing(local, own & solid, inside & shown)
    stuffing = _stuffing(views, own, gone | inside)
    inside |= stuffing & ~_standing(local, own & solid, stuffing & shown)
    revealed = _revealed(views, own, gone) & (local[:, 2] >= -THICK * surface.radius)
    low, high = np.quantile(local[own & solid, 2], [0.02, 0.98])
    if high - low < _SHEET * surface.radius:  # on a cloth stand things, whose bottoms no photo shows
        revealed &= ~_standing(local, own & solid, revealed)
    inside |= revealed
    _, coverage, heights = from_above(gaussians, surface, flat & ~inside, photo.cells)
    near = inside_hull(local[(own | revealed) & (local[:, 2] <= 2 * surface.radius), :2], photo.cells)
    filled = binary_dilation(unseen, iterations=_OVERLAP)
    hole = filled | ((near | binary_dilation(filled, iterations=_OVERLAP)) & (coverage < _BARE))
    level = np.abs(heights) <= THICK * surface.radius
    known = (coverage >= _BARE) & level & ~binary_dilation(hole, iterations=_RIM)
    if not hole.any() or known.sum() < FEWEST:
        return None
    trust = known * (_UNSEEN + photo.shown)
    factors = light(photo.colors, hole, trust)
    painted = completed(photo.colors.clip(0, 1) * factors[..., None], hole, trust)
    thin = flat & (np.abs(local[:, 2]) <= _WAVES * surface.radius)  # a banana on a cloth is none of its waves
    near = np.linalg.norm(local[:, :2] - surface.foot, axis=1) <= REACH * surface.radius
    counted = solid & near & ~gone & (shown | ~shown.any())  # nobody knows what hidden Gaussians are
    low = counted & (local[:, 2] <= _WAVES * surface.radius)
    surfaces = _of_surface(low, counted, segments)
    members = np.flatnonzero(thin & ~inside & counted & surfaces)
    if not len(members):
        members = np.flatnonzero(flat & ~inside)
    gone |= inside
    by = np.where(flat & surfaces & ~gone, _at(factors, local[:, :2], photo), 1.0)
    lit = np.flatnonzero(by > 1 + _LEAST_LIGHT)
    waves = known & (np.abs(heights) <= _WAVES * surface.radius)
    raised = _continued(heights, hole, waves if waves.sum() >= FEWEST else known)
    places = np.concatenate([photo.cells[hole], raised[:, None]], 1)
    colors = gaussians.sh0.detach().cpu().double().numpy()[members, 0] * SH_C0 + 0.5
    nearest = _sources(
        local[members, :2] / surface.radius, colors, photo.cells[hole] / surface.radius, painted
    )
    x, y, z, w = Rotation.from_matrix(surface.axes.T).as_quat()
    same = np.tile([w, x, y, z, *np.log(photo.size * np.array(_SIZES))], (len(painted), 1))
    disks = np.concatenate([surface.origin + places @ surface.axes, same, painted], 1).astype("<f4")
    return Fill(members[nearest].astype("<i4"), disks, lit.astype("<i4"), by[lit].astype("<f4"))


def _of_surface(low: Mask, counted: Mask, segments: Segments | None) -> Mask:
    """Which Gaussians ``[N]`` belong to no segment that rises from the surface, such as the rim of a pumpkin.

    Args:
        low: Those near by that are no higher than the surface; the sides of a table are lower.
        counted: Those near by: what a table is far away, or inside, says nothing.
        segments: The segments; None has nothing that rises.
    """
    found = np.ones(len(low), bool)
    if segments is not None:
        labels = segments.labels.cpu().numpy()
        for level in segments.levels.cpu().numpy():
            members = level[labels]
            rises = np.bincount(members, low) < _FLAT * np.bincount(members, counted)
            found &= ~(rises & (np.bincount(members) < _LARGE * len(low)))[members]
    return found


def _sources(
    places: FloatArray, colors: FloatArray, at: FloatArray, painted: FloatArray
) -> NDArray[np.int64]:
    """What each pixel of a fill continues ``[F]``: a Gaussian of the surface near by and of a like color.

    Args:
        places: Places of the Gaussians ``[M, 2]``, in radii of the foot.
        colors: Their RGB ``[M, 3]``.
        at: Places of the pixels ``[F, 2]``.
        painted: Their RGB ``[F, 3]``.
    """
    known = cKDTree(np.concatenate([places, cielab(colors.clip(0, 1)) / _ALIKE], 1))
    return np.asarray(known.query(np.concatenate([at, cielab(painted) / _ALIKE], 1))[1])


def _standing(local: FloatArray, thing: Mask, among: Mask) -> Mask:
    """Which of some Gaussians are higher than a thing is at their place ``[N]``, in coordinates of the surface."""
    found, places = among.copy(), np.flatnonzero(among)
    if len(places) and thing.any():
        body = local[thing]
        near = min(_NEAR, len(body))
        _, nearest = cKDTree(body[:, :2]).query(local[places, :2], k=range(1, near + 1))
        found[places] = local[places, 2] > np.median(body[nearest, 2], axis=1)
    return found


def _stuffing(views: Views, own: Mask, gone: Mask) -> Mask:
    """The Gaussians ``[N]`` within a thing's hull that hardly any view sees, because the thing hides them."""
    means = views.gaussians.means.detach().cpu().double().numpy()
    places = np.flatnonzero(~gone)
    places = places[inside_hull(means[own], means[places], GROWN)]
    found = np.zeros(len(gone), bool)
    if len(places) and views.of:
        found[places] = covering(views, gone, means[places]) > _STUFFED
    return found


def _revealed(views: Views, own: Mask, gone: Mask) -> Mask:
    """The Gaussians ``[N]`` around a thing of which the views show several times as much once the thing is gone."""
    means = views.gaussians.means.detach().cpu().double().numpy()
    places = np.flatnonzero(~gone)
    places = places[inside_hull(means[own], means[places], _AROUND)]
    found = np.zeros(len(gone), bool)
    if len(places):
        now, then = views.weights(places, gone)
        found[places] = then > _REVEALED * now
    return found


def _at(image: NDArray, points: FloatArray, photo: Orthophoto) -> NDArray:
    """The pixels ``[N]`` of an image ``[P, P]`` in which points ``[N, 2]`` of the plane lie; 0 outside."""
    (first, *_), count = photo.cells[0], len(image)
    columns = np.round((points[:, 0] - first[0]) / photo.size).astype(int)
    rows = np.round((first[1] - points[:, 1]) / photo.size).astype(int)
    inside = (columns >= 0) & (columns < count) & (rows >= 0) & (rows < count)
    return image[rows.clip(0, count - 1), columns.clip(0, count - 1)] * inside


def _continued(heights: FloatArray, hole: Mask, known: Mask) -> FloatArray:
    """Heights ``[F]`` for the pixels of a hole: a quadratic patch through those around."""
    rows, columns = np.mgrid[: hole.shape[0], : hole.shape[1]]
    center = np.argwhere(hole).mean(0)
    radius = max(float(np.sqrt(hole.sum() / np.pi)), 2.0)
    u, v = (rows - center[0]) / radius, (columns - center[1]) / radius
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1)
    weights = np.exp(-(u[known] ** 2 + v[known] ** 2) / 8)
    solution = np.linalg.lstsq(
        terms[known] * weights[:, None] ** 0.5, heights[known] * weights**0.5, rcond=None
    )[0]
    low, high = np.quantile(heights[known], [0.02, 0.98])
    return np.asarray((terms[hole] @ solution).clip(low, high))
