"""The evaluation as a page to look at.

``report.html`` is one file that loads nothing: styles, pictures and curves are inside, and its own content
policy forbids any request. Worst cases come first, because they are what a reader can learn from.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lexsplat.evaluation import Metrics
from lexsplat.evaluation.report.gallery import Gallery
from lexsplat.evaluation.report.markup import (
    cards,
    curve_points,
    data_uri,
    facts_table,
    header,
    image,
    meter,
    plot,
    provenance,
    section,
    table,
    write_page,
)
from lexsplat.evaluation.report.tables import COLUMNS, number, prompts_worst_first, protocol_rows, size_text
from lexsplat.queries.heatmaps import color_scale

MAX_CASES = 120
"""Rows of pictures in a report."""


def write_report(
    path: Path,
    metrics: Metrics,
    gallery: Gallery | None = None,
    *,
    title: str = "lexsplat",
    subtitle: str = "Measured on held-out views",
    max_cases: int = MAX_CASES,
) -> None:
    """Write ``report.html``, whole or not at all.

    Args:
        path: The file.
        metrics: What was measured.
        gallery: Pictures of the same evaluation.
        title: Heading of the page.
        subtitle: Line under it.
        max_cases: Most rows of pictures; the page says how many were left out.
    """
    gallery = gallery or Gallery()
    data = metrics.to_json()
    cases = _worst_first(metrics, gallery)
    sections = [
        _header(title, subtitle, data),
        _hero(cases, gallery),
        section("Words", _language_table(data)),
        section("Prompts, worst first", _prompt_table(data)),
        section("Precision over recall, all views", _curves(metrics)),
        section("Cases, worst first", _cases(cases, gallery, max_cases)),
        section("Pictures", _quality_table(data)),
        section("Speed and size", _resources(data)),
        section("Settings and machine", provenance(data["config"], data["machine"])),
    ]
    write_page(path, title, sections, view_styles(gallery, {case.view for case in cases[:max_cases]}))


@dataclass(frozen=True)
class _Case:
    """A prompt in a view that has pictures."""

    view: str
    prompt: str
    iou: float
    average_precision: float


def _worst_first(metrics: Metrics, gallery: Gallery) -> list[_Case]:
    cases = [
        _Case(view, prompt, pair.counts.at(metrics.thresholds[prompt]["auto"]).iou, pair.average_precision)
        for view, prompts in metrics.pairs.items()
        for prompt, pair in prompts.items()
        if (view, prompt) in gallery.cases
    ]
    return sorted(cases, key=lambda case: (case.iou, case.view, case.prompt))


# Sections of the page


def _header(title: str, subtitle: str, data: Mapping[str, Any]) -> str:
    facts = [
        ("PSNR", number(data["quality"]["psnr"], 2), "dB"),
        ("SSIM", number(data["quality"]["ssim"]), ""),
    ]
    if data["language"]:
        strict = data["language"]["strict"]
        facts += [
            ("mIoU", number(strict["auto"]["mIoU"]), "automatic threshold"),
            ("mAP", number(strict["mAP"]), ""),
            ("localization", number(strict["localization"]), ""),
        ]
    return header(title, subtitle, cards(facts))


def _hero(cases: Sequence[_Case], gallery: Gallery) -> str:
    if not cases:
        return ""
    view = cases[-1].view
    prompts = [case.prompt for case in reversed(cases) if case.view == view][:3]
    tiles = [image(gallery.views[view]["render"], f"rendering of {view}", "novel view")]
    tiles += [
        image(gallery.cases[view, prompt]["heatmap"], f"relevancy of {prompt}", prompt) for prompt in prompts
    ]
    stops = ", ".join(f"rgb({r} {g} {b})" for r, g, b in color_scale()[::15])
    scale = f'<i style="background:linear-gradient(90deg,{stops})"></i>'
    bar = f'<div class="bar"><span>not relevant</span>{scale}<span>most relevant</span></div>'
    return f'<div class="hero">{"".join(tiles)}</div>{bar}'


def _language_table(data: Mapping[str, Any]) -> str:
    if not data["language"]:
        return "<p>This scene has no masks, so words were not measured.</p>"
    rows = [
        [escape(name), *(number(row.get(key)) for key in (*COLUMNS, "localization", "acc_25", "acc_50"))]
        for name, row in protocol_rows({**data["language"], "strict": _with_localization(data)})
    ]
    note = (
        "<p>Prompts are averaged within a view, then views. The automatic threshold is chosen for each "
        "prompt from training views and never sees the truth. The oracle does: it is an upper bound, not a "
        "result. The official protocol repeats the authors' released evaluation, quirks included; its mAP "
        "can be 1.01. lerf-2d is LangSplat's: a map stretched to its own range is cut, and its blurred peak has to "
        "lie in a box. lerf-3d selects Gaussians by the automatic threshold and renders them alone; Acc is the "
        "share of IoUs beyond a quarter and a half. These two cannot be compared with each other.</p>"
    )
    form, method = (escape(str(data["language"].get(key))) for key in ("form", "method"))
    kind = f"<p>Relevancy: form <code>{form}</code>; language field: <code>{method}</code>.</p>"
    names = ["", *COLUMNS, "localization", "Acc@0.25", "Acc@0.5"]
    return table(names, rows) + _kind_table(data["language"].get("per_kind") or {}) + kind + note


def _with_localization(data: Mapping[str, Any]) -> dict[str, Any]:
    """The strict numbers with the localization beside the automatic threshold, where a reader looks for it."""
    strict = data["language"]["strict"]
    return {**strict, "auto": {**strict["auto"], "localization": strict["localization"]}}


def _kind_table(kinds: Mapping[str, Mapping[str, Any]]) -> str:
    """The strict numbers of each kind of prompt, where the capture says what kinds there are."""
    if not kinds:
        return ""
    names = ("mIoU_auto", "mIoU_oracle", "mAP", "localization")
    rows = [
        [f"{escape(kind)} ({row['prompts']})", *(number(row[name]) for name in names)]
        for kind, row in kinds.items()
    ]
    return table(["kind of prompt", "mIoU auto", "oracle", "mAP", "localization"], rows)


def _prompt_table(data: Mapping[str, Any]) -> str:
    if not data["language"]:
        return ""
    rows = []
    for prompt, row in prompts_worst_first(data["language"]["per_prompt"]):
        limits = row["thresholds"]
        rows.append(
            [
                f"{escape(prompt)}",
                f"{meter(row['IoU_auto'])}{number(row['IoU_auto'])}",
                *(number(row[key]) for key in ("IoU_fixed", "IoU_oracle", "PA", "P", "AP", "localization")),
                number(limits["auto"]),
                number(limits["oracle"]),
                number(row.get("IoU_lerf_2d")),
                number(row.get("IoU_lerf_3d")),
                str(row["views"]),
            ]
        )
    names = "prompt,IoU,fixed,oracle,PA,P,AP,localization,threshold,best threshold,lerf-2d,lerf-3d,views"
    return table(names.split(","), rows)


def _curves(metrics: Metrics) -> str:
    if not metrics.curves:
        return ""
    ranked = sorted(metrics.curves.items(), key=lambda item: float(item[1].mean()))
    mean = np.mean([curve for _, curve in ranked], axis=0)
    plots = [_plot("mean of prompts", mean, "mean"), *(_plot(prompt, curve, "") for prompt, curve in ranked)]
    return f'<div class="plots">{"".join(plots)}</div>'


def _plot(name: str, curve: NDArray[np.float64], kind: str) -> str:
    points = curve_points(curve)
    lines = f'<polygon points="10,86 {points} 130,86"/><polyline points="{points}"/>'
    return plot(name, lines, f"<b>{float(curve.mean()):.3f}</b>", kind)


def _cases(cases: Sequence[_Case], gallery: Gallery, limit: int) -> str:
    if not cases:
        return ""
    heads = "".join(
        f"<span>{name}</span>" for name in ("photo", "rendering", "relevancy", "mask", "ground_truth")
    )
    rows = [f'<div class="cases"><div class="case head">{heads}</div>']
    index = {view: place for place, view in enumerate(gallery.views)}
    for case in cases[:limit]:
        pictures = gallery.cases[case.view, case.prompt]
        tiles = [
            f'<div class="pic {kind}-{index[case.view]}" role="img" '
            f'aria-label="{kind} of {escape(case.view)}"></div>'
            for kind in ("photo", "render")
        ]
        tiles += [
            image(pictures[kind], f"{kind} of {case.prompt}") for kind in ("heatmap", "mask", "ground_truth")
        ]
        words = f"<b>{escape(case.prompt)}</b> in {escape(case.view)}"
        numbers = f"IoU {number(case.iou)} · AP {number(case.average_precision)}"
        rows.append(f'<div class="case"><p>{words}<span>{numbers}</span></p>{"".join(tiles)}</div>')
    rows.append("</div>")
    left_out = len(cases) - limit
    if left_out > 0:
        rows.append(f"<p>{left_out} better cases are left out.</p>")
    return "".join(rows)


def _quality_table(data: Mapping[str, Any]) -> str:
    rows = [
        [escape(view), number(scores["psnr"], 2), number(scores["ssim"]), number(scores["lpips"])]
        for view, scores in sorted(
            data["quality"]["per_view"].items(), key=lambda item: item[1]["psnr"] or 1e9
        )
    ]
    reason = data["quality"].get("lpips_reason")
    note = f"<p>LPIPS was not measured: {escape(reason)}.</p>" if reason else ""
    return table(["view", "PSNR", "SSIM", "LPIPS"], rows) + note


def _resources(data: Mapping[str, Any]) -> str:
    speed, size = data["speed"], data["size"]
    rows = [
        ("frames a second, color and one prompt", number(speed["render_fps"], 1)),
        ("frames a second, color", number(speed["rgb_fps"], 1)),
        ("milliseconds for a prompt in a view", number(speed["query_ms"], 1)),
        ("Gaussians", f"{size['gaussians']:,}"),
        ("geometry and color", size_text(size["gaussian_bytes"])),
        ("language", size_text(size["language_bytes"])),
        ("peak memory", size_text(size["peak_rss_bytes"])),
        ("peak memory of the GPU", size_text(size["peak_gpu_bytes"])),
    ]
    rows += [
        (f"seconds of {escape(name)}", number(value, 1)) for name, value in speed["stage_seconds"].items()
    ]
    return facts_table(rows)


def view_styles(gallery: Gallery, used: set[str]) -> str:
    """Photo and rendering of a view stand beside each of its prompts: stored once, as backgrounds."""
    rules = []
    for place, (view, pictures) in enumerate(gallery.views.items()):
        if view in used:
            width, height = Image.open(io.BytesIO(pictures["photo"])).size
            for kind, jpeg in pictures.items():
                rules.append(
                    f".{kind}-{place}{{background-image:url({data_uri(jpeg)});aspect-ratio:{width}/{height}}}"
                )
    return "\n".join(rules)
