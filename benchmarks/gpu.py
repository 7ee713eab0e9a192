"""Rendering and training speed on a GPU at the paper's resolution.

    python benchmarks/gpu.py                                       # 0.3, 1 and 3 million Gaussians, 1297x840
    python benchmarks/gpu.py --scene SCENE                         # also a scene of your own, at its size
    python benchmarks/gpu.py --device cpu --counts 20000 --size 320x240    # on a CPU

Synthetic scenes are three shells of Gaussians (`render.three_shells`) with four random codes each. Printed for each:

    rgb         frames per second of color
    prompt      frames per second of color and the relevancy of one prompt in one pass: the scores of the Gaussians
                are blended (`code` form) and computed for each frame, as if each frame had another prompt
    paper       frames per second of color, s and u in one pass, then the paper's decoder and relevancy per pixel
    training    iterations per second: render, L1 + D-SSIM, gradients, Adam on all parameters; no density control
    memory      peak memory in MiB (of the device; of the process on a CPU)

Each frame has another camera on a circle, so no projection is reused.
"""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from records import argument_parser, write_record
from render import three_shells

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import CodeField, LanguageField, TrainedField
from lexsplat.queries.relevancy import Question, code_relevancy, probability_relevancy
from lexsplat.reconstruction.image_losses import photometric_loss, ssim_target
from lexsplat.reconstruction.optimizers import adam
from lexsplat.rendering import render

CODES, DIMENSION = 128, 512


def cameras_around(count: int, width: int, height: int) -> list[Camera]:
    """Cameras on a circle of radius 3.2 around the origin."""
    angles = np.arange(count) * 2 * math.pi / count
    eyes = [np.array([3.2 * math.sin(a), -0.4, -3.2 * math.cos(a)]) for a in angles]
    up = np.array([0.0, -1.0, 0.0])
    return [look_at(eye, np.zeros(3), up, width, height, 2 * math.atan(120 / 280)) for eye in eyes]


def random_fields(gaussians: Gaussians) -> tuple[CodeField, TrainedField]:
    """Random language fields of realistic size."""
    generator = torch.Generator().manual_seed(0)
    unit = torch.nn.functional.normalize(torch.randn(CODES, DIMENSION, generator=generator), dim=-1)
    codebook = Codebook(unit.to(gaussians.device))
    count = len(gaussians)
    codes = torch.randint(0, CODES, (count, 4), generator=generator).byte().to(gaussians.device)
    weights = torch.rand(count, 4, generator=generator).to(gaussians.device)
    uncertain = torch.zeros(count, device=gaussians.device)
    lifted = CodeField(codebook, codes, weights / weights.sum(1, keepdim=True), uncertain)
    return lifted, TrainedField.initial(gaussians, codebook, generator=generator)


def frames_per_second(draw: Callable[[Camera], object], cameras: Sequence[Camera], seconds: float) -> float:
    """Frame rate after a warm-up, with the device synchronized at the end."""

    def wait() -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()

    with torch.no_grad():
        for camera in cameras[:3]:
            draw(camera)
        wait()
        start, frames = time.perf_counter(), 0
        while time.perf_counter() - start < seconds:
            for camera in cameras:
                draw(camera)
            frames += len(cameras)
            wait()
        return frames / (time.perf_counter() - start)


def draw_prompt(gaussians: Gaussians, field: LanguageField, camera: Camera, texts: Sequence[torch.Tensor]):
    """Color and relevancy of one prompt, in one pass ``[H, W, 4]``."""
    table = code_relevancy(field.codebook.clip, Question(*texts))
    return render(gaussians, camera, features=field.scores(table)).channels


def draw_as_the_paper(
    gaussians: Gaussians, field: TrainedField, camera: Camera, texts: Sequence[torch.Tensor]
):
    """Color, s and u in one pass, then decoder and relevancy at every pixel."""
    carried = torch.cat([field.semantics, field.uncertainties[:, None]], 1)
    rendering = render(gaussians, camera, features=carried)
    probabilities = field.decoder(rendering.features[..., :8]).softmax(-1)
    return probability_relevancy(probabilities, field.codebook.clip, Question(*texts))


