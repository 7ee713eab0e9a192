"""Training frames in memory, and labeled crops of them. Needs numpy and Pillow.

The labels of a crop are weighted by a Gaussian around its center. The embedding therefore describes the center of a
crop, as the crop pyramid (section 3.2 of the paper) requires; encoders trained on photos describe their subject.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from words import Label

GRID = 24
"""Samples along a side of a crop to find out what it shows."""
SIGMA = 0.22
"""Standard deviation of the weight about the center, in sides of the crop."""


@dataclass(frozen=True)
class Frame:
    """An image and the label of each pixel.

    Args:
        scene: Name of its scene; frames of one scene show the same things.
        image: RGB.
        codes: Place of each pixel's label in ``Frames.labels`` ``[H, W]`` int32, -1 where nothing is.
        things: Number of the thing of each pixel ``[H, W]`` uint8, 0 where nothing is.
    """

    scene: str
    image: Image.Image
    codes: NDArray[np.int32]
    things: NDArray[np.uint8]

    @functools.cached_property
    def thing_boxes(self) -> dict[int, Box]:
        """Bounding box of each object in pixels: (left, top, right, bottom), inclusive."""
        return _boxes(self.things)

    @functools.cached_property
    def code_boxes(self) -> dict[int, Box]:
        """Bounding box of each code, as `thing_boxes`."""
        return _boxes(self.codes)


Box = tuple[int, int, int, int]


def _boxes(values: NDArray[np.integer]) -> dict[int, Box]:
    found = {}
    for value in np.unique(values):
        rows, columns = np.nonzero(values == value)
        found[int(value)] = (int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max()))
    return found


def _pixel_of(
    values: NDArray[np.integer], wanted: int, box: Box, rng: np.random.Generator
) -> tuple[float, float]:
    """A random pixel (x, y) with this value, within its box."""
    left, top, right, bottom = box
    for _ in range(40):
        x, y = int(rng.integers(left, right + 1)), int(rng.integers(top, bottom + 1))
        if values[y, x] == wanted:
            return float(x), float(y)
    rows, columns = np.nonzero(values[top : bottom + 1, left : right + 1] == wanted)
    pixel = int(rng.integers(len(rows)))
    return float(left + columns[pixel]), float(top + rows[pixel])


class Frames:
    """All frames of some folders, and the table of their labels."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self.labels: list[Label] = []
        self.frames: list[Frame] = []
        places: dict[Label, int] = {}
        for folder in folders:
            for description in sorted(Path(folder).glob("s*.json")):
                scene = f"{Path(folder).name}/{description.stem}"
                lookup = np.full(256, -1, np.int32)
                for number, thing in json.loads(description.read_text()).items():
                    by_part = {0: None, **{part: name for name, part in thing["parts"].items()}}
                    for part, name in by_part.items():
                        label = Label(thing["kind"], thing["color"], thing["finish"], name)
                        lookup[10 * int(number) + part] = places.setdefault(label, len(places))
                for picture in sorted(description.parent.glob(f"{description.stem}_*.png")):
                    index = np.load(picture.with_suffix(".npz"), allow_pickle=False)["index"]
                    image = Image.open(picture).convert("RGB")
                    self.frames.append(Frame(scene, image, lookup[index], (index // 10).astype(np.uint8)))
        self.labels = list(places)
        if not self.frames:
            raise FileNotFoundError(f"no frames in {', '.join(map(str, folders))}: render them first")

    def __len__(self) -> int:
        return len(self.frames)

    @functools.cached_property
    def of_parts(self) -> dict[str, list[tuple[Frame, int]]]:
        """Frames that show each part with at least eight pixels, and the part's code in them."""
        found: dict[str, list[tuple[Frame, int]]] = {}
        for frame in self.frames:
            codes, counts = np.unique(frame.codes, return_counts=True)
            for code in codes[(counts >= 8) & (codes >= 0)].tolist():
                part = self.labels[code].part
                if part is not None:
                    found.setdefault(part, []).append((frame, code))
        return found


def center_weights(grid: int = GRID) -> NDArray[np.float64]:
    """Weights ``[grid * grid]`` of the samples of a crop; they sum to 1."""
    position = (np.arange(grid) + 0.5) / grid - 0.5
    line = np.exp(-(position**2) / (2 * SIGMA**2))
    weights = np.outer(line, line).ravel()
    return weights / weights.sum()


_WEIGHTS = center_weights()


@dataclass(frozen=True)
class Crop:
    """A square of a frame: box (left, top, side) in pixels, and its labels with their weights."""

    frame: Frame
    box: tuple[float, float, float]
    codes: NDArray[np.int64]
    weights: NDArray[np.float64]
    """Of each code, summing to at most 1."""
    grid: NDArray[np.int32]
    """Codes of a regular grid of samples ``[GRID, GRID]``, -1 where nothing is."""

    def pixels(self, size: int) -> NDArray[np.uint8]:
        """``[size, size, 3]``."""
        left, top, side = self.box
        box = (left, top, left + side, top + side)
        return np.asarray(
            self.frame.image.resize((size, size), Image.Resampling.BICUBIC, box=box, reducing_gap=2.0)
        )


def cut(frame: Frame, left: float, top: float, side: float) -> Crop:
    """The crop with this box, which must lie within the frame."""
    position = (np.arange(GRID) + 0.5) * side / GRID
    height, width = frame.codes.shape
    rows = np.clip((top + position).astype(int), 0, height - 1)
    columns = np.clip((left + position).astype(int), 0, width - 1)
    grid = frame.codes[np.ix_(rows, columns)]
    seen, inverse = np.unique(grid, return_inverse=True)
    weights = np.bincount(inverse.ravel(), _WEIGHTS, len(seen))
    known = seen >= 0
    return Crop(frame, (left, top, side), seen[known].astype(np.int64), weights[known], grid)


def patch_crop(crop: Crop, patch: int, count: int) -> Crop:
    """A patch of a crop as a crop with uniform weights.

    Args:
        crop: A whole crop.
        patch: Number of the patch, from left to right, then from top to bottom.
        count: Patches along a side; divides ``GRID``.
    """
    if GRID % count:
        raise ValueError(f"patches along a side: expected a divisor of {GRID}, found {count}")
    down, right = divmod(patch, count)
    side = GRID // count
    grid = crop.grid[down * side : (down + 1) * side, right * side : (right + 1) * side]
    seen, counts = np.unique(grid, return_counts=True)
    left, top, width = crop.box
    box = (left + right * width / count, top + down * width / count, width / count)
    known = seen >= 0
    return Crop(crop.frame, box, seen[known].astype(np.int64), counts[known] / grid.size, grid)


def random_crop(frames: Frames, rng: np.random.Generator) -> Crop:
    """A crop of a random frame, of any size: around an object, around a part, or anywhere."""
    frame = frames.frames[int(rng.integers(len(frames)))]
    height, width = frame.codes.shape
    draw = rng.random()
    side = float(np.exp(rng.uniform(np.log(18), np.log(120))))
    if draw < 0.8:
        of_things = draw < 0.45
        values = frame.things if of_things else frame.codes
        boxes = frame.thing_boxes if of_things else frame.code_boxes
        present = [value for value in boxes if value > (0 if of_things else -1)]
        if draw > 0.65:  # parts alone, where there are any
            present = [code for code in present if frames.labels[code].part is not None] or present
        chosen = present[int(rng.integers(len(present)))]
        whole = draw < 0.22 or draw > 0.7
        if whole:  # the whole of it, as in a photograph of it
            x0, y0, x1, y1 = boxes[chosen]
            wider = rng.uniform(0.7, 1.7) if of_things else rng.uniform(1.0, 2.5)
            side = float(np.clip((max(x1 - x0, y1 - y0) + 1) * wider, 14, 200))
            x = (x0 + x1) / 2 + rng.uniform(-0.15, 0.15) * side
            y = (y0 + y1) / 2 + rng.uniform(-0.15, 0.15) * side
        else:
            x, y = _pixel_of(values, chosen, boxes[chosen], rng)
    else:
        x, y = rng.uniform(0, width), rng.uniform(0, height)
    return _around(frame, x, y, side)


def _around(frame: Frame, x: float, y: float, side: float) -> Crop:
    """The crop with this center, shifted to lie within the frame."""
    height, width = frame.codes.shape
    left = float(np.clip(x - side / 2, 0, width - side))
    top = float(np.clip(y - side / 2, 0, height - side))
    return cut(frame, left, top, side)


def part_crops(
    frames: Frames, count: int, rng: np.random.Generator, *, near: bool = False, handles: int = 1
) -> list[Crop]:
    """Crops of a part, of the rest of the same thing, and of what is ``near``.

    A random crop shows a handle in one case of two hundred. Negatives of handles are crops of the same size, such
    as a mug's body or the edge of a table. All parts are equally frequent, except handles, which are the most
    ambiguous: ``handles`` times as frequent.
    """
    crops: list[Crop] = []
    parts = [part for part in frames.of_parts for _ in range(handles if part == "handle" else 1)]
    while len(crops) < count:
        places = frames.of_parts[parts[int(rng.integers(len(parts)))]]
        frame, code = places[int(rng.integers(len(places)))]
        side = float(np.exp(rng.uniform(np.log(14), np.log(60))))
        x, y = _pixel_of(frame.codes, code, frame.code_boxes[code], rng)
        crops.append(_around(frame, x, y, side))
        thing = int(frame.things[int(y), int(x)])
        rest = np.where(frame.codes == code, 0, frame.things)
        left, top, right, bottom = frame.thing_boxes[thing]
        if (rest == thing).any():
            x, y = _pixel_of(rest, thing, frame.thing_boxes[thing], rng)
            crops.append(_around(frame, x, y, side))
        if near:
            x, y = rng.uniform(left - 1.5 * side, right + 1.5 * side), rng.uniform(top - side, bottom + side)
            crops.append(_around(frame, float(x), float(y), side))
    return crops[:count]


def dominated_crops(frames: Frames, count: int, rng: np.random.Generator) -> list[tuple[Crop, Label]]:
    """Crops in which one object has at least half of the weight, with its label, for the scores.

    Two thirds are cut around objects, the rest anywhere.
    """
    found = []
    while len(found) < count:
        frame = frames.frames[int(rng.integers(len(frames)))]
        height, width = frame.codes.shape
        if rng.random() < 0.65:
            present = [t for t in np.unique(frame.things) if t and np.sum(frame.things == t) >= 150]
            rows, columns = np.nonzero(frame.things == present[int(rng.integers(len(present)))])
            extent = max(np.ptp(columns), np.ptp(rows)) + 1
            side = extent * rng.uniform(0.6, 1.6)
            x = (columns.min() + columns.max()) / 2 + rng.uniform(-0.2, 0.2) * extent
            y = (rows.min() + rows.max()) / 2 + rng.uniform(-0.2, 0.2) * extent
        else:
            side, x, y = rng.uniform(28, 130), rng.uniform(0, width), rng.uniform(0, height)
        side = float(np.clip(side, 24, 230))
        left, top = np.clip(x - side / 2, 0, width - side), np.clip(y - side / 2, 0, height - side)
        crop = cut(frame, float(left), float(top), side)
        shares: dict[tuple[str, str, str | None], float] = {}
        for code, weight in zip(crop.codes, crop.weights):
            label = frames.labels[code]
            key = (label.kind, label.color, label.finish)
            shares[key] = shares.get(key, 0) + weight
        best = max(shares, key=lambda key: shares[key], default=None)
        if best is not None and shares[best] >= 0.5:
            found.append((crop, Label(*best)))
    return found
