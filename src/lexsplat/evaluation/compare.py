"""``lexsplat compare``: several methods on the same Gaussians and features, in the columns of the paper's Table 1."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lexsplat.captures.ground_truth.prompt_lists import PromptList
from lexsplat.evaluation import PROTOCOLS, EvaluationConfig, baselines
from lexsplat.evaluation.ablate import in_form, language_settings, make_language
from lexsplat.evaluation.experiments import Bench, Results, with_seed
from lexsplat.evaluation.methods import Method
from lexsplat.language.fields import LanguageField
from lexsplat.pipeline.config import BuildConfig
from lexsplat.queries.relevancy import embed_prompts
from lexsplat.runtime.memory import parse_bytes
from lexsplat.runtime.progress import Listener, silent

OURS = ("averaged", "lifted", "trained", "lifted+tuned")
"""Our fields; with "-feature" behind, answered in the paper's form of relevancy."""

BASELINES = ("dff", "lerf", "3dovs", "nearest")
"""What the paper compares with, and the sanity line without 3D."""

METHODS = (*OURS, *(f"{name}-feature" for name in OURS), *BASELINES)

Made = tuple[LanguageField | Method, dict[str, float]]


def compare(
    capture: Path,
    output: Path,
    config: BuildConfig,
    *,
    methods: Sequence[str] = ("averaged", "lifted", "trained-feature", *BASELINES),
    seeds: Sequence[int] = (0,),
    lpips: bool = True,
    masks: Path | None = None,
    prompt_list: PromptList | None = None,
    protocols: Sequence[str] = PROTOCOLS,
    listener: Listener = silent,
) -> list[dict[str, Any]]:
    """Measure the methods; writes ``comparison.json``, ``.csv``, ``.tex`` and ``report.html`` into ``output``.

    A stopped run goes on where it was; the tables are written anew after every run. Memory is the peak while a
    method's language is made, where the system can tell (Linux), and includes what the process holds anyway;
    storage is what has to be kept to answer; training time is reconstruction, features and language.

    Args:
        capture: Folder with photos, cameras and masks.
        output: Where everything goes.
        config: Settings; ``config.seed`` is the seed of the Gaussians.
        methods: Names out of `METHODS`.
        seeds: Seeds of codebook and language; one is enough for methods without chance.
        lpips: Measure LPIPS if it is installed.
        masks: Folder with the ground truth in any layout of `scenes.annotations`, if not the capture's own.
        prompt_list: Ask the words of the paper or of the released code; for captures called like its scenes.
        protocols: Names out of `evaluation.PROTOCOLS`; "strict" is always measured.
        listener: Told how far each stage is.

    Returns:
        Rows as `report.table_rows` makes them.

    Raises:
        ValueError: If a method or protocol is unknown, or there is no method or seed.
        CaptureError: If there is no ground truth of held-out views, or no prompt list for the capture.
    """
    unknown = [name for name in methods if name not in METHODS]
    if unknown or not methods or not seeds:
        raise ValueError(f"methods are {', '.join(METHODS)}; got {', '.join(unknown) or 'too few'}")
    evaluation = EvaluationConfig(lpips=lpips, protocols=tuple(protocols))
    bench = Bench(capture, output, config, evaluation, listener, masks=masks, prompt_list=prompt_list)
    shared = bench.evaluation
    results = Results(bench, "comparison", methods, seeds)
    for seed in seeds:
        for name in methods:
            bench.evaluation = in_form(shared, "feature") if name.endswith("-feature") else shared
            settings, make = _method(bench, name, seed)
            results.add(bench.run(name, seed, settings, make, pictures=seed == seeds[0]))
    return results.rows()


def _method(bench: Bench, name: str, seed: int) -> tuple[list[Any], Callable[[], Made]]:
    """What a method depends on, and how it is made."""
    own = name.removesuffix("-feature")
    if own in OURS:
        config = with_seed(replace(bench.config, method=own), seed)  # type: ignore[arg-type]
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
    scene, maps = bench.scene, bench.maps
    training: Mapping[str, Any] = {view: scene.views[view].camera for view in scene.train_names}
    memory = parse_bytes(bench.config.memory)
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
        found = baselines.ViewFeatures({view: v.camera for view, v in scene.views.items()}, maps)
    return found, {name: time.perf_counter() - start}
