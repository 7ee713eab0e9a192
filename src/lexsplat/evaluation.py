"""How good a scene is on its held-out views: pictures, words, speed and size, as in the paper's Table 1.

Nothing is chosen on the views it is reported on. Three thresholds stand side by side: ``fixed`` (0.5, the
paper), ``auto`` (per prompt, from renderings of training views, `queries.scene_threshold`) and ``oracle``
(per prompt, the best one for the truth: an upper bound, never a result).

Relevancy is rendered at the size of the truth, so that neither has to be resized; only masks larger than
``max_pixels`` are met by a map rendered at the working size and enlarged. The official protocol renders at
the working size and resizes the truth, as the authors do.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.cameras import Camera
from lexsplat.gaussians import Gaussians
from lexsplat.metrics import (
    THRESHOLDS,
    MaskScores,
    OfficialScores,
    Perceptual,
    ThresholdCounts,
    average_precision,
    interpolated_precision,
    load_lpips,
    localization,
    mean_over_images,
    official_scores,
    psnr,
    resize_scores,
    ssim,
    threshold_counts,
)
from lexsplat.progress import Event, Listener, silent
from lexsplat.queries import QueryConfig, TextEncoder, embed_prompts, render_relevancy, scene_threshold

if TYPE_CHECKING:
    from lexsplat.language_field import LanguageField
    from lexsplat.scenes import Scene, View

THRESHOLD_KINDS = ("auto", "fixed", "oracle")


@dataclass(frozen=True)
class EvaluationConfig:
    """What is measured and how.

    Args:
        query: How text is compared with the scene; its ``threshold`` is the fixed one.
        threshold_views: Training views rendered for the automatic thresholds, at most.
        timing_views: Held-out views on which speed is measured, at most.
        max_pixels: Largest rendering for the truth's sake, in pixels.
        lpips: Whether to measure LPIPS if it is installed.
    """

    query: QueryConfig = field(default_factory=QueryConfig)
    threshold_views: int = 8
    timing_views: int = 4
    max_pixels: int = 2_000_000
    lpips: bool = True

    def __post_init__(self) -> None:
        if min(self.threshold_views, self.timing_views, self.max_pixels) < 1:
            raise ValueError("threshold_views, timing_views and max_pixels must be positive")


@dataclass(frozen=True)
class PairResult:
    """One prompt in one view.

    Args:
        counts: What the map finds at every threshold; ``counts.at(threshold)`` has IoU, accuracy, precision.
        average_precision: Strict, in 0..1; NaN when the truth is empty.
        localization: 1 if the highest relevancy lies on the object; NaN when the truth is empty.
        official: The authors' protocol.
    """

    counts: ThresholdCounts
    average_precision: float
    localization: float
    official: OfficialScores


@dataclass(frozen=True)
class ViewPictures:
    """What an observer sees of a view before it is forgotten; arrays must not be changed.

    Args:
        name: The view.
        photo: ``[H, W, 3]`` in 0..1, at the working size.
        image: The rendering, same shape.
        relevancy: ``[h, w]`` in 0..1 by prompt, at the size of the truth.
        truth: Boolean ``[h, w]`` by prompt.
        thresholds: The automatic threshold by prompt.
    """

    name: str
    photo: NDArray[np.float32]
    image: NDArray[np.float32]
    relevancy: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    truth: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    thresholds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Metrics:
    """Everything measured. The first six are the sections of ``metrics.json``.

    Args:
        quality: "psnr", "ssim", "lpips" (or None with "lpips_reason"), "per_view".
        language: "strict", "official", "per_prompt", "per_view", "form"; None for a scene without masks.
        speed: "render_fps" (a view in colour with one prompt's map), "rgb_fps", "query_ms" (a prompt's map in
            a view, language rendered anew), "stage_seconds".
        size: "gaussians", "language_bytes", "gaussian_bytes", "peak_rss_bytes", "peak_gpu_bytes".
        config: Settings.
        machine: What it ran on.
        curves: Interpolated precision at the 101 recalls by prompt, pixels of all views together.
        thresholds: ``{prompt: {kind: threshold}}``.
        pairs: ``{view: {prompt: PairResult}}``.
    """

    quality: dict[str, Any]
    language: dict[str, Any] | None
    speed: dict[str, Any]
    size: dict[str, Any]
    config: dict[str, Any]
    machine: dict[str, Any]
    curves: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    thresholds: dict[str, dict[str, float]] = field(default_factory=dict)
    pairs: dict[str, dict[str, PairResult]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The content of ``metrics.json``: plain types, 6 digits, None for what is not finite."""
        names = ("quality", "language", "speed", "size", "config", "machine")
        return {name: _plain(getattr(self, name)) for name in names}


