"""Claims about the weights of cells; the reference is the float64 renderer and a sum over its pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from support import rendering_reference as reference
from support.rendering_reference import front_camera, random_gaussians

from lexsplat.rendering import accumulate_weights, back_project, measure_weights, prepare, render, weigh_cells
from lexsplat.rendering.back_projection import DenseCellWeights

WIDTH, HEIGHT = 53, 37


def random_counts(seed: int = 0) -> torch.Tensor:
    """Counts of pixels, a third of which are 0."""
    counts = np.random.default_rng(seed).random((HEIGHT, WIDTH)).astype(np.float32)
    return torch.from_numpy(np.where(counts < 0.33, 0, counts))


def summed(gaussians, camera, cells, counts, values) -> torch.Tensor:
    weights = weigh_cells(gaussians, camera, cells, counts, prepare(gaussians, camera))
    sums = torch.zeros(len(gaussians), values.shape[1])
    weights.add_to(sums, values)
    return sums


@pytest.mark.parametrize("cells", [(1, 1), (5, 7), (HEIGHT, WIDTH), (80, 110)])
@pytest.mark.parametrize("channels", [1, 70])
@pytest.mark.parametrize("antialiased", [False, True])
def test_sums_over_cells_equal_the_float64_reference(cells, channels, antialiased):
    """Cells larger than tiles, than pixels, of one pixel, and smaller than pixels."""
    gaussians, camera = random_gaussians(40, 9, antialiased=antialiased), front_camera(WIDTH, HEIGHT)
    leaves = {name: value.detach() for name, value in reference.to_float64(gaussians).items()}
    expected = reference.render(leaves, camera, antialiased=antialiased, degree=3)
    values = torch.randn(cells[0] * cells[1], channels, generator=torch.Generator().manual_seed(0))
    counts = random_counts() * expected["clear"]
    found = summed(gaussians, camera, cells, counts.float(), values)
    rows = np.minimum(((np.arange(HEIGHT) + 0.5) * cells[0] / HEIGHT).astype(int), cells[0] - 1)
    columns = np.minimum(((np.arange(WIDTH) + 0.5) * cells[1] / WIDTH).astype(int), cells[1] - 1)
    pixels = values[rows[:, None] * cells[1] + columns].double() * counts[..., None]
    exact = torch.einsum("nhw,hwc->nc", expected["weights"], pixels)
    assert float(exact.abs().max()) > 1
    assert (found - exact).abs().max() < 1e-4


def test_sums_are_added_to_what_is_there():
    gaussians, camera = random_gaussians(40, 9), front_camera(WIDTH, HEIGHT)
    weights = weigh_cells(gaussians, camera, (5, 7), random_counts(), prepare(gaussians, camera))
    once, twice = torch.zeros(40, 3), torch.full((40, 3), 2.0)
    weights.add_to(once, torch.ones(35, 3))
    weights.add_to(twice, torch.ones(35, 3))
    torch.testing.assert_close(twice, once + 2)
    torch.testing.assert_close(weights.totals(), once[:, 0])


def test_sums_are_bit_identical_on_any_number_of_threads():
    gaussians, camera = random_gaussians(3000, 5, scale=0.05), front_camera(WIDTH, HEIGHT)
    values = torch.randn(35, 70, generator=torch.Generator().manual_seed(0))
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            results.append(summed(gaussians, camera, (5, 7), random_counts(), values))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(results[0], other) for other in results[1:])


def test_sparse_and_dense_weights_agree():
    gaussians, camera = random_gaussians(800, 5, scale=0.05), front_camera(WIDTH, HEIGHT)
    values = torch.randn(HEIGHT * WIDTH, 130, generator=torch.Generator().manual_seed(0))
    at = torch.arange(HEIGHT * WIDTH).view(HEIGHT, WIDTH)
    counts, prepared = random_counts(), prepare(gaussians, camera)
    dense = torch.zeros(800, 130)
    DenseCellWeights(gaussians, camera, at, counts, prepared).add_to(dense, values)
    straight = back_project(gaussians, camera, values.view(HEIGHT, WIDTH, 130) * counts[..., None])
    torch.testing.assert_close(dense, straight)
    sparse = summed(gaussians, camera, (HEIGHT, WIDTH), counts, values)
    torch.testing.assert_close(sparse, dense, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("antialiased", [False, True])
def test_weights_that_are_measured_in_one_pass_are_those_of_the_transpose(antialiased):
    gaussians, camera = random_gaussians(40, 9, antialiased=antialiased), front_camera(WIDTH, HEIGHT)
    expected = accumulate_weights(gaussians, camera)
    assert float(expected.max()) > 1
    torch.testing.assert_close(measure_weights(gaussians, camera), expected, rtol=1e-5, atol=1e-5)


def test_a_narrowed_view_has_the_weights_and_pixels_of_a_view_without_what_is_gone():
    """Bit for bit in its tiles; nothing is drawn in the others."""
    gaussians, camera = random_gaussians(300, 9, scale=0.05), front_camera(WIDTH, HEIGHT)
    gone, asked = torch.arange(300) % 3 == 0, torch.zeros(300, dtype=torch.bool)
    whole, others = prepare(gaussians, camera), gaussians.select(~gone)
    expected = torch.zeros(300)
    expected[~gone] = measure_weights(others, camera)
    now = measure_weights(gaussians, camera)
    asked[((expected > 0) & (now < expected)).nonzero()[:3, 0]] = True
    tiles = whole.pairs.tiles_of(asked.numpy())
    assert 0 < tiles.sum() < len(tiles)
    for by, weights in ((None, now), (gone.numpy(), expected)):
        narrowed = replace(whole, pairs=whole.pairs.narrowed(tiles, by))
        assert torch.equal(measure_weights(gaussians, camera, prepared=narrowed)[asked], weights[asked])
    for x, y in ((WIDTH - 1, 3), (20, HEIGHT - 1)):
        tile = np.zeros(len(tiles), bool)
        tile[(y // 16) * 4 + x // 16] = True
        assert whole.pairs.tiles_at(np.array([[x, y]])).tolist() == tile.tolist()
        pixels = render(gaussians, camera, prepared=replace(whole, pairs=whole.pairs.narrowed(tile))).image
        assert torch.equal(pixels[y, x], render(gaussians, camera).image[y, x])
        assert not pixels[0, 0].any()
        values = torch.zeros(HEIGHT, WIDTH, 2)
        values[y, x] = torch.tensor([1.0, -2.0])
        narrowed = replace(whole, pairs=whole.pairs.narrowed(tile))
        assert torch.equal(
            back_project(gaussians, camera, values, narrowed), back_project(gaussians, camera, values)
        )


def test_a_view_of_nothing_adds_nothing():
    gaussians, camera = random_gaussians(10, 9), front_camera(WIDTH, HEIGHT)
    gaussians.means[:] = torch.from_numpy(camera.position - 5 * camera.forward).float()
    assert not summed(gaussians, camera, (5, 7), random_counts(), torch.ones(35, 3)).any()
    none = gaussians.select(torch.zeros(10, dtype=torch.bool))
    assert summed(none, camera, (5, 7), random_counts(), torch.ones(35, 3)).shape == (0, 3)


def test_weights_of_a_view_prepared_for_another_camera_are_refused():
    gaussians = random_gaussians(10, 9)
    with pytest.raises(ValueError, match="another camera"):
        weigh_cells(
            gaussians, front_camera(60, 37), (5, 7), random_counts(), prepare(gaussians, front_camera(53, 37))
        )
