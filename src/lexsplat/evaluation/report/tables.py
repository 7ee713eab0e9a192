"""Results as tables: for the terminal, as CSV, and as LaTeX in the columns of the paper's Table 1."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lexsplat.evaluation.report.templating import latex_table, number, size_text
from lexsplat.runtime.files import write_file

COLUMNS = ("mIoU", "mPA", "mP", "mAP")

_PAPER = {
    "psnr": ("PSNR", 2), "ssim": ("SSIM", 3), "lpips": ("LPIPS", 3), "mPA": ("mPA", 3), "mP": ("mP", 3),
    "mIoU": ("mIoU", 3), "mAP": ("mAP", 3), "fps": ("FPS", 1), "host_bytes": ("host memory", -1),
    "gpu_bytes": ("GPU memory", -1), "storage_bytes": ("storage", -1), "training_seconds": ("training", -2),
}  # fmt: skip
"""Columns of the paper's Table 1: key, heading, decimals (-1: bytes, -2: seconds)."""

_HONEST = {
    "mIoU_fixed": ("mIoU 0.5", 3), "mIoU_oracle": ("oracle", 3), "localization": ("localization", 3),
    "language_seconds": ("language", -2),
}  # fmt: skip
"""Columns that the paper does not report."""

_OTHERS = {
    "official_mIoU": ("official mIoU", 3), "official_mPA": ("mPA", 3), "official_mP": ("mP", 3),
    "official_mAP": ("mAP", 3), "lerf_2d_mIoU": ("lerf-2d mIoU", 3), "lerf_2d_localization": ("localization", 3),
    "lerf_3d_mIoU": ("lerf-3d mIoU", 3), "lerf_3d_acc_25": ("Acc@0.25", 3), "lerf_3d_acc_50": ("Acc@0.5", 3),
}  # fmt: skip

OTHER_PROTOCOLS = tuple(_OTHERS)
"""Columns of the protocols of other authors."""

_HEADINGS = {**_PAPER, **_HONEST, **_OTHERS, "query_ms": ("ms/prompt", 1)}

_MEASURED_ONCE = {
    "fps", "query_ms", "host_bytes", "gpu_bytes", "storage_bytes", "training_seconds", "language_seconds",
}  # fmt: skip
"""Columns whose differences may be noise of the machine: no value of them is marked as best."""

_CAMERA_STAGES = ("poses", "views")
"""Stages that make cameras: no column counts their time."""

REFERENCE_ROWS = frozenset({"nearest"})
"""Rows that are shown but never marked as best: they use the evaluated photo itself."""

Row = Mapping[str, Any]
"""One line of a table: "name", and numbers by key; several runs give a list of numbers."""


def protocol_rows(
    language: Mapping[str, Any], *, with_localization: bool = False
) -> list[tuple[str, Mapping[str, Any]]]:
    """The lines of the language table: a name and its numbers in `COLUMNS`.

    Args:
        language: The section of ``metrics.json``.
        with_localization: Whether the line of the automatic threshold has the strict localization, too.
    """
    strict = language["strict"]
    found = {"localization": strict["localization"]} if with_localization else {}
    rows = [
        ("automatic threshold", {**strict["auto"], "mAP": strict["mAP"], **found}),
        ("fixed threshold", strict["fixed"]),
        ("oracle threshold", strict["oracle"]),
    ]
    names = {"official": "official protocol", "lerf_2d": "lerf-2d protocol", "lerf_3d": "lerf-3d protocol"}
    return rows + [(name, language[key]) for key, name in names.items() if language.get(key)]


