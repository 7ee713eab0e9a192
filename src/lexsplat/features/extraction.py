"""Extraction: features of every view into the cache, one view after the other (section 3.2)."""

from __future__ import annotations

import dataclasses
import queue
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
import tyro
from torch import Tensor

from lexsplat.features.cache import (
    FeatureMap,
    FeatureMaps,
    Tokens,
    hash_file,
    hash_of,
    is_stored,
    read_crops,
    read_grid,
    read_levels,
    write_crops,
    write_grid,
)
from lexsplat.features.encoders import DenseEncoder, Facet, ImageTextEncoder
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
from lexsplat.runtime import memory as budget
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures import Capture, View

_CPU_BATCH = 64  # larger batches leave the processor's cache: measured 10 to 15 % slower at 256
_LONGEST = 16  # in short sides: longer strips get coarser maps, or the memory of a map would know no bound
_MAX_WORKERS = 4  # beyond this, threads inside an operation pay better than more images in flight

_GRID = ("crop_sizes", "crop_strides", "crop_tokens")
_RANDOM = ("random_crops", "random_levels", "random_sizes", "seed")


@dataclass(frozen=True)
class FeatureConfig:
    """How dense features are made. The defaults suit CLIP ViT-B/16 and DINO ViT-S/8 on a GPU.

    Args:
        mode: "grid", a regular grid of crops for each size as in LERF and the authors' code; "random", the
            paper's hierarchical random crops.
        crop_sizes: Grid: sides of the crops as fractions of the image's short side.
        crop_strides: Grid: distance between crops of each size, as a fraction of their side; the overlap is
            the rest.
        crop_tokens: Grid: what of a crop speaks for a place. "class", the whole of it at its middle (the paper);
            "patch", each of its patches where it lies, read as in MaskCLIP, which needs a model of CLIP's own
            architecture; "both". None is "class", but "both" for the encoders that ship.
        random_crops: Random: crops of a view, shared out evenly over the sizes.
        random_levels: Random: number of sizes.
        random_sizes: Random: smallest and largest side as fractions of the image's short side.
        seed: Random: seed of the positions; every view draws its own.
        map_cells: Cells of the feature maps along the short side (fewer on strips longer than 16 short sides).
        max_short_side: Larger images are reduced to this many pixels on the short side before cropping.
        dino_short_side: Pixels on the short side of the image that DINO sees.
        dino_stride: Pixels of that image between features; below the patch size, shifted copies are
            evaluated.
        dino_facet: "key", attention keys, or "token", output tokens.
        dino_layer: Layer of the keys, 0-based; None is the last.
        dino_max_tokens: Patches that DINO's attention sees at once; larger images are seen in overlapping
            windows.
        memory: Bytes that extraction and reading may use, beside the weights of the encoders; a build sets it to its
            ``--memory``.
    """

    mode: Literal["grid", "random"] = "grid"
    crop_sizes: tuple[float, ...] = (0.05, 0.125, 0.2, 0.275, 0.35, 0.425, 0.5)
    crop_strides: tuple[float, ...] = (1.0, 0.625, 0.5, 0.5, 0.5, 0.5, 0.5)
    crop_tokens: Tokens | None = None
    random_crops: int = 3000
    random_levels: int = 20
    random_sizes: tuple[float, float] = (0.05, 0.2)
    seed: int = 0
    map_cells: int = 112
    max_short_side: int = 1080
    dino_short_side: int = 224
    dino_stride: int = 2
    dino_facet: Facet = "key"
    dino_layer: int | None = None
    dino_max_tokens: int = 4096
    memory: tyro.conf.Suppress[int] = 4 << 30

    def __post_init__(self) -> None:
        if self.mode not in ("grid", "random"):
            raise ValueError(f"mode must be 'grid' or 'random', got {self.mode!r}")
        if len(self.crop_sizes) != len(self.crop_strides) or not self.crop_sizes:
            raise ValueError(
                f"needs one crop stride a crop size, got {len(self.crop_strides)} for {len(self.crop_sizes)}"
            )
        if min(self.crop_sizes) <= 0 or min(self.crop_strides) <= 0:
            raise ValueError("crop sizes and strides must be positive")
        if not 0 < self.random_sizes[0] <= self.random_sizes[1]:
            raise ValueError(f"random_sizes must be positive and in order, got {self.random_sizes}")
        if self.crop_tokens not in (None, "class", "patch", "both"):
            raise ValueError(f"crop_tokens must be 'class', 'patch' or 'both', got {self.crop_tokens!r}")
        if self.tokens != "class" and self.mode != "grid":
            raise ValueError(f"crop_tokens={self.crop_tokens} needs mode=grid, random crops speak as wholes")
        if self.dino_facet not in ("key", "token"):
            raise ValueError(f"dino_facet must be 'key' or 'token', got {self.dino_facet!r}")
        sizes = ("map_cells", "max_short_side", "dino_short_side", "dino_stride", "dino_max_tokens")
        for name in (*sizes, "random_crops", "random_levels", "memory"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def tokens(self) -> Tokens:
        """What of a crop speaks."""
        return self.crop_tokens or "class"

    @classmethod
    def sparse(cls) -> FeatureConfig:
        """Settings for large encoders on a CPU: a sixth of the crops and a quarter of DINO's work."""
        return cls(crop_sizes=(0.2, 0.4), crop_strides=(0.5, 0.5), map_cells=56, dino_stride=4)

    @classmethod
    def bundled(cls) -> FeatureConfig:
        """Settings for the small encoders that ship with the package, chosen by measurement."""
        return cls(
            crop_sizes=(18 / 240, 44 / 240),
            crop_strides=(0.5, 0.35),
            crop_tokens="both",
            map_cells=120,
            max_short_side=360,
            dino_short_side=320,
            dino_stride=8,
        )

    def where_open(self, suited: FeatureConfig) -> FeatureConfig:
        """``suited`` with everything in which these settings differ from the defaults.

        Sizes and strides of the grid are one thing: they must have the same length.
        """
        if self.mode == "random":  # whose crops speak as wholes
            suited = dataclasses.replace(suited, crop_tokens=None)
        usual = FeatureConfig()
        given = {name for name in dataclasses.asdict(self) if getattr(self, name) != getattr(usual, name)}
        if given & {"crop_sizes", "crop_strides"}:
            given |= {"crop_sizes", "crop_strides"}
        return dataclasses.replace(suited, **{name: getattr(self, name) for name in given})

    def result_settings(self, use_dino: bool) -> FeatureConfig:
        """The same with those at their defaults that decide nothing: memory, the other mode's, an unused DINO's."""
        usual = FeatureConfig()
        unused = {"memory", *(_RANDOM if self.mode == "grid" else _GRID)}
        if self.tokens == "class":
            unused.add("crop_tokens")
        if not use_dino:
            unused |= {name for name in dataclasses.asdict(self) if name.startswith("dino_")}
        return dataclasses.replace(self, **{name: getattr(usual, name) for name in unused})


def extract_features(
    scene: Capture,
    clip: ImageTextEncoder,
    dino: DenseEncoder | None,
    config: FeatureConfig | None = None,
    *,
    cache_dir: Path,
    memory: int | None = None,
    listener: Listener = silent,
) -> FeatureMaps:
    """Extract and store the features of every view; views already stored with these settings cost nothing.

    A run that was stopped goes on with the views that are missing. On the CPU several views are in work at
    once, one thread each, which is faster than one view on several threads.

    Args:
        scene: Its views are read one after the other, at the resolution they were captured in.
        clip: Embeds crops.
        dino: Dense features beside CLIP; None for CLIP alone.
        config: Settings; None for the defaults.
        cache_dir: Folder of the cache; files of other settings or scenes may lie there too.
        memory: Host memory in bytes; None takes that of the settings.
        listener: Hears of stage "features" after every view.

    Returns:
        Maps by view name, read from the cache when asked for.

    Raises:
        CaptureError: If an image cannot be read.
        MemoryBudgetError: If a photo, or the patches of its crops, are too large for the memory of the settings.
        ModelError: If patches are to speak and the encoder's cannot be read.
    """
    config = config or FeatureConfig()
    if memory is not None:
        config = dataclasses.replace(config, memory=memory)
    cache_dir = Path(cache_dir)
    entries = {name: _Entry.of(view, clip, dino, config, cache_dir) for name, view in scene.views.items()}
    missing = [name for name, entry in entries.items() if not entry.is_complete()]
    done, total = len(entries) - len(missing), len(entries)
    listener(Event("features", done, total))
    workers = (
        1 if clip.device.type == "cuda" else min(_MAX_WORKERS, torch.get_num_threads(), max(1, len(missing)))
    )
    largest = 1
    for name, entry in entries.items():
        photo = scene.views[name].lens.width, scene.views[name].lens.height
        budget.check_photo(photo, config.memory, entry.image_size)
        largest = max(
            largest, budget.photo_bytes(photo, entry.image_size) + _patch_bytes(entry, clip, config)
        )
    workers = max(1, min(workers, config.memory // 2 // largest))
    pictures: dict[tuple[Path, Path | None], list[str]] = {}  # views with the same picture share their files
    for name in missing:
        pictures.setdefault((entries[name].clip, entries[name].dino), []).append(name)
    twins = {names[0]: names for names in pictures.values()}
    for name in _Extraction(scene.views, entries, list(twins), clip, dino, config, workers).run():
        done += len(twins[name])
        listener(Event("features", done, total))

    def load(name: str) -> FeatureMap:
        entry = entries[name]
        cols, rows = entry.map_size
        grid = None if entry.dino is None else read_grid(entry.dino, cols, rows)
        return FeatureMap(read_crops(entry.clip, cols, rows, config.tokens), grid)

    return FeatureMaps(list(entries), load, config.memory // 4)


def _patch_bytes(entry: _Entry, clip: ImageTextEncoder, config: FeatureConfig) -> int:
    """What the patches of all crops of a view take while they wait to be put together, with a copy; 0 without them.

    Raises:
        MemoryBudgetError: If that is more than half of the memory of the settings.
    """
    if config.tokens == "class":
        return 0
    crops = sum(map(len, grid_levels(*entry.image_size, config.crop_sizes, config.crop_strides)))
    need = 2 * 4 * crops * (1 + clip.patches**2) * clip.dim
    what, remedy = f"the patches of {crops:,} crops", "features.crop-tokens class"
    budget.require("features", 2 * need, config.memory, what, remedy)
    return need


def load_level_maps(
    scene: Capture, clip: ImageTextEncoder, config: FeatureConfig, cache_dir: Path, name: str
) -> tuple[Tensor, list[float]]:
    """The CLIP map of each crop size of one view, from features that `extract_features` has stored.

    Returns:
        Maps ``[L, h, w, D]``, unit length, and the sides of the crops as fractions of the image's width.

    Raises:
        FileFormatError: If the view's features are not stored.
    """
    entry = _Entry.of(scene.views[name], clip, None, config, Path(cache_dir))
    return read_levels(entry.clip, *entry.map_size)


@dataclass(frozen=True)
class _Entry:
    """Where the features of a view are stored, and the sizes they have."""

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
        width, height = view.capture_size
        factor = min(1.0, config.max_short_side / min(width, height))
        image_size = max(1, round(width * factor)), max(1, round(height * factor))
        cells = config.map_cells / min(width, height) * _strip_factor(width, height)
        map_size = max(1, round(width * cells)), max(1, round(height * cells))
        # The pixels follow from the file, the lens they are undistorted by, the background, the size and the mask.
        lens = dataclasses.asdict(view.lens)
        masked = [] if view.ignore_path is None else [hash_file(view.ignore_path)]
        pixels = hash_of(hash_file(view.image_path), lens, list(view.background), image_size, *masked)
        settings = dataclasses.asdict(config)
        crops = {name: settings[name] for name in ("mode", *(_GRID if config.mode == "grid" else _RANDOM))}
        dense = {name: settings[name] for name in settings if name.startswith("dino_")}
        crops.pop("crop_tokens", None)
        if config.tokens != "class":  # what patches say is stored as a map of this size
            crops["patches"] = map_size
        clip_key = hash_of("clip", clip.content_hash, crops, pixels)
        dino_path = None
        if dino is not None:
            dino_path = cache_dir / f"{hash_of('dino', dino.content_hash, dense, pixels)}.dino.safetensors"
        # Seeded by the image, so that views differ and a view's crops do not depend on the others.
        seed = int(hash_of(config.seed, pixels)[:12], 16)
        return cls(cache_dir / f"{clip_key}.clip.safetensors", dino_path, image_size, map_size, seed)

    def is_complete(self) -> bool:
        return is_stored(self.clip) and (self.dino is None or is_stored(self.dino))


def _strip_factor(width: int, height: int) -> float:
    """1, or for strips what makes the area of their maps that of a picture of 16 by 1."""
    return min(1.0, (_LONGEST * min(width, height) / max(width, height)) ** 0.5)


class _Extraction:
    """Workers that take views from one queue; each streams the crops of its views through the encoder."""

    def __init__(
        self,
        views: Mapping[str, View],
        entries: Mapping[str, _Entry],
        missing: list[str],
        clip: ImageTextEncoder,
        dino: DenseEncoder | None,
        config: FeatureConfig,
        workers: int,
    ) -> None:
        self.views, self.entries, self.clip, self.dino, self.config = views, entries, clip, dino, config
        self.workers = workers
        batch_size = batch_size_for(config.memory // workers, clip.image_size)
        self.batch_size = batch_size if clip.device.type == "cuda" else min(batch_size, _CPU_BATCH)
        self._todo: queue.SimpleQueue[str] = queue.SimpleQueue()
        for name in missing:
            self._todo.put(name)
        self._finished: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._stop = threading.Event()

    def run(self) -> Iterator[str]:
        """Names of the views as they get finished."""
        if self._todo.empty():
            return
        threads = torch.get_num_threads()
        inner = max(1, threads // self.workers)
        torch.set_num_threads(inner)
        try:
            with ThreadPoolExecutor(self.workers) as pool:
                futures = [pool.submit(self._work, inner) for _ in range(self.workers)]
                try:
                    running = self.workers
                    while running:
                        name = self._finished.get()
                        if name is None:
                            running -= 1
                        else:
                            yield name
                finally:
                    self._stop.set()  # also when the consumer stops early or is interrupted
            for future in futures:
                future.result()
        finally:
            torch.set_num_threads(threads)

    def _work(self, threads: int) -> None:
        torch.set_num_threads(threads)  # the setting is per thread
        try:
            for (name, levels, places), unique in encode_stream(self._encode, self._jobs(), self.batch_size):
                entry = self.entries[name]
                tokens = unique[places]
                if tokens.ndim == 2:
                    write_crops(entry.clip, levels, tokens, entry.image_size)
                else:
                    patches = patch_map(levels, tokens[:, 1:], *entry.image_size, *entry.map_size)
                    write_crops(entry.clip, levels, tokens[:, 0], entry.image_size, patches)
                self._finished.put(name)
        except BaseException:
            self._stop.set()
            raise
        finally:
            self._finished.put(None)

    def _encode(self, crops: Tensor) -> Tensor:
        """Crops to their embeddings ``[b, D]``, or with those of their patches after them ``[b, 1 + P * P, D]``."""
        if self.config.tokens == "class":
            return self.clip.encode_images(crops)
        whole, patches = self.clip.encode_patches(crops)
        return torch.cat([whole[:, None], patches.flatten(1, 2)], 1)

    def _jobs(self) -> Iterator[tuple[tuple[str, tuple[CropLevel, ...], Tensor], Iterator[Tensor]]]:
        """Views whose crops are missing, with their crops; DINO is done on the way."""
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
            levels = self._levels(entry)
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

    def _levels(self, entry: _Entry) -> tuple[CropLevel, ...]:
        config, (width, height) = self.config, entry.image_size
        if config.mode == "grid":
            return grid_levels(width, height, config.crop_sizes, config.crop_strides)
        smallest, largest = config.random_sizes
        return random_levels(
            width,
            height,
            crops=config.random_crops,
            levels=config.random_levels,
            smallest=smallest,
            largest=largest,
            rng=np.random.default_rng(entry.seed),
        )
