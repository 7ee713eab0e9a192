"""The up direction of a scene without cameras, from its ground and the things that stand on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.boxes import upright_frame
from lexsplat.pipeline.viewpoints.pieces import Pieces
from lexsplat.pipeline.viewpoints.standing import standing_shares

_CONVENTIONS = ((0, 0, 1), (0, 1, 0), (0, -1, 0))
"""Up directions of files that follow a convention: z up, y up (glTF), y down (COLMAP)."""
_TILTED = math.cos(math.radians(15))
_ALIGNED = math.cos(math.radians(10))
LOW = 0.05
"""Share of the points below the ground, where nobody has looked and nothing is as it seems."""
_GROUND_HEIGHT = 0.08
"""Half the height of the slab in which a ground lies, relative to the height of the scene."""
_GROUND_CELLS = 24
"""Cells along the longer side of the scene in which the ground is counted."""
_LEAD = 0.15
"""Lead in score over the other directions from which an up direction is certain."""
_GROUND = 0.25
"""Least share of the scene with a ground under it, seen from above: a thing alone has no ground."""
_WALL = 0.65
"""Share of ground from which another side may be the ground as well, or a wall."""
_STANDING = 0.5
"""Least share of the things that must then stand on the ground."""
_RIVAL = 0.6
"""Limit for the things on any other side that may be a ground, as a part of those on the ground."""
_UNLIKELY = 0.5
"""Difference of the scores by which a guess is much likelier than another direction."""
_SAME = math.cos(math.radians(20))

Points = NDArray[np.float64]


@dataclass(frozen=True)
class UpwardDirections:
    """Directions that may be up ``[D, 3]``, the best one first, with scores ``[D]``.

    Args:
        directions: Unit vectors, more than 20 degrees apart.
        scores: Likelihood score of each; only differences mean something.
        grounds: Share of the scene under which a ground lies ``[D]``.
        reliable: Whether the first one is up; else it is a guess.
    """

    directions: Points
    scores: Points
    grounds: Points
    reliable: bool

    def rivals(self) -> Points:
        """The other directions that are nearly as likely, of which walls make some ``[d, 3]``."""
        return self.directions[1:][self.scores[1:] > self.scores[0] - 2 * _LEAD]

    def contradict(self, up: Points) -> bool:
        """Whether the first one is far from a direction that is much less likely; if not reliable, a guess."""
        if up @ self.directions[0] >= 0.7 * np.linalg.norm(up):
            return False
        near = self.directions @ up > _SAME * np.linalg.norm(up)
        unlikely = not near.any() or self.scores[near].max() < self.scores[0] - _UNLIKELY
        return self.reliable or bool(unlikely and self.grounds[0] > _GROUND)


def find_upward(points: Points, look: Callable[[Points], float]) -> UpwardDirections:
    """Find the directions that may be up.

    Args:
        points: Solid points ``[M, 3]`` of the middle of the scene.
        look: Function of an up direction that returns the share of surfaces in views from above, in 0..1.
    """
    pieces = Pieces.of(points)
    candidates = up_candidates(pieces)
    directions = np.stack([direction for direction, _ in candidates])
    grounds = np.array([ground_share(pieces, direction) for direction in directions])
    # Without a large ground there are no walls that could be taken for a floor.
    walls = bool((grounds > _WALL).any())
    standing = standing_shares(pieces, directions) if walls else np.zeros(len(directions))
    plain = np.array([score + look(direction) for direction, score in candidates])
    scores = plain + np.where(grounds > _WALL, standing * grounds, 0)
    kept: list[int] = []
    for index in np.argsort(-scores, kind="stable"):
        if not kept or (directions[kept] @ directions[index]).max() < _SAME:
            kept.append(int(index))
    best, others = kept[0], np.array(kept[1:])
    reliable = scores[best] - scores[others].max() > _LEAD and grounds[best] > _GROUND
    if (grounds[others] > _WALL).any() or plain[best] - plain[others].max() <= _LEAD:
        rival = float(standing[others[grounds[others] > _GROUND]].max(initial=0))
        reliable &= bool(standing[best] >= _STANDING and rival < _RIVAL * standing[best])
    return UpwardDirections(directions[kept], scores[kept], grounds[kept], bool(reliable))


def up_candidates(pieces: Pieces) -> list[tuple[Points, float]]:
    """Directions that may be up, with scores.

    They are the normals of the largest planes, either way, and the directions of the usual conventions. The score of
    a direction has four terms: the area of surfaces across it in the lower third of the scene, less that in the upper
    third; the things above these surfaces; how low the points lie; and a small bonus by convention.

    Args:
        pieces: Surfaces of the middle of the scene.
    """
    normals, reach = pieces.normals, pieces.reach
    areas = np.minimum(reach, 3 * np.median(reach)) ** 2 * pieces.flatness
    shares = areas / max(float(areas.sum()), 1e-300)
    candidates = [np.array(axis, float) for axis in _CONVENTIONS]
    left = shares.copy()
    for _ in range(3):
        tried = normals[np.argsort(-left, kind="stable")[:: max(1, len(left) // 200)]]
        cosines = normals @ tried.T
        support = (np.abs(cosines, out=cosines) > _ALIGNED).T @ left
        first = tried[int(support.argmax())]
        near = np.abs(normals @ first) > _ALIGNED
        mean = (normals[near] * np.sign(normals[near] @ first)[:, None] * left[near, None]).sum(0)
        if np.linalg.norm(mean) < 1e-12:
            break
        candidates += [mean / np.linalg.norm(mean), -mean / np.linalg.norm(mean)]
        left = np.where(near, 0, left)
    return [(candidate, _up_score(pieces, shares, candidate)) for candidate in candidates]


def _up_score(pieces: Pieces, shares: Points, up: Points) -> float:
    heights = pieces.points @ up
    low, high = np.quantile(heights, [LOW, 1 - LOW])
    level = (heights - low) / max(high - low, 1e-12)
    across = np.where(np.abs(pieces.normals @ up) > _TILTED, shares, 0)
    floor = float(across[level < 0.33].sum() - across[level > 0.67].sum())
    standing = float(((level > 0.33) & (level < 0.67)).mean() - (level > 0.67).mean())
    lying = 0.5 - float(np.median(level))
    usual = max(float(up @ np.array(axis)) for axis in _CONVENTIONS)
    return floor + 0.5 * standing + lying + (0.2 if usual > math.cos(math.radians(20)) else 0.0)


def ground_share(pieces: Pieces, up: Points) -> float:
    """Share of a scene, as seen from above, under which a level ground lies, in 0..1.

    The ground is the slab in the lower third that holds most pieces of surface across the up direction.

    Args:
        pieces: Surfaces of the middle of the scene.
        up: The up direction ``[3]``, of unit length.
    """
    heights = pieces.points @ up
    low, high = np.quantile(heights, [LOW, 1 - LOW])
    level = (
        (np.abs(pieces.normals @ up) > _TILTED) & (pieces.flatness > 0.5) & (heights < low + (high - low) / 3)
    )
    half = _GROUND_HEIGHT * (high - low)
    if not level.any() or half <= 0:
        return 0.0
    counts, edges = np.histogram(heights[level], max(1, math.ceil(float(np.ptp(heights[level])) / half)))
    middle = edges[counts.argmax()] + half / 2
    footprint = pieces.points @ np.stack(upright_frame(up)[:2]).T
    first, last = np.quantile(footprint, [0.02, 0.98], axis=0)
    cells = np.floor((footprint - first) / max(float((last - first).max()) / _GROUND_CELLS, 1e-300))
    numbers = np.ascontiguousarray(cells).view(np.complex128)[:, 0]  # sorted ten times as fast as rows
    ground = level & (np.abs(heights - middle) < half)
    return len(np.unique(numbers[ground])) / len(np.unique(numbers))