Masks = Mapping[str, Mapping[str, "Path | NDArray[np.bool_]"]]
"""Truth by view and prompt: files or boolean arrays ``[H, W]``."""


def evaluate(
    scene: Scene,
    gaussians: Gaussians,
    language: LanguageField | None,
    encode_text: TextEncoder | None,
    config: EvaluationConfig | None = None,
    *,
    masks: Masks | None = None,
    observer: Callable[[ViewPictures], None] | None = None,
    listener: Listener = silent,
    stage_seconds: Mapping[str, float] | None = None,
    stored_bytes: Mapping[str, int] | None = None,
    settings: Mapping[str, Any] | None = None,
    machine: Mapping[str, Any] | None = None,
    prompt_kinds: Mapping[str, str] | None = None,
) -> Metrics:
    """Measure a scene on its held-out views, one view in memory at a time.

    Args:
        scene: Photos, cameras and the split.
        gaussians: The reconstruction.
        language: Its language; None measures pictures only.
        encode_text: Texts to embeddings; needed where there are masks.
        config: What is measured.
        masks: Truth by view and prompt; None takes ``segmentations/`` of the capture. Views of the training
            split are left out.
        observer: Called once for each held-out view, for reports.
        listener: Told how far it is.
        stage_seconds: Time of each stage of the build, passed through.
        stored_bytes: "language_bytes" and "gaussian_bytes" on disk; else the size of the tensors.
        settings: Settings of the build, passed through.
        machine: Passed through.
        prompt_kinds: What kind of question a prompt is ("name", "colour", "part", ...); the numbers are then also
            given for each kind.

    Raises:
        ValueError: If there are masks and a language but no ``encode_text``.
    """
    config = config or EvaluationConfig()
    if masks is None:
        from lexsplat.scenes import load_masks

        masks = load_masks(scene)
    run = _Evaluation(scene, gaussians, language, config, masks)
    if run.prompts:
        run.embed(encode_text)
    quality = run.run(observer, listener)
    words = summarize_language(run.pairs, run.thresholds)
    if words is not None and language is not None:
        words = {"form": config.query.form, "method": language.method, **words}
        words["per_kind"] = summarize_kinds(run.pairs, run.thresholds, prompt_kinds or {})
    return Metrics(
        quality=quality,
        language=words,
        speed={**run.speed(), "stage_seconds": dict(stage_seconds or {})},
        size=_sizes(gaussians, language, stored_bytes or {}),
        config={"evaluation": asdict(config), **dict(settings or {})},
        machine=dict(machine or {}),
        curves=precision_curves(run.pairs),
        thresholds=run.thresholds,
        pairs=run.pairs,
    )


