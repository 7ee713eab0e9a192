"""Contents of a scene with segments, kept by a library to answer most questions without opening the scene.

Language, places and images are kept by segment, not by Gaussian: a phrase takes or leaves whole segments
(`lexsplat.queries.segments`), and `lexsplat.scenes.library.indexed` finds out which from what is here. Segments are
those of the lowest level that has at most `_MOST`. Everything is in one file of tensors, named after its hash.

Dimension letters: L levels, S segments of the lowest kept level, K codes, D dimensions, V objects, M sampled points,
E links between segments, W images.
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.rotations import matrices_from_quaternions
from lexsplat.language.segment_codes import codes_of_field
from lexsplat.language.segments import Segments
from lexsplat.queries.relevancy import QueryConfig
from lexsplat.rendering import render
from lexsplat.runtime.device import one_thread
from lexsplat.runtime.fingerprints import digest
from lexsplat.runtime.sampling import evenly
from lexsplat.scenes.gone import gone_nouns
from lexsplat.scenes.library.records import damaged, mapped_tensors
from lexsplat.scenes.pixels import seen_colors
from lexsplat.scenes.scene import Scene

_MOST = 2048
"""Segments of the lowest kept level, at most, unless the coarsest level has more."""
_POINTS, _ALL_POINTS = 16, 12_000
"""Points of a segment that are kept, at most, unless fewer than the latter would be: they give boxes and frames."""
_IMAGES = 8
"""Largest number of images of a scene: the bits of a byte hold which images show a point."""
_SIDE, _QUALITY = 320, 70
"""Longer side of an image in pixels, and quality of its JPEG."""
_BEHIND = 0.05
"""Largest distance of a point behind the surface that an image shows there, as a share of its depth."""
_NEIGHBORS = 8
_FAINT = 0.1
"""Gaussians of lower opacity link nothing, as in `lexsplat.queries.selection`."""

_UPPER = np.triu_indices(3)

Array = NDArray[Any]


@dataclasses.dataclass(frozen=True, eq=False)
class Contents:
    """The segments, objects and images of a scene.

    Args:
        levels: Segment at each level of each segment ``[L, S]`` int32, the lowest level first.
        masses: Visible weight of each segment in the training views ``[S]``.
        rows: First entry of each segment in the two next tensors ``[S + 1]`` int32.
        columns: Codes that occur in each segment, int16.
        shares: Their shares, float16.
        places: Mean distributions over the codes of the objects ``[V, K]`` float16, where presence is decided.
        mean: Mean of the everyday words ``[D]``.
        best: The best height of an everyday word at each code ``[K]``.
        best_colored: The same with the scene's objects in any color ``[K]``.
        peak: Height that the scene's own things reach ``[1]``.
        counts: Number of visible Gaussians of each segment ``[S]`` int32.
        opacities: Their total opacity ``[S]``.
        spacings: Median distance of a Gaussian of the segment to its sixth neighbor ``[S]``, world units.
        links: Segments that are neighbors ``[E, 2]`` int32.
        gaps: Smallest distance between Gaussians of the two ``[E]``, world units.
        centers: Mean of the points of each segment ``[S, 3]``, world units.
        starts: First point of each segment ``[S + 1]`` int32.
        offsets: Points relative to these centers ``[M, 3]`` float16.
        weights: Their opacities ``[M]`` float16.
        seen: Which images show each point ``[M]`` uint8, one bit for each image.
        sizes: Width and height of the images in pixels ``[W, 2]`` int32.
        intrinsics: Of the images, in pixels ``[W, 3, 3]``.
        poses: World to camera ``[W, 4, 4]``.
        ends: End of each image file in ``pictures`` ``[W]`` int32.
        pictures: The files, JPEG, one after the other, uint8.
        facts: Names of the images ("views"), up direction ("world"), and the objects with name, place and size.
        spreads: Symmetric square roots of the covariances of the points (xx, xy, xz, yy, yz, zz) ``[M, 6]`` float16,
            world units; None in libraries that were made before boxes took them into account.
        uncertainties: Mean u_G of each segment ``[S]``; None in libraries that were made before scores took it into
            account.
    """

    levels: Tensor
    masses: Tensor
    rows: Tensor
    columns: Tensor
    shares: Tensor
    places: Tensor
    mean: Tensor
    best: Tensor
    best_colored: Tensor
    peak: Tensor
    counts: Tensor
    opacities: Tensor
    spacings: Tensor
    links: Tensor
    gaps: Tensor
    centers: Tensor
    starts: Tensor
    offsets: Tensor
    weights: Tensor
    seen: Tensor
    sizes: Tensor
    intrinsics: Tensor
    poses: Tensor
    ends: Tensor
    pictures: Tensor
    facts: Mapping[str, Any]
    spreads: Tensor | None = None
    uncertainties: Tensor | None = None

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name; the facts as bytes of JSON."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "facts"]
        text = json.dumps(self.facts, ensure_ascii=False, sort_keys=True).encode("utf-8")
        kept = {name: value for name in names if (value := getattr(self, name)) is not None}
        return {**kept, "facts": _bytes(text)}

    def content(self) -> str:
        """A hash of all values."""
        return _content(self.tensors())

    def camera(self, number: int) -> Camera:
        """The camera of an image."""
        width, height = self.sizes[number].tolist()
        return Camera(width, height, self.intrinsics[number].numpy(), self.poses[number].numpy())

    def spreads_of(self, rows: Array) -> Array | None:
        """Square roots of the covariances of points ``[m, 3, 3]``; None if the library has none."""
        if self.spreads is None:
            return None
        whole, (first, second) = np.zeros((len(rows), 3, 3)), _UPPER
        whole[:, first, second] = whole[:, second, first] = self.spreads.numpy()[rows]
        return whole

    def picture(self, number: int) -> Image.Image:
        """An image of the scene."""
        start = int(self.ends[number - 1]) if number else 0
        file = self.pictures[start : int(self.ends[number])].numpy().tobytes()
        return Image.open(io.BytesIO(file)).convert("RGB")

    @classmethod
    @torch.no_grad()
    @one_thread()
    def of(cls, scene: Scene) -> Contents | None:
        """The contents of a scene; None if it has no segments or is asked otherwise, such as in the paper's form.

        Raises:
            ModelError: If the everyday words are new to its folder and its encoder cannot be loaded.
        """
        if (
            scene.field.segments is None
            or scene.query != QueryConfig()
            or scene.presence_classifier.segment_codes is None
        ):
            return None
        segments = _kept_levels(scene.field.segments)
        points = _points(scene, segments)
        pictures = _images(scene, points.pop("means"))
        return cls(
            **_language(scene, segments),
            **_neighbors(scene, segments),
            **points,
            **{name: value for name, value in pictures.items() if name != "views"},
            facts={
                "views": pictures["views"],
                "world": scene.world.to_json(),
                "objects": [each.geometry() for each in scene.objects],
                "gone": sorted(gone_nouns(scene)),
                "colors": [seen_colors(scene, each) for each in scene.objects],
            },
        )


def map_contents(path: Path, content: str) -> Contents:
    """The contents in a file.

    Raises:
        FileFormatError: If it is missing, or its content is another one.
    """
    expected = "the objects that were written"
    tensors = mapped_tensors(path, expected)
    try:
        if _content(tensors) == content:
            facts = json.loads(tensors.pop("facts").numpy().tobytes())
            return Contents(**tensors, facts=facts)
        found = "damaged content (the hash differs)"
    except (TypeError, KeyError, ValueError) as error:
        found = str(error)[:80]
    raise damaged(path, expected, found)


def _content(tensors: Mapping[str, Tensor]) -> str:
    return digest(bytes(tensors[name].contiguous().numpy().data) for name in sorted(tensors))


def _bytes(content: bytes) -> Tensor:
    return torch.from_numpy(np.frombuffer(content, np.uint8).copy())


def _kept_levels(segments: Segments) -> Segments:
    """The segments from the lowest level with at most `_MOST` upward."""
    levels = segments.levels.cpu()
    counts = [int(level.max()) + 1 for level in levels]
    lowest = next((number for number, count in enumerate(counts) if count <= _MOST), len(counts) - 1)
    base = levels[lowest]
    kept = torch.zeros(len(levels) - lowest, counts[lowest], dtype=levels.dtype)
    kept[:, base] = levels[lowest:]
    return Segments(base[segments.labels.cpu()], segments.masses.cpu(), kept)


def _language(scene: Scene, segments: Segments) -> dict[str, Tensor]:
    """The language of segments and objects, and the scale of the scene."""
    codes = codes_of_field(scene.field, segments)
    lowest = codes.distributions[torch.from_numpy(codes.numbers[0])].half()
    rows, columns = lowest.nonzero(as_tuple=True)
    masses = torch.from_numpy(codes.masses[codes.numbers[0]])
    doubts = torch.zeros_like(masses).index_add_(
        0, segments.labels, segments.masses.double() * scene.field.uncertainties.cpu().double()
    )
    tables, scale = scene.presence_classifier.tables, scene.everyday_scale
    return {
        "levels": segments.levels.int(),
        "masses": masses.float(),
        "uncertainties": (doubts / masses.clamp(min=1e-12)).float(),
        "rows": torch.searchsorted(rows.contiguous(), torch.arange(len(lowest) + 1)).int(),
        "columns": columns.short(),
        "shares": lowest[rows, columns],
        "places": tables["places"].cpu().half(),
        "mean": scale.mean.cpu(),
        "best": scale.best.cpu(),
        "best_colored": tables["best_colored"].cpu().float().clone(),  # may be `best` itself
        "peak": torch.tensor([scale.peak]),
    }


def _neighbors(scene: Scene, segments: Segments) -> dict[str, Tensor]:
    """Sizes of the segments and distances between them."""
    count, labels = segments.levels.shape[1], segments.labels.numpy()
    opacities = scene.gaussians.opacities.detach().cpu().double().numpy()
    seen = ~scene.hidden.cpu().numpy()
    firm = np.flatnonzero(opacities >= _FAINT)  # hidden Gaussians link a lamp and its foot
    # Fills link as well, but do not count for the spacings: they are denser than what photos show.
    added = scene.field.segments.added if scene.field.segments else None
    means, of = scene.gaussians.means.detach().cpu().double().numpy()[firm], labels[firm]
    spacings, pairs, gaps = np.zeros(count), np.zeros((0, 2), np.int64), np.zeros(0)
    if len(firm) > 1:
        neighbors = min(_NEIGHBORS + 1, len(firm))
        apart, near = cKDTree(means).query(means, k=neighbors)
        counted = np.ones(len(firm), bool) if added is None else ~added.cpu().numpy()[firm]
        spacings = _medians(of[counted], apart[counted, min(6, neighbors - 1)], count)
        first, second = np.repeat(of, neighbors), of[near.ravel()]
        between = first != second
        keys = np.minimum(first, second) * count + np.maximum(first, second)
        order = np.lexsort((apart.ravel()[between], keys[between]))
        found, places = np.unique(keys[between][order], return_index=True)
        pairs, gaps = np.stack([found // count, found % count], 1), apart.ravel()[between][order][places]
    return {
        "counts": torch.from_numpy(np.bincount(labels[seen], minlength=count)).int(),
        "opacities": torch.from_numpy(np.bincount(labels, opacities, count)).float(),
        "spacings": torch.from_numpy(spacings).float(),
        "links": torch.from_numpy(pairs).int(),
        "gaps": torch.from_numpy(gaps).float(),
    }


def _medians(places: Array, values: Array, count: int) -> Array:
    """The median of the values at each of ``count`` places; 0 where there are none."""
    order = np.lexsort((values, places))
    numbers = np.bincount(places, minlength=count)
    middle = np.minimum(np.cumsum(numbers) - numbers + numbers // 2, len(values) - 1)
    return np.where(numbers > 0, values[order][middle], 0.0)


def _points(scene: Scene, segments: Segments) -> dict[str, Tensor]:
    """A sample of the visible Gaussians of each segment, and under "means" their positions."""
    labels, count = segments.labels.numpy(), segments.levels.shape[1]
    seen = np.flatnonzero(~scene.hidden.cpu().numpy())
    order = seen[np.argsort(labels[seen], kind="stable")]
    numbers = np.bincount(labels[order], minlength=count)
    first = np.cumsum(numbers) - numbers
    rank = np.arange(len(order)) - first[labels[order]]
    steps = -(-numbers // max(_POINTS, _ALL_POINTS // count))  # every second or third of them, and so on
    chosen = order[rank % np.maximum(steps[labels[order]], 1) == 0]
    gaussians = scene.gaussians.select(torch.from_numpy(chosen).to(scene.gaussians.means.device)).detach()
    means, rotations = gaussians.means.cpu(), matrices_from_quaternions(gaussians.quats)
    spreads = ((rotations * gaussians.scales[:, None]) @ rotations.transpose(1, 2)).cpu()
    of = labels[chosen]
    kept = np.bincount(of, minlength=count)
    sums = np.stack([np.bincount(of, means[:, axis].double().numpy(), count) for axis in range(3)], 1)
    centers = torch.from_numpy(sums / np.maximum(kept, 1)[:, None]).float()
    return {
        "centers": centers,
        "starts": torch.from_numpy(np.concatenate([[0], np.cumsum(kept)])).int(),
        "offsets": (means - centers[torch.from_numpy(of)]).half(),
        "weights": gaussians.opacities.cpu().half(),
        "spreads": spreads[:, _UPPER[0], _UPPER[1]].half(),
        "means": means,
    }


def _images(scene: Scene, means: Tensor) -> dict[str, Any]:
    """Images of the scene and which of the points ``[M, 3]`` they show."""
    names, files, cameras = evenly(list(scene.views), _IMAGES), [], []
    seen = np.zeros(len(means), np.uint8)
    for number, name in enumerate(names):
        camera = scene.camera(name).within(_SIDE)
        drawn = render(scene.gaussians, camera, depth=True)
        pixels = (drawn.image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, format="JPEG", quality=_QUALITY)
        files.append(file.getvalue())
        cameras.append(camera)
        if drawn.depth is not None:
            depth = drawn.depth.cpu().numpy()
            pixels, z, inside = camera.project(means.double().numpy())
            x, y = pixels[inside].astype(int).T
            seen[np.flatnonzero(inside)[z[inside] <= depth[y, x] * (1 + _BEHIND)]] |= np.uint8(1 << number)
    return {
        "views": list(names),
        "seen": torch.from_numpy(seen),
        "sizes": torch.tensor([[c.width, c.height] for c in cameras], dtype=torch.int32).reshape(-1, 2),
        "intrinsics": torch.from_numpy(np.array([c.K for c in cameras]).reshape(-1, 3, 3)).float(),
        "poses": torch.from_numpy(np.array([c.viewmat for c in cameras]).reshape(-1, 4, 4)).float(),
        "ends": torch.from_numpy(np.cumsum([len(file) for file in files], dtype=np.int64)).int(),
        "pictures": _bytes(b"".join(files)),
    }
