"""``lexsplat compare``: several methods on the same Gaussians and features, as in Table 1 of the paper."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

from lexsplat.evaluation.ablate import language_row
from lexsplat.evaluation.baselines import BASELINES, BaselineRun, TrainingData
from lexsplat.evaluation.experiments import Bench, Made, Row, require_each_once
from lexsplat.language.methods import METHODS, MethodName
from lexsplat.queries.relevancy import QueryForm, embed_prompts

COMPARED = (*METHODS, *(f"{name}-{form}" for name in METHODS for form in ("code", "feature")), *BASELINES)
"""Everything that can be compared. With "-code", our methods answer by single Gaussians; with "-feature", in the
paper's form of relevancy."""


@dataclass(frozen=True)
class ComparisonPlan:
    """The rows of a comparison, and how often each is measured.

    Args:
        methods: Names out of `COMPARED`.
        seeds: Seeds of codebook and language; one is enough for deterministic methods.

    Raises:
        ValueError: If a method is unknown, there is no method or seed, or one is given twice.
    """

    methods: Sequence[str] = ("averaged", "averaged-code", "trained-feature", *BASELINES)
    seeds: Sequence[int] = (0,)

    def __post_init__(self) -> None:
        unknown = [name for name in self.methods if name not in COMPARED]
        if unknown or not self.methods or not self.seeds:
            raise ValueError(f"methods are {', '.join(COMPARED)}; got {', '.join(unknown) or 'too few'}")
        require_each_once(methods=self.methods, seeds=self.seeds)

    def refuse_without_crop_sizes(self) -> None:
        """Refuse methods that cannot use features of another program, before anything that takes time.

        Raises:
            ValueError: If a method needs features of several crop sizes.
        """
        others = [
            name for name in self.methods if name not in BASELINES or not BASELINES[name].needs_crop_sizes
        ]
        unfit = [name for name in self.methods if name not in others]
        if unfit:
            way = f"give --methods {' '.join(others)}" if others else "give other --methods"
            raise ValueError(
                f"--features-from has one feature a pixel, and {' and '.join(unfit)} need several crop sizes: {way}"
            )


def compare(bench: Bench, plan: ComparisonPlan | None = None) -> list[dict[str, Any]]:
    """Measure the methods; writes ``comparison.json``, ``.csv``, ``.tex`` and ``.html`` (`Bench.measure`).

    Memory is the peak of the process while a method's language is made (Linux only). Storage is the size of the data
    needed to answer. Training time is reconstruction, features and language.

    Args:
        bench: Bench that makes and measures the methods.
        plan: The rows and seeds; None takes the defaults.

    Returns:
        Rows as `report.table_rows` makes them.
    """
    plan = plan or ComparisonPlan()
    return bench.measure("comparison", [_row(bench, name) for name in plan.methods], plan.seeds)


def _row(bench: Bench, name: str) -> Row:
    own, _, form = name.partition("-")
    if own in METHODS:
        config = replace(bench.config, method=cast(MethodName, own))
        return language_row(bench, name, config, cast(QueryForm, form or "segment"))
    baseline = BASELINES[name]
    prompts = bench.ground_truth.prompts() if baseline.knows_prompts else ()
    key = [name, baseline.settings, list(prompts)]

    def make(seed: int) -> Made:
        training = {view.name: view.camera for view in bench.capture.train_views}
        data = TrainingData(bench.gaussians, training, bench.maps, bench.level_maps)
        cameras = {name: view.camera for name, view in bench.capture.views.items()}
        start = time.perf_counter()
        classes = embed_prompts(prompts, bench.encode_text) if prompts else None
        run = BaselineRun(cameras, classes, seed, bench.config.memory_bytes, bench.listener)
        return Made(baseline.fit(data, run), {name: time.perf_counter() - start})

    return Row(name, key, make)
