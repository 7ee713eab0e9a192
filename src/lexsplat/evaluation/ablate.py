"""``lexsplat ablate``: the paper's Table 2 over several seeds, for one method or several.

Every variant leaves one part of a method out. Gaussians and features are shared by all variants, codebooks by those
with the same quantization; the seeds are those of codebook and language. Variants that are trained jointly train the
same Gaussians again, since the language does not change them. With labels corrupted on purpose
(`with_wrong_labels`) the same table is a stress test.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.evaluation import EvaluationConfig
from lexsplat.evaluation.experiments import Bench, Made, Row, require_each_once
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.fields import LanguageField
from lexsplat.language.methods import JOINT_METHODS, METHODS, FitRun, MethodName, TrainingViews
from lexsplat.language.methods.averaged import features_of_codes
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.geometry import GeometryRun, joint_training
from lexsplat.queries.relevancy import QueryForm

log = logging.getLogger("lexsplat")

COLUMNS = (
    "mPA", "mP", "mIoU", "mAP", "mIoU_fixed", "mIoU_oracle", "localization", "language_seconds", "storage_bytes",
)  # fmt: skip
"""Columns of the printed table; ``ablation.json`` has every number."""


def columns_of(evaluation: EvaluationConfig) -> tuple[str, ...]:
    """`COLUMNS`, with mIoU in 3D if its protocol is asked for."""
    return (*COLUMNS, "lerf_3d_mIoU") if "lerf-3d" in evaluation.protocols else COLUMNS


def with_wrong_labels(
    code_maps: Mapping[str, NDArray[np.uint8]], share: float, num_codes: int, seed: int
) -> dict[str, NDArray[np.uint8]]:
    """Index maps with a share of the pixels replaced by random codes, independently in every view.

    Args:
        code_maps: Index maps ``[H, W]`` by view.
        share: Share of the pixels, 0 to 1.
        num_codes: K; all codes are equally likely.
        seed: Seed of pixels and codes.

    Raises:
        ValueError: If the share is not within 0..1.
    """
    if not 0 <= share <= 1:
        raise ValueError(f"the share of wrong labels must be in 0..1, got {share:g}")
    wrong = {}
    for place, (name, codes) in enumerate(code_maps.items()):
        rng = np.random.default_rng([seed, place])
        hit = rng.random(codes.shape) < share
        wrong[name] = np.where(hit, rng.integers(0, num_codes, codes.shape), codes).astype(codes.dtype)
    return wrong


def changed(config: BuildConfig, variant: str) -> BuildConfig:
    """The settings of a variant of the method of the settings.

    Raises:
        ValueError: If the method has no such variant.
    """
    variants = METHODS[config.method].variants
    if variant not in variants:
        raise ValueError(f"variants of {config.method} are {', '.join(variants)}; got {variant!r}")
    parts = {part: replace(getattr(config, part), **changes) for part, changes in variants[variant].items()}
    return replace(config, **parts)


@dataclass(frozen=True)
class AblationPlan:
    """The rows of an ablation, and how often each is measured.

    Args:
        seeds: Seeds of codebook and language.
        variants: Names out of `lexsplat.language.methods.VARIANTS`; empty takes all of each method.
        methods: Names of methods. Rows of several are named "METHOD: VARIANT".
        wrong_labels: Share of the pixels of every training view whose code is replaced by a random one.
        forms: Forms of relevancy: "feature" as in the paper, "code". Names of rows end in the form if there are
            several.

    Raises:
        ValueError: If there is no seed, form or method, one is given twice, the share is not within 0..1, a method is
            unknown, or no method has a variant.
    """

    seeds: Sequence[int] = (0, 1, 2)
    variants: Sequence[str] = ()
    methods: Sequence[MethodName] = ("trained",)
    wrong_labels: float = 0.0
    forms: Sequence[QueryForm] = ("feature",)

    def __post_init__(self) -> None:
        if not self.seeds or not self.forms or not self.methods:
            raise ValueError("an ablation needs at least one seed, one form and one method")
        with_wrong_labels({}, self.wrong_labels, 1, 0)  # refuses an invalid share
        require_each_once(methods=self.methods, variants=self.variants, forms=self.forms, seeds=self.seeds)
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown:
            raise ValueError(f"methods are {', '.join(METHODS)}; got {', '.join(unknown)}")
        known = {variant: None for method in self.methods for variant in METHODS[method].variants}
        missing = [variant for variant in self.variants if variant not in known]
        if missing:
            methods = " and ".join(self.methods)
            raise ValueError(f"variants of {methods} are {', '.join(known)}; got {', '.join(missing)}")


def ablate(bench: Bench, plan: AblationPlan | None = None) -> list[dict[str, Any]]:
    """Measure the variants; writes ``ablation.json``, ``.csv``, ``.tex`` and ``.html`` (`Bench.measure`).

    Args:
        bench: Bench that makes and measures the variants; its settings are those of the full methods.
        plan: The rows and seeds; None takes all variants of the paper's method.

    Returns:
        Rows as `report.table_rows` makes them.
    """
    plan, rows = plan or AblationPlan(), []
    for method in plan.methods:
        for variant in plan.variants or METHODS[method].variants:
            if variant not in METHODS[method].variants:
                log.warning("%s has no variant %r: the row is left out", method, variant)
                continue
            full = replace(bench.config, method=method)
            config = changed(full, variant)
            if not plan.variants and variant != "full" and config == full:
                continue  # for class tokens the full method has DINO, for others it has none
            name = variant if len(plan.methods) == 1 else f"{method}: {variant}"
            for form in plan.forms:
                row = name if len(plan.forms) == 1 else f"{name}, {form}"
                rows.append(language_row(bench, row, config, form, plan.wrong_labels))
    return bench.measure("ablation", rows, plan.seeds, columns_of(bench.evaluation))


def paper_evaluation(protocols: Sequence[str] = ("strict", "official")) -> EvaluationConfig:
    """Strict and official protocol, or others, without LPIPS, which does not depend on language."""
    return EvaluationConfig(lpips=False, timing_views=1, protocols=tuple(protocols))


def language_row(
    bench: Bench, name: str, config: BuildConfig, form: QueryForm, wrong_labels: float = 0.0
) -> Row:
    """The row of a method of ours.

    Args:
        bench: Bench on which its language is made.
        name: Name of the row.
        config: Settings of the method; the seed is that of the run.
        form: Form of relevancy.
        wrong_labels: See `AblationPlan`.
    """
    settings = [config.method, *(getattr(config, part) for part in METHODS[config.method].settings)]
    settings += [wrong_labels] if wrong_labels else []
    settings += ["jointly"] if is_joint(bench, config) else []
    return Row(
        name, settings, lambda seed: make_language(bench, replace(config, seed=seed), wrong_labels), form
    )


def is_joint(bench: Bench, config: BuildConfig) -> bool:
    """Whether a row trains its language together with Gaussians of its own (``--joint``, ``--as-in-paper``)."""
    return bench.joint and config.method in JOINT_METHODS


def make_language(bench: Bench, config: BuildConfig, wrong_labels: float = 0.0) -> Made:
    """Make the language field of the settings.

    A method without index maps is fitted to the features of the wrong codes instead of wrong labels. A training that
    was stopped goes on from its checkpoint.
    """
    method, seconds = METHODS[config.method], {}
    views = TrainingViews({name: bench.capture.views[name] for name in bench.capture.train_names})
    from_codes = "codebook" in method.needs
    if from_codes or wrong_labels:
        codebook, code_maps, seconds["codebook"] = bench.codebook(config.codebook, config.seed)
        if wrong_labels:
            code_maps = with_wrong_labels(code_maps, wrong_labels, codebook.num_codes, config.seed)
    start = time.perf_counter()
    if from_codes:
        views = replace(views, code_maps=code_maps, codebook=codebook)
    else:
        views = replace(
            views, features=features_of_codes(code_maps, codebook) if wrong_labels else bench.maps
        )
    joint = is_joint(bench, config)
    checkpoint = bench.checkpoint([method.name, config, wrong_labels, joint])
    run = FitRun(
        seed=config.seed,
        memory=config.memory_bytes,
        scratch=bench.folder.root / "checkpoints",
        checkpoint=checkpoint,
        listener=bench.listener,
    )
    gaussians = None
    if joint:
        gaussians, field = _trained_jointly(bench, config, views, run)
    else:
        field = method.fit(bench.gaussians, views, config, run)
    field.method = method.name
    checkpoint.remove()
    seconds["reconstruct" if joint else "language"] = checkpoint.seconds_before + time.perf_counter() - start
    return Made(field, seconds, gaussians)


def _trained_jointly(
    bench: Bench, config: BuildConfig, views: TrainingViews, run: FitRun
) -> tuple[Gaussians, LanguageField]:
    """Gaussians and language, trained together; the Gaussians start from the points and the seed of the bench's."""
    run = replace(run, seed=bench.config.seed)
    geometry = GeometryRun(bench.capture, bench.folder, bench.device, run, key="", codes=lambda: views)
    training = joint_training(JOINT_METHODS[config.method], config, geometry)
    training.run(run.listener, run.checkpoint)
    return training.result()
