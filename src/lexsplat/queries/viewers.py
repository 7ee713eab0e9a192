"""The viewer of left and right: the views that show two things vote, weighted by how much of them they show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.cameras import Camera
from lexsplat.queries.phrases import RelationName
from lexsplat.queries.relations import CONE, REACH, Frame, frame_of, level_axes
from lexsplat.queries.selection import Selection

DIRECTED: tuple[RelationName, ...] = ("left of", "right of", "in front of", "behind")
"""Relations that depend on the viewer."""


def view_name(viewer: Camera | None, cameras: Mapping[str, Camera]) -> str:
    """The name of the view where a viewer stands; "" where it is no view of the scene."""
    return next((name for name, camera in cameras.items() if camera is viewer), "")


@dataclass
class Viewers:
    """The viewers that may decide what is to the left of a thing, or behind it.

    Args:
        relation: One of `DIRECTED`.
        like: Any selection of the scene, for its views, up and what the views show.
        chosen: The one that was asked for; None lets the views decide.
    """

    relation: RelationName
    like: Selection
    chosen: Camera | None = None
    _taken: list[str] = field(default_factory=list, init=False)
    _known: dict[int, tuple[Selection, NDArray[np.float64]]] = field(default_factory=dict, init=False)

    def frame(self, target: Selection, reference: Selection) -> Frame:
        """The frame of the view that decides for two things.

        Each view votes: the thing is to the left, to the right or neither (in front, behind or neither). The weight
        of a vote is the share of the image that the less visible of the two things covers. The answer with more than
        half of the weight wins. Views all around a thing have no majority: there the view with the largest weight
        decides. The view returned is the one with the largest weight among those that give this answer.
        """
        if self.chosen is not None or self.relation not in DIRECTED:
            return self._one
        weights = np.minimum(self._shares(target), self._shares(reference))
        if len(weights) == 0 or not weights.any():
            self._taken += [reference.best_view] * bool(reference.best_view)
            return frame_of(self.like.cameras.get(reference.best_view), self.like.up.direction)
        answers = self._answers(target, reference)
        totals = np.bincount(answers + 1, weights, 3)
        if totals.max() > weights.sum() / 2:
            weights = np.where(answers + 1 == totals.argmax(), weights, 0.0)
        best = int(weights.argmax())
        self._taken.append(self._names[best])
        right, ahead = self._level
        return Frame(right[best], ahead[best], self._up)

    @property
    def seen_from(self) -> str:
        """The views that left and right refer to, in words: "view_012", or "most views, such as view_012"."""
        if self.chosen is not None:
            return view_name(self.chosen, self.like.cameras)
        if not self._taken:
            return ""
        (name, _), *others = Counter(self._taken).most_common()
        return f"most views, such as {name}" if others else name

    @cached_property
    def _one(self) -> Frame:
        """The only frame: that of the chosen viewer, or any frame for relations without a viewer."""
        return frame_of(self.chosen, self.like.up.direction)

    @cached_property
    def _names(self) -> list[str]:
        seen = self.like.seen
        return seen.names if seen is not None and seen.complete else list(self.like.cameras)

    @cached_property
    def _axes(self) -> NDArray[np.float64]:
        """The axis to the right of each view, or ahead of it ``[V, 3]``."""
        right, ahead = self._level
        return right if self.relation in ("left of", "right of") else ahead

    @cached_property
    def _level(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The axes to the right of each view and ahead of it ``[V, 3]``."""
        return level_axes([self.like.cameras[name] for name in self._names], self._up)

    @cached_property
    def _up(self) -> NDArray[np.float64]:
        up = np.asarray(self.like.up.direction, float)
        return up / np.linalg.norm(up)

    def _shares(self, one: Selection) -> NDArray[np.float64]:
        """The share of each view that a thing covers ``[V]``, computed once for all pairs that it is in."""
        if id(one) not in self._known:
            self._known[id(one)] = one, self._covered(one)  # which keeps the thing, and so its number
        return self._known[id(one)][1]

    def _covered(self, one: Selection) -> NDArray[np.float64]:
        """The share of each view that a thing covers ``[V]``; 1 or 0 where no rendering of the views is kept."""
        seen = self.like.seen
        if seen is not None and seen.complete:
            return seen.covered(one.indices)
        cameras = [self.like.cameras[name] for name in self._names]
        return np.array([float(camera.project(one.center)[2]) for camera in cameras])

    def _answers(self, target: Selection, reference: Selection) -> NDArray[np.int64]:
        """The vote of each view ``[V]``: -1 left or in front, 1 right or behind, 0 neither."""
        up = self.like.up.direction
        offset = target.center - reference.center
        level = offset - (offset @ up) * up
        along = self._axes @ level
        reach = np.abs(self._axes @ reference.box.axes.T) @ reference.box.half_sizes
        clear = (np.abs(along) > REACH * reach) & (np.abs(along) >= CONE * np.linalg.norm(level))
        return np.asarray(np.where(clear, np.sign(along), 0), np.int64)
