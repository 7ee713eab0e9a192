"""Several methods on one page: ``report.html`` of ``compare`` and ``ablate``.

Like the report of one scene it is one file that loads nothing, and its worst cases come first: those that are bad on
the average of all methods. Beside each other stand what the methods answer to the same prompt in the same view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from lexsplat.evaluation.report.gallery import Gallery
from lexsplat.evaluation.report.markup import (
    cards,
    curve_points,
    folded,
    header,
    image,
    meter,
    plot,
    provenance,
    section,
    table,
    write_page,
)
from lexsplat.evaluation.report.page import view_styles
from lexsplat.evaluation.report.tables import (
    OTHER_PROTOCOLS,
    Row,
    best_rows,
    heading,
    mean_and_spread,
    number,
    prompts_worst_first,
    row_cells,
)

MAX_CASES = 40
"""Prompts in a view that are shown with the pictures of all methods."""

COLORS = 10
"""Colors of lines in the style sheet."""


@dataclass(frozen=True)
class MeasuredMethod:
    """One method, or variant of one, with its runs.

    Args:
        name: As in the table.
        results: Contents of ``metrics.json``, one for each seed.
        curves: Interpolated precision at 101 recalls by prompt, of the first seed.
        cases: ``{view: {prompt: {"IoU", "AP"}}}`` of the first seed, IoU at the automatic threshold.
        gallery: Pictures of the first seed.
    """

    name: str
    results: Sequence[Mapping[str, Any]]
    curves: Mapping[str, Sequence[float]] = field(default_factory=dict)
    cases: Mapping[str, Mapping[str, Mapping[str, float | None]]] = field(default_factory=dict)
    gallery: Gallery = field(default_factory=Gallery)

    def of_prompts(self, key: str) -> dict[str, tuple[float | None, float | None]]:
        """Mean and spread over the seeds of one number of every prompt."""
        rows = [result["language"]["per_prompt"] for result in self.results if result.get("language")]
        prompts = sorted({prompt for row in rows for prompt in row})
        return {p: mean_and_spread([row[p].get(key) for row in rows if p in row]) for p in prompts}


def write_comparison(
    path: Path,
    methods: Sequence[MeasuredMethod],
    rows: Sequence[Row],
    *,
    title: str,
    subtitle: str = "",
    columns: Sequence[str] = (),
    config: Mapping[str, Any] | None = None,
    machine: Mapping[str, Any] | None = None,
    max_cases: int = MAX_CASES,
) -> None:
    """Write the page, whole or not at all.

    Args:
        path: The file.
        methods: What was measured.
        rows: The same as rows of the table (`tables.table_rows`), in the same order.
        title: Heading of the page.
        subtitle: Line under it.
        columns: Keys of the table; none takes those of the paper's Table 1 and ours.
        config: Settings, with "seeds".
        machine: What it ran on.
        max_cases: Most cases with pictures; the page says how many were left out.
    """
    ranked = _worst_first(methods)
    shown = ranked[:max_cases]
    views = _shared_views(methods)
    sections = [
        header(title, subtitle, cards(_facts(methods, rows))),
        section("Table", _result_table(rows, columns) + _reading(rows)),
        section(
            "Other protocols", _result_table(rows, OTHER_PROTOCOLS) if _any(rows, OTHER_PROTOCOLS) else ""
        ),
        section("IoU of prompts, worst first", _prompt_table(methods, "IoU_auto")),
        section("Average precision of prompts, worst first", _prompt_table(methods, "AP")),
        section("Precision over recall, all views", _curves(methods)),
        section("Cases, worst first", _cases(methods, shown, views, len(ranked) - len(shown))),
        section("Every prompt of every method", _details(methods)),
        section("Seconds and seeds", _seconds(methods)),
        section("Settings and machine", provenance(config or {}, machine or {})),
    ]
    write_page(path, title, sections, view_styles(views, {view for view, _ in shown}))


def _facts(methods: Sequence[MeasuredMethod], rows: Sequence[Row]) -> list[tuple[str, str, str]]:
    """The best of the most telling numbers, with the name of whose it is."""
    facts = []
    for key, name in (("mIoU", "best mIoU"), ("mAP", "best mAP"), ("mIoU_oracle", "best with oracle")):
        best = sorted(best_rows(rows, key))
        if best:
            value = mean_and_spread(rows[best[0]].get(key))[0]
            facts.append((name, number(value), escape(str(rows[best[0]]["name"]))))
    prompts = {prompt for method in methods for views in method.cases.values() for prompt in views}
    views = {view for method in methods for view in method.cases}
    if prompts:
        facts += [("prompts", str(len(prompts)), ""), ("held-out views", str(len(views)), "")]
    return facts


def _any(rows: Sequence[Row], keys: Sequence[str]) -> bool:
    return bool(row_cells(rows, keys)[0])


def _result_table(rows: Sequence[Row], keys: Sequence[str]) -> str:
    shown, texts = row_cells(rows, keys)
    best = {key: best_rows(rows, key) for key in shown}
    cells = [
        [
            escape(str(row["name"])),
            *(f"<b>{t}</b>" if place in best[key] else t for key, t in zip(shown, line)),
        ]
        for place, (row, line) in enumerate(zip(rows, texts))
    ]
    return table(["", *map(heading, shown)], cells)


def _reading(rows: Sequence[Row]) -> str:
    seeds = max((int(row.get("runs", 1)) for row in rows), default=1)
    spread = f" Mean ± standard deviation over {seeds} seeds." if seeds > 1 else ""
    return (
        "<p>Strict protocol: mIoU, mPA and mP at the automatic threshold, which is chosen for each prompt from "
        "training views and never sees the ground truth; beside it mIoU at the fixed threshold of 0.5 and at the "
        "oracle's, which sees it: an upper bound, not a result. The best of a column is bold."
        f"{spread}</p>"
    )


def _prompt_table(methods: Sequence[MeasuredMethod], key: str) -> str:
    """One row for each prompt, one column for each method, sorted by the mean of the methods."""
    numbers = [method.of_prompts(key) for method in methods]
    prompts = sorted({prompt for found in numbers for prompt in found})
    means = {p: mean_and_spread([found[p][0] for found in numbers if p in found])[0] for p in prompts}
    rows = []
    for prompt in sorted(prompts, key=lambda p: (means[p] or 0.0, p)):
        cells = []
        for found in numbers:
            mean, spread = found.get(prompt, (None, None))
            cells.append(meter(mean) + number(mean) + ("" if spread is None else f" ± {number(spread)}"))
        rows.append([escape(prompt), f"<b>{number(means[prompt])}</b>", *cells])
    names = ["prompt", "mean", *(escape(method.name) for method in methods)]
    return table(names, rows) if rows else ""


def _curves(methods: Sequence[MeasuredMethod]) -> str:
    """A plot for each prompt with a line for each method, and one of their means."""
    drawn = [method for method in methods if method.curves]
    if not drawn:
        return ""
    prompts = sorted({prompt for method in drawn for prompt in method.curves})
    average = {p: float(np.mean([np.mean(m.curves[p]) for m in drawn if p in m.curves])) for p in prompts}
    legend = "".join(
        f'<span class="s{place % COLORS}"><i></i>{escape(m.name)}</span>'
        for place, m in enumerate(methods)
        if m.curves
    )
    means = {m.name: np.mean(list(m.curves.values()), axis=0) for m in drawn}
    plots = [plot("mean of prompts", _lines(methods, means), kind="mean")]
    for prompt in sorted(prompts, key=lambda p: (average[p], p)):
        found = {m.name: m.curves[prompt] for m in drawn if prompt in m.curves}
        plots.append(plot(prompt, _lines(methods, found), f"<b>{average[prompt]:.3f}</b>"))
    note = "<p>First seed; pixels of all held-out views together. The number is the mean of the methods.</p>"
    return f'<div class="legend">{legend}</div><div class="plots">{"".join(plots)}</div>{note}'


def _lines(methods: Sequence[MeasuredMethod], curves: Mapping[str, Any]) -> str:
    return "".join(
        f'<polyline class="s{place % COLORS}" points="{curve_points(curves[method.name])}"/>'
        for place, method in enumerate(methods)
        if method.name in curves
    )


def _worst_first(methods: Sequence[MeasuredMethod]) -> list[tuple[str, str]]:
    """Views and prompts that have pictures, by the mean IoU of the methods."""
    found: dict[tuple[str, str], list[float]] = {}
    for method in methods:
        for case in method.gallery.cases:
            iou = method.cases.get(case[0], {}).get(case[1], {}).get("IoU")
            found.setdefault(case, []).append(iou or 0.0)
    return sorted(found, key=lambda case: (float(np.mean(found[case])), case))


def _shared_views(methods: Sequence[MeasuredMethod]) -> Gallery:
    """Photo and rendering of every view: the same for all methods."""
    views: dict[str, dict[str, bytes]] = {}
    for method in methods:
        for view, pictures in method.gallery.views.items():
            views.setdefault(view, pictures)
    return Gallery(views=views)


def _cases(
    methods: Sequence[MeasuredMethod], cases: Sequence[tuple[str, str]], views: Gallery, left_out: int
) -> str:
    if not cases:
        return ""
    place_of = {view: place for place, view in enumerate(views.views)}
    blocks = [
        "<p>For each prompt in a view: photo, rendering and ground truth, then each method's relevancy "
        "above and its mask at the automatic threshold below. First seed.</p>"
    ]
    for view, prompt in cases:
        own = [method for method in methods if (view, prompt) in method.gallery.cases]
        shared = [
            f'<figure><div class="pic {kind}-{place_of[view]}" role="img" '
            f'aria-label="{word} of {escape(view)}"></div>'
            f"<figcaption>{word}</figcaption></figure>"
            for kind, word in (("photo", "photo"), ("render", "rendering"))
        ]
        shared.append(
            image(own[0].gallery.cases[view, prompt]["ground_truth"], f"truth of {prompt}", "ground_truth")
        )
        columns = "".join(_column(method, view, prompt) for method in own)
        blocks.append(
            f'<div class="versus"><p><b>{escape(prompt)}</b> in {escape(view)}</p>'
            f'<div class="row shared">{"".join(shared)}</div><div class="row">{columns}</div></div>'
        )
    if left_out > 0:
        blocks.append(f"<p>{left_out} better cases are left out.</p>")
    return "".join(blocks)


def _column(method: MeasuredMethod, view: str, prompt: str) -> str:
    """What one method answers: its name and numbers, heatmap, mask."""
    pictures = method.gallery.cases[view, prompt]
    numbers = method.cases.get(view, {}).get(prompt, {})
    scores = f"IoU {number(numbers.get('IoU'))} · AP {number(numbers.get('AP'))}"
    tiles = "".join(
        image(pictures[kind], f"{kind} of {prompt} by {method.name}") for kind in ("heatmap", "mask")
    )
    return f'<div class="answer"><p>{escape(method.name)}<span>{scores}</span></p>{tiles}</div>'


def _details(methods: Sequence[MeasuredMethod]) -> str:
    """All numbers of every prompt under the strict protocol, folded, for each method; mean over the seeds."""
    keys = (
        "IoU_auto",
        "IoU_fixed",
        "IoU_oracle",
        "PA",
        "P",
        "AP",
        "localization",
        "IoU_lerf_2d",
        "IoU_lerf_3d",
    )
    names = "prompt,IoU,fixed 0.5,oracle,PA,P,AP,localization,lerf-2d,lerf-3d,threshold,best threshold,views"
    parts = []
    for method in methods:
        numbers = {key: method.of_prompts(key) for key in keys}
        first: Mapping[str, Any] = next(
            (r["language"]["per_prompt"] for r in method.results if r.get("language")), {}
        )
        rows = [
            [
                escape(prompt),
                *(number(numbers[key].get(prompt, (None, None))[0]) for key in keys),
                number(row["thresholds"]["auto"]),
                number(row["thresholds"]["oracle"]),
                str(row["views"]),
            ]
            for prompt, row in prompts_worst_first(first)
        ]
        if rows:
            parts.append(folded(method.name, table(names.split(","), rows)))
    return "".join(parts)


def _seconds(methods: Sequence[MeasuredMethod]) -> str:
    """Seeds, and the seconds of every stage: mean over the seeds."""
    stages = list(dict.fromkeys(s for m in methods for r in m.results for s in r["speed"]["stage_seconds"]))
    rows = []
    for method in methods:
        seconds = [result["speed"]["stage_seconds"] for result in method.results]
        seeds = ", ".join(str(result["config"].get("seed", "-")) for result in method.results)
        means = [mean_and_spread([s.get(stage) for s in seconds])[0] for stage in stages]
        rows.append([escape(method.name), seeds, *(number(mean, 1) for mean in means)])
    return table(["", "seeds", *map(escape, stages)], rows)
