"""A bench for several methods or variants on the same Gaussians and features, for ``ablate`` and ``compare``.

Gaussians and features are made once (``OUTPUT/scene``, a scene folder that ``build`` can resume), codebooks once for
each setting and seed. A row that is trained jointly trains the same Gaussians again. Every measured run is kept, and
the state of a training, so that an interrupted command resumes where it stopped.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lexsplat.captures import check_ground_truth_options
from lexsplat.codebook import Codebook, CodebookConfig, assign_code_maps, fit_codebook
from lexsplat.evaluation import (
    EvaluationConfig,
    GroundTruthSource,
    Method,
    MethodScene,
    Metrics,
    evaluate,
    forget_peak_memory,
    peak_gpu_memory,
    peak_memory,
)
from lexsplat.evaluation.ground_truth import read_held_out
from lexsplat.evaluation.report import Gallery, MeasuredMethod, table_rows, write_comparison, write_rows
from lexsplat.evaluation.results import plain
from lexsplat.features import TextCache, load_level_maps
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import MaskedCodeMaps
from lexsplat.language.fields import LanguageField
from lexsplat.language.methods import METHODS
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.encoding import Encoders, feature_maps
from lexsplat.pipeline.inputs import preview_capture, reload_capture
from lexsplat.queries.relevancy import QueryConfig, QueryForm
from lexsplat.runtime.device import choose_device
from lexsplat.runtime.environment import code_identity, machine_facts
from lexsplat.runtime.errors import CaptureError, FileFormatError, SceneFolderError
from lexsplat.runtime.files import read_json, read_tensors, to_json, write_json, write_tensors
from lexsplat.runtime.fingerprints import file_hash, fingerprint
from lexsplat.runtime.progress import Listener, silent
from lexsplat.runtime.training import Checkpoint
from lexsplat.scenes.scene import Scene

log = logging.getLogger("lexsplat")

IMAGE_WIDTH = 240
"""Width in pixels of the images kept of a run."""

Peaks = dict[str, int | None]
"""Peak host and GPU memory in bytes, by the names in ``metrics.json``."""


class Made(NamedTuple):
    """A language that was made for a row.

    Args:
        language: The language.
        seconds: Seconds of its stages.
        gaussians: Those that it was trained together with; None where they are the bench's.
    """

    language: LanguageField | Method
    seconds: dict[str, float]
    gaussians: Gaussians | None = None


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Args:
        name: Name of the method or variant.
        settings: Everything the language depends on except seed and shared stages: dataclasses and plain data.
        make: Makes the language of a seed.
        form: Form of relevancy.
    """

    name: str
    settings: Sequence[Any]
    make: Callable[[int], Made]
    form: QueryForm = QueryConfig.form


@dataclass(frozen=True)
class MeasuredRun:
    """One measured run.

    Args:
        result: The content of its ``metrics.json``.
        detail: "curves" and "cases" as `report.MeasuredMethod` has them.
        images: File of its images; None if none were kept.
    """

    result: dict[str, Any]
    detail: dict[str, Any]
    images: Path | None


def require_each_once(**given: Sequence[Any]) -> None:
    """Refuse lists of settings with repetitions: a run that is counted twice makes a spread of seeds too small.

    Raises:
        ValueError: If something is in its list twice.
    """
    for name, values in given.items():
        if twice := [value for value in dict.fromkeys(values) if list(values).count(value) > 1]:
            raise ValueError(f"{name} are given once each; got {', '.join(map(str, twice))} more than once")


