"""Averages the scores of each prompt in each view to the metrics of a scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.evaluation.metrics import MaskScores, ThresholdCounts, interpolated_precision
from lexsplat.evaluation.protocols import accuracy_at
from lexsplat.evaluation.results import THRESHOLD_KINDS, PairResult, Pairs

Thresholds = Mapping[str, Mapping[str, float]]
_MASK_NAMES = {"mIoU": "iou", "mPA": "accuracy", "mP": "precision"}


def summarize_language(pairs: Pairs, thresholds: Thresholds) -> dict[str, Any] | None:
    """The section "language" of ``metrics.json``; None without pairs.

    The strict and the official protocol average prompts within a view, then views. The LERF-OVS protocols average all
    pairs equally.

    Args:
        pairs: ``{view: {prompt: result}}``.
        thresholds: ``{prompt: {kind: threshold}}`` for every kind of `THRESHOLD_KINDS`.
    """
    if not pairs:
        return None

    def scores_of(pair: PairResult, prompt: str, kind: str) -> MaskScores:
        return pair.auto if kind == "auto" else pair.counts.at(thresholds[prompt][kind])

    scores = {
        kind: {v: {p: scores_of(pair, p, kind) for p, pair in ps.items()} for v, ps in pairs.items()}
        for kind in THRESHOLD_KINDS
    }
    strict: dict[str, Any] = {
        kind: {name: _average(scores[kind], field_name) for name, field_name in _MASK_NAMES.items()}
        for kind in THRESHOLD_KINDS
    }
    strict["mAP"] = _average(pairs, "average_precision")
    strict["localization"] = _average(pairs, "localization")
    return {
        "strict": strict,
        **_other_protocols(pairs),
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


def _other_protocols(pairs: Pairs) -> dict[str, Any]:
    found: dict[str, Any] = {}
    every = [pair for prompts in pairs.values() for pair in prompts.values()]
    if all(pair.official is not None for pair in every):
        official = {
            view: {p: pair.official for p, pair in prompts.items()} for view, prompts in pairs.items()
        }
        names = {**_MASK_NAMES, "mAP": "average_precision"}
        found["official"] = {name: _average(official, field_name) for name, field_name in names.items()}
    flat = [pair.lerf_2d for pair in every if pair.lerf_2d is not None]
    if flat:
        found["lerf_2d"] = {
            "mIoU": mean_of([scores.iou for scores in flat]),
            "localization": mean_of([float(scores.hit) for scores in flat]),
        }
    ious = [pair.lerf_3d for pair in every if pair.lerf_3d is not None]
    if ious:
        found["lerf_3d"] = {
            "mIoU": mean_of(ious),
            "acc_25": accuracy_at(ious, 0.25),
            "acc_50": accuracy_at(ious, 0.5),
        }
    return found


def summarize_kinds(pairs: Pairs, thresholds: Thresholds, kinds: Mapping[str, str]) -> dict[str, Any]:
    """The strict metrics of `summarize_language` by kind of prompt: ``{kind: {..., "prompts"}}``."""
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
    thresholds: Thresholds,
) -> dict[str, Any]:
    views = [view for view, prompts in pairs.items() if prompt in prompts]
    auto = [scores["auto"][view][prompt] for view in views]
    results: list[PairResult] = [pairs[view][prompt] for view in views]
    row = {
        "views": len(views),
        "thresholds": dict(thresholds[prompt]),
        **{f"IoU_{kind}": mean_of([scores[kind][v][prompt].iou for v in views]) for kind in THRESHOLD_KINDS},
        "PA": mean_of([entry.accuracy for entry in auto]),
        "P": mean_of([entry.precision for entry in auto]),
        "AP": mean_of([pair.average_precision for pair in results]),
        "localization": mean_of([pair.localization for pair in results]),
    }
    if any(pair.lerf_2d for pair in results):
        row["IoU_lerf_2d"] = mean_of([pair.lerf_2d.iou for pair in results if pair.lerf_2d])
    if any(pair.lerf_3d is not None for pair in results):
        row["IoU_lerf_3d"] = mean_of([pair.lerf_3d for pair in results])
    return row


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
    """Mean over images of the mean over the prompts of an image."""
    return mean_of([mean_of([getattr(e, name) for e in ps.values()]) for ps in entries.values()])


def mean_of(values: Sequence[float | None]) -> float | None:
    """Mean ignoring None and NaN; None if nothing remains."""
    known = [value for value in values if value is not None and not math.isnan(value)]
    return float(np.mean(known)) if known else None
