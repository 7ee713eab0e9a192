"""Unit tests of the CPU rasterizer: projection, spherical harmonics, pairs, vectors, and the kernel cache."""

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.rendering_reference import front_camera, random_gaussians

from lexsplat.geometry.cameras import look_at
from lexsplat.rendering import Projection, cpu_backend, pairs, render
from lexsplat.rendering.kernels import binning, blending, gradients, lanes
from lexsplat.rendering.kernels.jit import parallel
from lexsplat.runtime.device import kernel_threads, threads_for_kernels

pytestmark = pytest.mark.slow

# --------------------------------------------------------------------------- gsplat's torch functions


@pytest.mark.parametrize("antialiased", [False, True])
def test_projection_equals_gsplats_torch_function(antialiased):
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    gaussians, camera = random_gaussians(500, 3, antialiased=antialiased), front_camera(160, 120)
    gaussians.opacity_logits[:] = 3.0
    leaves = {k: v.double().requires_grad_() for k, v in gaussians.tensors().items()}
    covariances, _ = _quat_scale_to_covar_preci(
        leaves["quats"], leaves["log_scales"].exp(), compute_preci=False
    )
    radii, means2d, depths, conics, compensations = _fully_fused_projection(
        leaves["means"], covariances, torch.from_numpy(camera.viewmat)[None], torch.from_numpy(camera.K)[None],
        160, 120, calc_compensations=True,
    )  # fmt: skip
    opacities = leaves["opacity_logits"].sigmoid()
    if antialiased:
        opacities = opacities * compensations[0]
    ours = gaussians.map(lambda t: t.clone().requires_grad_())
    found = cpu_backend.project(ours, camera, 0.01)
    drawn = found.radii > 0
    # gsplat's box assumes opacity 1, ours uses the actual opacity: all that we draw is drawn by gsplat, which draws
    # little more.
    assert (radii[0].amin(-1) > 0)[drawn].all()
    assert drawn.float().mean() > 0.5
    for mine, theirs in zip(
        (found.means2d, found.conics, found.opacities, found.depths),
        (means2d[0], conics[0], opacities, depths[0]),
    ):
        assert torch.allclose(mine[drawn].double(), theirs[drawn], rtol=2e-5, atol=2e-5)

    g = torch.Generator().manual_seed(0)
    outputs = (found.means2d, found.conics, found.opacities)
    grads = [torch.randn(t.shape, generator=g) * drawn.reshape(-1, *[1] * (t.ndim - 1)) for t in outputs]
    torch.autograd.backward(outputs, grads)
    torch.autograd.backward((means2d[0], conics[0], opacities), [t.double() for t in grads])
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        mine, theirs = getattr(ours, name).grad.double(), leaves[name].grad
        assert torch.allclose(mine, theirs, rtol=2e-4, atol=2e-5 * float(theirs.abs().max())), name


def test_gaussians_of_radius_zero_are_invisible():
    # Radius 0 means that no pixel receives alpha >= 1/255 (computed in float64 without boxes).
    from support import rendering_reference as reference

    gaussians, camera = random_gaussians(400, 8, antialiased=True), front_camera(40, 30)
    gaussians.means.mul_(2.5)
    leaves = {k: v.double() for k, v in gaussians.tensors().items()}
    projected = reference.project(leaves, camera, antialiased=True)
    found = cpu_backend.project(gaussians, camera, 0.01)
    radii, extents = found.radii, found.extents
    hidden = (radii == 0) & (projected["depth"] > 0.01)
    assert int(hidden.sum()) > 50
    xs, ys = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(30) + 0.5, indexing="xy")
    offset = torch.stack([xs, ys], -1).double() - projected["means2d"][:, None, None]
    power = 0.5 * torch.einsum("nhwi,nij,nhwj->nhw", offset, projected["conic"], offset)
    alpha = projected["opacity"][:, None, None] * torch.exp(-power)
    assert (alpha[hidden] < 1 / 255).all()
    # No pixel outside the box receives alpha >= 1/255.
    outside = (offset.abs() > extents[:, None, None] + 1e-3).any(-1)
    drawn = radii > 0
    assert (alpha[drawn][outside[drawn]] < 1 / 255 * (1 + 1e-5)).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_colors_equal_gsplats_torch_function(degree):
    from gsplat.cuda._torch_impl import _spherical_harmonics

    gaussians, camera = random_gaussians(300, degree, degree=4), front_camera()
    leaves = {k: v.double().requires_grad_() for k, v in gaussians.tensors().items()}
    coefficients = torch.cat([leaves["sh0"], leaves["shN"]], 1)
    direction = leaves["means"] - torch.from_numpy(camera.position)
    expected = (_spherical_harmonics(degree, direction, coefficients) + 0.5).clamp_min(0)
    ours = gaussians.map(lambda t: t.clone().requires_grad_())
    everything = torch.ones(300, dtype=torch.int32)  # colors of all Gaussians, drawn or not
    projection = replace(cpu_backend.project(ours, camera, 0.01), radii=everything, means=ours.means)
    found = cpu_backend.shade(ours, camera, projection, degree)
    assert torch.allclose(found.double(), expected, atol=1e-5)
    grad = torch.randn(300, 3, generator=torch.Generator().manual_seed(1))
    found.backward(grad)
    expected.backward(grad.double())
    for name in ("means", "sh0", "shN"):
        theirs = leaves[name].grad if leaves[name].grad is not None else torch.zeros_like(leaves[name])
        assert torch.allclose(getattr(ours, name).grad.double(), theirs, atol=2e-5, rtol=1e-4), name


