"""From crops to dense maps: positions of embeddings, choice of crops, and batching."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from lexsplat.features.pyramid import (
    CropLevel,
    batch_size_for,
    cut_crops,
    dense_map,
    encode_stream,
    grid_levels,
    patch_map,
    random_levels,
    unique_boxes,
)

OFFICIAL_SIZES = np.linspace(0.05, 0.5, 7).tolist()
OFFICIAL_STRIDES = [1.0, 0.625, 0.5, 0.5, 0.5, 0.5, 0.5]


class CenterEncoder:
    """Embeds a crop of a position image as the position of its center: (x, y, 9) before normalization.

    The image holds x / width in red and y / height in green, so the mean color of a crop is its center. The
    9 keeps vectors nearly of one length, so that averaging unit vectors hardly bends positions.
    """

    name, content_hash, image_size, dim = "center", "center", 8, 3
    device = torch.device("cpu")

    def __init__(self):
        self.batches: list[int] = []

    def encode_images(self, images):
        self.batches.append(len(images))
        mean = images.double().mean((-2, -1))
        return F.normalize(
            torch.stack([mean[:, 0], mean[:, 1], torch.full((len(mean),), 9.0)], 1), dim=-1
        ).float()

    def encode_text(self, prompts):
        raise AssertionError("no text here")


def position_image(width: int, height: int) -> torch.Tensor:
    x = ((torch.arange(width) + 0.5) / width).expand(height, width)
    y = ((torch.arange(height) + 0.5) / height)[:, None].expand(height, width)
    return torch.stack([x, y, torch.zeros_like(x)])


def encoded(levels, image, encoder=None, batch=64) -> torch.Tensor:
    encoder = encoder or CenterEncoder()
    boxes, places = unique_boxes(levels)
    ((_, unique),) = encode_stream(
        encoder.encode_images, [(0, cut_crops(image, boxes, encoder.image_size, batch))], batch
    )
    return unique[places]


def positions(features: torch.Tensor) -> torch.Tensor:
    return 9 * features[..., :2] / features[..., 2:]


def cell_centers(cols: int, rows: int) -> torch.Tensor:
    y, x = torch.meshgrid((torch.arange(rows) + 0.5) / rows, (torch.arange(cols) + 0.5) / cols, indexing="ij")
    return torch.stack([x, y], -1)


@pytest.mark.parametrize("size", [0.1, 0.25, 0.5])
@pytest.mark.parametrize("stride", [0.25, 0.5, 1.0])
def test_a_grid_level_puts_every_embedding_at_its_crop_center(size, stride):
    width, height, cols, rows = 160, 120, 64, 48
    levels = grid_levels(width, height, [size], [stride])
    found = positions(
        dense_map(levels, encoded(levels, position_image(width, height)), width, height, cols, rows)
    )
    side = levels[0].size
    low = torch.tensor([side / 2 / width, side / 2 / height])
    # Beyond the outermost crop centers, positions are clamped, never shifted.
    expected = torch.minimum(torch.maximum(cell_centers(cols, rows), low), 1 - low)
    assert (found - expected).abs().max() < 1e-3


def test_levels_of_different_sizes_are_aligned():
    """The published code shifts coarser maps by up to half a crop relative to the finest; here none is shifted."""
    width, height = 320, 240
    levels = grid_levels(width, height, OFFICIAL_SIZES, OFFICIAL_STRIDES)
    found = positions(
        dense_map(levels, encoded(levels, position_image(width, height)), width, height, 80, 60)
    )
    inner = (slice(16, 44), slice(16, 64))  # where no level is clamped
    error = found[inner] - cell_centers(80, 60)[inner]
    assert error.abs().max() < 2e-3


@pytest.mark.slow
def test_random_crops_put_embeddings_at_their_true_centers():
    width, height = 160, 120
    rng = np.random.default_rng(0)
    levels = random_levels(width, height, np.linspace(0.1, 0.4, 5), 3000, rng)
    found = positions(
        dense_map(levels, encoded(levels, position_image(width, height)), width, height, 40, 30)
    )
    inner = (slice(8, 22), slice(8, 32))
    error = found[inner] - cell_centers(40, 30)[inner]
    assert error.abs().max() < 0.04
    assert error.mean((0, 1)).abs().max() < 0.004


def patch_positions(level: CropLevel, width: int, height: int, side: int) -> torch.Tensor:
    """Embeddings of the patches of all crops, as `CenterEncoder` would make them ``[n, side * side, 3]``."""
    rows = []
    for left, top, size in level.boxes.tolist():
        for down in range(side):
            for right in range(side):
                x, y = left + (right + 0.5) * size / side, top + (down + 0.5) * size / side
                rows.append([x / width, y / height, 9.0])
    return F.normalize(torch.tensor(rows), dim=-1).reshape(len(level), side * side, 3)


@pytest.mark.parametrize(
    ("size", "stride", "side"), [(0.2, 0.5, 6), (0.2, 1.0, 2), (0.5, 0.35, 6), (0.4, 0.5, 1)]
)
def test_every_patch_is_placed_at_its_position(size, stride, side):
    width, height, cols, rows = 160, 120, 64, 48
    (level,) = grid_levels(width, height, [size], [stride])
    found = positions(
        patch_map([level], patch_positions(level, width, height, side), width, height, cols, rows)
    )
    image, patch = torch.tensor([width, height]), level.size / side
    inside = torch.minimum(
        torch.maximum(cell_centers(cols, rows) * image, torch.tensor(patch / 2)), image - patch / 2
    )
    # Border patches of unaligned crops have less weight, which shifts positions by a fraction of a patch.
    assert (found * image - inside).abs().max() < patch / 2


def test_the_map_of_patches_is_a_weighted_mean_by_a_loop():
    """Reference: every patch of every crop in float64; tents of a patch's size times the distance to the border."""
    width, height, cols, rows, dim, side = 57, 41, 9, 7, 5, 3
    levels = grid_levels(width, height, [0.3, 0.5], [0.6, 0.5])
    rng = np.random.default_rng(2)
    vectors = rng.normal(size=(sum(map(len, levels)), side * side, dim))
    found = patch_map(levels, torch.from_numpy(vectors).float(), width, height, cols, rows).numpy()
    for i in range(rows):
        for j in range(cols):
            expected, start = np.zeros(dim), 0
            for level in levels:
                patch, total, weights = level.size / side, np.zeros(dim), 0.0
                x = np.clip((j + 0.5) * width / cols, patch / 2, width - patch / 2)
                y = np.clip((i + 0.5) * height / rows, patch / 2, height - patch / 2)
                for left, top, size in level.boxes.tolist():
                    for place in range(side * side):
                        right, down = (place % side + 0.5) * patch, (place // side + 0.5) * patch
                        tent = max(0, 1 - abs(x - left - right) / patch) * max(
                            0, 1 - abs(y - top - down) / patch
                        )
                        weight = tent * min(right, size - right) * min(down, size - down)
                        total += weight * vectors[start, place]
                        weights += weight
                    start += 1
                expected += total / weights / len(levels)
            np.testing.assert_allclose(found[i, j], expected, atol=1e-5)


@pytest.mark.parametrize("mode", ["grid", "random"])
def test_the_map_is_the_mean_of_the_levels_by_a_loop(mode):
    """Reference: bilinear interpolation or the tent mean for each cell and level in float64, then the sum."""
    width, height, cols, rows, dim = 57, 41, 9, 7, 5
    rng = np.random.default_rng(1)
    if mode == "grid":
        levels = grid_levels(width, height, [0.2, 0.45], [0.6, 0.5])
    else:
        levels = random_levels(width, height, [0.3, 0.6], 40, rng)
    vectors = rng.normal(size=(sum(map(len, levels)), dim))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    found = dense_map(levels, torch.from_numpy(vectors).float(), width, height, cols, rows).numpy()
    for i in range(rows):
        for j in range(cols):
            x, y = (j + 0.5) * width / cols, (i + 0.5) * height / rows
            total, start = np.zeros(dim), 0
            for level in levels:
                part = vectors[start : start + len(level)]
                start += len(level)
                half = level.size / 2
                if mode == "grid":
                    table = part.reshape(len(level.tops), len(level.lefts), dim)
                    along = np.stack([
                        [np.interp(x, level.lefts + half, table[r, :, d]) for d in range(dim)]
                        for r in range(len(level.tops))
                    ])  # fmt: skip
                    total += [np.interp(y, level.tops + half, along[:, d]) for d in range(dim)]
                else:
                    weights = np.array([
                        max(0, 1 - abs(x - a - half) / half) * max(0, 1 - abs(y - b - half) / half)
                        for a, b in zip(level.lefts, level.tops)
                    ])  # fmt: skip
                    if weights.sum() > 0:
                        total += weights @ part / weights.sum()
            if np.linalg.norm(total) > 1e-6:
                np.testing.assert_allclose(found[i, j], total / np.linalg.norm(total), atol=1e-5)


def test_every_level_counts_and_counts_once():
    """One orthogonal direction per level: the map contains all of them equally."""
    levels = grid_levels(100, 80, OFFICIAL_SIZES, OFFICIAL_STRIDES)
    vectors = torch.cat([torch.eye(7)[i].expand(len(level), 7) for i, level in enumerate(levels)])
    found = dense_map(levels, vectors, 100, 80, 10, 8)
    torch.testing.assert_close(found, torch.full((8, 10, 7), 7**-0.5), atol=1e-6, rtol=0)


@settings(max_examples=25)
@given(
    width=st.integers(1, 200),
    height=st.integers(1, 200),
    cols=st.integers(1, 20),
    rows=st.integers(1, 20),
    mode=st.sampled_from(["grid", "random"]),
    data=st.data(),
)
def test_constant_features_stay_constant_at_any_size(width, height, cols, rows, mode, data):
    sizes = data.draw(st.lists(st.floats(0.02, 1.5), min_size=1, max_size=4))
    if mode == "grid":
        strides = data.draw(st.lists(st.floats(0.3, 1.2), min_size=len(sizes), max_size=len(sizes)))
        sizes = [max(size, 0.1) for size in sizes]  # keeps the number of crops small
        levels = grid_levels(width, height, sizes, strides)
    else:
        fractions = np.linspace(min(sizes), max(sizes), 3)
        levels = random_levels(width, height, fractions, 7, np.random.default_rng(0))
    vector = F.normalize(torch.tensor([0.3, -0.5, 0.8, 0.1]), dim=0)
    found = dense_map(levels, vector.expand(sum(map(len, levels)), 4), width, height, cols, rows)
    torch.testing.assert_close(found, vector.expand(rows, cols, 4), atol=1e-5, rtol=0)


@settings(max_examples=60)
@given(
    width=st.integers(1, 400),
    height=st.integers(1, 400),
    size=st.floats(0.05, 2.0),
    stride=st.floats(0.2, 1.5),
)
def test_grid_crops_span_the_image_at_most_a_stride_apart(width, height, size, stride):
    (level,) = grid_levels(width, height, [size], [stride])
    for starts, length in ((level.lefts, width), (level.tops, height)):
        assert starts[0] == 0
        assert starts[-1] + level.size == length
        assert np.diff(starts).min(initial=1) >= 0
        assert (
            np.diff(starts).max(initial=0) <= max(1.0, stride * level.size) + 1
        )  # plus rounding to whole pixels


def test_the_official_grid_has_about_the_published_number_of_crops():
    """About 1,300 crops per full-resolution image, some of them half outside; ours lie inside."""
    crops = sum(map(len, grid_levels(1297, 840, OFFICIAL_SIZES, OFFICIAL_STRIDES)))
    assert 1000 < crops < 1500


def test_random_crops_lie_inside_divide_evenly_and_follow_the_seed():
    def draw(seed):
        return random_levels(90, 70, np.linspace(0.05, 0.9, 6), 100, np.random.default_rng(seed))

    levels = draw(3)
    counts = [len(level) for level in levels]
    assert sum(counts) == 100
    assert max(counts) - min(counts) <= 1
    assert [level.size for level in levels] == sorted(level.size for level in levels)
    boxes = np.concatenate([level.boxes for level in levels])
    assert boxes[:, :2].min() >= 0
    assert (boxes[:, 0] + boxes[:, 2]).max() <= 90
    assert (boxes[:, 1] + boxes[:, 2]).max() <= 70
    np.testing.assert_array_equal(boxes, np.concatenate([level.boxes for level in draw(3)]))
    assert not np.array_equal(boxes, np.concatenate([level.boxes for level in draw(4)]))


def test_a_corner_outside_all_random_crops_takes_the_nearest_crop():
    levels = (CropLevel(10, np.array([0, 80]), np.array([0, 80]), grid=False),)
    vectors = torch.eye(2)
    found = dense_map(levels, vectors, 100, 100, 4, 4)
    assert found[0, 1].tolist() == [1, 0]
    assert found[3, 2].tolist() == [0, 1]
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(4, 4))


