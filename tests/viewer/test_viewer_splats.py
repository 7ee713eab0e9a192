"""What is sent to the browser: covariances against scipy's rotations, orders and budgets against definitions."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.spatial.transform import Rotation

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.geometry.rotations import covariances
from lexsplat.viewer.splats import SplatBlocks, level_of_detail, morton_order


def cloud(count: int, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=g),
        quats=torch.randn(count, 4, generator=g),
        log_scales=torch.randn(count, 3, generator=g) - 4,
        opacity_logits=torch.randn(count, generator=g),
        sh0=torch.randn(count, 1, 3, generator=g),
        shN=torch.zeros(count, 0, 3),
    )


def test_covariances_are_rotated_squared_scales():
    gaussians = cloud(50)
    found = covariances(gaussians.quats, gaussians.scales).numpy()
    rotations = Rotation.from_quat(gaussians.quats.double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
    for number in range(50):
        squares = np.diag(np.exp(2 * gaussians.log_scales[number].double().numpy()))
        expected = rotations[number] @ squares @ rotations[number].T
        assert np.allclose(found[number], expected, rtol=1e-4, atol=1e-5 * expected.max())


def test_every_gaussian_is_drawn_once_within_the_budget():
    gaussians = cloud(1000)
    splats = SplatBlocks(gaussians, budget=1000, block_size=300)
    index = np.concatenate([block.index for block in splats.blocks])
    assert sorted(index) == list(range(1000))
    assert max(len(block.index) for block in splats.blocks) <= 300
    assert splats.growth == 1
    for block in splats.blocks:
        assert np.allclose(block.centers / splats.unit, gaussians.means.numpy()[block.index], atol=1e-5)
        assert np.allclose(block.opacities[:, 0], gaussians.opacities.numpy()[block.index])
        expected = covariances(gaussians.quats, gaussians.scales).numpy()[block.index]
        assert np.allclose(block.covariances / splats.unit**2, expected, rtol=1e-4, atol=1e-9)


def test_half_floats_keep_the_shape_of_small_and_large_gaussians():
    """The browser's half floats range from 6e-8 to 65504; a room in kilometers or in millimeters must fit."""
    for size in (1e-4, 1.0, 1e3):
        gaussians = cloud(2000)
        gaussians.log_scales += float(np.log(size))
        splats = SplatBlocks(gaussians)
        sent = np.concatenate([block.covariances for block in splats.blocks])
        halves = sent.astype(np.float16).astype(np.float32)
        assert np.isfinite(halves).all()
        own, kept = np.trace(sent, axis1=1, axis2=2), np.trace(halves, axis1=1, axis2=2)
        assert np.quantile(np.abs(kept / own - 1), 0.99) < 0.01


def test_level_of_detail_keeps_and_enlarges_what_covers_most():
    gaussians = cloud(5000)
    kept, growth = level_of_detail(gaussians, 1000)
    assert len(set(kept)) == 1000
    assert 1 < growth <= 1.5
    scales = np.sort(gaussians.scales.numpy(), axis=1)
    coverage = gaussians.opacities.numpy() * scales[:, 1] * scales[:, 2]
    left_out = np.setdiff1d(np.arange(5000), kept)
    assert coverage[left_out].max() <= min(coverage[kept].min(), np.quantile(coverage, 0.99)) * (1 + 1e-6)
    splats = SplatBlocks(gaussians, budget=1000)
    assert (splats.drawn, splats.total, splats.growth) == (1000, 5000, growth)


def test_only_changed_blocks_are_sent_again():
    gaussians = cloud(1000)
    splats = SplatBlocks(gaussians, block_size=100)
    colors = np.zeros((1000, 3), np.uint8)
    first = splats.changes(colors)
    assert [number for number, _ in first] == list(range(len(splats.blocks)))
    assert splats.changes(colors) == []
    colors[splats.blocks[3].index[7]] = 9
    ((number, sent),) = splats.changes(colors)
    assert number == 3
    assert np.array_equal(sent, colors[splats.blocks[3].index])


def test_spatial_neighbors_share_blocks():
    points = np.random.default_rng(0).random((20_000, 3)).astype(np.float32)
    blocks = np.array_split(morton_order(points), 64)
    spread = np.mean([np.ptp(points[block], axis=0).max() for block in blocks])
    assert spread < 0.5  # at random it would be 1; a perfect cube of 1/64 of the volume has side 0.25


@settings(max_examples=60)
@given(
    npst.arrays(
        np.float32, st.tuples(st.integers(0, 40), st.just(3)), elements=st.floats(-1e6, 1e6, width=32)
    )
)
def test_the_order_is_a_permutation(points):
    assert sorted(morton_order(points)) == list(range(len(points)))


def test_the_order_of_a_grid_is_the_z_curve():
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32)
    shuffled = np.random.default_rng(1).permutation(8)
    order = morton_order(corners[shuffled])
    assert np.array_equal(shuffled[order], np.arange(8))


@pytest.mark.parametrize("options", [{"budget": 0}, {"block_size": 0}])
def test_invalid_budgets_are_refused(options):
    with pytest.raises(ValueError, match="positive"):
        SplatBlocks(cloud(3), **options)


def test_an_empty_scene_has_nothing_to_send():
    splats = SplatBlocks(cloud(3).select(torch.zeros(3, dtype=torch.bool)))
    assert splats.drawn == 0