# ----------------------------------------------------------------------------------------------------------- pairs


def random_ellipses(count: int, width: int, height: int, rng: np.random.Generator):
    """Means, conics, opacities, extents, depths, radii of ellipses around and outside the image."""
    means = (rng.uniform(-0.3, 1.3, (count, 2)) * (width, height)).astype(np.float32)
    angle, long, ratio = (
        rng.uniform(0, np.pi, count),
        rng.lognormal(1.0, 1.0, count),
        rng.uniform(0.02, 1, count),
    )
    c, s, v1, v2 = np.cos(angle), np.sin(angle), long**2 + 0.3, (long * ratio) ** 2 + 0.3
    xx, xy, yy = c * c * v1 + s * s * v2, c * s * (v1 - v2), s * s * v1 + c * c * v2
    conics = (np.stack([yy, -xy, xx], 1) / (v1 * v2)[:, None]).astype(np.float32)
    opacities = rng.uniform(0.004, 1, count).astype(np.float32)
    reach = np.sqrt(2 * np.log(opacities * 255.0))[:, None] * np.sqrt(np.stack([xx, yy], 1))
    depths = rng.choice(np.float32([0.5, 1, 1, 2]), count) * rng.uniform(0.5, 2, count).astype(np.float32)
    radii = np.where(rng.uniform(size=count) < 0.9, 1, 0).astype(np.int32)
    return means, conics, opacities, reach.astype(np.float32), depths, radii


def found_pairs(ellipses: tuple[np.ndarray, ...], width: int, height: int) -> pairs.TilePairs:
    names = ("means2d", "conics", "opacities", "extents", "depths", "radii")
    projection = Projection(**{name: torch.from_numpy(array) for name, array in zip(names, ellipses)})
    return pairs.find_pairs(projection, width, height)


@pytest.fixture
def poisoned_memory(monkeypatch):
    """Fills the memory of np.empty with values that must never be read: NaN, or an index far out of range."""
    leaves = random_gaussians(4, 0).map(lambda t: t.requires_grad_())
    render(leaves, front_camera()).image.sum().backward()  # Numba compiles before np.empty is replaced
    empty = np.empty

    def poisoned(shape, dtype=float, *args, **options):
        array = empty(shape, dtype, *args, **options)
        array.fill({"f": np.nan, "u": 255}.get(array.dtype.kind, -(2**30)))
        return array

    monkeypatch.setattr(np, "empty", poisoned)