def prompts_worst_first(prompts: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Rows of "per_prompt", the worst IoU first."""
    return sorted(prompts.items(), key=lambda item: (item[1]["IoU_auto"] or 0.0, item[0]))


def format_table(result: Mapping[str, Any]) -> str:
    """The content of ``metrics.json`` as a table for the terminal."""
    quality, speed, size = result["quality"], result["speed"], result["size"]
    psnr, ssim, lpips = number(quality["psnr"], 2), number(quality["ssim"]), number(quality["lpips"])
    lines = [f"PSNR {psnr} dB   SSIM {ssim}   LPIPS {lpips}"]
    if result["language"]:
        lines += _language_lines(result["language"])
    stored = f"{size_text(size['gaussian_bytes'])}; language {size_text(size['language_bytes'])}"
    memory = size_text(size["peak_rss_bytes"])
    lines += ["", f"{size['gaussians']:,} Gaussians, {stored}; peak memory {memory}"]
    if speed["render_fps"]:
        fps, query = number(speed["render_fps"], 1), number(speed["query_ms"], 1)
        lines.append(f"{fps} frames/s with language, {query} ms per prompt and view")
    return "\n".join(lines)


def _language_lines(language: Mapping[str, Any]) -> list[str]:
    strict = language["strict"]
    lines = ["", f"{'':<22}" + "".join(f"{name:>8}" for name in COLUMNS)]
    for name, row in protocol_rows(language):
        lines.append(f"{name:<22}" + "".join(f"{number(row.get(key)):>8}" for key in COLUMNS))
    lines.append(f"{'localization':<22}{number(strict['localization']):>8}")
    if language.get("lerf_2d"):
        lines.append(f"{'  lerf-2d':<22}{number(language['lerf_2d']['localization']):>8}")
    lines.append("")
    kinds = language.get("per_kind") or {}
    for kind, row in kinds.items():
        numbers = (row["mIoU_auto"], row["mAP"], row["localization"])
        cells = "".join(f"{number(value):>8}" for value in numbers)
        lines.append(f"{kind + ' prompts':<22}{cells}{row['prompts']:>7}")
    lines += ["(by kind: mIoU auto, mAP, localization, prompts)", ""] if kinds else []
    prompts = language["per_prompt"]
    width = min(40, max(len(prompt) for prompt in prompts))
    lines.append(f"{'prompt':<{width}}{'IoU':>8}{'AP':>8}{'loc':>8}{'views':>7}")
    for prompt, row in prompts_worst_first(prompts):
        numbers = (row["IoU_auto"], row["AP"], row["localization"])
        cells = "".join(f"{number(value):>8}" for value in numbers)
        lines.append(f"{prompt[:width]:<{width}}{cells}{row['views']:>7}")
    return lines


# Rows to compare


def table_rows(
    results: Mapping[str, Mapping[str, Any] | Sequence[Mapping[str, Any]]],
) -> list[dict[str, Any]]:
    """Rows for `write_rows` from contents of ``metrics.json``.

    Args:
        results: By row name: one result, or one for each seed.

    Returns:
        Dictionaries with "name", "runs" and, for each number, the list of its values over the runs.
    """
    rows = []
    for name, found in results.items():
        runs = [found] if isinstance(found, Mapping) else list(found)
        columns: dict[str, list[float | None]] = {}
        for run in runs:
            for key, value in _numbers(run).items():
                columns.setdefault(key, []).append(value)
        rows.append({"name": name, "runs": len(runs), **columns})
    return rows


def _numbers(result: Mapping[str, Any]) -> dict[str, float | None]:
    quality, speed, size = result["quality"], result["speed"], result["size"]
    language = result["language"] or {}
    strict = language.get("strict") or {}
    auto = strict.get("auto") or {}
    numbers: dict[str, float | None] = {name: quality.get(name) for name in ("psnr", "ssim", "lpips")}
    numbers |= {name: auto.get(name) for name in ("mPA", "mP", "mIoU")}
    numbers |= {"mAP": strict.get("mAP"), "localization": strict.get("localization")}
    for kind in ("fixed", "oracle"):
        numbers |= {f"{name}_{kind}": (strict.get(kind) or {}).get(name) for name in ("mPA", "mP", "mIoU")}
    for protocol in ("official", "lerf_2d", "lerf_3d"):
        numbers |= {f"{protocol}_{name}": v for name, v in (language.get(protocol) or {}).items()}
    seconds = speed.get("stage_seconds") or {}
    seconds = {stage: value for stage, value in seconds.items() if stage not in _CAMERA_STAGES}
    language_stages = [value for stage, value in seconds.items() if stage not in ("reconstruct", "features")]
    return numbers | {
        "fps": speed.get("render_fps"),
        "query_ms": speed.get("query_ms"),
        "host_bytes": size.get("peak_rss_bytes"),
        "gpu_bytes": size.get("peak_gpu_bytes"),
        "storage_bytes": size.get("language_bytes"),
        "training_seconds": sum(seconds.values()) if seconds else None,
        "language_seconds": sum(language_stages) if language_stages else None,
    }


def known_values(values: Any) -> list[float]:
    """The finite numbers of one value or a list of values."""
    listed = values if isinstance(values, (list, tuple)) else [values]
    return [float(value) for value in listed if value is not None and math.isfinite(value)]


def mean_and_std(values: Any) -> tuple[float | None, float | None]:
    """Mean and sample standard deviation of the finite values; None where there are too few."""
    known = known_values(values)
    if not known:
        return None, None
    return float(np.mean(known)), float(np.std(known, ddof=1)) if len(known) > 1 else None


def row_cells(rows: Sequence[Row], keys: Sequence[str] = ()) -> tuple[list[str], list[list[str]]]:
    """The keys that have a value in any row, and their values as text, row by row.

    Args:
        rows: As `table_rows` returns them.
        keys: Which numbers; empty: the columns of the paper's Table 1 and ours.
    """
    shown = [key for key in keys or (*_PAPER, *_HONEST) if any(known_values(row.get(key)) for row in rows)]
    return shown, [[_cell(row.get(key), _HEADINGS[key][1]) for key in shown] for row in rows]


def heading(key: str) -> str:
    """Heading of a column."""
    return _HEADINGS[key][0]


def best_rows(rows: Sequence[Row], key: str) -> set[int]:
    """Indices of the rows with the best mean of a score; empty if all are equal, and for times and sizes."""
    methods = {i: row.get(key) for i, row in enumerate(rows) if row.get("name") not in REFERENCE_ROWS}
    means = {i: mean for i, values in methods.items() if (mean := mean_and_std(values)[0]) is not None}
    if len(set(means.values())) < 2 or key in _MEASURED_ONCE:
        return set()
    best = (min if key == "lpips" else max)(means.values())
    return {i for i, mean in means.items() if mean == best}


def format_rows(rows: Sequence[Row], keys: Sequence[str] = ()) -> str:
    """Rows as a table for the terminal; several runs as mean and standard deviation."""
    shown, texts_of_rows = row_cells(rows, keys)
    cells = [["", *map(heading, shown)]]
    cells += [[str(row["name"]), *line] for row, line in zip(rows, texts_of_rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    lines = []
    for line in cells:
        texts = [f"{line[0]:<{widths[0]}}", *(f"{text:>{w}}" for text, w in zip(line[1:], widths[1:]))]
        lines.append("  ".join(texts))
    return "\n".join(lines)


def write_rows(folder: Path, stem: str, rows: Sequence[Row], keys: Sequence[str] = ()) -> None:
    """Write rows as ``STEM.csv`` (every number) and ``STEM.tex`` (for ``booktabs``).

    The LaTeX table has the columns of the paper's Table 1, or ``keys`` of them.
    """
    write_file(folder / f"{stem}.csv", csv_text(rows))
    write_file(folder / f"{stem}.tex", latex_text(rows, keys))


def csv_text(rows: Sequence[Row]) -> str:
    """Rows as CSV: the mean of each number, and its standard deviation if there were several runs."""
    keys = list(dict.fromkeys(key for row in rows for key in row if key not in ("name", "runs")))
    several = any(row.get("runs", 1) > 1 for row in rows)
    columns = [name for key in keys for name in ((key, f"{key}_std") if several else (key,))]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["name", "runs", *columns])
    for row in rows:
        values: list[Any] = [row["name"], row.get("runs", 1)]
        for key in keys:
            mean, std = mean_and_std(row.get(key))
            values += ["" if v is None else f"{v:.6g}" for v in ((mean, std) if several else (mean,))]
        writer.writerow(values)
    return stream.getvalue()


def latex_text(rows: Sequence[Row], keys: Sequence[str] = ()) -> str:
    """Rows as a LaTeX table."""
    shown, texts = row_cells(rows, keys or tuple(_PAPER))
    named = [(str(row["name"]), line) for row, line in zip(rows, texts)]
    return latex_table([heading(key) for key in shown], named)


def _cell(values: Any, digits: int) -> str:
    mean, std = mean_and_std(values)
    if digits == -1:
        return size_text(None if mean is None else int(mean))
    if digits == -2:
        return "-" if mean is None else f"{mean:.0f} s"
    text = number(mean, digits)
    return text if std is None else f"{text} ± {number(std, digits)}"
