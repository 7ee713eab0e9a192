"""Features computed by other programs: a folder with one array per view."""

from __future__ import annotations

import logging
import tokenize
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.features.cache import FeatureMap, FeatureMaps
from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import PICKLES, refuse_pickle
from lexsplat.runtime.fingerprints import file_stamp
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures import Capture, View

log = logging.getLogger("lexsplat")

_FLOATS = ("F64", "F32", "F16", "BF16")

_READ_FIRST = 1 << 24
"""Bytes of an array that are read to find wrong numbers before a build starts."""


def load_external_features(
    folder: Path,
    capture: Capture,
    *,
    memory: int = budget.DEFAULT_MEMORY,
    dimension: int | None = None,
    allow_holes: bool = True,
) -> FeatureMaps:
    """Per-view features from a folder of arrays, named by the views' stems.

    Three forms are read, for a view ``a/b.jpg``:

    - ``a/b.npy``: ``[h, w, D]``;
    - ``a/b.safetensors``: a tensor "clip" (or one tensor of any name) ``[h, w, D]``, and optionally "dino";
    - ``a/b_f.npy`` ``[n, D]`` with ``a/b_s.npy`` ``[h, w]`` or ``[L, h, w]``: one feature per segment, and the
      segment of every pixel (-1 for none) for L levels of segments, as written by LangSplat's preprocessing. Levels
      are averaged; pixels in no segment have a zero feature.

    An array has the photo's aspect at any size. Arrays finer than the working images are read only at the centers of
    their pixels.

    Args:
        folder: Folder of the arrays.
        capture: Every view must have an array.
        memory: Bytes available for reading a map; a quarter of it is for maps that are kept.
        dimension: Depth of the text embeddings, which the features must match; None accepts any.
        allow_holes: Whether pixels may have no feature.

    Returns:
        Maps by view name; each array is read and checked on access.

    Raises:
        FileFormatError: If a view has no array. On access, if an array has a wrong shape or type, is not finite, or
            differs in depth from the others.
        MemoryBudgetError: On access, if a map does not fit.
    """
    folder = Path(folder)
    sources = external_sources(folder, capture)
    depth: dict[str, int] = {}

    def load(name: str) -> FeatureMap:
        path, reading = sources[name], _Reading(capture.views[name], memory)
        found = reading.segments(path) if path.name.endswith("_f.npy") else reading.arrays(path)
        dims = {"clip": found.clip.shape[-1]} | ({} if found.dino is None else {"dino": found.dino.shape[-1]})
        _check_depth(dims["clip"], dimension, path)
        if depth and dims != depth:
            raise wrong(path, f"features of depth {depth}", dims, "give features of one encoder")
        depth.update(dims)
        if not allow_holes and not bool(found.clip.any(-1).all()):
            expected = "a feature for every pixel, because the codebook has 256 codes"
            remedy = "give --codebook.num-codes 255 or less"
            raise wrong(path, expected, "pixels without a feature", remedy)
        return found

    return FeatureMaps(list(sources), load, memory // 4)


def check_external_features(folder: Path, capture: Capture, dimension: int | None = None) -> None:
    """Refuse arrays that are wrong by their headers or not finite, before anything that takes time.

    Of a large array only every so many rows are read here; the rest is checked on access.

    Args:
        folder: Folder of the arrays (`load_external_features`).
        capture: Every view must have an array; those of training views are opened. Its cameras are not read.
        dimension: See `load_external_features`.

    Raises:
        FileFormatError: If a view has no array, one has a wrong shape or type, numbers that are no features or
            segments, or no photo has a segment.
    """
    sources, described = external_sources(folder, capture), False
    for name in capture.train_names:
        reading, path = _Reading(capture.views[name], budget.DEFAULT_MEMORY), sources[name]
        described |= reading.check(path, dimension)
    if not described and capture.train_names:
        raise _without_segments(folder)


def read_external_features(maps: FeatureMaps, folder: Path, listener: Listener = silent) -> None:
    """Read every map once, which checks it; a warning counts photos without segments.

    Args:
        maps: From `load_external_features`.
        folder: Their folder.
        listener: Receives events of stage "features".

    Raises:
        FileFormatError: If no photo has a segment, or a file is damaged.
    """
    empty = 0
    for done, name in enumerate(maps, start=1):
        empty += not bool(maps[name].clip.any())
        listener(Event("features", done, len(maps)))
    if empty == len(maps):
        raise _without_segments(folder)
    if empty:
        log.warning("%s: %d of %d photos have no segment, and so no features", folder, empty, len(maps))


def _without_segments(folder: Path) -> FileFormatError:
    return wrong(folder, "segments in some photo", "none in any", "write them again")


def _check_depth(found: int, dimension: int | None, path: Path) -> None:
    if dimension is not None and found != dimension:
        expected = f"features of depth {dimension}, like the embeddings of the text encoder"
        raise wrong(path, expected, found, "give the encoder of the features with --clip")


def external_sources(folder: Path, capture: Capture) -> dict[str, Path]:
    """The file of each view by its name; of a pair, the file of features.

    Raises:
        FileFormatError: If there is no folder, a view has no file or two, or one of a pair is missing.
    """
    if not folder.is_dir():
        raise wrong(folder, "a folder with one array per view", "no folder", "check the path")
    return {name: _source(folder, view.stem) for name, view in capture.views.items()}


def external_identity(folder: Path, capture: Capture) -> list[str]:
    """Name, size and modification time of every file that is read: changes whenever the features change."""
    files = []
    for path in external_sources(folder, capture).values():
        files.append(path)
        if path.name.endswith("_f.npy"):
            files.append(_segments_of(path))
    stamps = {file.relative_to(folder): file_stamp(file) for file in files if file.is_file()}
    return [f"{name} {size} {modified}" for name, (size, modified) in stamps.items()]


def _segments_of(path: Path) -> Path:
    return path.with_name(path.name.removesuffix("_f.npy") + "_s.npy")


def _source(folder: Path, stem: str) -> Path:
    candidates = [folder / f"{stem}{ending}" for ending in (".npy", ".safetensors", "_f.npy")]
    there = [path for path in candidates if path.is_file()]
    if len(there) > 1:
        found = " and ".join(path.name for path in there)
        raise wrong(folder, f"one array of the view {stem}", found, "remove those that are not meant")
    for path in there:
        if path.name.endswith("_f.npy") and not _segments_of(path).is_file():
            remedy = "put the segments of every pixel beside their features"
            raise wrong(_segments_of(path), f"the segments of {path.name}", "no such file", remedy)
        return path
    for ending in PICKLES:
        if (folder / f"{stem}{ending}").exists():
            refuse_pickle(folder / f"{stem}{ending}")
    remedy = "give one array per view, named after the image without its suffix"
    expected = f"{stem}.npy, {stem}.safetensors or {stem}_f.npy with {stem}_s.npy"
    raise wrong(folder, expected, "none of them", remedy)


class _Reading:
    """Reads the arrays of one view at no more cells than its working image has pixels.

    Args:
        view: The view.
        memory: Bytes available.
    """

    def __init__(self, view: View, memory: int) -> None:
        self.view, self.memory = view, memory

    def arrays(self, path: Path) -> FeatureMap:
        """``[h, w, D]`` from .npy or safetensors."""
        if path.suffix == ".npy":
            array = _open_features(path)
            itemsize = 0 if array.dtype == np.float32 else array.itemsize
            rows, columns = self._cells(array.shape, itemsize, path)
            return FeatureMap(_unit(array[rows[:, None], columns], path))
        with _tensors(path) as (clip, dino):
            made = [None if part is None else self._sliced(part, path) for part in (clip, dino)]
        return FeatureMap(*made)  # type: ignore[arg-type]

    def check(self, path: Path, dimension: int | None) -> bool:
        """Check headers and some rows of an array (`check_external_features`).

        Returns:
            Whether a pixel may have a feature: False if all have no segment.
        """
        if path.name.endswith("_f.npy"):
            features, numbers = self.open_segments(path)
            _check_depth(features.shape[1], dimension, path)
            _check_rows(lambda step: features[None, ::step], features.nbytes, path)
            step = 1 + numbers.nbytes // _READ_FIRST
            some = segment_numbers(numbers[..., ::step, :], _segments_of(path), len(features))
            return step > 1 or bool((some >= 0).any())
        if path.suffix == ".npy":
            array = _open_features(path)
            self.check_aspect(array.shape, path)
            _check_depth(array.shape[-1], dimension, path)
            _check_rows(lambda step: array[::step], array.nbytes, path)
            return True
        with _tensors(path) as (clip, dino):
            for part in (clip,) if dino is None else (clip, dino):
                height, width, depth = self.check_aspect(tuple(part.get_shape()), path)
                if part is clip:
                    _check_depth(depth, dimension, path)
                read = partial(_rows_of, part, height)
                _check_rows(read, 4 * height * width * depth, path)
        return True

    def _sliced(self, part: Any, path: Path) -> torch.Tensor:
        """Unit vectors of a slice of a safetensors file, row by row: only one row is held twice."""
        rows, columns = self._cells(tuple(part.get_shape()), 0, path)
        read = [part[row : row + 1][:, columns].float().numpy() for row in rows.tolist()]
        return _unit(np.concatenate(read), path)

    def segments(self, path: Path) -> FeatureMap:
        """The map of one feature per segment and the segments of every pixel."""
        features, numbers = self.open_segments(path)
        rows, columns = self._cells((*numbers.shape[-2:], features.shape[1]), 0, _segments_of(path))
        index = segment_numbers(numbers[..., rows[:, None], columns], _segments_of(path), len(features))
        unit = _unit(np.array(features)[None], path)[0].numpy()
        # Segment -1 selects the zero at the end.
        padded = np.concatenate([unit, np.zeros((1, unit.shape[1]), np.float32)])
        total = np.empty((*index.shape[1:], unit.shape[1]), np.float32)
        for row in range(len(total)):
            total[row] = padded[index[:, row]].sum(0)
        return FeatureMap(_unit(total, path, holes=True))

    def open_segments(self, path: Path) -> tuple[NDArray, NDArray]:
        """Features of segments ``[n, D]``, and the segments of the pixels ``[h, w]`` or ``[L, h, w]``, mapped."""
        features, pixels = _open_features(path), _segments_of(path)
        if features.ndim != 2 or 0 in features.shape:
            raise wrong(path, "features of segments [n, D]", list(features.shape))
        numbers = open_npy(pixels)
        if numbers.ndim not in (2, 3) or 0 in numbers.shape:
            raise wrong(pixels, "segment ids [h, w] or [levels, h, w]", list(numbers.shape))
        self.check_aspect((*numbers.shape[-2:], features.shape[1]), pixels)
        return features, numbers

    def check_aspect(self, shape: tuple[int, ...], path: Path) -> tuple[int, int, int]:
        """The shape of an array ``[h, w, D]``; another one, or one without the photo's aspect, is refused."""
        if len(shape) != 3 or 0 in shape:
            raise wrong(path, "features [h, w, D]", list(shape))
        height, width, depth = shape
        if height == width == 1:
            raise wrong(path, "a map of the photo", "one feature for all of it", "give features of its parts")
        photo_width, photo_height = self.view.capture_size
        # Numbers of cells are rounded: either side may be off by one.
        if abs(height * photo_width - width * photo_height) >= photo_width + photo_height:
            raise wrong(
                path,
                f"an array of the photo's aspect, {photo_width}x{photo_height}",
                f"{width}x{height}",
                "give features of the whole photo",
            )
        return height, width, depth

    def _cells(
        self, shape: tuple[int, ...], itemsize: int, path: Path
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns to read of an array ``[h, w, D]``."""
        height, width, depth = self.check_aspect(shape, path)
        rows, columns = min(height, self.view.camera.height), min(width, self.view.camera.width)
        # The map, and its source or its norms and a row.
        need = rows * columns * (depth * (4 + itemsize) + 16) + (16 << 20)
        what = f"features of {columns}x{rows}x{depth} of a view"
        budget.require("features", need, self.memory, what, "a larger --downscale")
        return _centers(rows, height), _centers(columns, width)


@contextmanager
def _tensors(path: Path) -> Iterator[tuple[Any, Any]]:
    """The slices "clip" and "dino" (or None) of a safetensors file; what fails while they are read names the file."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            parts = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            for name, part in parts.items():
                if part.get_dtype() not in _FLOATS:
                    raise wrong(path, f"{name} as floating-point numbers", part.get_dtype())
            dino = parts.pop("dino", None)
            if len(parts) != 1 and "clip" not in parts:
                raise wrong(path, 'a tensor "clip"', ", ".join(sorted(parts)) or "none")
            clip = parts.get("clip", next(iter(parts.values())))
            if dino is not None and dino.get_shape()[:2] != clip.get_shape()[:2]:
                raise wrong(path, f"dino of size {clip.get_shape()[:2]}", dino.get_shape()[:2])
            yield clip, dino
    except (OSError, SafetensorError, ValueError, RuntimeError, OverflowError) as error:
        raise wrong(path, "safetensors", error) from error


def _rows_of(part: Any, height: int, step: int) -> NDArray:
    """Every so many rows of a slice of a safetensors file."""
    return np.concatenate([part[row : row + 1].float().numpy() for row in range(0, height, step)])


def _check_rows(read: Callable[[int], NDArray], size: int, path: Path) -> None:
    """Refuse rows of features that are not finite or, if all are read, zeros alone.

    Args:
        read: Every so many rows of an array.
        size: Bytes of the array; about `_READ_FIRST` of them are read.
        path: Its file.
    """
    step = 1 + size // _READ_FIRST
    _unit(np.array(read(step), np.float32), path, holes=step > 1)


def _centers(count: int, length: int) -> NDArray[np.intp]:
    """Indices of the cells, out of ``length``, that contain the centers of ``count`` cells."""
    return ((2 * np.arange(count) + 1) * length) // (2 * count)


def segment_numbers(segments: NDArray, path: Path, count: int = 1 << 31) -> NDArray[np.int64]:
    """Segment ids ``[L, h, w]`` from ``[h, w]`` or ``[L, h, w]``: integers from -1 to ``count`` - 1.

    Raises:
        FileFormatError: If they are others.
    """
    if not np.isfinite(segments).all():
        raise wrong(path, "integer segment ids", "NaN or infinity")
    if np.abs(segments.astype(np.float64)).max() > 2**31:
        raise wrong(path, "integer segment ids up to 2^31", f"{segments.min():g} to {segments.max():g}")
    index = segments.astype(np.int64)
    if index.min() < -1 or index.max() >= count or (index != segments).any():
        raise wrong(path, f"integers from -1 to {count - 1}", f"{segments.min():g} to {segments.max():g}")
    return index.reshape(-1, *index.shape[-2:])


def open_npy(path: Path) -> NDArray:
    """An array of numbers, memory-mapped: a damaged header cannot allocate more than the file holds.

    Raises:
        FileFormatError: If it is no such array.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except _UNREADABLE as error:
        # numpy takes other formats for pickles, and advises to allow them.
        found = "another format, or pickled objects" if "pickle" in str(error) else error
        raise wrong(path, "a .npy array without pickled objects", found) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise wrong(path, "an array of numbers", getattr(array, "dtype", type(array)))
    return array


def _open_features(path: Path) -> NDArray:
    """As `open_npy`, of floating-point numbers: integers are quantized with unknown steps, or segment ids."""
    array = open_npy(path)
    if array.dtype.kind != "f":
        raise wrong(path, "features as floating-point numbers", array.dtype)
    return array


_UNREADABLE = (
    *(OSError, ValueError, EOFError, MemoryError, OverflowError, TypeError, SyntaxError, RecursionError),
    *(tokenize.TokenError, zipfile.BadZipFile),
)
"""Types that numpy raises on damaged arrays."""


def wrong(
    path: Path, expected: str, found: object, remedy: str = "write it again (docs/captures.md has the layout)"
) -> FileFormatError:
    """The error for an array with another content than is expected."""
    return FileFormatError(path, expected=expected, found=str(found)[:200], remedy=remedy)


def _unit(array: NDArray, path: Path, *, holes: bool = False) -> torch.Tensor:
    """Unit vectors ``[h, w, D]`` in float32; normalizes in place if the array is float32 already.

    With ``holes``, all of them may be zero: a photo without segments.
    """
    if 0 in array.shape:
        raise wrong(path, "features [h, w, D]", list(array.shape))
    with np.errstate(over="ignore"):  # overflow becomes infinity, which is refused below
        values = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
    lengths = torch.linalg.vector_norm(values, dim=-1, keepdim=True)
    if not bool(torch.isfinite(lengths).all()):
        finite = bool(np.isfinite(array).all())
        raise wrong(path, "finite numbers", "values beyond 1e19" if finite else "NaN or infinity")
    if not holes and not bool(lengths.any()):
        raise wrong(path, "features", "zeros alone")
    return values.div_(lengths.clamp_min(1e-12))