class _Evaluation:
    """One pass over the held-out views. Keeps numbers, no pictures."""

    def __init__(
        self,
        scene: Scene,
        gaussians: Gaussians,
        language: LanguageField | None,
        config: EvaluationConfig,
        masks: Masks,
    ) -> None:
        self.scene, self.gaussians, self.language, self.config = scene, gaussians, language, config
        self.views: list[View] = [scene.views[name] for name in scene.test_names]
        self.masks = {view.name: masks[view.name] for view in self.views if language and masks.get(view.name)}
        self.prompts = sorted({prompt for prompts in self.masks.values() for prompt in prompts})
        self.texts: dict[str, Tensor] = {}
        self.negatives = torch.empty(0)
        self.thresholds: dict[str, dict[str, float]] = {}
        self.pictures: dict[str, dict[str, float | None]] = {}
        self.pairs: dict[str, dict[str, PairResult]] = {}

    def embed(self, encode_text: TextEncoder | None) -> None:
        """Embed the prompts and choose what can be chosen without the truth."""
        if encode_text is None or self.language is None:
            raise ValueError("a scene with masks and language needs encode_text")
        query = self.config.query
        embeddings = embed_prompts(self.prompts, encode_text, query.templates)
        self.texts = dict(zip(self.prompts, embeddings))
        self.negatives = embed_prompts(query.negatives, encode_text, query.templates)
        views = [self.scene.views[name] for name in self.scene.train_names] or self.views
        cameras = [view.camera for view in _spread(views, self.config.threshold_views)]
        found = scene_threshold(self.language, self.gaussians, cameras, embeddings, self.negatives, query)
        for prompt, value in zip(self.prompts, found.tolist()):
            self.thresholds[prompt] = {"auto": round(value, 3), "fixed": query.threshold}

    def run(self, observer: Callable[[ViewPictures], None] | None, listener: Listener) -> dict[str, Any]:
        """Render and score every held-out view; returns the quality section."""
        perceptual: Perceptual | None = None
        reason: str | None = "switched off" if self.views else "no held-out views"
        if self.config.lpips and self.views:
            perceptual, reason = load_lpips(str(self.gaussians.device))
        for done, view in enumerate(self.views, start=1):
            photo, image = view.load_image(), self._render_image(view.camera)
            scores: dict[str, float | None] = {
                "psnr": psnr(image, photo),
                "ssim": ssim(image, photo) if min(image.shape[:2]) >= 11 else None,
                "lpips": perceptual(image, photo) if perceptual else None,
            }
            self.pictures[view.name] = scores
            relevancy, truth = self._score_language(view)
            if observer is not None:
                automatic = {prompt: self.thresholds[prompt]["auto"] for prompt in truth}
                observer(ViewPictures(view.name, photo, image, relevancy, truth, automatic))
            listener(Event("evaluate", done, len(self.views), {"psnr": scores["psnr"] or 0.0}))
        for prompt in self.prompts:
            curves = [prompts[prompt].counts.iou for prompts in self.pairs.values() if prompt in prompts]
            self.thresholds[prompt]["oracle"] = float(THRESHOLDS[np.argmax(np.mean(curves, axis=0))])
        quality: dict[str, Any] = {
            name: _mean([scores[name] for scores in self.pictures.values()])
            for name in ("psnr", "ssim", "lpips")
        }
        return quality | ({} if perceptual else {"lpips_reason": reason}) | {"per_view": self.pictures}

    def _render_image(self, camera: Camera) -> NDArray[np.float32]:
        from lexsplat.rendering import render

        device = self.gaussians.device
        background = torch.tensor(self.scene.background, dtype=torch.float32, device=device)
        with torch.no_grad():
            image = render(self.gaussians, camera, background=background).image
        return image.clamp(0, 1).cpu().numpy()

    def _relevancy(self, camera: Camera, prompts: Sequence[str]) -> dict[str, NDArray[np.float32]]:
        positives, query = torch.stack([self.texts[prompt] for prompt in prompts]), self.config.query
        if self.language is None:
            raise ValueError("this scene has no language")
        maps = render_relevancy(self.language, self.gaussians, camera, positives, self.negatives, query)
        return dict(zip(prompts, maps.cpu().numpy()))

    def _score_language(
        self, view: View
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, NDArray[np.bool_]]]:
        sources = sorted(self.masks.get(view.name, {}).items())
        truth = {prompt: _mask(view, source) for prompt, source in sources}
        if not truth:
            return {}, {}
        working = self._relevancy(view.camera, list(truth))
        relevancy: dict[str, NDArray[np.float32]] = {}
        for size in sorted({mask.shape for mask in truth.values()}):
            prompts = [prompt for prompt, mask in truth.items() if mask.shape == size]
            relevancy |= self._at_size(view.camera, size, {prompt: working[prompt] for prompt in prompts})
        self.pairs[view.name] = {
            prompt: PairResult(
                threshold_counts(relevancy[prompt], mask),
                average_precision(relevancy[prompt], mask),
                localization(relevancy[prompt], mask),
                official_scores(working[prompt], mask, self.config.query.threshold),
            )
            for prompt, mask in truth.items()
        }
        return relevancy, truth

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
        cameras = [view.camera for view in _spread(self.views, self.config.timing_views)]
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
        # What was rendered comes back to the CPU, so the device is done when the work returns.
        work(cameras[0])
        start = time.perf_counter()
        for camera in cameras:
            work(camera)
        return max(time.perf_counter() - start, 1e-9) / len(cameras)


Pairs = Mapping[str, Mapping[str, PairResult]]


def summarize_language(pairs: Pairs, thresholds: Mapping[str, Mapping[str, float]]) -> dict[str, Any] | None:
    """Means as ``metrics.json`` holds them: prompts averaged within a view, then views; None without pairs.

    Args:
        pairs: ``{view: {prompt: result}}``.
        thresholds: ``{prompt: {kind: threshold}}`` for every kind of `THRESHOLD_KINDS`.
    """
    if not pairs:
        return None

    def masks(kind: str) -> dict[str, dict[str, MaskScores]]:
        return {
            view: {prompt: pair.counts.at(thresholds[prompt][kind]) for prompt, pair in prompts.items()}
            for view, prompts in pairs.items()
        }

    scores = {kind: masks(kind) for kind in THRESHOLD_KINDS}
    official = {view: {p: pair.official for p, pair in prompts.items()} for view, prompts in pairs.items()}
    names = {"mIoU": "iou", "mPA": "accuracy", "mP": "precision"}
    strict: dict[str, Any] = {
        kind: {name: _average(scores[kind], field_name) for name, field_name in names.items()}
        for kind in THRESHOLD_KINDS
    }
    strict["mAP"] = _average(pairs, "average_precision")
    strict["localization"] = _average(pairs, "localization")
    return {
        "strict": strict,
        "official": {n: _average(official, f) for n, f in {**names, "mAP": "average_precision"}.items()},
        "per_prompt": {
            prompt: _prompt_row(prompt, pairs, scores, thresholds) for prompt in sorted(thresholds)
        },
        "per_view": {
            view: {
                "mIoU": _average({view: scores["auto"][view]}, "iou"),
                "mAP": _average({view: prompts}, "average_precision"),
            }
            for view, prompts in pairs.items()
        },
    }


