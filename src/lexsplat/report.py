"""The evaluation as a page to look at, and as a table for the terminal.

``report.html`` is one file that loads nothing: styles, pictures and curves are inside, and its own content
policy forbids any request. Worst cases come first, because they are what a reader can learn from.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lexsplat.atomic import atomic_path
from lexsplat.evaluation import Metrics, ViewPictures
from lexsplat.heatmaps import color_scale, overlay_heatmap, overlay_mask

MAX_CASES = 120
"""Rows of pictures in a report."""


@dataclass
class Gallery:
    """Collects small pictures while a scene is evaluated: pass `add` as the observer.

    Args:
        width: Width of a picture in pixels.
        views: ``{view: {"photo" | "render": JPEG}}``.
        cases: ``{(view, prompt): {"heatmap" | "mask" | "truth": JPEG}}``.
    """

    width: int = 300
    views: dict[str, dict[str, bytes]] = field(default_factory=dict)
    cases: dict[tuple[str, str], dict[str, bytes]] = field(default_factory=dict)

    def add(self, pictures: ViewPictures) -> None:
        """Keep a view and all its prompts, small."""
        self.views[pictures.name] = {
            "photo": self._jpeg(_to_bytes(pictures.photo)),
            "render": self._jpeg(_to_bytes(pictures.image)),
        }
        for prompt, relevancy in pictures.relevancy.items():
            image, photo = (
                _fit(_to_bytes(side), relevancy.shape) for side in (pictures.image, pictures.photo)
            )
            self.cases[pictures.name, prompt] = {
                "heatmap": self._jpeg(overlay_heatmap(image, relevancy)),
                "mask": self._jpeg(overlay_mask(image, relevancy >= pictures.thresholds[prompt])),
                "truth": self._jpeg(overlay_mask(photo, pictures.truth[prompt], color=(64, 200, 140))),
            }

    def _jpeg(self, picture: NDArray[np.uint8]) -> bytes:
        height = max(1, round(picture.shape[0] * self.width / picture.shape[1]))
        image = Image.fromarray(picture).resize(
            (self.width, height), Image.Resampling.LANCZOS, reducing_gap=3.0
        )
        buffer = io.BytesIO()
        image.save(buffer, format="JPEG", quality=82)
        return buffer.getvalue()


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
        _section("Words", _language_table(data)),
        _section("Prompts, worst first", _prompt_table(data)),
        _section("Precision over recall, all views", _curves(metrics)),
        _section("Cases, worst first", _cases(cases, gallery, max_cases)),
        _section("Pictures", _quality_table(data)),
        _section("Speed and size", _resources(data)),
        _section("Settings and machine", _settings(data)),
    ]
    page = _PAGE.format(
        title=escape(title),
        style=_STYLE + _view_styles(gallery, {case.view for case in cases[:max_cases]}),
        body="\n".join(section for section in sections if section),
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


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


def format_table(result: Mapping[str, Any]) -> str:
    """The content of ``metrics.json`` as a table for the terminal."""
    quality, speed, size = result["quality"], result["speed"], result["size"]
    psnr, ssim, lpips = _number(quality["psnr"], 2), _number(quality["ssim"]), _number(quality["lpips"])
    lines = [f"PSNR {psnr} dB   SSIM {ssim}   LPIPS {lpips}"]
    if result["language"]:
        strict = result["language"]["strict"]
        lines += ["", f"{'':<22}{'mIoU':>8}{'mPA':>8}{'mP':>8}{'mAP':>8}"]
        for name, row in _protocol_rows(result["language"]):
            lines.append(f"{name:<22}" + "".join(f"{_number(row.get(key)):>8}" for key in _COLUMNS))
        lines += [f"{'localisation':<22}{_number(strict['localization']):>8}", ""]
        kinds = result["language"].get("per_kind") or {}
        for kind, row in kinds.items():
            numbers = (row["mIoU_auto"], row["mAP"], row["localization"])
            cells = "".join(f"{_number(number):>8}" for number in numbers)
            lines.append(f"{kind + ' prompts':<22}{cells}{row['prompts']:>7}")
        lines += ["(by kind: mIoU auto, mAP, localisation, prompts)", ""] if kinds else []
        prompts = result["language"]["per_prompt"]
        width = min(40, max(len(prompt) for prompt in prompts))
        lines.append(f"{'prompt':<{width}}{'IoU':>8}{'AP':>8}{'loc':>8}{'views':>7}")
        for prompt, row in _prompts_worst_first(prompts):
            numbers = (row["IoU_auto"], row["AP"], row["localization"])
            cells = "".join(f"{_number(number):>8}" for number in numbers)
            lines.append(f"{prompt[:width]:<{width}}{cells}{row['views']:>7}")
    stored = f"{_bytes(size['gaussian_bytes'])}; language {_bytes(size['language_bytes'])}"
    lines += ["", f"{size['gaussians']:,} Gaussians, {stored}; peak memory {_bytes(size['peak_rss_bytes'])}"]
    if speed["render_fps"]:
        fps, query = _number(speed["render_fps"], 1), _number(speed["query_ms"], 1)
        lines.append(f"{fps} frames/s with language, {query} ms a prompt and view")
    return "\n".join(lines)


# Sections of the page


def _header(title: str, subtitle: str, data: Mapping[str, Any]) -> str:
    facts = [
        ("PSNR", _number(data["quality"]["psnr"], 2), "dB"),
        ("SSIM", _number(data["quality"]["ssim"]), ""),
    ]
    if data["language"]:
        strict = data["language"]["strict"]
        facts += [
            ("mIoU", _number(strict["auto"]["mIoU"]), "automatic threshold"),
            ("mAP", _number(strict["mAP"]), ""),
            ("localisation", _number(strict["localization"]), ""),
        ]
    cards = "".join(
        f'<div class="card"><b>{value}</b><span>{name}</span><small>{note}</small></div>'
        for name, value, note in facts
    )
    return (
        f'<header><h1>{escape(title)}</h1><p>{escape(subtitle)}</p><div class="cards">{cards}</div></header>'
    )


def _hero(cases: Sequence[_Case], gallery: Gallery) -> str:
    if not cases:
        return ""
    view = cases[-1].view
    prompts = [case.prompt for case in reversed(cases) if case.view == view][:3]
    tiles = [_image(gallery.views[view]["render"], f"rendering of {view}", "novel view")]
    tiles += [
        _image(gallery.cases[view, prompt]["heatmap"], f"relevancy of {prompt}", prompt) for prompt in prompts
    ]
    stops = ", ".join(f"rgb({r} {g} {b})" for r, g, b in color_scale()[::15])
    scale = f'<i style="background:linear-gradient(90deg,{stops})"></i>'
    bar = f'<div class="bar"><span>not relevant</span>{scale}<span>most relevant</span></div>'
    return f'<div class="hero">{"".join(tiles)}</div>{bar}'


def _language_table(data: Mapping[str, Any]) -> str:
    if not data["language"]:
        return "<p>This scene has no masks, so words were not measured.</p>"
    rows = [
        [escape(name), *(_number(row.get(key)) for key in _COLUMNS)]
        for name, row in _protocol_rows(data["language"])
    ]
    note = (
        "<p>Prompts are averaged within a view, then views. The automatic threshold is chosen for each "
        "prompt from training views and never sees the truth. The oracle does: it is an upper bound, not a "
        "result. The official protocol repeats the authors' released evaluation, quirks included; its mAP "
        "can be 1.01.</p>"
    )
    form, method = (escape(str(data["language"].get(key))) for key in ("form", "method"))
    kind = f"<p>Relevancy: form <code>{form}</code>; language field: <code>{method}</code>.</p>"
    return _table(["", *_COLUMNS], rows) + _kind_table(data["language"].get("per_kind") or {}) + kind + note


def _kind_table(kinds: Mapping[str, Mapping[str, Any]]) -> str:
    """The strict numbers of each kind of prompt, where the capture says what kinds there are."""
    if not kinds:
        return ""
    names = ("mIoU_auto", "mIoU_oracle", "mAP", "localization")
    rows = [
        [f"{escape(kind)} ({row['prompts']})", *(_number(row[name]) for name in names)]
        for kind, row in kinds.items()
    ]
    return _table(["kind of prompt", "mIoU auto", "oracle", "mAP", "localisation"], rows)


def _prompt_table(data: Mapping[str, Any]) -> str:
    if not data["language"]:
        return ""
    rows = []
    for prompt, row in _prompts_worst_first(data["language"]["per_prompt"]):
        share = max(0.0, min(1.0, row["IoU_auto"] or 0.0))
        meter = f'<span class="meter"><i style="width:{100 * share:.1f}%"></i></span>'
        limits = row["thresholds"]
        rows.append(
            [
                f"{escape(prompt)}",
                f"{meter}{_number(row['IoU_auto'])}",
                *(_number(row[key]) for key in ("IoU_fixed", "IoU_oracle", "PA", "P", "AP", "localization")),
                _number(limits["auto"]),
                _number(limits["oracle"]),
                str(row["views"]),
            ]
        )
    names = "prompt,IoU,fixed,oracle,PA,P,AP,localisation,threshold,best threshold,views"
    return _table(names.split(","), rows)


def _curves(metrics: Metrics) -> str:
    if not metrics.curves:
        return ""
    ranked = sorted(metrics.curves.items(), key=lambda item: float(item[1].mean()))
    mean = np.mean([curve for _, curve in ranked], axis=0)
    plots = [_plot("mean of prompts", mean, "mean"), *(_plot(prompt, curve, "") for prompt, curve in ranked)]
    return f'<div class="plots">{"".join(plots)}</div>'


def _plot(name: str, curve: NDArray[np.float64], kind: str) -> str:
    points = " ".join(f"{10 + 1.2 * i:.1f},{86 - 80 * float(value):.1f}" for i, value in enumerate(curve))
    area = f"10,86 {points} 130,86"
    return (
        f'<figure class="plot {kind}">'
        f'<svg viewBox="0 0 140 96" role="img" aria-label="precision over recall of {escape(name)}">'
        f'<path d="M10 6V86H130M10 46H130M70 6V86" class="grid"/>'
        f'<polygon points="{area}"/><polyline points="{points}"/></svg>'
        f"<figcaption>{escape(name)} <b>{float(curve.mean()):.3f}</b></figcaption></figure>"
    )


def _cases(cases: Sequence[_Case], gallery: Gallery, limit: int) -> str:
    if not cases:
        return ""
    heads = "".join(f"<span>{name}</span>" for name in ("photo", "rendering", "relevancy", "mask", "truth"))
    rows = [f'<div class="case head">{heads}</div>']
    index = {view: number for number, view in enumerate(gallery.views)}
    for case in cases[:limit]:
        pictures = gallery.cases[case.view, case.prompt]
        tiles = [
            f'<div class="pic {kind}-{index[case.view]}" role="img" '
            f'aria-label="{kind} of {escape(case.view)}"></div>'
            for kind in ("photo", "render")
        ]
        tiles += [_image(pictures[kind], f"{kind} of {case.prompt}") for kind in ("heatmap", "mask", "truth")]
        words = f"<b>{escape(case.prompt)}</b> in {escape(case.view)}"
        numbers = f"IoU {_number(case.iou)} · AP {_number(case.average_precision)}"
        rows.append(f'<div class="case"><p>{words}<span>{numbers}</span></p>{"".join(tiles)}</div>')
    left_out = len(cases) - limit
    if left_out > 0:
        rows.append(f"<p>{left_out} better cases are left out.</p>")
    return "".join(rows)


def _quality_table(data: Mapping[str, Any]) -> str:
    rows = [
        [escape(view), _number(scores["psnr"], 2), _number(scores["ssim"]), _number(scores["lpips"])]
        for view, scores in sorted(
            data["quality"]["per_view"].items(), key=lambda item: item[1]["psnr"] or 1e9
        )
    ]
    reason = data["quality"].get("lpips_reason")
    note = f"<p>LPIPS was not measured: {escape(reason)}.</p>" if reason else ""
    return _table(["view", "PSNR", "SSIM", "LPIPS"], rows) + note


def _resources(data: Mapping[str, Any]) -> str:
    speed, size = data["speed"], data["size"]
    rows = [
        ["frames a second, colour and one prompt", _number(speed["render_fps"], 1)],
        ["frames a second, colour", _number(speed["rgb_fps"], 1)],
        ["milliseconds for a prompt in a view", _number(speed["query_ms"], 1)],
        ["Gaussians", f"{size['gaussians']:,}"],
        ["geometry and colour", _bytes(size["gaussian_bytes"])],
        ["language", _bytes(size["language_bytes"])],
        ["peak memory", _bytes(size["peak_rss_bytes"])],
        ["peak memory of the GPU", _bytes(size["peak_gpu_bytes"])],
    ]
    rows += [
        [f"seconds of {escape(name)}", _number(value, 1)] for name, value in speed["stage_seconds"].items()
    ]
    return _table(["", ""], rows)


def _settings(data: Mapping[str, Any]) -> str:
    parts = []
    for name in ("machine", "config"):
        text = escape(json.dumps(data[name], indent=2, ensure_ascii=False))
        parts.append(f"<details><summary>{name}</summary><pre>{text}</pre></details>")
    return "".join(parts)


# Pieces

_COLUMNS = ("mIoU", "mPA", "mP", "mAP")


def _protocol_rows(language: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    strict = language["strict"]
    return [
        ("automatic threshold", {**strict["auto"], "mAP": strict["mAP"]}),
        ("fixed threshold", strict["fixed"]),
        ("oracle threshold", strict["oracle"]),
        ("official protocol", language["official"]),
    ]


def _prompts_worst_first(prompts: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return sorted(prompts.items(), key=lambda item: (item[1]["IoU_auto"] or 0.0, item[0]))


def _section(heading: str, content: str) -> str:
    return f"<section><h2>{heading}</h2>{content}</section>" if content else ""


def _table(names: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{name}</th>" for name in names)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _image(jpeg: bytes, description: str, caption: str = "") -> str:
    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    picture = f'<img src="{_data_uri(jpeg)}" alt="{escape(description)}">'
    return f"<figure>{picture}{text}</figure>"


def _view_styles(gallery: Gallery, used: set[str]) -> str:
    """Photo and rendering of a view stand beside each of its prompts: stored once, as backgrounds."""
    rules = []
    for number, (view, pictures) in enumerate(gallery.views.items()):
        if view in used:
            width, height = Image.open(io.BytesIO(pictures["photo"])).size
            for kind, jpeg in pictures.items():
                rules.append(
                    f".{kind}-{number}{{background-image:url({_data_uri(jpeg)});aspect-ratio:{width}/{height}}}"
                )
    return "\n".join(rules)


def _data_uri(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


def _to_bytes(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    return (np.clip(picture, 0, 1) * 255).round().astype(np.uint8)


def _fit(picture: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    if picture.shape[:2] == shape:
        return picture
    return np.asarray(Image.fromarray(picture).resize((shape[1], shape[0]), Image.Resampling.BICUBIC))


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None or value != value else f"{value:.{digits}f}"


def _bytes(count: int | None) -> str:
    if count is None:
        return "-"
    value, unit = float(count), "B"
    for larger in ("KB", "MB", "GB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" 
  content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style></head>
<body><main>
{body}
</main></body></html>
"""

