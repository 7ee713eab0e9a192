"""A set of Gaussians with the scores that selected it: the result of a search in 3D.

A `Selection` is immutable: ``a | b``, ``a - b``, ``a.grow()`` and the like make new ones. Its connected clusters are
its *instances*: two mugs found by "mug" are one selection with two instances, and so are two apples that touch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from lexsplat.geometry.boxes import Box, Up, fit_box, representatives
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.rotations import matrices_from_quaternions
from lexsplat.geometry.world import World
from lexsplat.queries.best_views import best_of, promising_views, visible_share
from lexsplat.queries.clusters import LINK, clusters, spacing
from lexsplat.queries.pieces import with_pieces
from lexsplat.queries.places import given_length, place_of
from lexsplat.queries.touching import divided
from lexsplat.queries.vocabulary import is_divided
from lexsplat.runtime.errors import QueryError
from lexsplat.runtime.lazy import at_first_call

if TYPE_CHECKING:
    from lexsplat.queries.seen import Seen

Presence = Literal["yes", "no", "unsure"]
PRESENCES: tuple[Presence, ...] = ("no", "unsure", "yes")
"""Whether a scene holds something, the least certain first."""

SMALLEST_SHARE = 0.1
"""A cluster with less than this share of the largest cluster's opacity is not an instance."""
CONVINCING = 0.65
"""An instance is kept if its peak exceeds the threshold by at least this share of the best instance's excess, both in
log-odds. On the second demo scene, 3 of the 4 wrong or partial instances of 20 prompts reach 0.47 to 0.50, and one
reaches 0.32; the right ones reach 1."""
_PLACE = ("indices", "num_gaussians", "box", "sample", "tree", "view_shares", "best_view")
"""Attributes that depend only on the Gaussians of a selection."""
_SAMPLE = 4000
PEAK_COUNT = 20
FAINT = 0.1
"""Gaussians of lower opacity join clusters but do not link them."""


