"""Many languages for one scene: what ``ablate`` and ``compare`` share.

Gaussians and features are made once (``OUTPUT/scene``, a scene folder that ``build`` goes on with too), codebooks
once for each setting and seed, and every measured run is kept, so that a stopped command goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from lexsplat.captures import Annotations, Capture, check_ground_truth_options, load_annotations
from lexsplat.captures.ground_truth.prompt_lists import PromptList
from lexsplat.codebook import Codebook, CodebookConfig, assign_code_maps, fit_codebook
from lexsplat.evaluation import (
    EvaluationConfig,
    Metrics,
    ViewPictures,
    evaluate,
    forget_peak_memory,
    peak_gpu_memory,
    peak_memory,
)
from lexsplat.evaluation.methods import Method
from lexsplat.evaluation.report import (
    Comparison,
    Gallery,
    MeasuredMethod,
    table_rows,
    write_comparison,
    write_rows,
)
from lexsplat.evaluation.results import plain
from lexsplat.features import FeatureMaps, TextCache, load_level_maps
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import MaskedCodeMaps
from lexsplat.language.fields import LanguageField
from lexsplat.pipeline.build import build, feature_maps
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.inputs import reload_capture
from lexsplat.runtime.device import choose_device
from lexsplat.runtime.environment import code_identity, machine_facts
from lexsplat.runtime.errors import CaptureError, FileFormatError
from lexsplat.runtime.files import read_json, read_tensors, to_json, write_json, write_tensors
from lexsplat.runtime.fingerprints import fingerprint
from lexsplat.runtime.memory import parse_bytes
from lexsplat.runtime.progress import Listener, silent
from lexsplat.scenes.folder import SceneFolder

log = logging.getLogger("lexsplat")

PICTURE_WIDTH = 240
"""Pixels across of the pictures that are kept of a run."""


Peaks = dict[str, int | None]
"""Peaks of host and GPU memory in bytes, by their names in ``metrics.json``."""

Made = tuple[LanguageField | Method, dict[str, float], Peaks]
"""A language, the seconds of its stages, and the peaks of memory while it was made."""


@dataclass(frozen=True)
class Run:
    """One measured run.

    Args:
        name: Of the variant or method.
        seed: Of the language; the Gaussians are shared.
        result: The content of its ``metrics.json``.
        kept: Whether it was measured earlier.
        detail: "curves" and "cases" as `report.MeasuredMethod` has them.
        pictures: Where its pictures are, if they were kept.
    """

    name: str
    seed: int
    result: dict[str, Any]
    kept: bool
    detail: dict[str, Any] = field(default_factory=dict)
    pictures: Path | None = None


class Bench:
    """A capture with its Gaussians and features, on which languages are made and measured.

    Args:
        capture: Folder with photos and cameras.
        output: Where everything goes.
        config: Settings; ``config.seed`` is the seed of the Gaussians.
        evaluation: How runs are measured.
        listener: Told how far each stage is.
        masks: Folder with the ground truth in any layout of `scenes.annotations`, if not the capture's own.
        prompt_list: Ask the words of the paper or of the released code; for captures called like its scenes.

    Raises:
        CaptureError: If there is no ground truth to measure against.
    """

    def __init__(
        self,
        capture: Path,
        output: Path,
        config: BuildConfig,
        evaluation: EvaluationConfig,
        listener: Listener = silent,
        *,
        masks: Path | None = None,
        prompt_list: PromptList | None = None,
    ) -> None:
        check_ground_truth_options(capture, masks, prompt_list)
        self.output, self.listener = output, listener
        # Other methods than the settings' may be measured: features are made with everything that any of them uses.
        everything = replace(config, method="trained") if config.method == "averaged" else config
        self.folder: SceneFolder = build(
            capture, output / "scene", everything, until="features", listener=listener
        )
        self.device = choose_device(config.device)
        self.scene, resolved = self._load_scene(config)
        self.config = resolved
        self.evaluation = evaluation
        self.prompt_list = prompt_list
        self.ground_truth: Annotations = load_annotations(self.scene, masks, prompt_list)
        held_out = set(self.scene.test_names)
        if not any(prompts for view, prompts in self.ground_truth.masks.items() if view in held_out):
            remedy = "draw some into segmentations/STEM/PROMPT.png (see docs/evaluation.md)"
            if masks is not None:
                remedy = "hold out the views that have masks: list them in test_views.json of the capture"
            if prompt_list is not None:
                remedy = "leave the prompt list out, or call the masks as the released code does"
            raise CaptureError(
                masks or capture,
                expected="masks of held-out views to measure against",
                found=f"none in the words of the list {prompt_list!r}" if prompt_list else "none",
                remedy=remedy,
            )
        self.gaussians: Gaussians = self.folder.read_gaussians().to(self.device)
        self._maps: FeatureMaps | None = None
        self._texts = TextCache(self.folder.root / "checkpoints" / "texts")
        self._clip: Any = None
        self._last: tuple[str, Made] | None = None
        self._codebook_peaks: Peaks = {}

    def _load_scene(self, config: BuildConfig) -> tuple[Capture, BuildConfig]:
        scene = reload_capture(self.folder)
        sizes = [view.capture_size for view in scene.views.values()]
        return scene, config.resolved(self.device, max(sizes, key=lambda size: size[0] * size[1]))

    # -- shared stages

    @property
    def maps(self) -> FeatureMaps:
        """Features of every view; they lie in the cache."""
        if self._maps is None:
            self._maps, _ = feature_maps(
                self.scene, self.config, self.folder.features_path, self.device, self.listener
            )
        return self._maps

    def level_maps(self, name: str) -> tuple[Tensor, list[float]]:
        """The CLIP map of each crop size of a view, and the sides of the crops (`features.load_level_maps`)."""
        if self.config.features_from is not None:
            raise CaptureError(
                self.config.features_from,
                expected="features of several crop sizes, which this method needs",
                found="one feature a pixel",
                remedy="leave --features-from out, or the method (lerf) with --methods",
            )
        if self._clip is None:
            from lexsplat.features.encoders import load_clip

            self._clip = load_clip(self.config.clip, self.device)
            len(self.maps)  # makes sure that all features are stored
        return load_level_maps(self.scene, self._clip, self.config.features, self.folder.features_path, name)

    def encode_text(self, texts: list[str]) -> Tensor:
        """Embeddings ``[T, D]`` by the CLIP of the features; each text is encoded once."""
        from lexsplat.features.encoders import load_clip

        known = self.folder.record["stages"]["features"]["clip_hash"]
        return self._texts.encode(known, texts, lambda: load_clip(self.config.clip, self.device))

    def codebook(self, settings: CodebookConfig, seed: int) -> tuple[Codebook, dict[str, np.ndarray], float]:
        """A codebook with the index maps of the training views, made once for each setting and seed.

        Returns:
            The codebook, index maps by view, and the seconds it took when it was made.
        """
        key = fingerprint(self._stage("features"), settings, seed, code_identity())
        path = self.output / "codebooks" / f"{key}.safetensors"
        names = self.scene.train_names
        if path.is_file():
            try:
                tensors, facts = read_tensors(path)
                maps = {name: tensors.pop(f"codes/{name}").numpy() for name in names}
                maps = dict(MaskedCodeMaps(maps, self.scene.views))
                self._codebook_peaks = json.loads(facts.get("peaks", "{}"))
                return Codebook.from_tensors(tensors).to(self.device), maps, float(facts["seconds"])
            except (FileFormatError, KeyError, ValueError) as error:
                log.warning("%s is damaged and made anew (%s)", path, error)
        start = time.perf_counter()
        memory = parse_bytes(self.config.memory)
        codebook = fit_codebook(
            self.maps, names, settings, seed=seed, device=self.device, memory=memory, listener=self.listener
        )
        assigned = assign_code_maps(self.maps, codebook, names, listener=self.listener)
        seconds = time.perf_counter() - start
        import torch

        stored = {f"codes/{name}": torch.from_numpy(codes) for name, codes in assigned.items()}
        self._codebook_peaks = self._peaks()
        facts = {"seconds": f"{seconds:.3f}", "peaks": json.dumps(self._codebook_peaks)}
        write_tensors(path, {**codebook.tensors(), **stored}, facts)
        return codebook.to(self.device), dict(MaskedCodeMaps(assigned, self.scene.views)), seconds

    def _stage(self, name: str) -> str:
        return str(self.folder.record["stages"][name]["fingerprint"])

    # -- runs

    def run(
        self,
        name: str,
        seed: int,
        settings: Sequence[Any],
        make: Callable[[], tuple[LanguageField | Method, dict[str, float]]],
        *,
        pictures: bool = False,
    ) -> Run:
        """Make a language and measure it, unless that was done before with the same settings and the same code.

        Args:
            name: Of the variant or method.
            seed: Of the language.
            settings: Everything the language depends on beside the shared stages: dataclasses and plain data.
            make: Makes it; returns it with the seconds of its stages.
            pictures: Whether to keep pictures of every prompt in every view.
        """
        stages = [self._stage("reconstruct"), self._stage("features")]
        measured = (asdict(self.evaluation), self._truth_identity, code_identity())
        made_from = fingerprint(stages, list(settings), seed, *measured)
        path = self.output / "runs" / _folder_name(name) / f"seed-{seed}.json"
        drawn = path.with_name(f"seed-{seed}.pictures.safetensors")
        if path.is_file():
            try:
                stored = read_json(path)
                if stored["fingerprint"] == made_from:
                    shown = drawn if drawn.is_file() else None
                    return Run(name, seed, stored["metrics"], True, stored.get("detail", {}), shown)
            except (FileFormatError, KeyError, TypeError) as error:
                log.warning("%s is damaged and measured anew (%s)", path, error)
        language, seconds, peaks = self._made(fingerprint(stages, list(settings), seed), make)
        gallery = Gallery(width=PICTURE_WIDTH)
        metrics = self._measure(name, language, seconds, gallery.add if pictures else None)
        result = metrics.to_json()
        result["size"] |= peaks
        result["config"]["seed"] = seed
        if pictures:
            write_tensors(drawn, gallery.tensors(), {"fingerprint": made_from})
        detail = detail_of(metrics)
        stored = {"fingerprint": made_from, "name": name, "seed": seed, "metrics": result, "detail": detail}
        write_json(path, stored)
        return Run(name, seed, result, False, detail, drawn if pictures else None)

    def _made(self, key: str, make: Callable[[], tuple[LanguageField | Method, dict[str, float]]]) -> Made:
        """What ``make`` makes; a language that is measured in two forms is made once."""
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        self._last, self._codebook_peaks = None, {}  # what was made before is let go first
        if self._maps is not None:
            self._maps.forget()
        forget_peak_memory()
        language, seconds = make()
        peaks = {name: _larger(peak, self._codebook_peaks.get(name)) for name, peak in self._peaks().items()}
        made = (language, seconds, peaks)
        self._last = (key, made)
        return made

    def _peaks(self) -> Peaks:
        return {"peak_rss_bytes": peak_memory(), "peak_gpu_bytes": peak_gpu_memory(self.device)}

    def _measure(
        self,
        name: str,
        language: LanguageField | Method,
        seconds: dict[str, float],
        observer: Callable[[ViewPictures], None] | None,
    ) -> Metrics:
        shared = self.folder.stage_seconds()
        stages = {stage: shared[stage] for stage in ("reconstruct", "features")}
        return evaluate(
            self.scene,
            self.gaussians,
            language,
            self.encode_text,
            self.evaluation,
            masks=self.ground_truth.masks,
            boxes=self.ground_truth.boxes,
            observer=observer,
            listener=self.listener,
            stage_seconds={**stages, **seconds},
            settings={"name": name},
            machine=machine_facts(),
        )

    @cached_property
    def _truth_identity(self) -> list[Any]:
        """Words and ground truth as they are measured, by content: wherever it lies, and whatever its files
        are called.
        """
        masks = {
            view: {p: _digest(m) for p, m in prompts.items()}
            for view, prompts in self.ground_truth.masks.items()
        }
        return [masks, self.ground_truth.boxes]


class Results:
    """The runs of an experiment as they come in, and the files made of them.

    Args:
        bench: On which they are measured.
        stem: "comparison" or "ablation": the name of the files.
        names: Of all rows, in the order of the table.
        seeds: Of all runs; pictures are those of the first.
        columns: Keys of the table; none takes those of the paper's Table 1 and ours.
    """

    def __init__(
        self, bench: Bench, stem: str, names: Sequence[str], seeds: Sequence[int], columns: Sequence[str] = ()
    ) -> None:
        self.bench, self.stem, self.columns = bench, stem, tuple(columns)
        self.names, self.seeds = list(names), list(seeds)
        self.runs: dict[str, list[Run]] = {}
        self.evaluation = bench.evaluation

    def add(self, run: Run) -> None:
        """Take a run in and write all files anew, so that a stopped experiment has whole tables."""
        self.runs.setdefault(run.name, []).append(run)
        rows, folder = self.rows(), self.bench.output
        write_rows(folder, self.stem, rows, self.columns)
        write_json(folder / f"{self.stem}.json", self._content(rows))
        comparison = Comparison(
            [self._measured(name) for name in self.names if name in self.runs],
            title=f"lexsplat {'ablate' if self.stem == 'ablation' else 'compare'}: {self.bench.scene.root.name}",
            subtitle="The same Gaussians and the same features, measured on held-out views",
            columns=self.columns,
            config={
                **to_json(self.bench.config),
                "seeds": self.seeds,
                "evaluation": to_json(self.evaluation),
                "ground_truth": self._truth(),
            },
            machine=machine_facts(),
        )
        write_comparison(folder / "report.html", comparison)

    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table so far (`report.table_rows`)."""
        found = {name: [run.result for run in self.runs[name]] for name in self.names if name in self.runs}
        return table_rows(found)

    def _content(self, rows: list[dict[str, Any]]) -> dict[str, Any]:
        words = {name: [run.result["language"] for run in runs] for name, runs in self.runs.items()}
        return {
            "rows": rows,
            "seeds": self.seeds,
            "config": to_json(self.bench.config),
            "evaluation": to_json(self.evaluation),
            "ground_truth": self._truth(),
            "machine": machine_facts(),
            "runs": {name: [language["strict"] for language in found] for name, found in words.items()},
            "per_prompt": {
                name: [language["per_prompt"] for language in found] for name, found in words.items()
            },
        }

    def _truth(self) -> dict[str, Any]:
        return self.bench.ground_truth.origin_facts(self.bench.prompt_list)

    def _measured(self, name: str) -> MeasuredMethod:
        runs = self.runs[name]
        first, gallery = runs[0], Gallery()
        if first.pictures is not None:
            try:
                gallery = Gallery.from_tensors(read_tensors(first.pictures)[0])
            except (FileFormatError, ValueError) as error:
                log.warning("%s is damaged and left out of the report (%s)", first.pictures, error)
        detail = first.detail
        results = [run.result for run in runs]
        return MeasuredMethod(name, results, detail.get("curves", {}), detail.get("cases", {}), gallery)