_STYLE = """
:root{color-scheme:light dark;--ground:#fbfaf8;--panel:#fff;--ink:#1d1c22;--soft:#6d6a75;
  --line:#e6e3de;--accent:#c2410c}
@media(prefers-color-scheme:dark){:root{
  --ground:#131217;--panel:#1c1b22;--ink:#ecebf0;--soft:#9a97a5;
  --line:#2e2c37;--accent:#fb923c}}
*{box-sizing:border-box}
body{margin:0;background:var(--ground);color:var(--ink);
  font:15px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1180px;margin:0 auto;padding:48px 24px 96px}
h1{font-size:34px;letter-spacing:-.02em;margin:0}
header p{color:var(--soft);margin:4px 0 24px}
h2{font-size:20px;letter-spacing:-.01em;margin:56px 0 16px}
section p{color:var(--soft);max-width:75ch}
.cards{display:flex;flex-wrap:wrap;gap:12px}
.card{background:var(--panel);border:1px solid var(--line);border-radius:12px;
  padding:14px 20px;min-width:128px}
.card b{display:block;font-size:26px;font-variant-numeric:tabular-nums;letter-spacing:-.02em}
.card span{display:block}
.card small{color:var(--soft)}
figure{margin:0}
img,.pic{display:block;width:100%;border-radius:8px;background-size:cover;
  print-color-adjust:exact;-webkit-print-color-adjust:exact}
figcaption{color:var(--soft);font-size:13px;margin-top:6px}
.hero{display:grid;grid-template-columns:repeat(auto-fit,minmax(220px,1fr));gap:12px;margin-top:32px}
.bar{display:flex;align-items:center;gap:10px;color:var(--soft);font-size:12px;margin-top:14px}
.bar i{flex:1;max-width:280px;height:8px;border-radius:4px}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;min-width:50%}
th,td{padding:7px 14px 7px 0;text-align:right;border-bottom:1px solid var(--line);white-space:nowrap}
th{color:var(--soft);font-weight:500;font-size:13px}
th:first-child,td:first-child{text-align:left}
.meter{display:inline-block;width:72px;height:6px;border-radius:3px;background:var(--line);
  margin-right:10px;vertical-align:middle;overflow:hidden}
.meter i{display:block;height:100%;background:var(--accent)}
.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(160px,1fr));gap:18px}
.plot svg{display:block;width:100%}
.plot .grid{fill:none;stroke:var(--line);stroke-width:1}
.plot polyline{fill:none;stroke:var(--accent);stroke-width:1.6;stroke-linejoin:round}
.plot polygon{fill:var(--accent);opacity:.12}
.plot.mean polyline{stroke:var(--ink);stroke-width:2.2}
.plot b{color:var(--ink);float:right}
.case{display:grid;grid-template-columns:repeat(5,1fr);gap:8px;margin-bottom:20px}
.case p{grid-column:1/-1;margin:0;color:var(--ink);max-width:none}
.case p span{float:right;color:var(--soft);font-variant-numeric:tabular-nums}
.case.head{color:var(--soft);font-size:13px;margin-bottom:4px}
details{margin:8px 0;background:var(--panel);border:1px solid var(--line);border-radius:10px;
  padding:10px 16px}
summary{cursor:pointer}
pre{overflow-x:auto;font-size:12px;color:var(--soft)}
"""