@dataclass(frozen=True, eq=False, repr=False)
class Selection:
    """Gaussians of a scene with the scores that selected them.

    ``len(selection)`` is the number of Gaussians, ``selection.count`` the number of instances.

    Args:
        gaussians: The scene's Gaussians.
        cameras: Its views by name, for the up direction and the best view.
        mask: The selected Gaussians ``[N]`` bool.
        scores: Relevancy of every Gaussian ``[N]`` in 0..1.
        threshold: Smallest score of a selected Gaussian.
        present: Whether the scene holds what was asked for; "yes" for selections made by hand.
        phrase: Phrase that was asked for.
        world: Up and scale of the scene; None takes up from the cameras.
        parts: Its instances where they are known, such as objects that touch each other; () takes clusters.
        names: Its likeliest names and their probabilities, if it is an object of `Scene.objects`.
        seen: Visibility of the scene's segments in the views; None renders the views.
        note: Remark on parts that nothing fits, and on whose left is meant; "" if there is none.
        seen_from: The view that left, right, front and behind refer to; "" where the answer depends on none.
    """

    gaussians: Gaussians
    cameras: Mapping[str, Camera]
    mask: Tensor
    scores: Tensor
    threshold: float = 0.5
    present: Presence = "yes"
    phrase: str = ""
    world: World | None = None
    parts: tuple[Selection, ...] = ()
    names: tuple[tuple[str, float], ...] = ()
    seen: Seen | None = None
    note: str = ""
    seen_from: str = ""

    def __post_init__(self) -> None:
        shape = (len(self.gaussians),)
        if tuple(self.mask.shape) != shape or self.mask.dtype != torch.bool:
            raise ValueError(
                f"mask must be bool {list(shape)}, got {self.mask.dtype} {list(self.mask.shape)}"
            )
        if tuple(self.scores.shape) != shape:
            raise ValueError(f"scores must be {list(shape)}, got {list(self.scores.shape)}")

    # -- what it is

    def __len__(self) -> int:
        return self.num_gaussians

    def __bool__(self) -> bool:
        return self.num_gaussians > 0

    def __repr__(self) -> str:
        return (
            f"Selection({self.phrase[:60]!r}, present={self.present!r}, gaussians={self.num_gaussians}, "
            f"threshold={self.threshold:.3g})"
        )

    _repr_html_ = at_first_call("lexsplat.queries.notebook", "selection_html")

    @cached_property
    def num_gaussians(self) -> int:
        """Number of Gaussians."""
        return len(self.indices)

    @property
    def count(self) -> int:
        """Number of instances."""
        return len(self.instances)

    @cached_property
    def indices(self) -> Tensor:
        """Indices of its Gaussians ``[M]``."""
        return self.mask.nonzero()[:, 0]

    @property
    def selected(self) -> Gaussians:
        """The selected Gaussians."""
        return self.gaussians.select(self.indices)

    @cached_property
    def score(self) -> float:
        """Mean score of its Gaussians, weighted by opacity; 0 for an empty selection."""
        weights = self.gaussians.opacity_logits.detach()[self.indices].sigmoid()
        return float((self.scores[self.indices] * weights).sum() / weights.sum().clamp_min(1e-12))

    @cached_property
    def up(self) -> Up:
        """The scene's up direction: that of its world, else of its cameras (z if there are none)."""
        return (self.world or World.of_cameras(self.cameras.values())).up

    @cached_property
    def box(self) -> Box:
        """The upright bounding box: center, axes (rows), half sizes, in world units.

        Raises:
            QueryError: If nothing is selected.
        """
        if not self:
            raise QueryError(self.phrase or "selection", expected="something selected", found="nothing")
        opacities = self.gaussians.opacity_logits.detach()[self.indices].sigmoid().cpu().numpy()
        chosen = torch.from_numpy(representatives(opacities)).to(self.indices.device)
        thin = self.gaussians.select(self.indices[chosen]).detach()
        spreads = matrices_from_quaternions(thin.quats) * thin.scales[:, None]
        return fit_box(thin.means.cpu().numpy(), self.up.direction, spreads.cpu().numpy())

    @property
    def center(self) -> NDArray[np.float64]:
        """Center of the box ``[3]``, world units."""
        return self.box.center

    @property
    def size(self) -> NDArray[np.float64]:
        """Extent along the axes of the box ``[3]``, world units; the last one is the height."""
        return 2 * self.box.half_sizes

    @property
    def size_meters(self) -> NDArray[np.float64] | None:
        """`size` in meters; None if the scale of the scene is unknown (``lexsplat scale``)."""
        return self._in_meters(self.size)

    @property
    def center_meters(self) -> NDArray[np.float64] | None:
        """`center` in meters, in the axes of the scene and from its origin; None if the scale is unknown."""
        return self._in_meters(self.center)

    def distance_to(self, other: Selection) -> float:
        """Distance between the centers of the boxes of two selections of one scene, world units.

        In meters it is `distance_meters_to`.

        Raises:
            QueryError: If one is empty.
            TypeError, ValueError: If the other is no selection, or of another scene.
        """
        if not isinstance(other, Selection):
            raise TypeError(f"expected a Selection, got {other!r}"[:200])
        self._check_scene(other)
        return float(np.linalg.norm(self.center - other.center))

    def distance_meters_to(self, other: Selection) -> float | None:
        """`distance_to` in meters; None if the scale of the scene is unknown."""
        distance = self.distance_to(other)
        return self.world.meters(distance) if self.world else None

    @cached_property
    def instances(self) -> list[Selection]:
        """Its parts within it, or else its connected clusters without specks, the largest first."""
        if self.parts:
            return [part for part in (known.within(self.mask) for known in self.parts) if part]
        return self.clusters(SMALLEST_SHARE)

    def clusters(self, smallest: float = 0.0) -> list[Selection]:
        """All clusters with at least ``smallest`` times the opacity of the largest, largest first.

        A cluster is connected; things of one kind that touch are clusters of their own (`lexsplat.queries.touching`).
        """
        labels, weights = self._clusters()
        if len(weights) == 1:
            return [self]
        order = np.argsort(-weights, kind="stable")
        kept = [int(label) for label in order if weights[label] >= smallest * weights[order[0]]]
        members = self.indices[torch.from_numpy(np.argsort(labels, kind="stable")).to(self.indices.device)]
        parts = members.split(np.bincount(labels).tolist())
        return [self.part(parts[label]) for label in kept]

    @cached_property
    def best_view(self) -> str:
        """Name of the view that shows most of it, or nearly as much and the whole of it; "" if there is none."""
        return best_of(self)

    @cached_property
    def view_shares(self) -> list[tuple[str, float]]:
        """The views that show most of it and the share of the image it covers there, at most 8; best first."""
        if self.seen is not None and self:
            found = self.seen.shares(self.indices, None if self.seen.complete else promising_views(self))
            return found if found and found[0][1] > 0 else [(name, 0.0) for name in promising_views(self)]
        shares = [(name, visible_share(self, self.cameras[name])) for name in promising_views(self)]
        return sorted(shares, key=lambda entry: -entry[1])

    @property
    def shown_in(self) -> str:
        """`best_view`, or "" if not even that shows it."""
        return self.best_view if self.view_shares and self.view_shares[0][1] > 0 else ""

    def is_of(self, gaussians: Gaussians) -> bool:
        """Whether it was made in a scene of these Gaussians, in any colors."""
        own, others = self.gaussians.means, gaussians.means
        return own is others or (own.shape == others.shape and torch.equal(own, others.to(own)))

    # -- making others from it

    def __or__(self, other: Selection) -> Selection:
        return self._combined(other, "or", torch.bitwise_or)

    def __and__(self, other: Selection) -> Selection:
        return self._combined(other, "and", torch.bitwise_and)

    def __sub__(self, other: Selection) -> Selection:
        return self._combined(other, "minus", lambda own, others: own & ~others)

    def __invert__(self) -> Selection:
        phrase = f"not {self.phrase}".strip()
        return replace(self, mask=~self.mask, parts=(), scores=1 - self.scores, phrase=phrase)

    def grow(self, distance: float | None = None, *, meters: float | None = None) -> Selection:
        """The union with the Gaussians within a distance.

        Args:
            distance: In world units; None derives it from the spacing of the Gaussians.
            meters: In meters, in place of ``distance``.

        Raises:
            QueryError: If the distance is negative or no number, given in both ways, or in meters without a scale.
        """
        if not self:
            return self
        reach = self._reach(distance, meters)
        tree = cKDTree(self._means()[self.mask.cpu().numpy()])
        apart, _ = tree.query(self._means(), distance_upper_bound=reach)
        return replace(self, mask=self.mask | self._tensor(np.isfinite(apart)), parts=())

    def shrink(self, distance: float | None = None, *, meters: float | None = None) -> Selection:
        """The Gaussians farther than a distance from each one outside the selection; arguments as of `grow`."""
        outside = (~self.mask & (self.gaussians.opacities >= FAINT)).cpu().numpy()
        if not self or not outside.any():
            return self
        reach = self._reach(distance, meters)
        apart, _ = cKDTree(self._means()[outside]).query(self._means(), distance_upper_bound=reach)
        mask = self.mask & ~self._tensor(np.isfinite(apart))
        return replace(self, mask=mask, present=self.present if bool(mask.any()) else "no")

    def largest(self) -> Selection:
        """The largest instance; the selection itself if it is empty."""
        return self.instances[0] if self.instances else self

    def without_specks(self) -> Selection:
        """The Gaussians that belong to an instance."""
        return replace(self, mask=union(self.mask, self.instances), parts=tuple(self.instances))

    def convincing(self, scores: Tensor | None = None) -> Selection:
        """The instances whose peak is close to that of the best instance.

        Args:
            scores: Scores to compare ``[N]``; None takes those of the selection.

        For the prompt "apple", part of a duck may exceed the threshold that keeps the rim of the apple, but the duck
        peaks far below the apple. Two apples have similar peaks.
        """
        if len(self.instances) < 2:
            return self
        compared = self.scores if scores is None else scores
        peaks = [
            float(compared[one.indices].topk(min(PEAK_COUNT, len(one))).values.mean())
            for one in self.instances
        ]
        limit = min(self.convincing_limit(max(peaks)), max(peaks))  # the best one stays
        kept = tuple(instance for peak, instance in zip(peaks, self.instances) if peak >= limit)
        return replace(self, mask=union(self.mask, kept), parts=kept)

    def convincing_limit(self, best: float) -> float:
        """The smallest score of an instance if the best one scores ``best``: `CONVINCING`, in log-odds."""
        low, high = (
            math.log(p / (1 - p)) for p in (min(max(p, 1e-6), 1 - 1e-6) for p in (self.threshold, best))
        )
        return 1 / (1 + math.exp(-(low + CONVINCING * (high - low))))

    def within(self, mask: Tensor) -> Selection:
        """The intersection with a mask ``[N]``."""
        kept = self.indices[mask.to(self.mask.device)[self.indices]]
        return self if len(kept) == len(self) else self.part(kept, self.parts)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON: presence, threshold and the place of each instance, without the Gaussians.

        If the scene does not hold what was asked for ("present" is "no"), "count" is 0 and "instances" is empty,
        even if some Gaussians exceed the threshold.
        """
        instances = [] if self.present == "no" else self.instances
        return {
            "phrase": self.phrase,
            "present": self.present,
            "count": len(instances),
            "gaussians": self.num_gaussians,
            "threshold": round(float(self.threshold), 4),
            "best_view": self.shown_in if instances else "",
            "note": self.note,
            "instances": [instance.geometry() for instance in instances],
        }

    def geometry(self) -> dict[str, Any]:
        """Number of Gaussians, score, box and best view as plain data, in world units; in meters too if known.

        Raises:
            QueryError: If nothing is selected.
        """
        return place_of(self)

    # -- inside

    @cached_property
    def sample(self) -> NDArray[np.float64]:
        """Up to `_SAMPLE` of its points ``[M, 3]``, for distances and relations."""
        points, _ = self.points
        return points[:: max(1, len(points) // _SAMPLE)]

    @cached_property
    def tree(self) -> cKDTree:
        """The `sample`, for the search of neighbors."""
        return cKDTree(self.sample)

    def _combined(
        self, other: Selection, word: str, combine: Callable[[Tensor, Tensor], Tensor]
    ) -> Selection:
        if not isinstance(other, Selection):
            return NotImplemented
        self._check_scene(other)
        mask = combine(self.mask, other.mask)
        scores = self.scores if word == "minus" else torch.maximum(self.scores, other.scores)
        ranks = [PRESENCES.index(self.present), PRESENCES.index(other.present)]
        present = {"or": max(ranks), "and": min(ranks), "minus": ranks[0]}[word]
        present = present if word == "or" or bool(mask.any()) else PRESENCES.index("no")
        phrase = f"{self.phrase} {word} {other.phrase}".strip()
        threshold = min(self.threshold, other.threshold) if word == "or" else self.threshold
        parts = () if word == "or" else self.parts
        facts = {"present": PRESENCES[present], "phrase": phrase, "threshold": threshold, "parts": parts}
        return replace(self, mask=mask, scores=scores, **facts)  # type: ignore[arg-type]

    def _check_scene(self, other: Selection) -> None:
        if not self.is_of(other.gaussians):
            raise ValueError("the selections are of different scenes")

    def described(self, box: Box | None = None, **facts: Any) -> Selection:
        """The same Gaussians with other facts, such as ``phrase`` or ``scores``; a known box stays known."""
        made = replace(self, **facts)
        known = {name: self.__dict__[name] for name in _PLACE if name in self.__dict__}
        made.__dict__.update(known if box is None else {**known, "box": box})
        return made

    def part(self, indices: Tensor, parts: tuple[Selection, ...] = ()) -> Selection:
        """Some of its Gaussians, by their indices ``[M]`` in the scene, with the instances among them if known."""
        mask = torch.zeros_like(self.mask)
        mask[indices] = True
        made = replace(self, mask=mask, parts=parts)
        made.__dict__["indices"] = indices  # not searched for again among all Gaussians
        return made

    def _means(self) -> NDArray[np.float32]:
        return self.gaussians.means.detach().cpu().numpy()

    def _tensor(self, array: NDArray[np.bool_]) -> Tensor:
        return torch.from_numpy(array).to(self.mask.device)

    @property
    def points(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centers ``[M, 3]`` and opacities ``[M]`` of the selected Gaussians."""
        means, logits = (
            each.detach()[self.indices] for each in (self.gaussians.means, self.gaussians.opacity_logits)
        )
        return means.cpu().double().numpy(), logits.sigmoid().cpu().double().numpy()

    def _in_meters(self, lengths: NDArray[np.float64]) -> NDArray[np.float64] | None:
        scale = self.world.meters_per_unit if self.world else None
        return None if scale is None else lengths * scale

    def _reach(self, distance: float | None, meters: float | None = None) -> float:
        given = given_length(self.world, distance, meters)
        return self._spacing() * LINK if given is None else float(np.nextafter(given, np.inf))

    def _spacing(self) -> float:
        """Median distance from a selected Gaussian to its sixth neighbor."""
        points, _ = self.points
        if len(points) < 2:
            return float(self.gaussians.log_scales[self.indices].exp().max())
        return spacing(points)

    def _clusters(self) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Cluster of each selected Gaussian ``[M]`` and the total opacity of each cluster ``[C]``."""
        points, opacities = self.points
        firm = opacities >= FAINT
        counted = None if self.seen is None else self.seen.counted(self.indices)
        labels = divided(points, firm, clusters(points, firm, counted), self.up.direction)
        if labels.any():
            shapes = replace(self.gaussians, shN=self.gaussians.shN[:, :0]).select(self.indices)
            labels = with_pieces(shapes, labels, opacities, surface=is_divided(self.phrase))
        return labels, np.bincount(labels, weights=opacities).astype(np.float64)


def union(like: Tensor, parts: Iterable[Selection]) -> Tensor:
    """The Gaussians ``[N]`` bool of any of some selections, on the device of ``like [N]``."""
    mask = torch.zeros_like(like)
    for part in parts:
        mask[part.indices] = True
    return mask
