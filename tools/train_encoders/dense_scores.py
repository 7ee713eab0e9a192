"""How well dense features cluster by object, on scenes outside the training set."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from crops import Frame, Frames
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from sklearn.metrics import normalized_mutual_info_score

PATCH = 8
CLUSTERS = 24


def patch_things(frame: Frame) -> NDArray[np.int64]:
    """The object with the most pixels in each patch ``[H / 8, W / 8]``."""
    height, width = frame.things.shape
    patches = frame.things.reshape(height // PATCH, PATCH, width // PATCH, PATCH).swapaxes(1, 2)
    patches = patches.reshape(height // PATCH, width // PATCH, -1)
    return np.apply_along_axis(lambda patch: np.bincount(patch).argmax(), 2, patches)


def mean_colors(frame: Frame) -> NDArray[np.float64]:
    """Mean color of each patch ``[H / 8, W / 8, 3]``, the baseline of dense features."""
    pixels = np.asarray(frame.image, float) / 255
    height, width = frame.things.shape
    return pixels.reshape(height // PATCH, PATCH, width // PATCH, PATCH, 3).mean((1, 3))


def grouping(frames: Frames, features: Callable[[Frame], NDArray], *, scenes: int = 10) -> dict[str, float]:
    """Purity and normalized mutual information between k-means clusters and objects, for each scene.

    Args:
        frames: Frames; those of one scene are clustered together.
        features: Of a frame ``[H / 8, W / 8, D]``.
        scenes: How many scenes.
    """
    purities, informations = [], []
    for scene in sorted({frame.scene for frame in frames.frames})[:scenes]:
        views = [frame for frame in frames.frames if frame.scene == scene]
        things = np.concatenate([patch_things(frame).ravel() for frame in views])
        vectors = np.concatenate([(f := features(frame)).reshape(-1, f.shape[-1]) for frame in views])
        clusters = KMeans(CLUSTERS, n_init=2, random_state=0).fit_predict(vectors)
        most = sum(np.bincount(things[clusters == number]).max() for number in np.unique(clusters))
        purities.append(most / len(things))
        informations.append(normalized_mutual_info_score(things, clusters))
    return {"purity": round(float(np.mean(purities)), 4), "nmi": round(float(np.mean(informations)), 4)}