def test_pair_lists_are_complete_permutations(poisoned_memory):
    rng = np.random.default_rng(0)
    for _ in range(1000):
        count, width, height = int(rng.integers(1, 120)), int(rng.integers(1, 90)), int(rng.integers(1, 90))
        means, conics, opacities, reach, depths, radii = random_ellipses(count, width, height, rng)
        found = found_pairs((means, conics, opacities, reach, depths, radii), width, height)
        total = int(found.tile_offsets[-1])
        # Sorted by depth, ties by index, visible Gaussians only.
        visible = np.flatnonzero(radii)
        assert np.array_equal(found.order, visible[np.argsort(depths[visible], kind="stable")])
        # Every slot of both lists was written exactly once.
        assert np.array_equal(np.sort(found.pairs), np.arange(total))
        assert found.pair_offsets[-1] == total == len(found.members)
        # Both lists contain the same Gaussian, and tiles preserve depth order.
        owner = np.repeat(np.arange(len(visible)), np.diff(found.pair_offsets))
        assert np.array_equal(owner[found.pairs], found.members)
        tile = np.repeat(np.arange(found.tiles), np.diff(found.tile_offsets))
        assert (np.diff(tile.astype(np.int64) * count + found.members) > 0).all()


def test_pairs_reach_every_row_with_a_contribution_and_hardly_any_other():
    rng = np.random.default_rng(2)
    contributions = listed_rows = 0
    for _ in range(60):
        count, width, height = int(rng.integers(1, 60)), int(rng.integers(1, 90)), int(rng.integers(1, 90))
        ellipses = random_ellipses(count, width, height, rng)
        found = found_pairs(ellipses, width, height)
        listed = np.zeros((len(found.order), -(-height // 16) * 16, found.tiles_x), bool)
        for tile in range(found.tiles):
            for slot in range(found.tile_offsets[tile], found.tile_offsets[tile + 1]):
                first, last = (tile // found.tiles_x * 16 + int(row) for row in found.rows[slot])
                assert last > first
                listed[found.members[slot], first:last, tile % found.tiles_x] = True
        means, conics, opacities = (array[found.order].astype(float) for array in ellipses[:3])
        dx, dy = (np.arange(size) + 0.5 - means[:, i : i + 1] for i, size in enumerate((width, height)))
        dx, dy = dx[:, None], dy[:, :, None]
        a, b, c, opacity = (array[:, None, None] for array in (*conics.T, opacities))
        visible = opacity * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy) >= 1 / 255
        rows = np.stack([visible[:, :, left : left + 16].any(2) for left in range(0, width, 16)], 2)
        assert not (rows & ~listed[:, :height]).any()
        # Tight: in a listed row, the ellipse reaches between the first and last pixel of the tile.
        left = np.arange(found.tiles_x) * 16 + 0.5 - means[:, :1] - 0.01
        nearest = np.clip(-b * dy / a, left[:, None], left[:, None] + 15.02)
        level = 0.5 * (a * nearest * nearest + c * dy * dy) + b * nearest * dy
        reached = level <= np.log(255 * opacity) * 1.05 + 0.05
        assert not (listed[:, :height] & ~reached).any()
        contributions, listed_rows = contributions + rows.sum(), listed_rows + listed.sum()
    assert contributions > 0.8 * listed_rows


def test_no_uninitialized_memory_is_read(poisoned_memory):
    rng = np.random.default_rng(1)
    for _ in range(20):
        count, width, height, channels = (
            150,
            int(rng.integers(1, 70)),
            int(rng.integers(1, 70)),
            3 + int(rng.integers(6)),
        )
        projected = random_ellipses(count, width, height, rng)
        found = found_pairs(projected, width, height)
        values = rng.uniform(size=(len(found.order), channels)).astype(np.float32)
        lists = (found.ellipses, found.tile_offsets, found.members)
        image, alpha = np.empty((height, width, channels), np.float32), np.empty((height, width), np.float32)
        ones = np.ones(3, np.float32)
        passed, last = np.empty((2, found.tiles * blending.PIXELS), np.float32)
        blending.blend(
            0, found.tiles, *lists, found.rows, values, ones, found.tiles_x, image, alpha, passed, last
        )
        assert np.isfinite(image).all()
        assert np.isfinite(alpha).all()
        rows = np.empty(len(found.members) * gradients.row_width(channels), np.float32)
        gradients.blend_backward(
            0, found.tiles, *lists, found.pairs, found.rows, values, ones, found.tiles_x, 3, True, passed, last,
            np.ones_like(image), np.ones_like(alpha), rows,
        )  # fmt: skip
        assert np.isfinite(rows).all()


@settings(max_examples=50)
@given(st.lists(st.floats(2**-20, 2**30, width=32), min_size=0, max_size=200), st.integers(0, 2**32 - 1))
def test_the_radix_sort_equals_numpys_stable_sort(depths, seed):
    keys = np.array(depths, np.float32)
    radii = np.random.default_rng(seed).integers(0, 2, len(keys)).astype(np.int32)
    order, scratch = np.zeros(len(keys), np.int32), np.zeros(len(keys), np.int32)
    count = binning.sort_visible(keys.view(np.uint32), radii, order, scratch)
    visible = np.flatnonzero(radii)
    assert np.array_equal(order[:count], visible[np.argsort(keys[visible], kind="stable")])


# ----------------------------------------------------------------------------------------------------------- lanes


@numba.njit
def _with_lanes(a, b, out):
    x, y = lanes.load(a, 0), lanes.load(b, 0)
    lanes.store(out, 0, x + y)
    lanes.store(out, 16, x - np.float32(2))
    lanes.store(out, 32, x * y)
    lanes.store(out, 48, x / y)
    lanes.store(out, 64, lanes.select_greater(x, y, x, lanes.splat(np.float32(7))))
    lanes.store_totals(out, 80, x, y, x * y, lanes.splat(np.float32(1)))
    out[84] = lanes.total(x)
    out[85] = lanes.any_positive(x)
    out[86] = lanes.any_positive(lanes.select_greater(x, np.float32(0), np.float32(-1), x))


def test_lane_operations_equal_numpy():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 16)).astype(np.float32)
    out = np.zeros(87, np.float32)
    _with_lanes(a, b, out)
    expected = [a + b, a - 2, a * b, a / b, np.where(a > b, a, 7)]
    assert out[:80] == pytest.approx(np.concatenate(expected), rel=1e-6)
    sums = [a.sum(), b.sum(), (a * b).sum(), 16, a.sum(), 1, 0]
    assert out[80:] == pytest.approx(np.array(sums), rel=1e-5, abs=1e-5)


@numba.njit
def _alpha_at(s, opacity):
    row = blending.alpha_of(lanes.splat(s), lanes.splat(np.float32(0)), np.float32(0), opacity)
    return lanes.total(row) / np.float32(16)


@settings(max_examples=40)
@given(st.floats(0, 5.6), st.floats(0.004, 1.0))
def test_alpha_equals_the_exponential_within_3e_6(exponent, opacity):
    exact = min(opacity * math.exp(-exponent), 0.999)
    assume(abs(exact * 255 - 1) > 1e-4)
    found = _alpha_at(np.float32(-exponent / 8), np.float32(opacity))
    assert found == pytest.approx(exact if exact >= 1 / 255 else 0.0, rel=3e-6)


def test_a_tile_is_finished_when_its_last_pixel_is():
    for place in range(blending.PIXELS):
        live = np.full(blending.PIXELS, -0.5, np.float32)
        assert blending.tile_finished(live)
        live[place] = 2e-4
        assert not blending.tile_finished(live)


# ---------------------------------------------------------------------------------------------------- threads


def test_kernels_keep_their_threads_where_torch_has_one():
    before = torch.get_num_threads()
    with threads_for_kernels():
        assert (torch.get_num_threads(), kernel_threads()) == (1, before)
        with threads_for_kernels():
            assert kernel_threads() == before
    assert torch.get_num_threads() == kernel_threads() == before


def test_parallel_processes_every_item_once_and_propagates_errors():
    before = torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            seen = np.zeros(101, int)

            def mark(start, stop, target):
                target[start:stop] += 1

            parallel(mark, 101, 7, seen)
            assert (seen == 1).all()

            def fail(start, stop):
                raise ZeroDivisionError

            with pytest.raises(ZeroDivisionError):
                parallel(fail, 101, 7)
    finally:
        torch.set_num_threads(before)


def test_a_strongly_rotated_camera_keeps_depths_positive():
    camera = look_at(np.array([0.0, 0, 0]), np.array([1.0, 0, 0]), np.array([0.0, 0, 1]), 64, 48, 1.2)
    gaussians = random_gaussians(300, 4, scale=0.05)
    found = cpu_backend.project(gaussians, camera, 0.2)
    depths, radii = found.depths, found.radii
    assert (depths[radii > 0] >= 0.2).all()
    assert (radii[(gaussians.means[:, 0] < 0.2 - 1e-5)] == 0).all()
