"""SOG of version 1, and streamed SOG, as their programs write them; independent of lexsplat's readers and writers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image


def picture(folder: Path, name: str, pixels: np.ndarray, width: int = 4) -> str:
    """Write pixels ``[N, 4]`` in rows of ``width``; returns the name."""
    rows = -(-len(pixels) // width)
    image = np.zeros((rows * width, 4), np.uint8)
    image[: len(pixels)] = pixels
    Image.fromarray(image.reshape(rows, width, 4)).save(folder / name, "WEBP", lossless=True, exact=True)
    return name


def write_version_1(folder: Path, count: int = 10, seed: int = 0) -> dict[str, np.ndarray]:
    """Write a ``meta.json`` of version 1 with random pictures and harmonics of degree 1; returns what they mean."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    low, high, scales, sh0, turns = (rng.integers(0, 256, (count, 4), dtype=np.uint8) for _ in range(5))
    turns[:, 3] = 252  # w is left out
    turns[:, :3] = turns[:, :3] // 3 + 80  # so that it is the largest
    palette = rng.integers(0, 256, (64 * 3, 4), dtype=np.uint8)
    labels = np.zeros((count, 4), np.uint8)
    labels[:, 0] = np.arange(count) % 64
    for pixels in (low, high, scales, palette, labels):
        pixels[:, 3] = 255
    bounds = {
        "means": ([-1.0, -2, 0.5], [1.5, 2, 3]), "scales": ([-6.0, -5, -4], [-1.0, -2, -3]),
        "sh0": ([-1.0, -2, -3, -4], [1.0, 2, 3, 5]), "shN": (-0.5, 0.7),
    }  # fmt: skip
    parts = {
        "means": [("means_l.webp", low), ("means_u.webp", high)], "scales": [("scales.webp", scales)],
        "quats": [("quats.webp", turns)], "sh0": [("sh0.webp", sh0)], "shN": [("shN_labels.webp", labels)],
    }  # fmt: skip
    meta = {}
    for part, files in parts.items():
        names = [picture(folder, name, pixels) for name, pixels in files]
        meta[part] = {"shape": [count, 3], "dtype": "float32", "files": names}
        if part in bounds:
            meta[part]["mins"], meta[part]["maxs"] = bounds[part]
    meta["shN"]["files"].insert(0, picture(folder, "shN_centroids.webp", palette, width=192))
    (folder / "meta.json").write_text(json.dumps(meta))

    def between(part: str, values: np.ndarray, steps: float) -> np.ndarray:
        first, last = (np.asarray(bound, float) for bound in bounds[part])
        return first + values / steps * (last - first)

    logs = between("means", low[:, :3] + 256.0 * high[:, :3], 65535)
    small = (turns[:, :3] / 255 * 2 - 1) / np.sqrt(2)
    return {
        "means": np.sign(logs) * (np.exp(np.abs(logs)) - 1), "log_scales": between("scales", scales[:, :3], 255),
        "quats": np.column_stack([np.sqrt(1 - (small**2).sum(1)), small]),
        "opacity_logits": between("sh0", sh0, 255)[:, 3], "sh0": between("sh0", sh0, 255)[:, None, :3],
        "shN": between("shN", palette[:, :3], 255).reshape(64, 3, 3)[labels[:, 0]],
    }  # fmt: skip


def write_streamed(folder: Path, levels: dict[str, int], tree: dict, **further: object) -> None:
    """Write a ``lod-meta.json`` whose files are SOG of version 1 in folders, with these counts."""
    for seed, (name, count) in enumerate(levels.items()):
        write_version_1(folder / name, count, seed)
    meta = {"version": 1, "lodLevels": 2, "filenames": [f"{name}/meta.json" for name in levels], "tree": tree}
    (folder / "lod-meta.json").write_text(json.dumps(meta | further))
