"""Segments of photos in 2D, and features that are pooled by them, so that they end where segments end.

Segments come from superpixels (SLIC), from a folder with one map a photo, or from SAM 2. There may be several levels
of them. The features of a segment are replaced by their mean. Each level is an observation of the pixel; levels from
parts to things also make a map each, for methods that keep them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.features.cache import FeatureMap, FeatureMaps, hash_of, is_stored, read_labels, write_labels
from lexsplat.features.external import open_npy, segment_numbers, wrong
from lexsplat.features.extraction import pixels_hash, reduced, size_of_map
from lexsplat.features.hub import model_folder
from lexsplat.features.settings import FeatureConfig
from lexsplat.runtime.errors import CaptureError, ModelError
from lexsplat.runtime.fingerprints import file_hash
from lexsplat.runtime.progress import Event, FirstUnits, Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures import Capture, View

SOURCES = ("none", "slic", "sam2")
"""Names of sources of segments other than folders and models."""

SUPERPIXELS = (3000, 1000)
"""Superpixels of a photo in each level of "slic"."""

_COMPACTNESS = 10.0  # of superpixels: weight of distance relative to color
_SHORT_SIDE = 480  # pixels of the photo in which superpixels are searched: about four a cell


class Segmenter(Protocol):
    """Finds the segments of photos."""

    kept_apart: bool
    """Whether its levels are parts and things, which have language of their own."""

    def key(self, view: View) -> list[Any]:
        """Everything the segments of a view depend on, as JSON-like values."""

    def labels(self, view: View, size: tuple[int, int]) -> NDArray[np.int32]:
        """Segments at a width and height ``[L, height, width]``, numbered in each of L levels; -1 for none."""


def is_folder_of_segments(name: str) -> bool:
    """Whether a value of `FeatureConfig.segments` names a folder of maps rather than a word or a model."""
    folder = Path(name).expanduser()
    return name not in SOURCES and folder.is_dir() and not (folder / "config.json").is_file()


def sam2_name(name: str) -> str | None:
    """The name or folder of the SAM 2 model that a value of `FeatureConfig.segments` stands for, if any.

    Raises:
        ModelError: If the value is no word, folder or name.
    """
    if name == "sam2":
        from lexsplat.features.sam2 import DEFAULT_SAM2

        return DEFAULT_SAM2
    if name in SOURCES or is_folder_of_segments(name):
        return None
    if "/" in name or Path(name).expanduser().is_dir():
        return name
    close = get_close_matches(name.lower(), SOURCES, n=1)
    raise ModelError(
        f"features.segments {name}",
        expected="none, slic, sam2, a folder of segments, or a SAM 2 model OWNER/NAME",
        found="no such word and no such folder",
        remedy=f"did you mean {close[0]}?" if close else "check the path",
    )


def load_segmenter(name: str, device: torch.device | str = "cpu") -> Segmenter:
    """Load the source of 2D segments.

    Args:
        name: "slic", "sam2", a folder of segments, or the name or folder of a SAM 2 model.
        device: Device of SAM 2.

    Raises:
        ModelError: If it is none of them, or the model cannot be loaded.
    """
    model = sam2_name(name)
    if model is not None:
        from lexsplat.features.sam2 import Sam2Segmenter

        return Sam2Segmenter(model_folder(model, "segments"), model, device)
    return Superpixels() if name == "slic" else SegmentFolder(Path(name).expanduser())


class Superpixels:
    """SLIC superpixels of several sizes, by scikit-image. The same photo gives the same ones."""

    kept_apart = False

    def key(self, view: View) -> list[Any]:
        """The photo and the settings."""
        return ["slic", SUPERPIXELS, _COMPACTNESS, pixels_hash(view, reduced(view.capture_size, _SHORT_SIDE))]

    def labels(self, view: View, size: tuple[int, int]) -> NDArray[np.int32]:
        """A level for each number of superpixels; see `Segmenter`."""
        from skimage.segmentation import slic

        from lexsplat.captures.images.reading import resize_nearest

        image = view.load_image(reduced(view.capture_size, _SHORT_SIDE))
        levels = [
            slic(image, number, compactness=_COMPACTNESS, start_label=0, channel_axis=-1)
            for number in SUPERPIXELS
        ]
        return np.stack([resize_nearest(level, size) for level in levels]).astype(np.int32)


class SegmentFolder:
    """A folder with one map of segments a photo, named after it without its suffix.

    - ``STEM.png``: 8 or 16 bits of one channel; 0 for none.
    - ``STEM.npy``: integers ``[h, w]`` or ``[levels, h, w]``; -1 for none.
    - ``STEM_s.npy``: the same, as written by LangSplat's preprocessing.

    Maps have the photo's aspect at any size, and are drawn on the photo as it is stored, or undistorted.
    """

    kept_apart = True

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def key(self, view: View) -> list[Any]:
        """The content of the file, and what undistorts it."""
        lens = view.lens
        camera = [lens.model, lens.width, lens.height, lens.params, view.capture_size]
        return ["folder", file_hash(self.path(view), 16), *camera]

    def path(self, view: View) -> Path:
        """The file of a view.

        Raises:
            FileFormatError: If there is none.
        """
        paths = [self.folder / f"{view.stem}{ending}" for ending in (".png", ".npy", "_s.npy")]
        found = next((path for path in paths if path.is_file()), None)
        if found is None:
            expected = f"{view.stem}.png, {view.stem}.npy or {view.stem}_s.npy"
            remedy = "give one map of segments a photo, named after it without its suffix"
            raise wrong(self.folder, expected, "none of them", remedy)
        return found

    def labels(self, view: View, size: tuple[int, int]) -> NDArray[np.int32]:
        """The segments at the centers of cells; see `Segmenter`.

        Raises:
            FileFormatError: If the file is no map of integers.
            CaptureError: If it cannot be read, or does not have the photo's aspect.
        """
        path = self.path(view)
        try:
            return self._labels(path, view, size)
        except CaptureError as error:  # its remedies are those of photos and masks
            remedy = "write the map of segments again (docs/captures.md has the layout)"
            expected = error.expected.replace("a mask of", "a map of segments of")
            raise CaptureError(path, expected=expected, found=error.found, remedy=remedy) from error

    def _labels(self, path: Path, view: View, size: tuple[int, int]) -> NDArray[np.int32]:
        if path.suffix == ".png":
            levels = _png_numbers(path)[None]
        else:
            levels = open_npy(path)
            if levels.ndim not in (2, 3) or 0 in levels.shape:
                raise wrong(path, "segments [h, w] or [levels, h, w]", list(levels.shape))
            levels = levels.reshape(-1, *levels.shape[-2:])
        sampled = np.stack([view.undistort_mask(level, path, size) for level in levels])
        return segment_numbers(sampled, path).astype(np.int32)


def _png_numbers(path: Path) -> NDArray[np.int32]:
    """Numbers ``[h, w]`` of a PNG of one channel, less 1: black is -1, no segment."""
    from lexsplat.captures.images.reading import open_image

    with open_image(path) as image:
        if image.mode not in ("1", "L", "P", "I") and not image.mode.startswith("I;"):
            remedy = "write the numbers of segments, not colors"
            raise wrong(path, "one number a pixel, 8 or 16 bits", f"an image of mode {image.mode}", remedy)
        return np.asarray(image).astype(np.int32) - 1


def check_segments(config: FeatureConfig, capture: Capture) -> None:
    """Refuse unusable segments before anything that takes time; models are checked when loaded.

    Args:
        config: Settings of the features.
        capture: Its training views must have segments, if they come from a folder.

    Raises:
        FileFormatError: If a map is missing or no map of integers, or has other levels than that of another photo.
        CaptureError: If a map cannot be read, or does not have the photo's aspect.
        ModelError: If the name is no word, folder or name of a model.
    """
    name = config.segments
    if sam2_name(name) is None and is_folder_of_segments(name):
        folder = SegmentFolder(Path(name).expanduser())
        levels = 0
        for view in capture.train_views:
            found = len(folder.labels(view, size_of_map(view.capture_size, config)))
            levels = levels or found
            if found != levels:
                expected = f"{_count(levels)}, as {capture.train_views[0].stem} has"
                remedy = "give each photo the same levels of segments, in one order"
                raise wrong(folder.path(view), expected, _count(found), remedy)


def _count(levels: int) -> str:
    return f"{levels} level" + "s" * (levels != 1)


def segments_identity(name: str, capture: Capture) -> list[str]:
    """The name, and of a folder of segments the content of every file that training reads."""
    if not is_folder_of_segments(name):
        return [name]
    folder = SegmentFolder(Path(name).expanduser())
    return ["folder", *(f"{view.stem} {file_hash(folder.path(view), 16)}" for view in capture.train_views)]


# More than the maps: the source of the segments, their cache, and the listener.
def pooled_features(
    maps: FeatureMaps,
    capture: Capture,
    segmenter: Segmenter,
    config: FeatureConfig,
    *,
    cache_dir: Path,
    listener: Listener = silent,
) -> FeatureMaps:
    """Feature maps that are pooled by segments when they are read; the segments are found once and stored.

    Args:
        maps: Maps by view name, of the size that ``config`` gives; zero cells stay zero and count for no segment.
        capture: The views.
        segmenter: Finds the segments of a view.
        config: Settings of the features.
        cache_dir: Folder of the cache.
        listener: Receives events of stage "2D segments".

    Raises:
        LexsplatError: If a view has no segments (`SegmentFolder.labels`).
    """
    paths: dict[str, Path] = {}
    apart = segmenter.kept_apart
    missing, told = 0, FirstUnits("2D segments", "photos")
    told(0, len(maps))
    listener(Event("2D segments", 0, len(maps)))
    for done, name in enumerate(maps, start=1):
        view = capture.views[name]
        size = size_of_map(view.capture_size, config)
        key = hash_of("segments", segmenter.key(view), size)
        paths[name] = Path(cache_dir) / f"{key}.segments.safetensors"
        if not is_stored(paths[name]):
            write_labels(paths[name], segmenter.labels(view, size))
            missing += 1
        if missing == done:  # stored ones take no time
            told(done, len(maps))
        listener(Event("2D segments", done, len(maps)))

    def load(name: str) -> FeatureMap:
        found = maps[name]
        rows, cols = found.clip.shape[:2]
        labels = read_labels(paths[name], cols, rows)
        levels = labels.split(1) if apart and len(labels) > 1 else ()
        return replace(_pooled(found, labels), levels=tuple(_pooled(found, level) for level in levels))

    return FeatureMaps(list(maps), load, 0, source=maps)


def _pooled(found: FeatureMap, labels: Tensor) -> FeatureMap:
    return FeatureMap(pool(found.clip, labels), None if found.dino is None else pool(found.dino, labels))


def pool(features: Tensor, labels: Tensor | Sequence[Tensor]) -> Tensor:
    """The mean direction of the features of each segment, in all of its cells.

    Args:
        features: Unit vectors ``[h, w, D]``; zero where a cell is ignored.
        labels: Segments ``[L, h, w]``, integers; -1 for none.

    Returns:
        ``[h, w, D]``: the mean of the unit vectors of the levels that have a segment there, shorter than 1 where
        levels disagree; the cell's own feature where none has; zero where it is ignored.
    """
    from scipy.sparse import csr_matrix

    flat = features.reshape(-1, features.shape[-1]).float()
    known = flat.any(-1)
    total, count = torch.zeros_like(flat), torch.zeros(len(flat), 1)
    for level in labels:
        inside = ((level.reshape(-1) >= 0) & known).nonzero()[:, 0]
        if len(inside) == 0:
            continue
        segments = level.reshape(-1)[inside].unique(return_inverse=True)[1]
        number = int(segments.max()) + 1
        members = csr_matrix(
            (np.ones(len(inside), np.float32), (segments.numpy(), inside.numpy())), shape=(number, len(flat))
        )
        means = F.normalize(torch.from_numpy(members @ flat.numpy()), dim=-1)
        total.index_add_(0, inside, means[segments])
        count[inside] += 1
    total /= count.clamp_min(1)
    alone = (count[:, 0] == 0).nonzero()[:, 0]
    total[alone] = flat[alone]
    return total.reshape(features.shape)
