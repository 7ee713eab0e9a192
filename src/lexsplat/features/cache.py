"""The feature cache on disk: one file per view and encoder, named by a hash of everything its content depends on.

For CLIP, the file holds the embeddings of the crops, which are 10 to 50 times smaller than the dense map; the map is
computed by a few small matrix products. For DINO, it holds the encoder's grid. Both are in half precision. If
features are pooled by 2D segments, these are stored in the same way.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.features.pyramid import CropLevel, dense_map, mean_map
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.fingerprints import digest

if TYPE_CHECKING:
    from lexsplat.captures import Capture

FORMAT_VERSION = "1"

Tokens = Literal["class", "patch", "both"]
"""Which embeddings of a crop are used: the image-level one, those of its patches, or both."""


@dataclass(frozen=True)
class FeatureMap:
    """Dense language features of one view, F = F_CLIP (+) F_DINO (Eq. 2).

    Cell (i, j) is centered at the pixel ((j + .5) W / w, (i + .5) H / h) of the W x H image.

    Args:
        clip: Image-text features ``[h, w, Dc]``, float32, unit length.
        dino: Dense features ``[h, w, Dd]``, float32, unit length; None without DINO.
        levels: The view pooled by each of several levels of 2D segments apart; () without.
    """

    clip: Tensor
    dino: Tensor | None = None
    levels: tuple[FeatureMap, ...] = ()

    def __post_init__(self) -> None:
        if self.clip.ndim != 3 or (self.dino is not None and self.dino.shape[:2] != self.clip.shape[:2]):
            shapes = [list(part.shape) for part in (self.clip, self.dino) if part is not None]
            raise ValueError(f"feature maps must be [h, w, D] and of one size, got {shapes}")

    @property
    def nbytes(self) -> int:
        """Bytes held in memory."""
        own = sum(part.nbytes for part in (self.clip, self.dino) if part is not None)
        return own + sum(level.nbytes for level in self.levels)


class FeatureMaps(Mapping[str, FeatureMap]):
    """Feature maps by view name, loaded on access; the most recent ones are kept as long as they fit.

    Args:
        names: Names of the views.
        load: Returns the map of a view.
        cache_bytes: Most bytes of maps to keep.
        source: The maps that ``load`` reads from, if it keeps some too; `forget` is passed on to it.
    """

    def __init__(
        self,
        names: Sequence[str],
        load: Callable[[str], FeatureMap],
        cache_bytes: int = 1 << 30,
        source: FeatureMaps | None = None,
    ) -> None:
        self._names, self._load, self._limit = dict.fromkeys(names), load, cache_bytes
        self._kept: OrderedDict[str, FeatureMap] = OrderedDict()
        self._lock, self._source = Lock(), source

    def __getitem__(self, name: str) -> FeatureMap:
        if name not in self._names:
            raise KeyError(name)
        with self._lock:
            if name in self._kept:
                self._kept.move_to_end(name)
                return self._kept[name]
        found = self._load(name)
        with self._lock:
            self._kept[name] = found
            while self._kept and self.cached_bytes > self._limit:
                self._kept.popitem(last=False)
        return found

    def __contains__(self, name: object) -> bool:
        return name in self._names  # that of Mapping would load the map

    def forget(self) -> None:
        """Free the kept maps; they are loaded again on access."""
        with self._lock:
            self._kept.clear()
        if self._source is not None:
            self._source.forget()

    def __getstate__(self) -> dict[str, Any]:
        """Without the kept maps and their lock, for workers."""
        return {**vars(self), "_kept": OrderedDict(), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._lock = Lock()

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    @property
    def cached_bytes(self) -> int:
        """Bytes of the maps currently in memory."""
        return sum(found.nbytes for found in self._kept.values())


def without_masked_cells(maps: FeatureMaps, capture: Capture) -> FeatureMaps:
    """Feature maps in which cells without an unmasked pixel are zero; the codebook skips zero cells.

    Encoders see masked pixels in the photo's mean color (`lexsplat.captures.View.load_image`).

    Args:
        maps: Maps by view name.
        capture: The views.
    """
    if not any(capture.views[name].is_masked for name in maps if name in capture.views):
        return maps

    def load(name: str) -> FeatureMap:
        found = maps[name]
        height, width = found.clip.shape[:2]
        share = capture.views[name].valid_share((width, height))
        if share is None:
            return found
        counts = torch.from_numpy(share > 0)[..., None].to(found.clip.device)
        return FeatureMap(found.clip * counts, None if found.dino is None else found.dino * counts)

    return FeatureMaps(list(maps), load, 0, source=maps)


def hash_of(*parts: Any) -> str:
    """Hash of JSON-like values, 32 hex digits: the cache keys. Changing it invalidates every cache."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return digest([text.encode()], 16)