def summarize_kinds(
    pairs: Pairs, thresholds: Mapping[str, Mapping[str, float]], kinds: Mapping[str, str]
) -> dict[str, Any]:
    """The strict numbers of `summarize_language` for each kind of prompt alone: ``{kind: {..., "prompts"}}``."""
    table: dict[str, Any] = {}
    for kind in sorted({kinds[prompt] for prompt in thresholds if prompt in kinds}):
        chosen = {prompt: limits for prompt, limits in thresholds.items() if kinds.get(prompt) == kind}
        part = {
            view: {p: pair for p, pair in prompts.items() if p in chosen} for view, prompts in pairs.items()
        }
        summary = summarize_language({view: prompts for view, prompts in part.items() if prompts}, chosen)
        if summary is not None:
            strict = summary["strict"]
            table[kind] = {
                **{f"mIoU_{name}": strict[name]["mIoU"] for name in THRESHOLD_KINDS},
                "mAP": strict["mAP"],
                "localization": strict["localization"],
                "prompts": len(chosen),
            }
    return table


def _prompt_row(
    prompt: str,
    pairs: Pairs,
    scores: Mapping[str, Mapping[str, Mapping[str, MaskScores]]],
    thresholds: Mapping[str, Mapping[str, float]],
) -> dict[str, Any]:
    views = [view for view, prompts in pairs.items() if prompt in prompts]
    auto = [scores["auto"][view][prompt] for view in views]
    return {
        "views": len(views),
        "thresholds": dict(thresholds[prompt]),
        **{f"IoU_{kind}": _mean([scores[kind][v][prompt].iou for v in views]) for kind in THRESHOLD_KINDS},
        "PA": _mean([entry.accuracy for entry in auto]),
        "P": _mean([entry.precision for entry in auto]),
        "AP": _mean([pairs[view][prompt].average_precision for view in views]),
        "localization": _mean([pairs[view][prompt].localization for view in views]),
    }


def precision_curves(pairs: Pairs) -> dict[str, NDArray[np.float64]]:
    """Interpolated precision ``[101]`` at `metrics.RECALLS` by prompt, over the pixels of all views."""
    totals: dict[str, ThresholdCounts] = {}
    for prompts in pairs.values():
        for prompt, pair in prompts.items():
            totals[prompt] = totals[prompt] + pair.counts if prompt in totals else pair.counts
    return {
        prompt: interpolated_precision(*total.curve)
        for prompt, total in sorted(totals.items())
        if total.hits[0]
    }


def _average(entries: Mapping[str, Mapping[str, Any]], name: str) -> float | None:
    return mean_over_images({v: {p: getattr(e, name) for p, e in ps.items()} for v, ps in entries.items()})


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and not math.isnan(value)]
    return float(np.mean(known)) if known else None


def _spread(items: Sequence[Any], count: int) -> list[Any]:
    """At most ``count`` items, evenly spread, in order."""
    if len(items) <= count:
        return list(items)
    return [items[round(i * (len(items) - 1) / max(1, count - 1))] for i in range(count)]


def _mask(view: View, source: Path | NDArray[np.bool_]) -> NDArray[np.bool_]:
    return source.astype(bool) if isinstance(source, np.ndarray) else view.load_mask(source)


def _sizes(
    gaussians: Gaussians, language: LanguageField | None, stored: Mapping[str, int]
) -> dict[str, int | None]:
    def size(tensors: Mapping[str, Tensor]) -> int:
        return sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())

    on_gpu = gaussians.device.type == "cuda"
    return {
        "gaussians": len(gaussians),
        "language_bytes": stored.get("language_bytes", size(language.tensors()) if language else 0),
        "gaussian_bytes": stored.get("gaussian_bytes", size(gaussians.tensors())),
        "peak_rss_bytes": peak_memory(),
        "peak_gpu_bytes": torch.cuda.max_memory_allocated(gaussians.device) if on_gpu else None,
    }


def peak_memory() -> int | None:
    """Largest resident size of this process so far in bytes; None where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, (float, np.floating)):
        return round(float(value), 6) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return str(value) if isinstance(value, Path) else value