def test_crops_equal_those_of_pillow():
    image = torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(0))
    boxes = np.array([[0, 0, 20], [60, 40, 20], [13, 7, 20], [5, 9, 48], [0, 0, 48]], dtype=np.int32)
    crops = list(cut_crops(image, boxes, 32, chunk=2))
    assert [len(chunk) for chunk in crops] == [2, 1, 2]
    for (left, top, size), crop in zip(boxes.tolist(), torch.cat(crops)):
        for plane, resized in zip(image, crop):
            patch = Image.fromarray(plane[top : top + size, left : left + size].numpy())
            expected = np.asarray(patch.resize((32, 32), Image.Resampling.BICUBIC))
            np.testing.assert_allclose(resized.numpy(), np.clip(expected, 0, 1), atol=2e-5)


def test_equal_crops_are_encoded_once():
    levels = grid_levels(64, 64, [0.5, 0.501, 1.0, 3.0], [0.5, 0.5, 1.0, 1.0])  # two pairs of equal levels
    encoder = CenterEncoder()
    vectors = encoded(levels, position_image(64, 64), encoder)
    assert len(vectors) == 9 + 9 + 1 + 1
    assert sum(encoder.batches) == 9 + 1
    torch.testing.assert_close(vectors[:9], vectors[9:18])


