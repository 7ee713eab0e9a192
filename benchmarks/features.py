"""Image encoders against matrix products of the same sizes: milliseconds and operations of a crop and of a photo.

    python benchmarks/features.py [--threads 1] [--repeats 9] [--json FILE]
    python benchmarks/features.py --precisions [--batches 8 64] [--repeats 3]

Encoders: the bundled CLIP, and the image tower of a ViT-B/16 with random weights. They run as in a build on the CPU:
crops are embedded with their patches, in batches of the same size, in bfloat16 where the processor is faster in it.
A further row has the same in float32.

    precision   that of the matrix products of the forward pass
    products    GFLOP/s of only these products, by torch on contiguous matrices of the same sizes and precision: what
                the processor reaches
    share       of this peak that the encoder reaches: 1 would be an encoder that does nothing but matrix products
    photo       all crops of a photo of the demo with the default settings of the encoder, without cutting them

``--precisions`` runs the ViT-B/16 in float32, in bfloat16 as lexsplat does (autocast) and with its weights in
bfloat16, in 8-bit integers (torch's dynamic quantization), and in ONNX Runtime in float32 and in 8-bit integers where
the packages ``onnx``, ``onnxscript`` and ``onnxruntime`` are installed. "cosine" is the lowest of its embeddings of
bundled images with those in float32; weights are random, so it says nothing about published weights.

Forward passes and products alternate; times are medians of processor time, which other programs hardly disturb.
"clock" is the share by the clock.
"""

from __future__ import annotations

import copy
import math
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import torch
from records import argument_parser, write_record
from torch import Tensor
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode

from lexsplat.captures import load_capture
from lexsplat.evaluation.demo import demo_capture
from lexsplat.features import FeatureConfig, pretrained
from lexsplat.features.checks import bundled_images
from lexsplat.features.clip_image import ClipImages
from lexsplat.features.encoders import load_clip
from lexsplat.features.estimate import count_crops
from lexsplat.features.extraction import cpu_batch

aten = torch.ops.aten
SIDE = 224
"""Pixels along a side of the ViT-B/16's input."""
Encode = Callable[[Tensor], Tensor]


class Product(NamedTuple):
    """The sizes and the precision of a product of matrices, or of a batch of them."""

    batch: int
    rows: int
    inner: int
    columns: int
    dtype: torch.dtype

    @property
    def operations(self) -> int:
        """Multiplications and additions."""
        return 2 * self.batch * self.rows * self.inner * self.columns

    def matrices(self) -> tuple[Tensor, Tensor]:
        """Random factors, without a batch of one."""
        left = torch.rand(self.batch, self.rows, self.inner).to(self.dtype)
        right = torch.rand(self.batch, self.inner, self.columns).to(self.dtype)
        return (left[0], right[0]) if self.batch == 1 else (left, right)


class Case(NamedTuple):
    """An encoder as a build runs it, and its default settings on a CPU."""

    name: str
    encode: Callable[[Tensor], object]
    side: int
    config: FeatureConfig


