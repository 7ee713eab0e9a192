"""``lexsplat ablate``: the paper's Table 2 over several seeds, for one method or several beside each other.

Every variant leaves one part of the method out. Gaussians and features are shared by all, codebooks by those that
do not change the quantization; the seed is that of codebook and language. With wrong labels mixed in on purpose
(`with_wrong_labels`) the same table is a stress test.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.captures.ground_truth.prompt_lists import PromptList
from lexsplat.evaluation import EvaluationConfig
from lexsplat.evaluation.experiments import Bench, Results, with_seed
from lexsplat.language.fields import LanguageField
from lexsplat.language.methods.averaged import features_of_codes
from lexsplat.pipeline.build import make_averaged_field, make_field
from lexsplat.pipeline.config import BuildConfig, LanguageMethod
from lexsplat.queries.relevancy import QueryForm
from lexsplat.runtime.progress import Listener, silent

VARIANTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "w/o DINO": {"codebook": {"use_dino": False}},
    "w/o L_lb": {"codebook": {"load_balancing": False}},
    "w/o u_G": {"trained": {"use_uncertainty": False}},
    "w/o MLP": {"trained": {"use_smoothing": False}},
    "w/o u_G & MLP": {"trained": {"use_uncertainty": False, "use_smoothing": False}},
    "with neighbors": {"lifted": {"use_smoothing": True}},
    "one code": {"lifted": {"top": 1}},
    "full": {},
}
"""What each row changes: those of the paper's Table 2 in its order, and what a lifted field can have otherwise."""

COLUMNS = (
    "mPA", "mP", "mIoU", "mAP", "mIoU_fixed", "mIoU_oracle", "localization", "language_seconds", "storage_bytes",
)  # fmt: skip
"""What the table shows; the file has every number."""


def variants_of(method: str) -> tuple[str, ...]:
    """The variants that make a difference for a method: a lifted field has no u_G to train and no MLP, averaged
    features are quantized by k-means alone.
    """
    without = {
        "averaged": {"codebook", "trained", "lifted"},
        "lifted": {"trained"},
        "trained": {"lifted"},
    }
    return tuple(name for name, changes in VARIANTS.items() if not without.get(method, set()) & set(changes))


