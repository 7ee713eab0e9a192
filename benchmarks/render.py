"""Time of the CPU rasterizer, forward and backward, compared with a naive port of the CUDA kernel.

    python benchmarks/render.py [--threads 2] [--repeats 15] [--json FILE]

For each size, number of Gaussians and number of channels, in milliseconds (best and median by the clock, and for
forward and backward "cpu", the median of the processor time of all threads):

    forward     projection, shading, sorting into tiles, blending, without gradients
    backward    gradients of all tensors from those of image and alpha
    blend       the blending part of forward
    naive       the same blending pixel by pixel over the list of its tile, with libm's exp (`per_pixel`)

and the pairs of Gaussian and tile per second of forward time. Four lower bounds, in milliseconds:

    exps        time of the exponentials of blending: the rows of 16 pixels that Gaussians reach, at the measured
                rate of a loop of only `alpha_of`; forward and backward each evaluate them once
    bytes       time to move the necessary bytes of forward (`bytes_moved`) at the rate of a copy
    b.bytes     the same of backward (`bytes_of_gradients`)
    places      time to write each pair into the list of its tile, Gaussian by Gaussian, where all places are known
"""

from __future__ import annotations

import math
import os
import platform
import time

import numba
import numpy as np
import torch
from records import argument_parser, write_record

from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.rendering import cpu_backend, prepare, render
from lexsplat.rendering.kernels import binning, blending, lanes
from lexsplat.rendering.kernels.jit import parallel
from lexsplat.rendering.pairs import TilePairs

SIZES = ((320, 240), (640, 480))
COUNTS = (20_000, 100_000)
CHANNELS = (3, 12)


def three_shells(count: int, seed: int = 0) -> Gaussians:
    """Gaussians on three spheres; their size depends on their number so that they cover the same area."""
    g = torch.Generator().manual_seed(seed)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=-1)
    means *= torch.tensor([0.6, 1.0, 1.4])[torch.randint(0, 3, (count,), generator=g)][:, None]
    size = 0.025 * math.sqrt(20_000 / count)
    return Gaussians(
        means=means,
        quats=torch.randn(count, 4, generator=g),
        log_scales=math.log(size) + 0.4 * torch.randn(count, 3, generator=g),
        opacity_logits=1.5 * torch.randn(count, generator=g),
        sh0=torch.randn(count, 1, 3, generator=g),
        shN=0.2 * torch.randn(count, 15, 3, generator=g),
        antialiased=True,
    )


def camera_of(width: int, height: int) -> Camera:
    eye, target, up = np.array([0.0, 0.0, -3.2]), np.zeros(3), np.array([0.0, -1.0, 0.0])
    return look_at(eye, target, up, width, height, 2 * math.atan(120 / 280))


