"""Measuring a scene on its held-out views: images, language, speed and size, as in the paper's Table 1.

Nothing is chosen on the views it is reported on. Three thresholds are reported side by side: ``fixed`` (0.5, the
paper), ``auto`` (per prompt, that of `lexsplat.scenes.scene.Scene.ask`, from training views) and ``oracle`` (per
prompt, the best one for the ground truth: an upper bound, never a result).

Relevancy is rendered at the size of the ground truth, so that neither is resized. Only for masks larger than
``max_pixels`` is the map rendered at the working size and enlarged. The official protocol renders at the working
size and resizes the ground truth, as the authors do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.captures.ground_truth.layouts import Annotations, load_annotations, load_ground_truth
from lexsplat.evaluation.ground_truth import warn_of_odd_masks
from lexsplat.evaluation.memory import peak_gpu_memory, peak_memory
from lexsplat.evaluation.methods import MethodScene
from lexsplat.evaluation.metrics import (
    THRESHOLDS,
    Perceptual,
    average_precision,
    load_lpips,
    localization,
    mask_scores,
    psnr,
    resize_scores,
    ssim,
    threshold_counts,
)
from lexsplat.evaluation.protocols import PROTOCOLS, lerf_2d_scores, official_scores, silhouette_iou
from lexsplat.evaluation.results import Metrics, PairResult, ViewImages
from lexsplat.evaluation.summary import mean_of, precision_curves, summarize_kinds, summarize_language
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.scoring import form_used
from lexsplat.rendering import render
from lexsplat.runtime.device import kernel_threads
from lexsplat.runtime.progress import Event, Listener, silent
from lexsplat.runtime.sampling import evenly
from lexsplat.scenes.scene import Scene

if TYPE_CHECKING:
    from lexsplat.captures import Capture, View


@dataclass(frozen=True)
class EvaluationConfig:
    """Settings of an evaluation.

    Args:
        timing_views: Held-out views on which speed is measured, at most.
        max_pixels: Largest rendering at the size of the ground truth, in pixels.
        lpips: Whether to measure LPIPS, if it is installed.
        protocols: Names out of `PROTOCOLS`; "strict" is always measured.
    """

    timing_views: int = 4
    max_pixels: int = 2_000_000
    lpips: bool = True
    protocols: tuple[str, ...] = PROTOCOLS

    def __post_init__(self) -> None:
        unknown = set(self.protocols) - set(PROTOCOLS)
        if unknown:
            raise ValueError(f"protocols are {', '.join(PROTOCOLS)}, got {', '.join(sorted(unknown))}")
        if min(self.timing_views, self.max_pixels) < 1:
            raise ValueError("timing_views and max_pixels must be positive")


def evaluate(
    capture: Capture,
    scene: Scene | MethodScene,
    config: EvaluationConfig | None = None,
    *,
    ground_truth: Annotations | None = None,
    prompt_kinds: Mapping[str, str] | None = None,
    observer: Callable[[ViewImages], None] | None = None,
    listener: Listener = silent,
) -> Metrics:
    """Measure a scene on its held-out views, with one view in memory at a time.

    Args:
        capture: Photos, cameras and the split.
        scene: Scene to measure; the fixed threshold is that of its ``query``.
        config: Settings.
        ground_truth: Annotations that the language is measured against; None takes those of the capture
            (`lexsplat.captures.load_annotations`). Masks of training views are ignored. Where there are no boxes for
            LangSplat's localization, those of the masks stand in.
        prompt_kinds: Kind of each prompt ("name", "color", "part", ...); adds the numbers of each kind.
        observer: Receives the images of each held-out view once, for reports.
        listener: Receives progress events.

    Returns:
        What was measured; `Metrics.with_facts` adds what is known of build and machine.
    """
    config, ground_truth = config or EvaluationConfig(), ground_truth or load_annotations(capture)
    listener(Event("evaluate", 0, len(capture.test_names)))
    run = _Evaluation(capture, scene, config, ground_truth)
    quality = run.run(observer, listener)
    words = summarize_language(run.pairs, run.thresholds)
    if words is not None:
        # Rebuilt methods compare features with the text, whatever form is asked for.
        form = form_used(scene.field, scene.query) if isinstance(scene, Scene) else "feature"
        words = {"form": form, "method": scene.field.method, **words}
        words["per_kind"] = summarize_kinds(run.pairs, run.thresholds, prompt_kinds or {})
    return Metrics(
        quality=quality,
        language=words,
        speed={**run.speed(), "stage_seconds": {}},
        size={
            "gaussians": len(scene.gaussians),
            "language_bytes": sum(tensor.nbytes for tensor in scene.field.tensors().values()),
            "gaussian_bytes": sum(tensor.nbytes for tensor in scene.gaussians.tensors().values()),
            "peak_rss_bytes": peak_memory(),
            "peak_gpu_bytes": peak_gpu_memory(scene.gaussians.device),
        },
        config={"evaluation": {"query": asdict(scene.query), **asdict(config)}},
        curves=precision_curves(run.pairs),
        thresholds=run.thresholds,
        pairs=run.pairs,
    )


class _Evaluation:
    """One pass over the held-out views; keeps numbers, no images."""

    def __init__(
        self,
        capture: Capture,
        scene: Scene | MethodScene,
        config: EvaluationConfig,
        ground_truth: Annotations,
    ) -> None:
        self.capture, self.scene, self.config = capture, scene, config
        masks, self.boxes = ground_truth.masks, ground_truth.boxes
        self.views: list[View] = [capture.views[name] for name in capture.test_names]
        self.masks = {view.name: masks[view.name] for view in self.views if masks.get(view.name)}
        warn_of_odd_masks(ground_truth, self.views)
        self.prompts = sorted({prompt for prompts in self.masks.values() for prompt in prompts})
        self.selected: dict[str, Gaussians] = {}
        self.thresholds: dict[str, dict[str, float]] = {}
        self.pairs: dict[str, dict[str, PairResult]] = {}
        if not self.prompts:
            return
        answers = scene.ask(self.prompts)
        for prompt, value in zip(self.prompts, answers.thresholds.tolist()):
            self.thresholds[prompt] = {"auto": value, "fixed": scene.query.threshold}
        if "lerf-3d" in config.protocols and answers.scores is not None:
            for number, prompt in enumerate(self.prompts):
                self.selected[prompt] = scene.gaussians.select(answers.chosen(number))

    def run(self, observer: Callable[[ViewImages], None] | None, listener: Listener) -> dict[str, Any]:
        """Render and score every held-out view; returns the quality section."""
        perceptual: Perceptual | None = None
        reason: str | None = "switched off" if self.views else "no held-out views"
        if self.config.lpips and self.views:
            perceptual, reason = load_lpips(str(self.scene.gaussians.device))
        per_view: dict[str, dict[str, float | None]] = {}
        for done, view in enumerate(self.views, start=1):
            photo, image = view.load_image(), self._render_image(view.camera)
            valid = view.load_valid()
            if valid is not None:  # masked pixels are copied from the photo and not counted below
                image = np.where(valid[..., None], image, photo)
            counted = 1.0 if valid is None else max(float(valid.mean()), 1e-6)
            structure = ssim(image, photo) if min(image.shape[:2]) >= 11 else None
            per_view[view.name] = {
                "psnr": psnr(image, photo) if valid is None else psnr(image[valid], photo[valid]),
                "ssim": None if structure is None else 1 - (1 - structure) / counted,
                "lpips": perceptual(image, photo) if perceptual else None,
            }
            relevancy, ground_truth = self._score_language(view)
            if observer is not None:
                automatic = {prompt: self.thresholds[prompt]["auto"] for prompt in ground_truth}
                observer(ViewImages(view.name, photo, image, relevancy, ground_truth, automatic))
            so_far = mean_of([each["psnr"] for each in per_view.values()]) or 0.0
            listener(Event("evaluate", done, len(self.views), {"psnr": so_far}))
        for prompt in self.prompts:
            curves = [prompts[prompt].counts.iou for prompts in self.pairs.values() if prompt in prompts]
            self.thresholds[prompt]["oracle"] = float(THRESHOLDS[np.argmax(np.mean(curves, axis=0))])
        names = ("psnr", "ssim", "lpips")
        quality: dict[str, Any] = {
            name: mean_of([scores[name] for scores in per_view.values()]) for name in names
        }
        return quality | ({} if perceptual else {"lpips_reason": reason}) | {"per_view": per_view}

    @torch.no_grad()
    def _render_image(self, camera: Camera) -> NDArray[np.float32]:
        gaussians = self.scene.gaussians
        background = torch.tensor(self.capture.background, dtype=torch.float32, device=gaussians.device)
        return render(gaussians, camera, background=background).image.clamp(0, 1).cpu().numpy()

    def _relevancy(self, camera: Camera, prompts: Sequence[str]) -> dict[str, NDArray[np.float32]]:
        return dict(zip(prompts, self.scene.relevancy(prompts, camera).cpu().numpy()))

    def _score_language(
        self, view: View
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, NDArray[np.bool_]]]:
        """The maps and the ground truth of a view by prompt, both at the size of the ground truth."""
        sources = sorted(self.masks.get(view.name, {}).items())
        ground_truth = {prompt: load_ground_truth(view, source) for prompt, source in sources}
        if not ground_truth:
            return {}, {}
        working = self._relevancy(view.camera, list(ground_truth))
        relevancy: dict[str, NDArray[np.float32]] = {}
        for size in sorted({mask.shape for mask in ground_truth.values()}):
            prompts = [prompt for prompt, mask in ground_truth.items() if mask.shape == size]
            relevancy |= self._at_size(view.camera, size, {prompt: working[prompt] for prompt in prompts})

        silhouettes = {
            prompt: self._silhouette(view.camera, prompt, mask)
            for prompt, mask in ground_truth.items()
            if prompt in self.selected
        }

        def measured(prompt: str) -> PairResult:
            found, mask, thresholds = relevancy[prompt], ground_truth[prompt], self.thresholds[prompt]
            boxes, asked = self.boxes.get(view.name, {}).get(prompt), self.config.protocols
            return PairResult(
                threshold_counts(found, mask),
                mask_scores(found >= thresholds["auto"], mask),
                average_precision(found, mask),
                localization(found, mask),
                official_scores(working[prompt], mask, thresholds["fixed"]) if "official" in asked else None,
                lerf_2d_scores(found, mask, boxes) if "lerf-2d" in asked and mask.any() else None,
                silhouettes.get(prompt),
            )

        with ThreadPoolExecutor(kernel_threads()) as pool:  # counting and sorting release the GIL
            self.pairs[view.name] = dict(zip(ground_truth, pool.map(measured, ground_truth)))
        return relevancy, ground_truth

    @torch.no_grad()
    def _silhouette(self, camera: Camera, prompt: str, mask: NDArray[np.bool_]) -> float:
        """IoU of the Gaussians selected for a prompt, rendered alone."""
        height, width = mask.shape
        if height * width <= self.config.max_pixels:
            camera = camera.resized(width, height)
        alpha = np.zeros((camera.height, camera.width), np.float32)
        if len(self.selected[prompt]):
            alpha = render(self.selected[prompt], camera).alpha.cpu().numpy()
        return silhouette_iou(resize_scores(alpha, width, height), mask)

    def _at_size(
        self, camera: Camera, size: tuple[int, ...], working: dict[str, NDArray[np.float32]]
    ) -> dict[str, NDArray[np.float32]]:
        height, width = size
        if (camera.height, camera.width) == size:
            return working
        if height * width <= self.config.max_pixels:
            return self._relevancy(camera.resized(width, height), list(working))
        return {prompt: resize_scores(values, width, height) for prompt, values in working.items()}

    def speed(self) -> dict[str, float | None]:
        """Mean times over a few held-out views after one warm-up."""
        cameras = [view.camera for view in evenly(self.views, self.config.timing_views)]
        if not cameras:
            return {"render_fps": None, "rgb_fps": None, "query_ms": None}
        rgb = self._seconds(self._render_image, cameras)
        if not self.prompts:
            return {"render_fps": None, "rgb_fps": 1 / rgb, "query_ms": None}
        one = self._seconds(lambda camera: self._relevancy(camera, self.prompts[:1]), cameras)
        every = self._seconds(lambda camera: self._relevancy(camera, self.prompts), cameras)
        query_ms = 1e3 * every / len(self.prompts)
        return {"render_fps": 1 / (rgb + one), "rgb_fps": 1 / rgb, "query_ms": query_ms}

    def _seconds(self, work: Callable[[Camera], object], cameras: Sequence[Camera]) -> float:
        # Results are copied to the CPU, so the device has finished when the work returns.
        work(cameras[0])
        start = time.perf_counter()
        for camera in cameras:
            work(camera)
        return max(time.perf_counter() - start, 1e-9) / len(cameras)