@settings(max_examples=50)
@given(chunks=st.lists(st.lists(st.integers(1, 7), max_size=4), max_size=6), batch=st.integers(1, 9))
def test_batches_run_across_images_are_full_and_come_back_in_order(chunks, batch):
    class FirstPixel(CenterEncoder):
        def encode_images(self, images):
            self.batches.append(len(images))
            return images[:, 0, 0, :1]

    chunks = [sizes for sizes in chunks if sizes]
    numbers = iter(range(1000))
    jobs, expected = [], []
    for key, sizes in enumerate(chunks):
        values = [[float(next(numbers)) for _ in range(size)] for size in sizes]
        jobs.append((key, [torch.tensor(part).reshape(-1, 1, 1, 1).expand(-1, 3, 2, 2) for part in values]))
        expected.append((key, [number for part in values for number in part]))
    encoder = FirstPixel()
    found = [
        (key, vectors[:, 0].tolist())
        for key, vectors in encode_stream(encoder.encode_images, iter(jobs), batch)
    ]
    assert found == expected
    assert all(size == batch for size in encoder.batches[:-1])
    assert max(encoder.batches, default=0) <= batch


def test_an_image_is_returned_before_later_ones_are_read():
    read = []

    def jobs():
        for key in range(6):
            read.append(key)
            yield key, [torch.zeros(4, 3, 8, 8)]

    stream = encode_stream(CenterEncoder().encode_images, jobs(), batch_size=6)
    next(stream)
    assert len(read) <= 2


def test_the_batch_shrinks_with_the_memory_and_the_image():
    assert batch_size_for(4 << 30, 224) > batch_size_for(1 << 30, 224) > batch_size_for(1 << 30, 512) >= 1
    assert batch_size_for(1, 224) == 1
    assert batch_size_for(1 << 50, 64) == 256


def test_embeddings_of_other_crops_are_refused():
    with pytest.raises(ValueError, match="1 embeddings where the crops have"):
        dense_map(grid_levels(10, 10, [0.5], [0.5]), torch.zeros(1, 3), 10, 10, 2, 2)