def with_wrong_labels(
    code_maps: Mapping[str, NDArray[np.uint8]], share: float, num_codes: int, seed: int
) -> dict[str, NDArray[np.uint8]]:
    """Index maps with ``share`` of the pixels replaced by random codes, others in every view.

    Args:
        code_maps: Index maps ``[H, W]`` by view.
        share: Of the pixels, 0 to 1.
        num_codes: K; each code is as likely.
        seed: Decides which pixels and codes.

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
    """The settings of a variant.

    Raises:
        ValueError: If there is no such variant.
    """
    if variant not in VARIANTS:
        raise ValueError(f"variants are {', '.join(VARIANTS)}; got {variant!r}")
    parts = {part: replace(getattr(config, part), **changes) for part, changes in VARIANTS[variant].items()}
    return replace(config, **parts)


def as_in_paper(config: BuildConfig) -> BuildConfig:
    """The fit and the training of the paper in place of our short ones."""
    return replace(config, codebook=config.codebook.as_in_paper(), trained=config.trained.as_in_paper())


def ablate(
    capture: Path,
    output: Path,
    config: BuildConfig,
    *,
    seeds: Sequence[int] = (0, 1, 2),
    variants: Sequence[str] = (),
    methods: Sequence[LanguageMethod] = (),
    wrong_labels: float = 0.0,
    forms: Sequence[QueryForm] = ("feature",),
    evaluation: EvaluationConfig | None = None,
    masks: Path | None = None,
    prompt_list: PromptList | None = None,
    listener: Listener = silent,
) -> list[dict[str, Any]]:
    """Measure the variants; writes ``ablation.json``, ``.csv``, ``.tex`` and ``report.html`` into ``output``.

    A stopped run goes on where it was; the tables are written anew after every run.

    Args:
        capture: Folder with photos, cameras and masks.
        output: Where everything goes.
        config: Settings of the full method; ``config.seed`` is the seed of the Gaussians.
        seeds: Seeds of codebook and language.
        variants: Names out of `VARIANTS`; none takes those that make a difference for the method.
        methods: "averaged", "trained", "lifted", "lifted+tuned"; none takes that of the settings. Rows of several are
            called "METHOD: VARIANT".
        wrong_labels: Share of the pixels of every training view whose code is replaced by a random one.
        forms: How codes and text are compared, each beside the others: "feature" as in the paper, "code". Names of
            rows end in the form where there are several.
        evaluation: How to measure; by default as `paper_evaluation`.
        masks: Folder with the ground truth in any layout of `scenes.annotations`, if not the capture's own.
        prompt_list: Ask the words of the paper or of the released code; for captures called like its scenes.
        listener: Told how far each stage is.

    Returns:
        Rows as `report.table_rows` makes them.

    Raises:
        ValueError: If a variant is unknown, or there is no seed.
        CaptureError: If there is no ground truth of held-out views, or no prompt list for the capture.
    """
    plan = _plan(config, list(methods) or [config.method], variants)
    if not seeds or not forms:
        raise ValueError("an ablation needs at least one seed and one form")
    with_wrong_labels({}, wrong_labels, 1, 0)  # a wrong share is told before anything is made
    measure = in_form(evaluation or paper_evaluation(), forms[0])
    bench = Bench(capture, output, config, measure, listener, masks=masks, prompt_list=prompt_list)
    names = [_row(name, form, forms) for name, _, _ in plan for form in forms]
    results = Results(bench, "ablation", names, seeds, COLUMNS)
    for seed in seeds:  # one seed for all variants first: a stopped run leaves whole tables of fewer seeds
        for name, method, variant in plan:
            settings = with_seed(changed(replace(bench.config, method=method), variant), seed)
            made_from = [*language_settings(settings), *([wrong_labels] if wrong_labels else [])]
            make = partial(make_language, bench, settings, wrong_labels)
            for form in forms:
                bench.evaluation = in_form(measure, form)
                row = _row(name, form, forms)
                results.add(bench.run(row, seed, made_from, make, pictures=seed == seeds[0]))
    return results.rows()


def _plan(
    config: BuildConfig, methods: Sequence[LanguageMethod], variants: Sequence[str]
) -> list[tuple[str, LanguageMethod, str]]:
    """Name, method and variant of every row."""
    for variant in variants:
        changed(config, variant)  # an unknown name is told before anything is made
    rows: list[tuple[str, LanguageMethod, str]] = []
    for method in methods:
        replace(config, method=method)  # as is an unknown method
        for variant in [v for v in variants or variants_of(method) if v in variants_of(method)]:
            rows.append((variant if len(methods) == 1 else f"{method}: {variant}", method, variant))
    return rows


def _row(name: str, form: QueryForm, forms: Sequence[QueryForm]) -> str:
    return name if len(forms) == 1 else f"{name}, {form}"


def in_form(evaluation: EvaluationConfig, form: QueryForm) -> EvaluationConfig:
    """The same measures of relevancies compared in another form."""
    return replace(evaluation, query=replace(evaluation.query, form=form))


def paper_evaluation() -> EvaluationConfig:
    """Strict and official numbers, without LPIPS, which a language does not change."""
    return EvaluationConfig(lpips=False, timing_views=1, protocols=("strict", "official"))


def make_language(
    bench: Bench, config: BuildConfig, wrong_labels: float = 0.0
) -> tuple[LanguageField, dict[str, float]]:
    """A language field by the settings, with the seconds of its stages.

    Wrong labels reach averaged features as the features of the wrong codes.
    """
    views = {name: bench.scene.views[name] for name in bench.scene.train_names}
    bounded, seconds = config.within_memory(), {}
    averaged = config.method == "averaged"
    if not averaged or wrong_labels:
        codebook, code_maps, seconds["codebook"] = bench.codebook(config.codebook, config.seed)
        if wrong_labels:
            code_maps = with_wrong_labels(code_maps, wrong_labels, codebook.num_codes, config.seed)
    start = time.perf_counter()
    field: LanguageField
    if averaged:
        maps = features_of_codes(code_maps, codebook) if wrong_labels else bench.maps
        scratch = bench.folder.root / "checkpoints"
        field = make_averaged_field(bench.gaussians, views, maps, bounded, scratch, bench.listener)
    else:
        cameras = {name: view.camera for name, view in views.items()}
        field = make_field(bench.gaussians, cameras, code_maps, codebook, bounded, bench.listener)
    return field, {**seconds, "language": time.perf_counter() - start}


def language_settings(config: BuildConfig) -> list[Any]:
    """Everything a language depends on beside Gaussians, features and seed."""
    return [
        config.method, config.codebook, config.averaged, config.trained, config.lifted, config.tuning,
    ]  # fmt: skip
