"""Several methods on one page: the report of ``compare`` and ``ablate``.

The maps of all methods for the same prompt and view are shown side by side, the cases with the worst mean
over the methods first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lexsplat.evaluation.report.gallery import Gallery
from lexsplat.evaluation.report.tables import (
    OTHER_PROTOCOLS,
    REFERENCE_ROWS,
    Row,
    best_rows,
    heading,
    mean_and_std,
    prompts_worst_first,
    row_cells,
    table_rows,
)
from lexsplat.evaluation.report.templating import number, write_page

MAX_CASES = 40
"""Cases that are shown with the images of all methods, at most; the page states how many were left out."""

COLORS = 10
"""Line colors in the style sheet."""

_DETAILS = (
    "IoU_auto", "IoU_fixed", "IoU_oracle", "PA", "P", "AP", "localization", "IoU_lerf_2d", "IoU_lerf_3d",
)  # fmt: skip


@dataclass(frozen=True)
class MeasuredMethod:
    """One method, or variant of one, with its runs.

    Args:
        name: As in the table.
        results: Contents of ``metrics.json``, one for each seed.
        curves: Interpolated precision at 101 recalls by prompt, of the first seed.
        cases: ``{view: {prompt: {"IoU", "AP"}}}`` of the first seed, IoU at the automatic threshold.
        gallery: Images of the first seed.
    """

    name: str
    results: Sequence[Mapping[str, Any]]
    curves: Mapping[str, Sequence[float]] = field(default_factory=dict)
    cases: Mapping[str, Mapping[str, Mapping[str, float | None]]] = field(default_factory=dict)
    gallery: Gallery = field(default_factory=Gallery)

    def case(self, view: str, prompt: str) -> Mapping[str, float | None]:
        """The numbers of one prompt in one view; empty if unknown."""
        return self.cases.get(view, {}).get(prompt, {})

    def of_prompts(self, key: str) -> dict[str, tuple[float | None, float | None]]:
        """Mean and standard deviation over the seeds of one number of each prompt."""
        rows = [result["language"]["per_prompt"] for result in self.results if result.get("language")]
        prompts = sorted({prompt for row in rows for prompt in row})
        return {p: mean_and_std([row[p].get(key) for row in rows if p in row]) for p in prompts}


def write_comparison(
    path: Path,
    methods: Sequence[MeasuredMethod],
    title: str,
    columns: Sequence[str] = (),
    *,
    config: Mapping[str, Any],
    machine: Mapping[str, Any],
) -> None:
    """Write the page, whole or not at all.

    Args:
        path: The file.
        methods: The measured methods, in the order of the table.
        title: Heading of the page.
        columns: Keys of the table; empty: the columns of the paper's Table 1 and ours.
        config: Settings, with "seeds".
        machine: Facts about the machine.
    """
    rows = table_rows({method.name: method.results for method in methods})
    ranked = _worst_first(methods)
    shown = ranked[:MAX_CASES]
    stages, seconds = _seconds(methods)
    views = _shared_views(methods)
    content = {
        "title": title,
        "subtitle": "The same Gaussians and the same features, measured on held-out views",
        "cards": _cards(methods, rows),
        "methods": methods,
        "method_names": [method.name for method in methods],
        "colors": {method.name: index % COLORS for index, method in enumerate(methods)},
        "table": _table(rows, columns),
        "other_protocols": _table(rows, OTHER_PROTOCOLS),
        "reference_rows": [str(row["name"]) for row in rows if row["name"] in REFERENCE_ROWS],
        "seeds": max((int(row["runs"]) for row in rows), default=1),
        "prompt_tables": [
            ("IoU", _prompt_table(methods, "IoU_auto")),
            ("Average precision", _prompt_table(methods, "AP")),
        ],
        "curves": _curves(methods),
        "cases": [(v, p, [m for m in methods if (v, p) in m.gallery.cases]) for v, p in shown],
        "left_out": len(ranked) - len(shown),
        "details": [(method.name, prompts) for method in methods if (prompts := _details(method))],
        "stages": stages,
        "stage_seconds": seconds,
        "config": config,
        "machine": machine,
        "shown_views": [view for view in views if view in {view for view, _ in shown}],
    }
    write_page(path, "comparison.html", content, views)


def _cards(methods: Sequence[MeasuredMethod], rows: Sequence[Row]) -> list[tuple[str, str, str]]:
    """The best values with the names of their methods, and the numbers of views and prompts."""
    facts = []
    for key, name in (("mIoU", "best mIoU"), ("mAP", "best mAP"), ("mIoU_oracle", "best oracle mIoU")):
        best = sorted(best_rows(rows, key))
        if best:
            row = rows[best[0]]
            facts.append((name, number(mean_and_std(row.get(key))[0]), str(row["name"])))
    prompts = {prompt for method in methods for views in method.cases.values() for prompt in views}
    views = {view for method in methods for view in method.cases}
    if prompts:
        facts += [("prompts", str(len(prompts)), ""), ("held-out views", str(len(views)), "")]
    return facts


def _table(rows: Sequence[Row], keys: Sequence[str]) -> dict[str, Any]:
    """Headings and rows of cells; the best value of a column is marked."""
    shown, texts = row_cells(rows, keys)
    best = [best_rows(rows, key) for key in shown]
    cells = [[(text, i in marked) for text, marked in zip(line, best)] for i, line in enumerate(texts)]
    return {
        "headings": [heading(key) for key in shown],
        "rows": list(zip([row["name"] for row in rows], cells)),
    }


def _prompt_table(
    methods: Sequence[MeasuredMethod], key: str
) -> list[tuple[str, float | None, list[tuple[float | None, float | None]]]]:
    """Prompt, mean over the methods, and mean and standard deviation of each method; sorted by the mean."""
    numbers = [method.of_prompts(key) for method in methods]
    prompts = sorted({prompt for found in numbers for prompt in found})
    means = {p: mean_and_std([found[p][0] for found in numbers if p in found])[0] for p in prompts}
    return [
        (prompt, means[prompt], [found.get(prompt, (None, None)) for found in numbers])
        for prompt in sorted(prompts, key=lambda p: (means[p] or 0.0, p))
    ]


def _curves(methods: Sequence[MeasuredMethod]) -> list[tuple[str, float, dict[str, Any]]]:
    """Name, mean precision and the curve of each method: first the mean of the prompts, then prompts, worst first."""
    drawn = [method for method in methods if method.curves]
    if not drawn:
        return []
    found = []
    for prompt in {prompt for method in drawn for prompt in method.curves}:
        curves = {method.name: method.curves[prompt] for method in drawn if prompt in method.curves}
        found.append((prompt, float(np.mean([np.mean(curve) for curve in curves.values()])), curves))
    means = {method.name: np.mean(list(method.curves.values()), axis=0) for method in drawn}
    overall = float(np.mean([curve.mean() for curve in means.values()]))
    return [("mean of prompts", overall, means), *sorted(found, key=lambda item: (item[1], item[0]))]


def _worst_first(methods: Sequence[MeasuredMethod]) -> list[tuple[str, str]]:
    """Views and prompts that have images, by the mean IoU of the methods."""
    found: dict[tuple[str, str], list[float]] = {}
    for method in methods:
        for case in method.gallery.cases:
            found.setdefault(case, []).append(method.case(*case).get("IoU") or 0.0)
    return sorted(found, key=lambda case: (float(np.mean(found[case])), case))


def _shared_views(methods: Sequence[MeasuredMethod]) -> dict[str, dict[str, bytes]]:
    """Photo and rendering of each view, the same for all methods."""
    views: dict[str, dict[str, bytes]] = {}
    for method in methods:
        for view, images in method.gallery.views.items():
            views.setdefault(view, images)
    return views


def _details(method: MeasuredMethod) -> list[tuple[str, list[float | None], Any]]:
    """Prompt, its strict numbers (mean over the seeds) and its row of the first seed, worst first."""
    numbers = [method.of_prompts(key) for key in _DETAILS]
    languages = [result["language"] for result in method.results if result.get("language")]
    first = languages[0]["per_prompt"] if languages else {}
    return [
        (prompt, [found.get(prompt, (None, None))[0] for found in numbers], row)
        for prompt, row in prompts_worst_first(first)
    ]


def _seconds(
    methods: Sequence[MeasuredMethod],
) -> tuple[list[str], list[tuple[str, str, list[float | None]]]]:
    """Names of all stages; for each method its name, its seeds, and the mean seconds of each stage."""
    stages = list(dict.fromkeys(s for m in methods for r in m.results for s in r["speed"]["stage_seconds"]))
    rows = []
    for method in methods:
        seconds = [result["speed"]["stage_seconds"] for result in method.results]
        seeds = ", ".join(str(result["config"].get("seed", "-")) for result in method.results)
        rows.append((method.name, seeds, [mean_and_std([s.get(t) for s in seconds])[0] for t in stages]))
    return stages, rows
