"""Extracts the features of every view into the cache (section 3.2)."""

from __future__ import annotations

import dataclasses
import queue
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lexsplat.features.cache import (
    FeatureMap,
    FeatureMaps,
    hash_of,
    is_stored,
    read_crops,
    read_grid,
    read_levels,
    write_crops,
    write_grid,
)
from lexsplat.features.encoders import DenseEncoder, ImageTextEncoder
from lexsplat.features.pyramid import (
    CropLevel,
    batch_size_for,
    cut_crops,
    encode_stream,
    grid_levels,
    patch_map,
    random_levels,
    unique_boxes,
)
from lexsplat.features.settings import GRID_SETTINGS, RANDOM_SETTINGS, FeatureConfig
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import torch_threads
from lexsplat.runtime.fingerprints import file_hash
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures import Capture, View

# Larger batches exceed the processor's cache: 256 crops of the bundled encoder take 10 to 15 % longer than 64, and 64
# of a ViT-B/16 take 16 % longer than 8.
_CPU_BATCH, _CPU_PIXELS = 64, 8 * 224**2
_LONGEST = 16  # in short sides: the maps of longer images get coarser, which bounds their memory
_MAX_WORKERS = 4  # beyond this, more threads per operation are faster than more views at once


def extract_features(
    capture: Capture,
    clip: ImageTextEncoder,
    dino: DenseEncoder | None,
    config: FeatureConfig | None = None,
    *,
    cache_dir: Path,
    memory: int = budget.DEFAULT_MEMORY,
    listener: Listener = silent,
) -> FeatureMaps:
    """Extract and cache the features of every view; views that are cached with these settings are skipped.

    An interrupted run resumes with the missing views. On the CPU several views are processed at once, one thread
    each, which is faster than one view on several threads.

    Args:
        capture: Its views are read one at a time, at their capture resolution.
        clip: Encoder of the crops.
        dino: Encoder of dense features; None for CLIP alone.
        config: Settings; None for the defaults.
        cache_dir: Folder of the cache; it may hold files of other settings and captures.
        memory: Bytes of host memory for extraction and for maps that are read, without the encoders' weights.
        listener: Receives an event of stage "features" after every view.

    Returns:
        Maps by view name, read from the cache on access.

    Raises:
        CaptureError: If an image cannot be read.
        MemoryBudgetError: If a photo, or the patches of its crops, do not fit into ``memory``.
        ModelError: If patches are requested of an encoder that has none.
        ValueError: If ``memory`` is not positive.
    """
    if memory < 1:
        raise ValueError(f"memory must be at least 1 byte, got {memory}")
    config = config or FeatureConfig()
    cache_dir = Path(cache_dir)
    entries = {name: _Entry.of(view, clip, dino, config, cache_dir) for name, view in capture.views.items()}
    twins = _missing(entries)
    missing, total = sum(map(len, twins.values())), len(entries)
    done = total - missing
    listener(Event("features", done, total))
    largest = max([1, *(_view_bytes(capture.views[n], entries[n], clip, config, memory) for n in entries)])
    workers = min(parallel_views(clip.device), max(1, missing))
    workers = max(1, min(workers, memory // 2 // largest))
    batch_size = batch_size_for(memory // workers, clip.image_size)
    extraction = _Extraction(capture.views, entries, clip, dino, config, batch_size)
    for name in extraction.run(list(twins), workers):
        done += len(twins[name])
        listener(Event("features", done, total))

    def load(name: str) -> FeatureMap:
        entry = entries[name]
        cols, rows = entry.map_size
        grid = None if entry.dino is None else read_grid(entry.dino, cols, rows)
        return FeatureMap(read_crops(entry.clip, cols, rows, config.tokens), grid)

    return FeatureMaps(list(entries), load, memory // 4)


def missing_views(
    capture: Capture,
    clip: ImageTextEncoder,
    dino: DenseEncoder | None,
    config: FeatureConfig,
    cache_dir: Path,
) -> dict[str, tuple[str, ...]]:
    """Views whose features are not cached, by the name of the first view of the same photo."""
    views = capture.views.items()
    return _missing({name: _Entry.of(view, clip, dino, config, Path(cache_dir)) for name, view in views})


def _missing(entries: Mapping[str, _Entry]) -> dict[str, tuple[str, ...]]:
    """See `missing_views`; views of identical photos share their files."""
    same_files: dict[tuple[Path, Path | None], tuple[str, ...]] = {}
    for name, entry in entries.items():
        if not entry.is_complete():
            same_files[entry.clip, entry.dino] = (*same_files.get((entry.clip, entry.dino), ()), name)
    return {names[0]: names for names in same_files.values()}


def _view_bytes(view: View, entry: _Entry, clip: ImageTextEncoder, config: FeatureConfig, memory: int) -> int:
    """Bytes that one view takes while it is processed: its photo, and the embeddings of its patches with a copy."""
    photo = view.lens.width, view.lens.height
    budget.check_photo(photo, memory, entry.image_size)
    need = budget.photo_bytes(photo, entry.image_size)
    if config.tokens == "class":
        return need
    crops = sum(map(len, crop_levels(entry.image_size, config, entry.seed)))
    patches = 2 * 4 * crops * (1 + clip.patches**2) * clip.dim
    what, remedy = f"the patches of {crops:,} crops", "features.crop-tokens class"
    budget.require("features", 2 * patches, memory, what, remedy)
    return need + patches


def load_level_maps(
    capture: Capture, clip: ImageTextEncoder, config: FeatureConfig, cache_dir: Path, name: str
) -> tuple[Tensor, list[float]]:
    """The CLIP map of each crop size of one view, from features that `extract_features` has cached.

    Returns:
        Maps ``[L, h, w, D]``, unit length, and the sides of the crops as fractions of the image's width.

    Raises:
        FileFormatError: If the view's features are not cached.
    """
    entry = _Entry.of(capture.views[name], clip, None, config, Path(cache_dir))
    return read_levels(entry.clip, *entry.map_size)


def parallel_views(device: torch.device) -> int:
    """Number of views that are processed at once, if memory suffices."""
    return min(_MAX_WORKERS, torch.get_num_threads()) if device.type == "cpu" else 1


def cpu_batch(image_size: int) -> int:
    """Number of crops of this side that a CPU encodes at once."""
    return min(_CPU_BATCH, max(1, _CPU_PIXELS // image_size**2))


def encoded_size(capture_size: tuple[int, int], config: FeatureConfig) -> tuple[int, int]:
    """Width and height at which a photo is cut into crops."""
    return reduced(capture_size, config.max_short_side)


def reduced(capture_size: tuple[int, int], short_side: int) -> tuple[int, int]:
    """Width and height of a photo whose short side is at most this long."""
    factor = min(1.0, short_side / min(capture_size))
    return max(1, round(capture_size[0] * factor)), max(1, round(capture_size[1] * factor))


def crop_levels(size: tuple[int, int], config: FeatureConfig, seed: int) -> tuple[CropLevel, ...]:
    """The crops of a photo of this width and height; the seed is that of random ones."""
    if config.mode == "grid":
        return grid_levels(*size, config.crop_sizes, config.crop_strides)
    fractions = np.linspace(*config.random_sizes, config.random_levels).tolist()
    return random_levels(*size, fractions, config.random_crops, np.random.default_rng(seed))


def size_of_map(capture_size: tuple[int, int], config: FeatureConfig) -> tuple[int, int]:
    """Width and height of a feature map in cells."""
    width, height = capture_size
    cells = config.map_cells / min(width, height) * _strip_factor(width, height)
    return max(1, round(width * cells)), max(1, round(height * cells))


def pixels_hash(view: View, size: tuple[int, int]) -> str:
    """Hash of everything the pixels of `View.load_image` depend on: file, lens, background, size and mask."""
    lens = dataclasses.asdict(view.lens)
    masked = [] if view.ignore_path is None else [file_hash(view.ignore_path, 16)]
    masked += ["transparent"] if view.ignores_transparent else []
    return hash_of(file_hash(view.image_path, 16), lens, list(view.background), size, *masked)


@dataclass(frozen=True)
class _Entry:
    """Cache files, image size and map size of a view."""

    clip: Path
    dino: Path | None
    image_size: tuple[int, int]
    map_size: tuple[int, int]
    seed: int

    @classmethod
    def of(
        cls,
        view: View,
        clip: ImageTextEncoder,
        dino: DenseEncoder | None,
        config: FeatureConfig,
        cache_dir: Path,
    ) -> _Entry:
        image_size, map_size = encoded_size(view.capture_size, config), size_of_map(view.capture_size, config)
        pixels = pixels_hash(view, image_size)
        settings = dataclasses.asdict(config)
        crops = {
            name: settings[name]
            for name in ("mode", *(GRID_SETTINGS if config.mode == "grid" else RANDOM_SETTINGS))
        }
        dense = {name: settings[name] for name in settings if name.startswith("dino_")}
        crops.pop("crop_tokens", None)
        if config.tokens != "class":  # patches are stored as a map of this size
            crops["patches"] = map_size
        clip_key = hash_of("clip", clip.content_hash, crops, pixels)
        dino_path = None
        if dino is not None:
            dino_path = cache_dir / f"{hash_of('dino', dino.content_hash, dense, pixels)}.dino.safetensors"
        # Seeded by the image: views differ, and a view's crops do not depend on other views.
        seed = int(hash_of(config.seed, pixels)[:12], 16)
        return cls(cache_dir / f"{clip_key}.clip.safetensors", dino_path, image_size, map_size, seed)

    def is_complete(self) -> bool:
        return is_stored(self.clip) and (self.dino is None or is_stored(self.dino))


def _strip_factor(width: int, height: int) -> float:
    """Scale of a map: 1, or less for images longer than 16 short sides, whose map area it bounds."""
    return min(1.0, (_LONGEST * min(width, height) / max(width, height)) ** 0.5)


class _Extraction:
    """Workers that take views from one queue and stream their crops through the encoder."""

    def __init__(
        self,
        views: Mapping[str, View],
        entries: Mapping[str, _Entry],
        clip: ImageTextEncoder,
        dino: DenseEncoder | None,
        config: FeatureConfig,
        batch_size: int,
    ) -> None:
        self.views, self.entries, self.clip, self.dino, self.config = views, entries, clip, dino, config
        self.batch_size = batch_size
        if clip.device.type == "cpu":
            self.batch_size = min(batch_size, cpu_batch(clip.image_size))
        self._todo: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._finished: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._stop = threading.Event()

    def run(self, missing: list[str], workers: int) -> Iterator[str]:
        """Extract ``missing`` views; yields their names as they are finished."""
        if not missing:
            return
        for view in missing:
            self._todo.put(view)
        inner = max(1, torch.get_num_threads() // workers)
        with torch_threads(inner), ThreadPoolExecutor(workers) as pool:
            futures = [pool.submit(self._work, inner) for _ in range(workers)]
            try:
                running = workers
                while running:
                    finished = self._finished.get()
                    if finished is None:
                        running -= 1
                    else:
                        yield finished
            finally:
                self._stop.set()  # even if the consumer stops early or is interrupted
        for future in futures:
            future.result()

    def _work(self, threads: int) -> None:
        torch.set_num_threads(threads)  # the setting is per thread
        try:
            for (name, levels, places), unique in encode_stream(self._encode, self._jobs(), self.batch_size):
                entry = self.entries[name]
                if unique.ndim == 2:
                    write_crops(entry.clip, levels, unique[places], entry.image_size)
                else:
                    whole, tokens = unique[places, 0], unique[:, 1:][places]
                    del unique  # as large as the tokens
                    patches = patch_map(levels, tokens, *entry.image_size, *entry.map_size)
                    del tokens
                    write_crops(entry.clip, levels, whole, entry.image_size, patches)
                self._finished.put(name)
        except BaseException:
            self._stop.set()
            raise
        finally:
            self._finished.put(None)

    def _encode(self, crops: Tensor) -> Tensor:
        """Embeddings of crops ``[b, D]``, or of crops and their patches ``[b, 1 + P * P, D]``."""
        if self.config.tokens == "class":
            return self.clip.encode_images(crops)
        whole, patches = self.clip.encode_patches(crops)
        return torch.cat([whole[:, None], patches.flatten(1, 2)], 1)

    def _jobs(self) -> Iterator[tuple[tuple[str, tuple[CropLevel, ...], Tensor], Iterator[Tensor]]]:
        """Views whose crops are missing, with their crops. Also extracts missing DINO features."""
        while not self._stop.is_set():
            try:
                name = self._todo.get_nowait()
            except queue.Empty:
                return
            entry = self.entries[name]
            pixels = torch.from_numpy(np.ascontiguousarray(self.views[name].load_image(entry.image_size)))
            image = pixels.permute(2, 0, 1)
            if self.dino is not None and entry.dino is not None and not is_stored(entry.dino):
                write_grid(entry.dino, self._dense(self.dino, image))
            if is_stored(entry.clip):
                self._finished.put(name)
                continue
            levels = crop_levels(entry.image_size, self.config, entry.seed)
            boxes, places = unique_boxes(levels)
            crops = cut_crops(image.to(self.clip.device), boxes, self.clip.image_size, self.batch_size)
            yield (name, levels, torch.from_numpy(places)), crops

    def _dense(self, dino: DenseEncoder, image: Tensor) -> Tensor:
        config = self.config
        return dino.encode_dense(
            image,
            short_side=max(1, round(config.dino_short_side * _strip_factor(*image.shape[-2:]))),
            stride=config.dino_stride,
            facet=config.dino_facet,
            layer=config.dino_layer,
            max_tokens=config.dino_max_tokens,
        )
