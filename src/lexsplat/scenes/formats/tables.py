"""Labels and point clouds as tables for spreadsheets, CloudCompare and scripts."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.gaussians import SH_C0, Gaussians


def colors_of(gaussians: Gaussians) -> NDArray[np.uint8]:
    """View-independent color of every Gaussian (spherical harmonics of degree 0) ``[N, 3]``."""
    rgb = gaussians.sh0[:, 0].detach() * SH_C0 + 0.5
    return (rgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def write_labels_csv(
    gaussians: Gaussians, labels: Tensor, scores: Tensor, names: Sequence[str], path: Path
) -> None:
    """Write one row per Gaussian: index, x, y, z, red, green, blue, opacity, label, score.

    Args:
        gaussians: The scene.
        labels: Index of each Gaussian's label in ``names``, -1 if it has none ``[N]``.
        scores: Score of each Gaussian's best label ``[N]``.
        names: Names of the labels.
        path: The file.
    """
    means = gaussians.means.detach().cpu().numpy()
    opacities = gaussians.opacities.detach().cpu().numpy()
    rgb = colors_of(gaussians)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["index", "x", "y", "z", "red", "green", "blue", "opacity", "label", "score"])
        for index, (label, score) in enumerate(zip(labels.tolist(), scores.tolist())):
            place = [f"{v:.6g}" for v in means[index]]
            name = names[label] if label >= 0 else ""
            writer.writerow(
                [index, *place, *rgb[index].tolist(), f"{opacities[index]:.4f}", name, f"{score:.4f}"]
            )


def write_points_ply(gaussians: Gaussians, path: Path) -> None:
    """Write a colored point cloud (x, y, z, red, green, blue): one point per Gaussian of opacity 0.1 or more."""
    shown = gaussians.select((gaussians.opacities >= 0.1).detach())
    layout = [("place", "<f4", 3), ("color", "u1", 3)]
    table = np.zeros(len(shown), dtype=layout)
    table["place"], table["color"] = shown.means.detach().cpu().numpy(), colors_of(shown)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(shown)}"]
    header += [f"property float {name}" for name in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    with open(path, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        file.write(table.tobytes())