class Bench:
    """A capture with its Gaussians and features, on which languages are made and measured.

    Args:
        source: Folder with photos and cameras.
        output: Folder for everything that is written.
        config: Settings; ``config.seed`` is the seed of the Gaussians.
        evaluation: Settings of each evaluation.
        ground_truth: Source of the ground truth; None takes the capture's.
        listener: Receives progress events.

    Raises:
        CaptureError: If there is no ground truth of held-out views, or no prompt list for the capture.
        SceneFolderError: If the output folder is a scene.
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
        self.origin = ground_truth or GroundTruthSource()
        if (output / "scene.json").exists():
            raise SceneFolderError(
                output,
                expected="a folder of its own for all results",
                found="a scene",
                remedy="give another --output",
            )
        check_ground_truth_options(source, self.origin.masks, self.origin.prompt_list)
        self.output, self.listener, self.evaluation = output, listener, evaluation
        config = config.spelled_out()
        self.as_in_paper, self.joint = config.as_in_paper, config.joint
        # Gaussians and features are made first; a row that is trained jointly trains Gaussians of its own.
        config = replace(config, joint=False, as_in_paper=False)
        preview = preview_capture(source, output, config)
        if preview is not None:  # before the build, which takes long
            read_held_out(preview, self.origin)
        # Features are shared by methods that use DINO and others that do not, so they are made with both encoders.
        with_dino: Any = next(name for name, method in METHODS.items() if method.uses_dino(config))
        every = config if METHODS[config.method].uses_dino(config) else replace(config, method=with_dino)
        # Other methods read all photos.
        every = replace(every, averaged=replace(every.averaged, sightings=0))
        self.folder = build(source, output / "scene", every, until="features", listener=listener)
        self.device = choose_device(config.device)
        self.capture = reload_capture(self.folder)
        sizes = [view.capture_size for view in self.capture.views.values()]
        self.config = config.resolved(self.device, max(sizes, key=lambda size: size[0] * size[1]))
        self.ground_truth = read_held_out(self.capture, self.origin)
        self.gaussians = self.folder.read_gaussians().to(self.device)
        self._encoders = Encoders(
            config.clip, config.dino, self.config.encoder_device, config.features.segments
        )
        # Features of every view, the held-out ones too, outside every measured time.
        self.maps = feature_maps(
            self.capture, self.config, self._encoders, self.folder.features_path, listener
        )
        self._texts = TextCache(self.folder.root / "checkpoints" / "texts")
        self._last: tuple[str, Made, Peaks] | None = None
        self._codebook_peaks: Peaks = {}

    # -- shared stages

    def level_maps(self, name: str) -> tuple[Tensor, list[float]]:
        """The CLIP map of each crop size of a view, and the sides of the crops (`features.load_level_maps`)."""
        if self.config.features_from is not None:
            raise CaptureError(
                self.config.features_from,
                expected="features of several crop sizes, which this method needs",
                found="one feature a pixel",
                remedy="leave --features-from out, or the method with --methods",
            )
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
        key = fingerprint(self._stages()[1], settings, seed, code_identity())
        path = self.output / "codebooks" / f"{key}.safetensors"
        names, views = self.capture.train_names, self.capture.views
        if path.is_file():
            try:
                tensors, facts = read_tensors(path)
                maps = {name: tensors.pop(f"codes/{name}").numpy() for name in names}
                self._codebook_peaks = json.loads(facts.get("peaks", "{}"))
                codebook = Codebook.from_tensors(tensors).to(self.device)
                return codebook, dict(MaskedCodeMaps(maps, views)), float(facts["seconds"])
            except (FileFormatError, KeyError, ValueError) as error:
                log.warning("%s is damaged and is computed again (%s)", path, error)
        start = time.perf_counter()
        codebook = fit_codebook(
            self.maps,
            names,
            settings,
            seed=seed,
            device=self.device,
            memory=self.config.memory_bytes,
            listener=self.listener,
        )
        maps = assign_code_maps(self.maps, codebook, names, listener=self.listener)
        seconds = time.perf_counter() - start
        stored = {f"codes/{name}": torch.from_numpy(codes) for name, codes in maps.items()}
        self._codebook_peaks = self._peaks()
        facts = {"seconds": f"{seconds:.3f}", "peaks": json.dumps(self._codebook_peaks)}
        write_tensors(path, {**codebook.tensors(), **stored}, facts)
        return codebook.to(self.device), dict(MaskedCodeMaps(maps, views)), seconds

    def checkpoint(self, inputs: Sequence[Any]) -> Checkpoint:
        """Where the training of a row saves its state, by everything that it depends on besides the shared stages."""
        path = self.output / "checkpoints" / "training.safetensors"
        key = fingerprint(self._stages(), list(inputs), code_identity())
        return Checkpoint(path, key, every=self.config.checkpoint_seconds)

    def _stages(self) -> list[str]:
        """Fingerprints of the shared stages."""
        stages = self.folder.record["stages"]
        return [str(stages[name]["fingerprint"]) for name in ("reconstruct", "features")]

    # -- runs

    def measure(
        self, stem: str, rows: Sequence[Row], seeds: Sequence[int], columns: Sequence[str] = ()
    ) -> list[dict[str, Any]]:
        """Measure every row with every seed; writes ``STEM.json``, ``.csv``, ``.tex`` and ``.html`` after each run.

        Seed by seed, so that an interrupted command leaves complete tables of fewer seeds.

        Args:
            stem: "comparison" or "ablation".
            rows: The rows, in the order of the table.
            seeds: Seeds of codebook and language; images are kept of the first.
            columns: Keys of the table; empty takes those of the paper's Table 1 and ours.

        Returns:
            Rows as `report.table_rows` makes them.
        """
        runs: dict[str, list[MeasuredRun]] = {}
        table: list[dict[str, Any]] = []
        for seed in seeds:
            for row in rows:
                run = self.run(row, seed, keep_images=seed == seeds[0])
                runs.setdefault(row.name, []).append(run)
                table = self._write(stem, runs, columns)
        return table

    def _write(
        self, stem: str, runs: Mapping[str, Sequence[MeasuredRun]], columns: Sequence[str]
    ) -> list[dict[str, Any]]:
        """Write the files of the runs so far; returns the rows of the table."""
        rows = table_rows({name: [run.result for run in done] for name, done in runs.items()})
        languages = {name: [run.result["language"] for run in done] for name, done in runs.items()}
        config, machine = to_json(self.config), machine_facts()
        facts = {
            "seeds": sorted({run.result["config"]["seed"] for done in runs.values() for run in done}),
            "evaluation": to_json(self.evaluation),
            "ground_truth": self.ground_truth.origin_facts(self.origin.prompt_list),
        }
        content = {
            "rows": rows,
            "config": config,
            **facts,
            "machine": machine,
            "forms": {name: done[0]["form"] for name, done in languages.items()},
            "runs": {name: [language["strict"] for language in done] for name, done in languages.items()},
            "per_prompt": {
                name: [language["per_prompt"] for language in done] for name, done in languages.items()
            },
        }
        write_rows(self.output, stem, rows, columns)
        write_json(self.output / f"{stem}.json", content)
        write_comparison(
            self.output / f"{stem}.html",
            [_with_images(name, done) for name, done in runs.items()],
            f"lexsplat {'ablate' if stem == 'ablation' else 'compare'}: {self.capture.root.name}",
            columns,
            config={**config, **facts},
            machine=machine,
        )
        return rows

    def run(self, row: Row, seed: int, *, keep_images: bool = False) -> MeasuredRun:
        """Make and measure a language, unless the same settings, code and ground truth were measured before.

        Args:
            row: Row of the table: language and form of relevancy.
            seed: Seed of the language.
            keep_images: Whether to keep images of every prompt in every view.
        """
        query, settings = QueryConfig(form=row.form, fixed=self.as_in_paper), list(row.settings)
        measured = (asdict(self.evaluation), asdict(query), self._ground_truth_identity, code_identity())
        inputs = fingerprint(self._stages(), settings, seed, *measured)
        path = self.output / "runs" / _folder_name(row.name) / f"seed-{seed}.json"
        images = path.with_name(f"seed-{seed}.images.safetensors")
        if path.is_file():
            try:
                stored = read_json(path)
                if stored["fingerprint"] == inputs:
                    detail = stored.get("detail", {})
                    return MeasuredRun(stored["metrics"], detail, images if images.is_file() else None)
            except (FileFormatError, KeyError, TypeError) as error:
                log.warning("%s is damaged and is measured again (%s)", path, error)
        made, peaks = self._made(fingerprint(self._stages(), settings, seed), lambda: row.make(seed))
        gallery = Gallery(width=IMAGE_WIDTH)
        shared = self.folder.stage_seconds()
        metrics = evaluate(
            self.capture,
            self._scene_of(made, query),
            self.evaluation,
            ground_truth=self.ground_truth,
            observer=gallery.add if keep_images else None,
            listener=self.listener,
        ).with_facts(
            stage_seconds={stage: shared[stage] for stage in ("reconstruct", "features")} | made.seconds,
            settings={"name": row.name, "seed": seed},
            machine=machine_facts(),
        )
        result, detail = metrics.to_json(), detail_of(metrics)
        result["size"] |= peaks
        if keep_images:
            write_tensors(images, gallery.tensors(), {"fingerprint": inputs})
        stored = {"fingerprint": inputs, "name": row.name, "seed": seed, "metrics": result, "detail": detail}
        write_json(path, stored)
        return MeasuredRun(result, detail, images if keep_images else None)

    def _made(self, key: str, make: Callable[[], Made]) -> tuple[Made, Peaks]:
        """The language and its peaks; a language that is measured in two forms is made once."""
        if self._last is None or self._last[0] != key:
            self._last, self._codebook_peaks = None, {}  # frees the language made before
            self.maps.forget()
            forget_peak_memory()
            made = make()
            peaks = {
                name: _larger(peak, self._codebook_peaks.get(name)) for name, peak in self._peaks().items()
            }
            self._last = (key, made, peaks)
        return self._last[1:]

    def _peaks(self) -> Peaks:
        return {"peak_rss_bytes": peak_memory(), "peak_gpu_bytes": peak_gpu_memory(self.device)}

    def _scene_of(self, made: Made, query: QueryConfig) -> Scene | MethodScene:
        gaussians = self.gaussians if made.gaussians is None else made.gaussians
        if isinstance(made.language, Method):
            cameras = [view.camera for view in self.capture.train_views]
            return MethodScene(gaussians, made.language, cameras, self.encode_text, query)
        views, clip = self.folder.read_cameras(), self.config.clip
        return Scene(gaussians, made.language, views, clip, query, self.folder, self.encode_text)

    @cached_property
    def _ground_truth_identity(self) -> list[Any]:
        """Prompts and ground truth by content, independent of folders and file names."""
        masks = {
            view: {p: _digest(m) for p, m in prompts.items()}
            for view, prompts in self.ground_truth.masks.items()
        }
        return [masks, self.ground_truth.boxes]


def _with_images(name: str, runs: Sequence[MeasuredRun]) -> MeasuredMethod:
    """The runs of a row with the images and details of the first one."""
    first, gallery = runs[0], Gallery()
    if first.images is not None:
        try:
            gallery = Gallery.from_tensors(read_tensors(first.images)[0])
        except (FileFormatError, ValueError) as error:
            log.warning("%s is damaged and is left out of the report (%s)", first.images, error)
    curves, cases = (first.detail.get(part, {}) for part in ("curves", "cases"))
    return MeasuredMethod(name, [run.result for run in runs], curves, cases, gallery)


def detail_of(metrics: Metrics) -> dict[str, Any]:
    """Curves and numbers of every prompt in every view, for the report."""
    cases = {
        view: {p: plain({"IoU": pair.auto.iou, "AP": pair.average_precision}) for p, pair in prompts.items()}
        for view, prompts in metrics.pairs.items()
    }
    curves = {prompt: [round(float(v), 4) for v in curve] for prompt, curve in metrics.curves.items()}
    return {"curves": curves, "cases": cases}


def _larger(peak: int | None, other: int | None) -> int | None:
    return max(peak, other) if peak is not None and other is not None else peak


def _digest(mask: Path | np.ndarray) -> str:
    """Hash of a mask: of its file, or of the shape and values of an array."""
    if isinstance(mask, Path):
        return file_hash(mask)
    return fingerprint(mask.shape, np.packbits(mask).tobytes().hex())


def _folder_name(name: str) -> str:
    return "".join(character if character.isalnum() or character in "+-" else "_" for character in name)