def write_crops(
    path: Path,
    levels: Sequence[CropLevel],
    embeddings: Tensor,
    size: tuple[int, int],
    patches: Tensor | None = None,
) -> None:
    """Store the crops of a ``size`` = (width, height) image and their embeddings.

    Args:
        path: The file.
        levels: Crops by size.
        embeddings: One per crop ``[n, D]``.
        size: Width and height of the image.
        patches: The map of their patches ``[h, w, D]`` (`lexsplat.features.pyramid.mean_map`), if used.
    """
    tensors = {"embeddings": embeddings.half().contiguous()}
    if patches is not None:
        tensors["patches"] = patches.half().contiguous()
    for index, level in enumerate(levels):
        tensors[f"lefts.{index}"] = torch.from_numpy(level.lefts.astype(np.int32))
        tensors[f"tops.{index}"] = torch.from_numpy(level.tops.astype(np.int32))
    facts = {"size": size, "levels": [{"size": level.size, "grid": level.grid} for level in levels]}
    _write(path, tensors, facts)


def read_crops(path: Path, cols: int, rows: int, tokens: Tokens = "class") -> Tensor:
    """The dense map ``[rows, cols, D]`` of stored crops, of their patches, or of both with equal weight.

    See `lexsplat.features.pyramid.dense_map`.

    Raises:
        FileFormatError: If the file is not such a cache file.
    """
    levels, embeddings, (width, height), patches = _stored_crops(path)
    if tokens == "class":
        return dense_map(levels, embeddings, width, height, cols, rows)
    if patches is None or patches.shape[:2] != (rows, cols) or patches.shape[-1] != embeddings.shape[-1]:
        raise _damaged(path, ValueError("no patches of this size"))
    if tokens == "patch":
        return F.normalize(patches, dim=-1)
    return F.normalize(patches + mean_map(levels, embeddings, width, height, cols, rows), dim=-1)


def read_levels(path: Path, cols: int, rows: int) -> tuple[Tensor, list[float]]:
    """A map per crop size ``[L, rows, cols, D]``, unit length, and the sides of the crops.

    The sides are fractions of the image's width.

    Raises:
        FileFormatError: If the file is not such a cache file.
    """
    levels, embeddings, (width, height), _ = _stored_crops(path)
    maps = []
    for level in levels:
        maps.append(dense_map([level], embeddings[: len(level)], width, height, cols, rows))
        embeddings = embeddings[len(level) :]
    return torch.stack(maps), [level.size / width for level in levels]


