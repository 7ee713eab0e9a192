"""Features made elsewhere: a folder with one array a view."""

from __future__ import annotations

import tokenize
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from lexsplat.errors import FileFormatError
from lexsplat.features.cache import FeatureMap, FeatureMaps
from lexsplat.tensor_files import PICKLES, refuse_pickle

if TYPE_CHECKING:
    from lexsplat.scenes import Scene


def load_external_features(folder: Path, scene: Scene, *, cache_bytes: int = 1 << 30) -> FeatureMaps:
    """Per-view features from a folder of arrays, named by the views' stems.

    Three forms are read, for a view ``a/b.jpg``:

    - ``a/b.npy``: ``[h, w, D]``;
    - ``a/b.safetensors``: a tensor "clip" (or one tensor of any name) ``[h, w, D]``, and if wanted "dino";
    - ``a/b_f.npy`` ``[n, D]`` with ``a/b_s.npy`` ``[h, w]`` or ``[L, h, w]``: one feature a segment, and the
      segment of every pixel (-1 for none) for L levels of segments, as LangSplat-style preprocessing writes
      them; levels are averaged.

    Args:
        folder: Where the arrays are.
        scene: Every view must have its array.
        cache_bytes: Most bytes of maps to keep in memory.

    Returns:
        Maps by view name; each array is read, and its numbers checked, when its view is asked for.

    Raises:
        FileFormatError: If a view has no array or, when it is read, the array has a wrong shape or type, is
            not finite, or has another depth than those before.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileFormatError(folder, expected="a folder with one array a view", found="no folder")
    sources = {name: _source(folder, view.stem) for name, view in scene.views.items()}
    depth: dict[str, int] = {}

    def load(name: str) -> FeatureMap:
        path = sources[name]
        found = _read_segments(path) if path.name.endswith("_f.npy") else _read_arrays(path)
        dims = {"clip": found.clip.shape[-1]} | ({} if found.dino is None else {"dino": found.dino.shape[-1]})
        if depth and dims != depth:
            raise FileFormatError(path, expected=f"features of depth {depth}", found=f"{dims}")
        depth.update(dims)
        return found

    return FeatureMaps(list(sources), load, cache_bytes)


def _source(folder: Path, stem: str) -> Path:
    candidates = [folder / f"{stem}{ending}" for ending in (".npy", ".safetensors", "_f.npy")]
    for path in candidates:
        if path.is_file():
            return path
    for ending in PICKLES:
        if (folder / f"{stem}{ending}").exists():
            refuse_pickle(folder / f"{stem}{ending}")
    raise FileFormatError(
        folder,
        expected=f"{stem}.npy, {stem}.safetensors or {stem}_f.npy with {stem}_s.npy",
        found="none of them",
        remedy="give one array for every view, named by the image's name without its ending",
    )


def _read_arrays(path: Path) -> FeatureMap:
    if path.suffix == ".npy":
        return FeatureMap(_unit(_read_npy(path), path))
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        tensors = load_file(path)
    except (OSError, SafetensorError, ValueError, RuntimeError) as error:
        raise FileFormatError(path, expected="safetensors", found=str(error)[:200]) from error
    for name, tensor in tensors.items():
        if not tensor.is_floating_point():
            raise FileFormatError(path, expected=f"{name} as floating-point numbers", found=str(tensor.dtype))
    dino = tensors.pop("dino", None)
    if len(tensors) != 1 and "clip" not in tensors:
        raise FileFormatError(path, expected='a tensor "clip"', found=", ".join(sorted(tensors)) or "none")
    clip = _unit(tensors.get("clip", next(iter(tensors.values()))).float().numpy(), path)
    if dino is None:
        return FeatureMap(clip)
    if dino.shape[:2] != clip.shape[:2]:
        raise FileFormatError(
            path, expected=f"dino of size {list(clip.shape[:2])}", found=f"{list(dino.shape[:2])}"
        )
    return FeatureMap(clip, _unit(dino.float().numpy(), path))


def _read_segments(path: Path) -> FeatureMap:
    features = _read_npy(path)
    pixels = path.with_name(path.name.removesuffix("_f.npy") + "_s.npy")
    segments = _read_npy(pixels)
    if features.ndim != 2:
        raise FileFormatError(path, expected="[n, D]", found=str(list(features.shape)))
    if segments.ndim not in (2, 3):
        raise FileFormatError(pixels, expected="[h, w] or [L, h, w]", found=str(list(segments.shape)))
    if (
        0 in segments.shape
        or not np.isfinite(segments).all()
        or np.abs(segments.astype(np.float64)).max() > 2**31
    ):
        raise FileFormatError(pixels, expected="segment numbers", found="none, or numbers that are none")
    index = segments.astype(np.int64)
    if index.min() < -1 or index.max() >= len(features) or (index != segments).any():
        raise FileFormatError(
            pixels,
            expected=f"whole numbers from -1 to {len(features) - 1}",
            found=f"{segments.min():g} to {segments.max():g}",
        )
    index = index.reshape(-1, *index.shape[-2:])
    unit = _unit(features[None], path)[0].numpy()
    padded = np.concatenate([unit, np.zeros((1, unit.shape[1]), np.float32)])  # -1 picks the zero at the end
    total = np.zeros((*index.shape[1:], unit.shape[1]), np.float32)
    for level in index:
        total += padded[level]
    return FeatureMap(_unit(total, path))


def _read_npy(path: Path) -> NDArray:
    try:
        # Mapped first: a header that promises more than the file holds must not become memory.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, MemoryError, OverflowError, TypeError) as error:
        raise _no_array(path, error) from error
    except (SyntaxError, RecursionError, tokenize.TokenError, zipfile.BadZipFile) as error:
        raise _no_array(path, error) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise FileFormatError(
            path, expected="an array of numbers", found=str(getattr(array, "dtype", type(array)))
        )
    return np.array(array)


def _no_array(path: Path, error: Exception) -> FileFormatError:
    return FileFormatError(path, expected="a .npy array without pickled objects", found=str(error)[:200])


def _unit(array: NDArray, path: Path) -> torch.Tensor:
    if array.ndim != 3 or 0 in array.shape:
        raise FileFormatError(path, expected="features [h, w, D]", found=str(list(array.shape)))
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, which is refused below
        array = array.astype(np.float32)
    values = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
    if not bool(torch.isfinite(values).all()):
        raise FileFormatError(path, expected="finite numbers", found="NaN or infinity")
    return F.normalize(values, dim=-1)
