"""Image encoders against matrix products of the same sizes: milliseconds and operations of an image and of a photo.

    python benchmarks/features.py [--threads 1] [--repeats 9] [--json FILE]
    python benchmarks/features.py --precisions [--batches 8 64] [--repeats 3]

Encoders: the bundled CLIP, and the image tower of a ViT-B/16 with random weights.

    products    time of only the matrix products of the forward pass, by torch on contiguous matrices of the same
                sizes: what the processor reaches
    share       products / forward: 1 would be an encoder that does nothing but matrix products at full speed
    crops       crops of a photo of the demo with its settings; "photo" is the time and operations of all of them

``--precisions`` runs the ViT-B/16 in float32, in bfloat16 as lexsplat does (autocast) and with its weights in
bfloat16, in 8-bit integers (torch's dynamic quantization), and in ONNX Runtime in float32 and in 8-bit integers where
the packages ``onnx``, ``onnxscript`` and ``onnxruntime`` are installed. "cosine" is the lowest of its embeddings of
bundled images with those in float32; weights are random, so it says nothing about published weights.

Forward passes and products alternate; times are medians of processor time, which other programs hardly disturb.
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
from typing import Any

import numpy as np
import torch
from records import argument_parser, write_record
from torch import Tensor
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode

from lexsplat.captures import load_capture
from lexsplat.evaluation.demo import demo_capture
from lexsplat.features import FeatureConfig
from lexsplat.features.checks import bundled_images
from lexsplat.features.clip_image import ClipImages
from lexsplat.features.encoders import load_clip
from lexsplat.features.extraction import encoded_size
from lexsplat.features.pyramid import grid_levels, unique_boxes

aten = torch.ops.aten
SIDE = 224
"""Pixels along a side of the ViT-B/16's input."""
Encode = Callable[[Tensor], Tensor]


class Products(TorchDispatchMode):
    """Counts the matrix products of a computation by their sizes (batch, rows, inner, columns)."""

    def __init__(self) -> None:
        super().__init__()
        self.sizes: Counter[tuple[int, int, int, int]] = Counter()

    def __torch_dispatch__(self, function, kinds, arguments=(), options=None):  # type: ignore[no-untyped-def]
        result = function(*arguments, **(options or {}))
        name = function.overloadpacket
        if name in (aten.mm, aten.addmm, aten.bmm, aten.baddbmm, aten.matmul):
            left, right = [a for a in arguments if isinstance(a, Tensor)][-2:]
            self.sizes[math.prod(left.shape[:-2]), left.shape[-2], left.shape[-1], right.shape[-1]] += 1
        elif name is aten.linear:
            rows, weight = arguments[0].numel() // arguments[0].shape[-1], arguments[1]
            self.sizes[1, rows, weight.shape[1], weight.shape[0]] += 1
        elif name in (aten.convolution, aten.conv2d):
            weight = arguments[1]
            pixels = result.numel() // weight.shape[0]
            self.sizes[1, pixels, math.prod(weight.shape[1:]), weight.shape[0]] += 1
        elif "scaled_dot_product" in str(name):
            query, key = arguments[:2]
            batch, (rows, inner), columns = math.prod(query.shape[:-2]), query.shape[-2:], key.shape[-2]
            self.sizes[batch, rows, inner, columns] += 1
            self.sizes[batch, rows, columns, inner] += 1
        return result


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


def crops_of_a_photo() -> int:
    capture, config = load_capture(demo_capture("tabletop")), FeatureConfig.bundled()
    size = encoded_size(next(iter(capture.views.values())).capture_size, config)
    return len(unique_boxes(grid_levels(*size, config.crop_sizes, config.crop_strides))[0])


def timed(function: Callable[[], object]) -> float:
    start = time.process_time()
    function()
    return 1e3 * (time.process_time() - start)


@torch.inference_mode()
def run_case(name: str, encode: Encode, side: int, batch: int, repeats: int) -> dict[str, float]:
    images = torch.rand(batch, 3, side, side)
    encode(images)  # the first call also tries which precision is faster
    with Products() as products:
        encode(images)
    sizes = products.sizes
    matrices = {size: (torch.rand(size[:3]), torch.rand(size[0], size[2], size[3])) for size in sizes}

    def multiply() -> None:
        for size, count in sizes.items():
            left, right = matrices[size]
            for _ in range(count):
                left[0] @ right[0] if size[0] == 1 else torch.bmm(left, right)

    multiply()
    times = np.array([(timed(lambda: encode(images)), timed(multiply)) for _ in range(repeats)])
    forward, alone = np.median(times, 0)
    operations = sum(2 * math.prod(size) * count for size, count in sizes.items())
    return {
        "encoder": name, "batch": batch, "image_ms": forward / batch, "image_gflop": operations / batch / 1e9,
        "gflops": operations / forward / 1e6, "products_gflops": operations / alone / 1e6, "share": alone / forward,
    }  # fmt: skip


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
            seconds = float(np.median([timed(partial(encode, images)) for _ in range(repeats)])) / 1e3 / batch
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
    clip, vision, crops = load_clip("bundled"), vit_b16_tower(), crops_of_a_photo()
    cases = (
        ("bundled", clip.encode_images, clip.image_size, 64),
        ("ViT-B/16", lambda images: vision(images, patches=False), SIDE, 8),
    )
    print(f"{options.threads} threads, {crops} crops in a photo")
    print(
        f"{'encoder':10} {'ms/image':>9} {'GFLOP':>7} {'GFLOP/s':>8} {'products':>9} {'share':>6} {'s/photo':>8}"
    )
    rows = []
    for case in cases:
        row = run_case(*case, options.repeats)
        row["photo_seconds"] = crops * row["image_ms"] / 1e3
        rows.append(row)
        print(
            f"{row['encoder']:10} {row['image_ms']:9.2f} {row['image_gflop']:7.3f} {row['gflops']:8.1f}"
            f" {row['products_gflops']:9.1f} {row['share']:6.2f} {row['photo_seconds']:8.2f}",
            flush=True,
        )
    write_record(options.json, rows, threads=options.threads, crops=crops)


if __name__ == "__main__":
    main()