def _stored_crops(path: Path) -> tuple[list[CropLevel], Tensor, tuple[int, int], Tensor | None]:
    """Levels, embeddings ``[n, D]`` float32, width and height of the image, and the map of patches ``[h, w, D]``
    float32 if there is one. Checks them against each other.
    """
    tensors, facts = _read(path)
    try:
        embeddings = tensors["embeddings"].float()
        patches = tensors["patches"].float() if "patches" in tensors else None
        width, height = facts["size"]
        levels = []
        for i, level in enumerate(facts["levels"]):
            lefts, tops = tensors[f"lefts.{i}"], tensors[f"tops.{i}"]
            if {lefts.dtype, tops.dtype} != {torch.int32} or lefts.ndim != 1 or tops.ndim != 1:
                raise ValueError("crop positions that are not int32 vectors")
            levels.append(CropLevel(level["size"], lefts.numpy(), tops.numpy(), level["grid"]))
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(path, error) from error
    sides = [width, height, *(level.size for level in levels)]
    whole = all(type(side) is int and 1 <= side <= 1 << 16 for side in sides)
    grids = all(
        type(level.grid) is bool and (level.grid or len(level.lefts) == len(level.tops)) for level in levels
    )
    if not whole or not grids or embeddings.ndim != 2 or len(embeddings) != sum(map(len, levels)):
        raise _damaged(path, ValueError("crops that do not match the embeddings"))
    if len(embeddings) == 0 or not bool(torch.isfinite(embeddings).all()):
        raise _damaged(path, ValueError("no embeddings, or NaN or infinity"))
    if patches is not None and (patches.ndim != 3 or not bool(torch.isfinite(patches).all())):
        raise _damaged(path, ValueError("patches that are not a map, or NaN or infinity"))
    return levels, embeddings, (width, height), patches


def write_grid(path: Path, features: Tensor) -> None:
    """Store dense features ``[h, w, D]``."""
    _write(path, {"features": features.half().contiguous()}, {})


def read_grid(path: Path, cols: int, rows: int) -> Tensor:
    """Stored dense features at another size ``[rows, cols, D]``, unit length.

    Raises:
        FileFormatError: If the file is not such a cache file.
    """
    tensors, _ = _read(path)
    features = tensors.get("features", torch.zeros(0)).float()
    if features.ndim != 3 or features.numel() == 0 or not bool(torch.isfinite(features).all()):
        raise _damaged(path, ValueError("no features, or NaN or infinity"))
    return resize_grid(features, cols, rows)


def write_labels(path: Path, labels: NDArray[np.integer]) -> None:
    """Store the segments of a view ``[L, h, w]`` (`lexsplat.features.segments2d`)."""
    _write(path, {"labels": torch.from_numpy(np.ascontiguousarray(labels, np.int32))}, {})


def read_labels(path: Path, cols: int, rows: int) -> Tensor:
    """Stored segments ``[L, rows, cols]`` int32, -1 for none.

    Raises:
        FileFormatError: If the file is not such a cache file.
    """
    labels = _read(path)[0].get("labels", torch.zeros(0))
    if labels.ndim != 3 or labels.shape[1:] != (rows, cols) or labels.dtype != torch.int32:
        raise _damaged(path, ValueError("no segments of this size"))
    return labels


def resize_grid(features: Tensor, cols: int, rows: int) -> Tensor:
    """Features ``[h, w, D]`` at the centers of ``rows`` x ``cols`` cells, unit length."""
    if features.shape[:2] != (rows, cols):
        planes = features.permute(2, 0, 1)[None]
        planes = F.interpolate(planes, (rows, cols), mode="bilinear", antialias=True, align_corners=False)
        features = planes[0].permute(1, 2, 0)
    return F.normalize(features, dim=-1)


def is_stored(path: Path) -> bool:
    """Whether a complete cache file exists; reads its header only."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            return (file.metadata() or {}).get("format_version") == FORMAT_VERSION
    except (OSError, SafetensorError):
        return False


def _write(path: Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
    write_tensors(path, tensors, {"format_version": FORMAT_VERSION, "facts": json.dumps(facts)})


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    try:
        tensors, metadata = read_tensors(path)
        facts = json.loads(metadata["facts"])
    except (FileFormatError, KeyError, ValueError, RecursionError) as error:
        raise _damaged(path, error) from error
    if not isinstance(facts, dict):
        raise _damaged(path, TypeError("facts"))
    return tensors, facts


def _damaged(path: Path, error: Exception) -> FileFormatError:
    found = error.found if isinstance(error, FileFormatError) else str(error)
    if isinstance(error, KeyError):
        found = f"no {found}"
    remedy = "delete the file and run again"
    return FileFormatError(path, expected="cached features", found=found[:200], remedy=remedy)
