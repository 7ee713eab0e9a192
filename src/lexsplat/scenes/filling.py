"""Fills the hole that a deleted thing leaves in the surface under it, which no photo shows.

1. A thing stands on a surface (`lexsplat.scenes.surfaces`). The hole is the part of the surface that hardly any view
   sees, because the thing hides it, alone or together with others.
2. Gaussians of the reconstruction in the hole are deleted, because no photo shows them. So are those near the thing
   that show mostly without it: few pixels of the photos told their colors.
3. The pattern of the surface is continued in the hole (`lexsplat.scenes.completing`), in an image from above. Each
   painted pixel becomes a flat Gaussian. It takes the language of what it continues: of a neighbor in the surface,
   near by and of a like color (`_sources`). Under a thing at the edge of a cloth, a part of the fill is cloth and the
   rest is table (`lexsplat.scenes.materials`); each continues itself.
4. The surfaces around keep the shadow of the thing. Their Gaussians there are brightened, and the fill continues what
   they are then: by the light that the shadows of all things tell (`lexsplat.scenes.shadows`), else by what the
   pattern is elsewhere (`lexsplat.scenes.completing.brightening`).

Where no plane is found, such as below a hanging lamp, nothing is filled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion
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
from lexsplat.scenes.completing import brightening, completed
from lexsplat.scenes.fills import COLUMNS, MOST, Fill
from lexsplat.scenes.materials import THING, UNLISTED, are_listed, materials
from lexsplat.scenes.shadows import Shadows
from lexsplat.scenes.surfaces import (
    FEWEST,
    REACH,
    THICK,
    Orthophoto,
    Surface,
    Views,
    covering,
    covers,
    from_above,
    photographed,
    surface_below,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
Mask = NDArray[np.bool_]

_FAINT = 0.1
_HIDDEN = 0.88
"""Share of the views in which the thing hides a place, above which the Gaussians there are deleted."""
_PARTLY = 0.3
"""Share of the views in which the thing hides a place that no view sees, above which the place is filled, too: other
things hide it in the rest. Hidden Gaussians there are deleted. From .15 to .5 the second scene gains the same."""
_STUFFED = 0.5
"""Share of the views in which the thing hides a Gaussian within its hull, above which that is deleted too."""
_REVEALED, _AROUND = 3.0, 1.3
"""Growth of a Gaussian's visible weight without the thing, above which it is deleted if it lies in the thing's hull,
enlarged by the other factor. Both are chosen on the second scene."""
_ALMOST_ALL, _SPECK = 5.0, 5.0
"""The same for Gaussians below a thing, up to a radius of its foot below the surface, and how many pixels more the
views must show: large dark ones, of which the photos hardly showed the rim."""
_BORDER, _OVERLAP, _RIM = 3, 4, 3
"""Pixels around such places in which Gaussians are deleted, the fill overlaps the rest, and colors do not count."""
_NEAR = 8
"""Gaussians of a thing, nearest from above, that tell its height at a place."""
_BARE = 0.6
"""Coverage below which a pixel is bare."""
_VOID = (0.2, 0.5)
"""A pixel that is covered less than the first, though more of the views than the second see it, is beyond the end of
the surface."""
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
_FLAT, _LARGE = 0.5, 0.25
"""A segment of which less is flat rises from the surface, unless it is this share of the scene, as a group is."""
_MIXED = 2
"""Pixels around the edge between two surfaces in which their colors are mixed, and are no source."""
_LEAST_LIGHT = 0.01
"""Change of brightness below which a Gaussian stays as it is: nobody sees it, and a step lists each that changes."""


def fill_for(
    chosen: Selection,
    cameras: Sequence[Camera] = (),
    listener: Listener = silent,
    hidden: Tensor | None = None,
    segments: Segments | None = None,
    kinds: IntArray | None = None,
    shadows: Shadows | None = None,
) -> tuple[Fill | None, Tensor]:
    """What closes the surfaces under a deleted selection, and the Gaussians that are deleted with it.

    Args:
        chosen: The selection.
        cameras: The views that the scene was made from.
        listener: Receives events of stage "fill", one unit a thing.
        hidden: Which Gaussians are hidden ``[N]`` bool; others that stand on a thing stay. None takes all as hidden.
        segments: The segments of the scene: the fill takes no language from things that stand on the surface.
        kinds: What each Gaussian is of ``[N]``, as `lexsplat.scenes.materials.kinds_of_segments` says: surfaces meet
            under a thing. None takes all for one surface.
        shadows: The shadows of the selection and of what stays; None guesses them from the pattern around a thing.

    Returns:
        The fill, which may only brighten, or None if there is nothing to do; and the selection with the remains under
        its things ``[N]`` bool.
    """
    gone = chosen.mask.cpu().numpy().copy()
    shown = np.zeros_like(gone) if hidden is None else ~hidden.cpu().numpy()
    kinds = np.full(len(gone), UNLISTED) if kinds is None else kinds
    scene = _Scene(Views(chosen.gaussians, cameras), shown, segments, kinds, shadows)
    things, found = chosen.instances, list[Fill]()
    try:
        for done, thing in enumerate(things):
            listener(Event("fill", done, len(things)))
            fill = _fill_below(thing, gone, scene)
            found += [] if fill is None else [fill]
        if shadows is not None:
            found.append(_without_shadow(chosen.gaussians, gone, kinds, shadows))
    finally:  # a viewer goes on after an error, and its bar ends
        listener(Event("fill", len(things), len(things)))
    mask = torch.from_numpy(gone).to(chosen.mask.device)
    if not any(len(fill.disks) + len(fill.lit) for fill in found):
        return None, mask
    sources, disks, *_ = (np.concatenate(rows)[:MOST] for rows in zip(*found))
    by = np.ones(len(gone))
    for fill in found:
        by[fill.lit] = np.maximum(by[fill.lit], fill.factors)
    return _brightened(by)._replace(sources=sources, disks=disks), mask


class _Scene(NamedTuple):
    """What is known of a scene: see `fill_for`.

    Args:
        views: The scene and its views.
        shown: The Gaussians that are not hidden ``[N]``.
        segments: Its segments.
        kinds: What each Gaussian is of ``[N]``.
        shadows: The shadows of what is deleted and of other things; None if the light is not known.
    """

    views: Views
    shown: Mask
    segments: Segments | None
    kinds: IntArray
    shadows: Shadows | None


class _Place(NamedTuple):
    """A surface with a thing on it, in coordinates of the surface.

    Args:
        views: The scene and its views.
        surface: The plane.
        own: The Gaussians of the thing ``[N]``.
        body: Those of them that are not faint ``[N]``.
        solid: All that are not faint ``[N]``.
        local: Means of all Gaussians: along the two axes, and above the plane ``[N, 3]``.
        level: Those near the plane ``[N]``.
        photo: The surface from above.
        unseen: Its pixels that hardly any view sees, because the thing hides them ``[P, P]``.
        unknown: Those that no view sees, because the thing and others hide them ``[P, P]``.
    """

    views: Views
    surface: Surface
    own: Mask
    body: Mask
    solid: Mask
    local: FloatArray
    level: Mask
    photo: Orthophoto
    unseen: Mask
    unknown: Mask


def _place_of(thing: Selection, gone: Mask, views: Views, kinds: IntArray) -> _Place | None:
    """Where a thing stands; None if it stands on nothing."""
    gaussians = thing.gaussians
    means = gaussians.means.detach().cpu().double().numpy()
    own, solid = thing.mask.cpu().numpy(), gaussians.opacities.detach().cpu().numpy() >= _FAINT
    surface = surface_below(
        means[own & solid], means[~gone & solid], thing.up.direction, means[~gone & solid & (kinds >= 0)]
    )
    if surface is None:
        return None
    local = (means - surface.origin) @ surface.axes.T
    level = np.abs(local[:, 2]) <= THICK * surface.radius
    photo = photographed(views, gone, surface, ~gone & solid & level)
    unseen = binary_dilation(photo.covered > _HIDDEN, iterations=_BORDER)
    unknown = (photo.revealed > _PARTLY) & (photo.shown <= 0)
    return _Place(views, surface, own, own & solid, solid, local, level, photo, unseen, unknown)


def _remains(place: _Place, gone: Mask, shown: Mask) -> tuple[Mask, Mask]:
    """The Gaussians that go with a thing ``[N]``, and those of them that it only hid for the most part ``[N]``.

    Those that are shown and stand on the thing are no remains: things on a cloth, on a table.
    """
    local, body, radius = place.local, place.body, place.surface.radius
    inside = place.photo.at(place.unseen, local[:, :2]) & place.level
    inside &= ~_standing(local, body, inside & shown)
    inside |= place.photo.at(place.unknown, local[:, :2]) & place.level & ~shown
    stuffing = _stuffing(place.views, place.own, gone | inside)
    inside |= stuffing & ~_standing(local, body, stuffing & shown)
    around, below = _revealed(place.views, place.own, gone, -radius * place.surface.axes[2])
    revealed = (around & (local[:, 2] >= -THICK * radius)) | (below & (local[:, 2] >= -radius))
    low, high = np.quantile(local[body, 2], [0.02, 0.98])
    if high - low < _SHEET * radius:  # on a cloth stand things, whose bottoms no photo shows
        revealed &= ~_standing(local, body, revealed)
    return inside | revealed, revealed


def _hole(place: _Place, flat: Mask, revealed: Mask) -> tuple[Mask, Mask, FloatArray]:
    """The pixels to fill, those whose colors count, and the heights of all ``[P, P]``.

    Args:
        place: Where the thing stands.
        flat: The Gaussians of the surface that stay ``[N]``.
        revealed: See `_remains`.
    """
    local, radius, cells = place.local, place.surface.radius, place.photo.cells
    _, coverage, heights = from_above(place.views.gaussians, place.surface, flat, cells)
    near = inside_hull(local[(place.own | revealed) & (local[:, 2] <= 2 * radius), :2], cells)
    filled = binary_dilation(place.unseen, iterations=_OVERLAP)
    around = near | place.unknown | binary_dilation(filled, iterations=_OVERLAP)
    hole = filled | (around & (coverage < _BARE))
    if place.views.of:
        hole &= ~((place.photo.coverage < _VOID[0]) & (place.photo.shown > _VOID[1]))
    level = np.abs(heights) <= THICK * radius
    known = (coverage >= _BARE) & level & ~binary_dilation(hole, iterations=_RIM)
    return hole, known, heights


def _fill_below(thing: Selection, gone: Mask, scene: _Scene) -> Fill | None:
    """The Gaussians that close the surface under one thing; remains there are added to ``gone [N]``."""
    place = _place_of(thing, gone, scene.views, scene.kinds)
    if place is None:
        return None
    surface, photo, local = place.surface, place.photo, place.local
    flat = ~gone & place.solid & place.level
    inside, revealed = _remains(place, gone, scene.shown)
    hole, known, heights = _hole(place, flat & ~inside, revealed)
    if not hole.any() or known.sum() < FEWEST:
        return None
    covered = covers(thing.gaussians, surface, flat & ~inside, photo.cells, _groups(scene.kinds))
    labels, others = materials(covered, known)
    if (known & ~others).sum() >= FEWEST:  # what stands on the surface is none of its pattern
        known &= ~others
    listed = are_listed(labels, covered, known)
    painted, factors = _painted(place, hole, known, np.where(listed, labels, UNLISTED), scene.shadows)
    near = np.linalg.norm(local[:, :2] - surface.foot, axis=1) <= REACH * surface.radius
    # nobody knows what hidden Gaussians are
    counted = place.solid & near & ~gone & (scene.shown | ~scene.shown.any())
    surfaces = _of_surface(counted & (local[:, 2] <= _WAVES * surface.radius), counted, scene.segments)
    thin = flat & (np.abs(local[:, 2]) <= _WAVES * surface.radius)  # a banana on a cloth is none of its waves
    members = np.flatnonzero(thin & ~inside & counted & surfaces)
    if not len(members):
        members = np.flatnonzero(flat & ~inside)
    gone |= inside
    by = np.where(flat & surfaces & ~gone, photo.at(factors, local[:, :2]), 1.0)
    waves = known & (np.abs(heights) <= _WAVES * surface.radius)
    raised = _continued(heights, hole, waves if waves.sum() >= FEWEST else known)
    places = np.concatenate([photo.cells[hole], raised[:, None]], 1)
    colors = thing.gaussians.sh0.detach().cpu().double().numpy()[members, 0] * SH_C0 + 0.5
    nearest = _sources(
        local[members, :2] / surface.radius, colors, photo.cells[hole] / surface.radius, painted
    )
    x, y, z, w = Rotation.from_matrix(surface.axes.T).as_quat()
    same = np.tile([w, x, y, z, *np.log(photo.size * np.array(_SIZES))], (len(painted), 1))
    disks = np.concatenate([surface.origin + places @ surface.axes, same, painted], 1).astype("<f4")
    return _brightened(by)._replace(sources=members[nearest].astype("<i4"), disks=disks)


def _brightened(by: FloatArray) -> Fill:
    """Gaussians brightened by factors ``[N]``, and nothing added."""
    lit = np.flatnonzero(by > 1 + _LEAST_LIGHT)
    lit = np.sort(lit[np.argsort(-by[lit], kind="stable")[:MOST]])
    return Fill(np.zeros(0, "<i4"), np.zeros((0, COLUMNS), "<f4"), lit.astype("<i4"), by[lit].astype("<f4"))


def _without_shadow(gaussians: Gaussians, gone: Mask, kinds: IntArray, shadows: Shadows) -> Fill:
    """What brightens surfaces once the shadow of things is gone."""
    by, asked = np.ones(len(gone)), np.flatnonzero((kinds >= 0) & ~gone)
    means = gaussians.means.detach().cpu().double().numpy()[asked]
    by[asked] = shadows.factors(means, kinds[asked])
    return _brightened(by)


def _groups(kinds: IntArray) -> Mask:
    """Which Gaussians ``[N]`` are of each surface, and of things ``[N, G + 1]``."""
    return np.stack([*(kinds == number for number in range(kinds.max(initial=-1) + 1)), kinds == THING], 1)


def _painted(
    place: _Place, hole: Mask, known: Mask, labels: IntArray, shadows: Shadows | None
) -> tuple[FloatArray, FloatArray]:
    """Colors of the pixels of a hole ``[F, 3]``, and the light that the surface seems to lack ``[P, P]``.

    Each material continues itself as it is without any shadow.

    Args:
        place: The surface from above.
        hole: The pixels to paint ``[P, P]``.
        known: The pixels whose colors count ``[P, P]``.
        labels: The material of each pixel ``[P, P]``.
        shadows: The shadows. The pattern tells the light of what is no listed surface, or has no direct light.
    """
    photo, surface = place.photo, place.surface
    image, (factors, now, then) = photo.colors.clip(0, 1), np.ones((3, *hole.shape))
    if shadows is not None:
        points = (surface.origin + photo.cells @ surface.axes[:2]).reshape(-1, 3)
        now, then = (each.reshape(hole.shape) for each in shadows.at(points, labels.ravel()))
        image = image / now[..., None]
    trust = known * (_UNSEEN + photo.shown)
    parts = []
    for part in (labels == label for label in np.unique(labels)):
        pure = binary_erosion(part, iterations=_MIXED, border_value=1)
        parts.append((part, trust * pure if (known & pure).sum() >= FEWEST else trust))
    for part, sources in parts:
        if shadows is not None and labels[part][0] >= 0 and shadows.light.direct[labels[part][0]]:
            factors[part] = (then / now)[part]
        else:
            lighter = brightening(photo.colors, hole, sources)[part]
            factors[part], image[part] = lighter, image[part] * lighter[:, None]
    painted = image.copy()
    for part, sources in parts:
        if (hole & part).any():
            painted[hole & part] = completed(image, hole & part, sources)
    return (painted * then[..., None])[hole], factors


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


def _revealed(views: Views, own: Mask, gone: Mask, down: FloatArray) -> tuple[Mask, Mask]:
    """The Gaussians of which the views show several times as much once a thing is gone: those around it ``[N]``, and
    below it ``[N]``.

    Args:
        views: The scene and its views.
        own: The Gaussians of the thing ``[N]``.
        gone: Those of all that goes ``[N]``.
        down: How far below the thing is looked ``[3]``.
    """
    means = views.gaussians.means.detach().cpu().double().numpy()
    places = np.flatnonzero(~gone)
    around = inside_hull(means[own], means[places], _AROUND)
    below = inside_hull(np.concatenate([means[own], means[own] + down]), means[places], _AROUND)
    places, around = places[around | below], around[around | below]
    found = np.zeros((2, len(gone)), bool)
    if len(places):
        now, then = views.weights(places, gone)
        found[:, places] = (then > _REVEALED * now) & around, then > _ALMOST_ALL * now + _SPECK
    return found[0], found[1]


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