def iterations_per_second(gaussians: Gaussians, cameras: Sequence[Camera], seconds: float) -> float:
    """Photometric training on darkened renderings of the Gaussians themselves."""
    with torch.no_grad():
        targets = [ssim_target(0.8 * render(gaussians, camera).image) for camera in cameras]
    leaves = gaussians.map(lambda tensor: torch.nn.Parameter(tensor.detach().clone()))
    optimizers = [adam(leaf, 1e-4) for leaf in leaves.tensors().values()]
    by_camera = {id(camera): target for camera, target in zip(cameras, targets)}

    def iterate(camera: Camera) -> None:
        with torch.enable_grad():
            image = render(leaves, camera).image
            photometric_loss(image, by_camera[id(camera)]).backward()
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad()

    return frames_per_second(iterate, cameras, seconds)


def measure(gaussians: Gaussians, cameras: Sequence[Camera], seconds: float) -> dict[str, float]:
    """All rates of one scene."""
    device = gaussians.device
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    generator = torch.Generator().manual_seed(1)
    texts = [
        torch.nn.functional.normalize(torch.randn(n, DIMENSION, generator=generator), dim=-1).to(device)
        for n in (1, 4)
    ]
    lifted, trained = random_fields(gaussians)
    rates = {
        "rgb": frames_per_second(lambda c: render(gaussians, c).image, cameras, seconds),
        "prompt": frames_per_second(lambda c: draw_prompt(gaussians, lifted, c, texts), cameras, seconds),
        "paper": frames_per_second(
            lambda c: draw_as_the_paper(gaussians, trained, c, texts), cameras, seconds
        ),
        "training": iterations_per_second(gaussians, cameras[:3], seconds),
    }
    if device.type == "cuda":
        rates["memory"] = torch.cuda.max_memory_allocated() / 2**20
    else:
        rates["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {name: round(value, 1) for name, value in rates.items()}


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--counts", type=int, nargs="*", default=[300_000, 1_000_000, 3_000_000])
    parser.add_argument("--size", default="1297x840", help="of the synthetic scenes")
    parser.add_argument("--scene", type=Path, nargs="*", default=[], help="scene folders to measure as well")
    parser.add_argument("--seconds", type=float, default=3.0, help="duration of each measurement")
    options = parser.parse_args()
    if options.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("no CUDA device; use --device cpu")
    width, height = map(int, options.size.split("x"))
    cases = [(f"synthetic {n:,}", three_shells(n), cameras_around(24, width, height)) for n in options.counts]
    for folder in options.scene:
        from lexsplat import open_scene

        scene = open_scene(folder, device="cpu")
        cases.append((folder.name, scene.gaussians, list(scene.cameras.values())[:24]))
    device = (
        torch.cuda.get_device_name()
        if options.device == "cuda"
        else f"CPU, {torch.get_num_threads()} threads"
    )
    print(f"{device}, torch {torch.__version__}")
    heads = {"gaussians": 10, "size": 10, "rgb": 8, "prompt": 8, "paper": 8, "training": 9, "memory": 8}
    print(f"{'scene':>22}", *(f"{head:>{room}}" for head, room in heads.items()))
    rows = []
    for title, gaussians, cameras in cases:
        rates = measure(gaussians.to(options.device), cameras, options.seconds)
        size = f"{cameras[0].width}x{cameras[0].height}"
        rows.append({"scene": title, "gaussians": len(gaussians), "size": size, **rates})
        print(f"{title:>22}", *(f"{rows[-1][head]:>{room}}" for head, room in heads.items()), flush=True)
    write_record(options.json, rows, device=device)


if __name__ == "__main__":
    main()
