"""``report.html`` of one scene. Worst cases come first, because a reader learns most from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lexsplat.evaluation.report.gallery import Gallery
from lexsplat.evaluation.report.tables import prompts_worst_first, protocol_rows
from lexsplat.evaluation.report.templating import number, write_page
from lexsplat.evaluation.results import Metrics
from lexsplat.queries.heatmaps import color_scale

MAX_CASES = 120
"""Rows of images in a report, at most; the page states how many were left out."""


def write_report(path: Path, metrics: Metrics, gallery: Gallery, *, title: str = "lexsplat") -> None:
    """Write ``report.html``, whole or not at all."""
    data = metrics.to_json()
    language, per_view = data["language"], data["quality"]["per_view"]
    cases = _worst_first(metrics, gallery)
    shown = cases[:MAX_CASES]
    content = {
        **data,
        "title": title,
        "subtitle": "Measured on held-out views",
        "cards": _cards(data),
        "hero": _hero(cases, gallery),
        "protocols": protocol_rows(language, with_localization=True) if language else [],
        "prompts": prompts_worst_first(language["per_prompt"]) if language else [],
        "curves": _curves(metrics),
        "cases": shown,
        "images": gallery.cases,
        "left_out": len(cases) - len(shown),
        "quality_per_view": sorted(per_view.items(), key=lambda item: item[1]["psnr"] or 1e9),
        "shown_views": [view for view in gallery.views if view in {case.view for case in shown}],
    }
    write_page(path, "report.html", content, gallery.views)


@dataclass(frozen=True)
class _Case:
    """A prompt in a view that has images."""

    view: str
    prompt: str
    iou: float
    average_precision: float


def _worst_first(metrics: Metrics, gallery: Gallery) -> list[_Case]:
    cases = [
        _Case(view, prompt, pair.auto.iou, pair.average_precision)
        for view, prompts in metrics.pairs.items()
        for prompt, pair in prompts.items()
        if (view, prompt) in gallery.cases
    ]
    return sorted(cases, key=lambda case: (case.iou, case.view, case.prompt))


def _cards(data: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The headline numbers."""
    quality = data["quality"]
    facts = [("PSNR", number(quality["psnr"], 2), "dB"), ("SSIM", number(quality["ssim"]), "")]
    if data["language"]:
        strict = data["language"]["strict"]
        facts += [
            ("mIoU", number(strict["auto"]["mIoU"]), "automatic threshold"),
            ("mAP", number(strict["mAP"]), ""),
            ("localization", number(strict["localization"]), ""),
        ]
    return facts


def _hero(cases: Sequence[_Case], gallery: Gallery) -> dict[str, Any] | None:
    """The view of the best case with up to three of its best prompts, and the color scale as CSS stops."""
    if not cases:
        return None
    view = cases[-1].view
    best = [case.prompt for case in reversed(cases) if case.view == view][:3]
    return {
        "view": view,
        "heatmaps": [(prompt, gallery.cases[view, prompt]["heatmap"]) for prompt in best],
        "scale": ", ".join(f"rgb({r} {g} {b})" for r, g, b in color_scale()[::15]),
    }


def _curves(metrics: Metrics) -> list[tuple[str, Any]]:
    """The mean precision-recall curve, then that of each prompt, worst first."""
    if not metrics.curves:
        return []
    ranked = sorted(metrics.curves.items(), key=lambda item: float(item[1].mean()))
    return [("mean of prompts", np.mean([curve for _, curve in ranked], axis=0)), *ranked]