@numba.njit(nogil=True, error_model="numpy", cache=True)
def per_pixel(start, stop, ellipses, tile_offsets, members, values, tiles_x, image, alpha):
    height, width, channels = image.shape
    for tile in range(start, stop):
        left, top = (tile % tiles_x) * binning.TILE, (tile // tiles_x) * binning.TILE
        for y in range(top, min(top + binning.TILE, height)):
            for x in range(left, min(left + binning.TILE, width)):
                transmittance = np.float32(1)
                for channel in range(channels):
                    image[y, x, channel] = 0
                for slot in range(tile_offsets[tile], tile_offsets[tile + 1]):
                    k = members[slot]
                    dx = np.float32(x) + np.float32(0.5) - ellipses[k, 0]
                    dy = np.float32(y) + np.float32(0.5) - ellipses[k, 1]
                    power = ellipses[k, 2] * dx * dx + ellipses[k, 4] * dy * dy + ellipses[k, 3] * dx * dy
                    a = min(np.float32(0.999), ellipses[k, 5] * math.exp(-power))
                    if a < np.float32(1 / 255):
                        continue
                    after = transmittance * (np.float32(1) - a)
                    if after <= np.float32(1e-4):
                        break
                    for channel in range(channels):
                        image[y, x, channel] += a * transmittance * values[k, channel]
                    transmittance = after
                alpha[y, x] = np.float32(1) - transmittance


@numba.njit(nogil=True, error_model="numpy", cache=True)
def only_alphas(start, stop, rows, out):
    """Only the rows of `alpha_of` that blending computes."""
    step = lanes.splat(np.float32(-1e-3))
    for part in range(start, stop):
        sums = lanes.splat(np.float32(0))
        for i in range(part * rows // 64, (part + 1) * rows // 64):
            sums += blending.alpha_of(step, step, np.float32(i % 64), np.float32(0.7))
        out[part] = lanes.total(sums)


@numba.njit(nogil=True, error_model="numpy", cache=True)
def only_places(start, stop, owners, places, lists):
    """Only the last step of any sorting of pairs: each goes to its place in the list of its tile."""
    for pair in range(start, stop):
        lists[places[pair]] = owners[pair]


def measure(function, repeats: int) -> tuple[float, float, float]:
    """Best and median wall time and median processor time in milliseconds after one warm-up call."""
    function()
    times = []
    for _ in range(repeats):
        start = np.array([time.perf_counter(), time.process_time()])
        function()
        times.append(1e3 * (np.array([time.perf_counter(), time.process_time()]) - start))
    walls, processor = np.transpose(times)
    return float(walls.min()), float(np.median(walls)), float(np.median(processor))


def rows_of(pairs: TilePairs) -> int:
    """Number of rows of 16 pixels that all Gaussians reach, without early termination of tiles."""
    return int(pairs.rows[:, 1].sum(dtype=np.int64) - pairs.rows[:, 0].sum(dtype=np.int64))


def bytes_moved(gaussians: Gaussians, channels: int, pairs: TilePairs) -> int:
    """Minimum number of bytes that a forward pass reads and writes: parameters, projections, pairs, image.

    A visible Gaussian has 12 projected numbers and its channels, each written and read once; a pair has one number,
    written and read once.
    """
    parameters = sum(tensor.numel() for tensor in gaussians.tensors().values())
    parameters += len(gaussians) * (channels - 3)
    projected = 2 * len(pairs.order) * (12 + channels)
    pixels = pairs.width * pairs.height * (channels + 1)
    return 4 * (parameters + projected + 2 * len(pairs.members) + pixels)


def bytes_of_gradients(gaussians: Gaussians, channels: int, pairs: TilePairs) -> int:
    """Minimum number of bytes that a backward pass reads and writes.

    It reads what forward wrote and the gradients of the image, writes and reads the gradients of the projected
    numbers, and reads the parameters and writes their gradients.
    """
    parameters = sum(tensor.numel() for tensor in gaussians.tensors().values())
    parameters += len(gaussians) * (channels - 3)
    projected = 3 * len(pairs.order) * (12 + channels)
    pixels = 2 * pairs.width * pairs.height * (channels + 1)
    return 4 * (2 * parameters + projected + len(pairs.members) + pixels)


def copy_rate(repeats: int) -> float:
    """Bytes read and written per millisecond by a copy of 64 MiB on all threads."""
    source = torch.ones(1 << 24)
    target = torch.empty_like(source)
    return 2 * 4 * source.numel() / measure(lambda: target.copy_(source), repeats)[0]


def run_case(width: int, height: int, count: int, channels: int, repeats: int) -> dict[str, float]:
    camera, gaussians = camera_of(width, height), three_shells(count)
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(count, channels - 3, generator=generator) if channels > 3 else None
    view = prepare(gaussians, camera)
    pairs: TilePairs = view.pairs

    with torch.no_grad():
        forward = measure(lambda: render(gaussians, camera, features=features), repeats)
    leaves = gaussians.map(lambda t: t.requires_grad_())
    if features is not None:
        features.requires_grad_()
    rendering = render(leaves, camera, features=features)
    upstream = torch.randn(rendering.channels.shape, generator=generator), torch.ones(height, width)

    wanted = [*leaves.tensors().values(), *([] if features is None else [features])]

    def backward() -> None:
        torch.autograd.grad((rendering.channels, rendering.alpha), wanted, upstream, retain_graph=True)

    backward_times = measure(backward, repeats)

    values = torch.rand(count, channels, generator=generator)
    with torch.no_grad():
        blend = measure(lambda: cpu_backend.blend(view.projection, pairs, values, None, None), repeats)
        ours, _ = cpu_backend.blend(view.projection, pairs, values, None, None)
    gathered = values.numpy()[pairs.order]
    image, alpha = np.empty((height, width, channels), np.float32), np.empty((height, width), np.float32)
    lists = (pairs.ellipses, pairs.tile_offsets, pairs.members, gathered, pairs.tiles_x, image, alpha)
    naive = measure(lambda: parallel(per_pixel, pairs.tiles, 8, *lists), max(3, repeats // 4))
    if np.abs(ours.numpy() - image).mean() > 1e-5:
        raise SystemExit("the naive port renders another image")
    floor = measure(lambda: parallel(only_alphas, 64, 4, rows_of(pairs), np.empty(64, np.float32)), repeats)
    rate = copy_rate(repeats)
    by_gaussian = np.argsort(pairs.members, kind="stable").astype(np.int32)
    places = (pairs.members[by_gaussian], by_gaussian, np.empty_like(pairs.members))
    placing = measure(lambda: parallel(only_places, len(by_gaussian), 1 << 14, *places), repeats)
    if not np.array_equal(places[2], pairs.members):
        raise SystemExit("the pairs are not where their tiles have them")
    return {
        "width": width, "height": height, "gaussians": count, "channels": channels, "pairs": len(pairs.members),
        "forward_ms": forward[0], "forward_median_ms": forward[1], "forward_processor_ms": forward[2],
        "backward_ms": backward_times[0], "backward_median_ms": backward_times[1],
        "backward_processor_ms": backward_times[2], "blend_processor_ms": blend[2], "naive_processor_ms": naive[2],
        "blend_ms": blend[0], "naive_ms": naive[0], "ratio": naive[0] / blend[0], "floor_ms": floor[0],
        "bytes_ms": bytes_moved(gaussians, channels, pairs) / rate,
        "backward_bytes_ms": bytes_of_gradients(gaussians, channels, pairs) / rate, "places_ms": placing[0],
        "pairs_per_second": len(pairs.members) / forward[0] * 1e3,
    }  # fmt: skip


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(
        f"{platform.processor() or platform.machine()}, {options.threads} threads; milliseconds: best (median)"
    )
    print(
        f"{'size':>8} {'N':>7} {'C':>3} {'pairs':>8}   {'forward':>14} {'cpu':>6}   {'backward':>14} {'cpu':>6}"
        f" {'Mpairs/s':>9} {'blend':>7} {'naive':>7} {'ratio':>6} {'exps':>6} {'bytes':>6}"
        f" {'b.bytes':>7} {'places':>6}"
    )
    cases = []
    for width, height in SIZES:
        for count in COUNTS:
            for channels in CHANNELS:
                c = run_case(width, height, count, channels, options.repeats)
                cases.append(c)
                forward = f"{c['forward_ms']:.1f} ({c['forward_median_ms']:.1f})"
                backward = f"{c['backward_ms']:.1f} ({c['backward_median_ms']:.1f})"
                print(
                    f"{width:>4}x{height} {count:>7} {channels:>3} {c['pairs']:>8}   {forward:>14}"
                    f" {c['forward_processor_ms']:>6.1f}   {backward:>14} {c['backward_processor_ms']:>6.1f}"
                    f" {c['pairs_per_second'] / 1e6:>9.1f} {c['blend_ms']:>7.1f} {c['naive_ms']:>7.1f}"
                    f" {c['ratio']:>6.1f} {c['floor_ms']:>6.1f} {c['bytes_ms']:>6.1f} {c['backward_bytes_ms']:>7.1f}"
                    f" {c['places_ms']:>6.1f}",
                    flush=True,
                )
    write_record(options.json, cases, threads=options.threads)


if __name__ == "__main__":
    main()
