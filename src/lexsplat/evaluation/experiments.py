"""Many languages on the same Gaussians and features: what ``ablate`` and ``compare`` share.

Gaussians and features are made once (``OUTPUT/scene``, a scene folder that ``build`` can resume), codebooks once for
each setting and seed. Every measured run is kept, so that an interrupted command resumes where it stopped.
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
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from lexsplat.captures import Annotations, check_ground_truth_options, load_annotations
from lexsplat.codebook import Codebook, CodebookConfig, assign_code_maps, fit_codebook
from lexsplat.evaluation import (
    EvaluationConfig,
    GroundTruth,
    GroundTruthSource,
    Metrics,
    Subject,
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
from lexsplat.language.methods import METHODS, MethodName
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.encoding import Encoders, feature_maps
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
"""Width in pixels of the images kept of a run."""

Peaks = dict[str, int | None]
"""Peak host and GPU memory in bytes, by the names in ``metrics.json``."""

Made = tuple[LanguageField | Method, dict[str, float]]
"""A language and the seconds of its stages."""


@dataclass(frozen=True)
class MeasuredRun:
    """One measured run.

    Args:
        name: Name of the variant or method.
        seed: Seed of the language; the Gaussians are shared.
        result: The content of its ``metrics.json``.
        kept: Whether it was measured by an earlier command.
        detail: "curves" and "cases" as `report.MeasuredMethod` has them.
        pictures: File of its images; None if none were kept.
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
        source: Folder with photos and cameras.
        output: Folder for everything that is written.
        config: Settings; ``config.seed`` is the seed of the Gaussians.
        evaluation: How runs are measured.
        ground_truth: Where the ground truth is read from.
        listener: Receives progress events.

    Raises:
        CaptureError: If there is no ground truth of held-out views.
    """

    def __init__(
        self,
        source: Path,
        output: Path,
        config: BuildConfig,
        evaluation: EvaluationConfig,
        ground_truth: GroundTruthSource | None = None,
        listener: Listener = silent,
    ) -> None:
        ground_truth = ground_truth or GroundTruthSource()
        masks, prompt_list = ground_truth.masks, ground_truth.prompt_list
        check_ground_truth_options(source, masks, prompt_list)
        self.output, self.listener = output, listener
        # Features are shared by methods that use DINO and others that do not, so they are made with both encoders.
        every = config if METHODS[config.method].uses_dino else replace(config, method=_method_with_dino())
        self.folder: SceneFolder = build(source, output / "scene", every, until="features", listener=listener)
        self.device = choose_device(config.device)
        self.capture = reload_capture(self.folder)
        sizes = [view.capture_size for view in self.capture.views.values()]
        self.config = config.resolved(self.device, max(sizes, key=lambda size: size[0] * size[1]))
        self.memory = parse_bytes(config.memory)
        self.evaluation = evaluation
        self.prompt_list = prompt_list
        self.ground_truth: Annotations = load_annotations(self.capture, masks, prompt_list)
        held_out = set(self.capture.test_names)
        if not any(prompts for view, prompts in self.ground_truth.masks.items() if view in held_out):
            remedy = "draw some into segmentations/STEM/PROMPT.png (see docs/evaluation.md)"
            if masks is not None:
                remedy = "hold out the views that have masks: list them in test_views.json of the capture"
            if prompt_list is not None:
                remedy = "leave the prompt list out, or name the masks as the released code does"
            raise CaptureError(
                masks or source,
                expected="masks of held-out views to measure against",
                found=f"none in the words of the list {prompt_list!r}" if prompt_list else "none",
                remedy=remedy,
            )
        self.gaussians: Gaussians = self.folder.read_gaussians().to(self.device)
        self._encoders = Encoders(config.clip, config.dino, self.config.encoder_device)
        self._maps: FeatureMaps | None = None
        self._texts = TextCache(self.folder.root / "checkpoints" / "texts")
        self._last: tuple[str, LanguageField | Method, dict[str, float], Peaks] | None = None
        self._codebook_peaks: Peaks = {}

    # -- shared stages

    @property
    def maps(self) -> FeatureMaps:
        """Features of every view, read from the cache."""
        if self._maps is None:
            self._maps = feature_maps(
                self.capture, self.config, self._encoders, self.folder.features_path, self.listener
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
        _ = self.maps  # stores the features of all views
        return load_level_maps(
            self.capture, self._encoders.clip, self.config.features, self.folder.features_path, name
        )

    def encode_text(self, texts: list[str]) -> Tensor:
        """Embeddings ``[T, D]`` by the CLIP of the features; each text is encoded once."""
        known = self.folder.record["stages"]["features"]["clip_hash"]
        return self._texts.encode(known, texts, lambda: self._encoders.clip)

    def codebook(self, settings: CodebookConfig, seed: int) -> tuple[Codebook, dict[str, np.ndarray], float]:
        """A codebook and the index maps of the training views, made once for each setting and seed.

        Returns:
            The codebook, index maps by view, and the seconds they took when they were made.
        """
        key = fingerprint(self._stage("features"), settings, seed, code_identity())
        path = self.output / "codebooks" / f"{key}.safetensors"
        names = self.capture.train_names
        if path.is_file():
            try:
                tensors, facts = read_tensors(path)
                maps = {name: tensors.pop(f"codes/{name}").numpy() for name in names}
                maps = dict(MaskedCodeMaps(maps, self.capture.views))
                self._codebook_peaks = json.loads(facts.get("peaks", "{}"))
                return Codebook.from_tensors(tensors).to(self.device), maps, float(facts["seconds"])
            except (FileFormatError, KeyError, ValueError) as error:
                log.warning("%s is damaged and is computed again (%s)", path, error)
        start = time.perf_counter()
        codebook = fit_codebook(
            self.maps,
            names,
            settings,
            seed=seed,
            device=self.device,
            memory=self.memory,
            listener=self.listener,
        )
        assigned = assign_code_maps(self.maps, codebook, names, listener=self.listener)
        seconds = time.perf_counter() - start
        stored = {f"codes/{name}": torch.from_numpy(codes) for name, codes in assigned.items()}
        self._codebook_peaks = self._peaks()
        facts = {"seconds": f"{seconds:.3f}", "peaks": json.dumps(self._codebook_peaks)}
        write_tensors(path, {**codebook.tensors(), **stored}, facts)
        return codebook.to(self.device), dict(MaskedCodeMaps(assigned, self.capture.views)), seconds

    def _stage(self, name: str) -> str:
        return str(self.folder.record["stages"][name]["fingerprint"])

    # -- runs

    def run(
        self,
        name: str,
        seed: int,
        settings: Sequence[Any],
        make: Callable[[], Made],
        *,
        pictures: bool = False,
    ) -> MeasuredRun:
        """Make a language and measure it, unless it was measured before with the same settings and the same code.

        Args:
            name: Name of the variant or method.
            seed: Seed of the language.
            settings: Everything the language depends on beside the shared stages: dataclasses and plain data.
            make: Makes the language.
            pictures: Whether to keep images of every prompt in every view.
        """
        stages = [self._stage("reconstruct"), self._stage("features")]
        measured = (asdict(self.evaluation), self._ground_truth_identity, code_identity())
        made_from = fingerprint(stages, list(settings), seed, *measured)
        path = self.output / "runs" / _folder_name(name) / f"seed-{seed}.json"
        drawn = path.with_name(f"seed-{seed}.pictures.safetensors")
        if path.is_file():
            try:
                stored = read_json(path)
                if stored["fingerprint"] == made_from:
                    shown = drawn if drawn.is_file() else None
                    return MeasuredRun(name, seed, stored["metrics"], True, stored.get("detail", {}), shown)
            except (FileFormatError, KeyError, TypeError) as error:
                log.warning("%s is damaged and is measured again (%s)", path, error)
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
        return MeasuredRun(name, seed, result, False, detail, drawn if pictures else None)

    def _made(
        self, key: str, make: Callable[[], Made]
    ) -> tuple[LanguageField | Method, dict[str, float], Peaks]:
        """The language, its seconds and peaks; a language that is measured in two forms is made once."""
        if self._last is None or self._last[0] != key:
            self._last, self._codebook_peaks = None, {}  # frees the language made before
            if self._maps is not None:
                self._maps.forget()
            forget_peak_memory()
            language, seconds = make()
            peaks = {
                name: _larger(peak, self._codebook_peaks.get(name)) for name, peak in self._peaks().items()
            }
            self._last = (key, language, seconds, peaks)
        return self._last[1:]

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
            self.capture,
            Subject(self.gaussians, language, self.encode_text),
            self.evaluation,
            ground_truth=GroundTruth(self.ground_truth.masks, self.ground_truth.boxes),
            observer=observer,
            listener=self.listener,
        ).with_facts(
            stage_seconds={**stages, **seconds},
            settings={"name": name},
            machine=machine_facts(),
        )

    @cached_property
    def _ground_truth_identity(self) -> list[Any]:
        """Prompts and ground truth by content, independent of folders and file names."""
        masks = {
            view: {p: _digest(m) for p, m in prompts.items()}
            for view, prompts in self.ground_truth.masks.items()
        }
        return [masks, self.ground_truth.boxes]


class Results:
    """The runs of an experiment as they finish, and the files written from them.

    Args:
        bench: The bench on which they are measured.
        stem: "comparison" or "ablation", the stem of the file names.
        names: Names of all rows, in the order of the table.
        seeds: Seeds of all runs; images are kept of the first.
        columns: Keys of the table; empty takes those of the paper's Table 1 and ours.
    """

    def __init__(
        self, bench: Bench, stem: str, names: Sequence[str], seeds: Sequence[int], columns: Sequence[str] = ()
    ) -> None:
        self.bench, self.stem, self.columns = bench, stem, tuple(columns)
        self.names, self.seeds = list(names), list(seeds)
        self.runs: dict[str, list[MeasuredRun]] = {}
        self.evaluation = bench.evaluation

    def add(self, run: MeasuredRun) -> None:
        """Add a run and rewrite all files, so that an interrupted experiment leaves complete tables."""
        self.runs.setdefault(run.name, []).append(run)
        rows, folder = self.rows(), self.bench.output
        write_rows(folder, self.stem, rows, self.columns)
        write_json(folder / f"{self.stem}.json", self._content(rows))
        comparison = Comparison(
            [self._measured(name) for name in self.names if name in self.runs],
            title=f"lexsplat {'ablate' if self.stem == 'ablation' else 'compare'}: {self.bench.capture.root.name}",
            subtitle="The same Gaussians and the same features, measured on held-out views",
            columns=self.columns,
            config={
                **to_json(self.bench.config),
                "seeds": self.seeds,
                "evaluation": to_json(self.evaluation),
                "ground_truth": self._ground_truth(),
            },
            machine=machine_facts(),
        )
        write_comparison(folder / f"{self.stem}.html", comparison)

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
            "ground_truth": self._ground_truth(),
            "machine": machine_facts(),
            "runs": {name: [language["strict"] for language in found] for name, found in words.items()},
            "per_prompt": {
                name: [language["per_prompt"] for language in found] for name, found in words.items()
            },
        }

    def _ground_truth(self) -> dict[str, Any]:
        return self.bench.ground_truth.origin_facts(self.bench.prompt_list)

    def _measured(self, name: str) -> MeasuredMethod:
        runs = self.runs[name]
        first, gallery = runs[0], Gallery()
        if first.pictures is not None:
            try:
                gallery = Gallery.from_tensors(read_tensors(first.pictures)[0])
            except (FileFormatError, ValueError) as error:
                log.warning("%s is damaged and is left out of the report (%s)", first.pictures, error)
        detail = first.detail
        results = [run.result for run in runs]
        return MeasuredMethod(name, results, detail.get("curves", {}), detail.get("cases", {}), gallery)


def detail_of(metrics: Metrics) -> dict[str, Any]:
    """Curves and numbers of every prompt in every view, for the report."""
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
    """Hash of a mask: of its file, or of the shape and values of an array."""
    if isinstance(mask, Path):
        return hashlib.blake2b(mask.read_bytes(), digest_size=12).hexdigest()
    content = repr(mask.shape).encode() + np.ascontiguousarray(mask).tobytes()
    return hashlib.blake2b(content, digest_size=12).hexdigest()


def _folder_name(name: str) -> str:
    return "".join(character if character.isalnum() or character in "+-" else "_" for character in name)


def _method_with_dino() -> MethodName:
    """A method whose features include those of DINO."""
    return next(name for name in get_args(MethodName) if METHODS[name].uses_dino)
