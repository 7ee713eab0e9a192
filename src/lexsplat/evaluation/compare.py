"""``lexsplat compare``: several methods on the same Gaussians and features, as in Table 1 of the paper."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lexsplat.evaluation import EvaluationConfig, GroundTruthSource, baselines
from lexsplat.evaluation.ablate import in_form, language_settings, make_language
from lexsplat.evaluation.experiments import Bench, Made, Results
from lexsplat.evaluation.methods import Method
from lexsplat.language import methods as language
from lexsplat.pipeline.config import BuildConfig
from lexsplat.queries.relevancy import QueryForm, embed_prompts
from lexsplat.runtime.progress import Listener, silent

OURS = language.names()
"""Our methods. With the suffix "-code" they answer by single Gaussians, with "-feature" in the paper's form."""

BASELINES = ("dff", "lerf", "3dovs", "nearest")
"""The methods that the paper compares with, and "nearest", a lower bound without 3D."""

FORMS: tuple[QueryForm, ...] = ("code", "feature")
"""Suffixes of our methods."""

METHODS = (*OURS, *(f"{name}-{form}" for name in OURS for form in FORMS), *BASELINES)
"""Everything that can be compared."""


@dataclass(frozen=True)
class ComparisonPlan:
    """The rows of a comparison, and how often each is measured.

    Args:
        methods: Names out of `METHODS`.
        seeds: Seeds of codebook and language; one is enough for deterministic methods.

    Raises:
        ValueError: If a method is unknown, or there is no method or seed.
    """

    methods: Sequence[str] = ("averaged", "averaged-code", "trained-feature", *BASELINES)
    seeds: Sequence[int] = (0,)

    def __post_init__(self) -> None:
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown or not self.methods or not self.seeds:
            raise ValueError(f"methods are {', '.join(METHODS)}; got {', '.join(unknown) or 'too few'}")


def compare(
    source: Path,
    output: Path,
    config: BuildConfig,
    plan: ComparisonPlan | None = None,
    *,
    evaluation: EvaluationConfig | None = None,
    ground_truth: GroundTruthSource | None = None,
    listener: Listener = silent,
) -> list[dict[str, Any]]:
    """Measure the methods; writes ``comparison.json``, ``.csv``, ``.tex`` and ``.html`` into ``output``.

    An interrupted command resumes where it stopped; the tables are rewritten after every run. Memory is the peak of
    the process while a method's language is made (Linux only); storage is what a scene must keep to answer;
    training time is reconstruction, features and language.

    Args:
        source: Folder with photos, cameras and masks.
        output: Folder for everything that is written.
        config: Settings; ``config.seed`` is the seed of the Gaussians.
        plan: The rows and seeds; None takes the defaults.
        evaluation: How to measure; None takes the defaults: all protocols.
        ground_truth: Where the ground truth is read from; None takes the capture's.
        listener: Receives progress events.

    Returns:
        Rows as `report.table_rows` makes them.

    Raises:
        CaptureError: If there is no ground truth of held-out views, or no prompt list for the capture.
    """
    plan = plan or ComparisonPlan()
    shared = evaluation or EvaluationConfig()
    bench = Bench(source, output, config, shared, ground_truth, listener)
    results = Results(bench, "comparison", plan.methods, plan.seeds)
    for seed in plan.seeds:
        for name in plan.methods:
            forms = [form for form in FORMS if name.endswith(f"-{form}")]
            bench.evaluation = in_form(shared, forms[0]) if forms else shared
            settings, make = _method(bench, name, seed)
            results.add(bench.run(name, seed, settings, make, pictures=seed == plan.seeds[0]))
    return results.rows()


def _method(bench: Bench, name: str, seed: int) -> tuple[list[Any], Callable[[], Made]]:
    """The settings a method depends on, and a function that makes its language."""
    own = name.removesuffix("-feature").removesuffix("-code")
    if own in OURS:
        config = replace(bench.config, method=own, seed=seed)  # type: ignore[arg-type]
        return language_settings(config), lambda: make_language(bench, config)
    settings = {
        "dff": baselines.DffConfig(),
        "lerf": baselines.LerfConfig(),
        "3dovs": baselines.Ovs3dConfig(),
        "nearest": None,
    }[name]
    prompts = list(bench.ground_truth.prompts()) if name == "3dovs" else []
    return [name, settings, prompts], lambda: _baseline(bench, name, settings, seed)


def _baseline(bench: Bench, name: str, settings: Any, seed: int) -> Made:
    views, maps = bench.capture.views, bench.maps
    training: Mapping[str, Any] = {name: views[name].camera for name in bench.capture.train_names}
    memory = bench.memory
    data = baselines.TrainingData(bench.gaussians, training, maps, bench.level_maps)
    start = time.perf_counter()
    found: Method
    if name == "dff":
        found = baselines.distill(data, settings, seed=seed, memory=memory, listener=bench.listener)
    elif name == "lerf":
        found = baselines.fit_lerf(data, settings, memory=memory, listener=bench.listener)
    elif name == "3dovs":
        classes = embed_prompts(
            bench.ground_truth.prompts(), bench.encode_text, bench.evaluation.query.templates
        )
        found = baselines.fit_3dovs(
            data, classes, settings, seed=seed, memory=memory, listener=bench.listener
        )
    else:
        found = baselines.ViewFeatures({view: v.camera for view, v in views.items()}, maps)
    return found, {name: time.perf_counter() - start}