def detail_of(metrics: Metrics) -> dict[str, Any]:
    """Curves and numbers of every prompt in every view, for a report that compares."""
    return {
        "curves": {prompt: [round(float(v), 4) for v in curve] for prompt, curve in metrics.curves.items()},
        "cases": {
            view: {
                prompt: plain(
                    {
                        "IoU": pair.counts.at(metrics.thresholds[prompt]["auto"]).iou,
                        "AP": pair.average_precision,
                    }
                )
                for prompt, pair in prompts.items()
            }
            for view, prompts in metrics.pairs.items()
        },
    }


def _larger(peak: int | None, other: int | None) -> int | None:
    return max(peak, other) if peak is not None and other is not None else peak


def _digest(mask: Path | np.ndarray) -> str:
    """A hash of a mask's file, or of an array's shape and values."""
    if isinstance(mask, Path):
        return hashlib.blake2b(mask.read_bytes(), digest_size=12).hexdigest()
    content = repr(mask.shape).encode() + np.ascontiguousarray(mask).tobytes()
    return hashlib.blake2b(content, digest_size=12).hexdigest()


def _folder_name(name: str) -> str:
    return "".join(character if character.isalnum() or character in "+-" else "_" for character in name)


def with_seed(config: BuildConfig, seed: int) -> BuildConfig:
    """The same settings with another seed for the language."""
    return replace(config, seed=seed)