class Products(TorchDispatchMode):
    """Counts the matrix products of a computation."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[Product] = Counter()

    def __torch_dispatch__(self, function, kinds, arguments=(), options=None):  # type: ignore[no-untyped-def]
        result = function(*arguments, **(options or {}))
        name = function.overloadpacket
        if name in (aten.mm, aten.addmm, aten.bmm, aten.baddbmm, aten.matmul):
            left, right = [a for a in arguments if isinstance(a, Tensor)][-2:]
            self._count(left, math.prod(left.shape[:-2]), *left.shape[-2:], right.shape[-1])
        elif name is aten.linear:
            left, weight = arguments[:2]
            self._count(left, 1, left.numel() // left.shape[-1], weight.shape[1], weight.shape[0])
        elif name in (aten.convolution, aten.conv2d):
            weight = arguments[1]
            pixels = result.numel() // weight.shape[0]
            self._count(weight, 1, pixels, math.prod(weight.shape[1:]), weight.shape[0])
        elif "scaled_dot_product" in str(name):
            query, key = arguments[:2]
            batch, (rows, inner), columns = math.prod(query.shape[:-2]), query.shape[-2:], key.shape[-2]
            self._count(query, batch, rows, inner, columns)
            self._count(query, batch, rows, columns, inner)
        return result

    def _count(self, factor: Tensor, *sizes: int) -> None:
        self.counts[Product(*sizes, factor.dtype)] += 1


def vit_b16() -> torch.nn.Module:
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    config = CLIPVisionConfig(
        hidden_size=768, intermediate_size=3072, num_hidden_layers=12, num_attention_heads=12, patch_size=16
    )
    return CLIPVisionModelWithProjection(config).eval()


def vit_b16_tower() -> ClipImages:
    """The same as lexsplat runs it."""
    from transformers import CLIPConfig, CLIPModel

    vision = vit_b16().config.to_dict()
    text = {"hidden_size": 64, "intermediate_size": 64, "num_hidden_layers": 1, "num_attention_heads": 1}
    return ClipImages(CLIPModel(CLIPConfig(vision_config=vision, text_config=text)).eval())


def cases() -> Iterator[Case]:
    """The bundled encoder, then the ViT-B/16; both settings read crops and their patches."""
    clip, vision = load_clip("bundled"), vit_b16_tower()
    yield Case("bundled", clip.encode_patches, clip.image_size, FeatureConfig.bundled())

    def encode(images: Tensor) -> Tensor:
        with pretrained.precision(images.device, crops=True):
            return vision(images, patches=True)

    yield Case("ViT-B/16", encode, SIDE, FeatureConfig.suited(vision.patches))


def timed(function: Callable[[], object]) -> tuple[float, float]:
    """Milliseconds of processor time and by the clock."""
    processor, wall = time.process_time(), time.perf_counter()
    function()
    return 1e3 * (time.process_time() - processor), 1e3 * (time.perf_counter() - wall)


@torch.inference_mode()
def run_case(case: Case, size: tuple[int, int], repeats: int) -> dict[str, Any]:
    """Times and operations of a crop, and of all crops of a photo of this width and height."""
    batch, crops = cpu_batch(case.side), count_crops(case.config, size)
    images = torch.rand(batch, 3, case.side, case.side)
    case.encode(images)  # the first call also tries which precision is faster
    with Products() as products:
        case.encode(images)
    factors = [(*product.matrices(), count) for product, count in products.counts.items()]

    def multiply() -> None:
        for left, right, count in factors:
            for _ in range(count):
                left @ right

    multiply()
    times = np.array([(timed(lambda: case.encode(images)), timed(multiply)) for _ in range(repeats)])
    (forward, forward_wall), (alone, alone_wall) = np.median(times, 0)
    operations = sum(product.operations * count for product, count in products.counts.items())
    kinds = sorted({str(product.dtype).removeprefix("torch.") for product in products.counts})
    return {
        "encoder": case.name, "precision": ", ".join(kinds), "batch": batch, "crop_ms": forward / batch,
        "crop_gflop": operations / batch / 1e9, "gflops": operations / forward / 1e6,
        "products_gflops": operations / alone / 1e6, "share": alone / forward, "crops": crops,
        "share_by_the_clock": alone_wall / forward_wall, "crop_wall_ms": forward_wall / batch,
        "photo_ms": crops * forward / batch, "photo_gflop": crops * operations / batch / 1e9,
    }  # fmt: skip


def run_encoders(repeats: int) -> list[dict[str, Any]]:
    """A row for each encoder as a build runs it, and one in float32 where that is another precision."""
    size = next(iter(load_capture(demo_capture("tabletop")).views.values())).capture_size
    print(
        f"{'encoder':8} {'precision':9} {'ms/crop':>8} {'GFLOP':>6} {'GFLOP/s':>8} {'products':>8} {'share':>5}"
        f" {'clock':>5} {'crops':>5} {'ms/photo':>8} {'GFLOP/photo':>11}"
    )
    rows: list[dict[str, Any]] = []
    for case in cases():
        rows.append(run_case(case, size, repeats))
        print_row(rows[-1])
        if rows[-1]["precision"] != "float32":
            with mock.patch.object(pretrained, "bfloat16_is_faster", return_value=False):
                rows.append(run_case(case, size, repeats))
            print_row(rows[-1])
    return rows


def print_row(row: dict[str, Any]) -> None:
    print(
        f"{row['encoder']:8} {row['precision']:9} {row['crop_ms']:8.2f} {row['crop_gflop']:6.3f} {row['gflops']:8.1f}"
        f" {row['products_gflops']:8.1f} {row['share']:5.2f}"
        f" {row['share_by_the_clock']:5.2f} {row['crops']:5} {row['photo_ms']:8.0f} {row['photo_gflop']:11.1f}",
        flush=True,
    )


def precision_cases(model: torch.nn.Module, threads: int) -> Iterator[tuple[str, Encode]]:
    """The ViT-B/16 in each precision that this machine has packages for."""

    def plain(images: Tensor) -> Tensor:
        return model(pixel_values=images).image_embeds

    def autocast(images: Tensor) -> Tensor:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return plain(images)

    half = copy.deepcopy(model).bfloat16()
    yield "float32", plain
    yield "bfloat16, autocast", autocast
    yield "bfloat16, weights", lambda images: half(pixel_values=images.bfloat16()).image_embeds
    whole = torch.ao.quantization.quantize_dynamic(copy.deepcopy(model), {torch.nn.Linear}, torch.qint8)
    yield "int8, torch", lambda images: whole(pixel_values=images).image_embeds
    with tempfile.TemporaryDirectory() as folder:
        yield from onnx_cases(model, Path(folder), threads)


def onnx_cases(model: torch.nn.Module, folder: Path, threads: int) -> Iterator[tuple[str, Encode]]:
    """The same in ONNX Runtime; nothing if it cannot be exported here."""
    try:
        import onnxruntime
        from onnxruntime.quantization import quantize_dynamic

        class Tower(torch.nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.model = model

            def forward(self, images: Tensor) -> Tensor:
                return self.model(pixel_values=images).image_embeds

        images = torch.rand(2, 3, SIDE, SIDE)
        batch = {"images": {0: torch.export.Dim("batch")}}
        path, small = folder / "float32.onnx", folder / "int8.onnx"
        torch.onnx.export(Tower().eval(), (images,), path, dynamo=True, dynamic_shapes=batch, verbose=False)
        quantize_dynamic(path, small)
    except ImportError as error:
        print(f"ONNX Runtime is not measured: {error}")
        return
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    for name, file in (("float32, ONNX Runtime", path), ("int8, ONNX Runtime", small)):
        session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
        given = session.get_inputs()[0].name
        yield (
            name,
            lambda images, run=session.run, key=given: torch.from_numpy(run(None, {key: images.numpy()})[0]),
        )


@torch.inference_mode()
def run_precisions(threads: int, batches: list[int], repeats: int) -> list[dict[str, Any]]:
    """Median processor time of an image in each precision and batch size, and how far the embeddings agree."""
    model, rows = vit_b16(), []
    seen = bundled_images(SIDE)[:8]
    exact = functional.normalize(model(pixel_values=seen).image_embeds, dim=-1)
    print(f"{'precision':22} {'batch':>5} {'s/image':>8} {'cosine':>8}")
    for name, encode in precision_cases(model, threads):
        cosine = float((functional.normalize(encode(seen).float(), dim=-1) * exact).sum(-1).min())
        for batch in batches:
            images = torch.rand(batch, 3, SIDE, SIDE)
            encode(images)
            seconds = (
                float(np.median([timed(partial(encode, images))[0] for _ in range(repeats)])) / 1e3 / batch
            )
            rows.append({"precision": name, "batch": batch, "image_seconds": seconds, "cosine": cosine})
            print(f"{name:22} {batch:5} {seconds:8.3f} {cosine:8.5f}", flush=True)
    return rows


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--precisions", action="store_true")
    parser.add_argument("--batches", type=int, nargs="+", default=[8])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.precisions:
        rows = run_precisions(options.threads, options.batches, options.repeats)
        return write_record(options.json, rows, threads=options.threads)
    print(f"{options.threads} threads")
    write_record(options.json, run_encoders(options.repeats), threads=options.threads)


if __name__ == "__main__":
    main()
