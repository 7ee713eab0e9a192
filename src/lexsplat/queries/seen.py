"""Visibility of segments in the views of a scene. It gives best views and hidden Gaussians without rendering.

Rendering is linear in what Gaussians carry, so the share of an image that a selection covers is a sum over its
Gaussians. The sums of whole segments are kept, view by view. A selection covers of each segment what it has of the
segment's visible weight. Dimension letters: N Gaussians, S lowest segments, V views.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.segments import Segments
from lexsplat.queries.visibility import hidden_gaussians
from lexsplat.rendering import measure_weights
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.sampling import evenly

MOST_VIEWS = 256
"""Best views are chosen among so many of the views."""
_LONG_SIDE = 120
"""Longer side of a view in pixels, at most."""
_BEST = 8


class Seen:
    """The share of each view that each segment covers, with occlusion. Many threads may ask.

    Args:
        gaussians: The scene.
        cameras: Its views by name.
        training: The names of those that the masses of the segments come from.
        segments: Its segments.
        kept: From `tensors` of an earlier one of the same scene; None computes what is asked for.
        key: Hash of what it is computed from; "" where nobody needs it.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Mapping[str, Camera],
        training: Sequence[str],
        segments: Segments,
        kept: Mapping[str, Tensor] | None = None,
        key: str = "",
    ) -> None:
        self.key = key
        self._gaussians, self._segments = gaussians, segments
        self._training = [cameras[name] for name in training]
        self._cameras = {name: cameras[name] for name in evenly(list(cameras), MOST_VIEWS)}
        self._names = list(self._cameras)
        self._labels: NDArray[np.int64] = segments.labels.cpu().numpy()
        self._masses: NDArray[np.float32] = segments.masses.cpu().numpy()
        self._working = threading.Lock()
        self._shares = np.zeros((segments.levels.shape[1], len(self._names)), np.float32)
        self._known = np.zeros(len(self._names), bool)
        self._complete = kept is not None
        if kept is not None:
            self._shares, self._known[:] = kept["shares"].float().numpy(), True
            self.hidden = kept["hidden"].to(gaussians.device)

    @cached_property
    def hidden(self) -> Tensor:
        """Gaussians ``[N]`` bool that the training views hardly show (`lexsplat.queries.visibility`)."""
        known = self._segments.hidden
        if known is not None:
            return known.to(self._gaussians.device)
        return hidden_gaussians(self._gaussians, self._training, self._segments.masses)

    def counted(self, indices: Tensor) -> NDArray[np.bool_] | None:
        """Which of some Gaussians ``[M]`` belong to no fill (`lexsplat.language.segments`); None without fills."""
        added = self._segments.added
        return None if added is None else ~added.cpu()[indices.cpu()].numpy()

    @property
    def complete(self) -> bool:
        """Whether all views were computed at once, so that no question renders any.

        Questions that render them one by one do not make it so: the same question has the same answer afterwards.
        """
        return self._complete

    def complete_all(self, listener: Listener = silent) -> None:
        """Compute what is not known yet; reports stage "views"."""
        for place, name in enumerate(self._names):
            listener(Event("views", place, len(self._names)))
            self._column(name)
        self._complete = True
        listener(Event("views", len(self._names), len(self._names)))

    def tensors(self) -> dict[str, Tensor]:
        """All that is known, for safetensors: shares ``[S, V]`` and hidden Gaussians ``[N]``."""
        self.complete_all()
        return {"shares": torch.from_numpy(self._shares).half(), "hidden": self.hidden.cpu()}

    @property
    def names(self) -> list[str]:
        """The views, in the order of `covered`."""
        return list(self._names)

    def covered(self, indices: Tensor) -> NDArray[np.float64]:
        """The share of each view ``[V]`` that some Gaussians ``[M]`` cover; see `complete`."""
        labels, taken = self._taken(indices)
        return np.asarray(taken @ self._shares[labels])

    def _taken(self, indices: Tensor) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Segments and the part of their visible weight that some Gaussians have."""
        found = indices.cpu().numpy()
        labels, inverse = np.unique(self._labels[found], return_inverse=True)
        mass = np.bincount(inverse, self._masses[found], len(labels))
        return labels, mass / np.maximum(self._totals[labels], 1e-12)

    def shares(
        self, indices: Tensor, promising: Sequence[str] | None, most: int = _BEST
    ) -> list[tuple[str, float]]:
        """The views that show most of some Gaussians and the share of the image they cover there; best first.

        Args:
            indices: The Gaussians ``[M]``.
            promising: The views to look at; None looks at all, which `complete` makes cheap.
            most: The number of views that are told, at most.
        """
        labels, taken = self._taken(indices)
        names = self._names if promising is None else [name for name in promising if name in self._cameras]
        shares = taken @ self._shares[labels] if promising is None else self._at(names, labels, taken)
        order = np.argsort(-shares, kind="stable")[:most]
        return [(names[place], float(shares[place])) for place in order]

    @cached_property
    def _totals(self) -> NDArray[np.float64]:
        """Visible weight of each segment ``[S]``."""
        return np.bincount(self._labels, self._masses, len(self._shares)).astype(np.float64)

    def _at(self, names: Sequence[str], labels: NDArray[np.int64], taken: NDArray) -> NDArray[np.float64]:
        return np.array([taken @ self._column(name)[labels] for name in names])

    def _column(self, name: str) -> NDArray[np.float32]:
        """The share of a view that each segment covers ``[S]``."""
        place = self._names.index(name)
        with self._working:
            if not self._known[place]:
                small = self._cameras[name].within(_LONG_SIDE)
                with torch.no_grad():
                    weights = measure_weights(self._gaussians, small).cpu().numpy()
                covered = np.bincount(self._labels, weights, len(self._shares))
                self._shares[:, place] = covered / (small.width * small.height)
                self._known[place] = True
        return np.asarray(self._shares[:, place])
