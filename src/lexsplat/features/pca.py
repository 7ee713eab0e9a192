"""A picture of features: their three main directions as red, green and blue."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def pca_image(features: Tensor) -> NDArray[np.uint8]:
    """Color features by their first three principal components.

    Args:
        features: ``[h, w, D]``.

    Returns:
        Picture ``[h, w, 3]``; each component runs from its 2nd to its 98th percentile. Without variation it
        is gray.

    Raises:
        ValueError: If the features are not ``[h, w, D]`` with D at least 1.
    """
    if features.ndim != 3 or 0 in features.shape:
        raise ValueError(f"features must be [h, w, D], got {list(features.shape)}")
    rows, cols, dim = features.shape
    flat = features.reshape(-1, dim).double().cpu()
    flat = flat - flat.mean(0)
    # The eigenvectors of the D x D covariance: cheaper than a decomposition of all the cells.
    variances, directions = torch.linalg.eigh(flat.T @ flat)
    directions = directions[:, -3:].flip(-1)
    # An eigenvector's sign is arbitrary; its largest entry is made positive so that pictures are
    # reproducible.
    signs = directions.gather(0, directions.abs().argmax(0, keepdim=True)).sign()
    parts = (flat @ (directions * signs)).numpy()
    low, high = np.percentile(parts, [2, 98], axis=0)
    spread = high - low
    flat_scale = np.sqrt(max(float(variances[-1]), 0.0) / len(flat))
    varied = spread > max(1e-6, 1e-4 * flat_scale)
    scaled = np.where(varied, np.clip((parts - low) / np.where(varied, spread, 1), 0, 1), 0.5)
    picture = np.full((rows * cols, 3), 0.5)
    picture[:, : scaled.shape[1]] = scaled
    return np.round(picture.reshape(rows, cols, 3) * 255).astype(np.uint8)
