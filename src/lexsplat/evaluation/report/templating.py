"""Jinja2 environment of the reports.

A page is one file that loads nothing: styles, images and curves are inside, and its own content security policy
forbids every request.
"""

from __future__ import annotations

import base64
import functools
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from numpy.typing import NDArray
from PIL import Image

from lexsplat.runtime.files import write_file


def write_page(path: Path, template: str, content: Mapping[str, Any], views: Mapping[str, Any]) -> None:
    """Render a template into a file, whole or not at all.

    Args:
        path: The file.
        template: File name in ``templates/``.
        content: Variables of the template, with "title", "subtitle", "cards" (names, values and notes), "shown_views"
            (names of ``views`` whose images the page contains), "config" and "machine".
        views: ``{view: {"photo" | "render": JPEG}}``.
    """
    variables = {
        **content,
        "views": views,
        "view_index": {view: index for index, view in enumerate(views)},
        "provenance": _provenance(content["config"], content["machine"]),
        "documents": {name: content[name] for name in ("machine", "config")},
    }
    write_file(path, environment().get_template(template).render(variables))


def latex_table(headings: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]]) -> str:
    """A LaTeX table of named rows, for ``booktabs``."""
    # LaTeX is full of braces: this template has other delimiters.
    latex = environment().overlay(
        variable_start_string="<<", variable_end_string=">>", block_start_string="<%", block_end_string="%>",
        autoescape=False,
    )  # fmt: skip
    return latex.get_template("table.tex").render(headings=headings, rows=rows)


@functools.cache
def environment() -> Environment:
    """The templates with their filters; everything but LaTeX is escaped."""
    found = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    found.filters |= {
        "number": number,
        "bytes": size_text,
        "data_uri": lambda jpeg: "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii"),
        "aspect_ratio": lambda jpeg: "{}/{}".format(*Image.open(io.BytesIO(jpeg)).size),
        "curve_points": curve_points,
        "pretty_json": lambda content: json.dumps(content, indent=2, ensure_ascii=False),
        "latex": _latex,
    }
    found.globals["parts"] = found.get_template("parts.html").module
    return found


def number(value: float | None, digits: int = 3) -> str:
    """A number with a fixed number of decimals; "-" for None and NaN."""
    return "-" if value is None or value != value else f"{value:.{digits}f}"


def size_text(count: int | None) -> str:
    """A number of bytes in the largest fitting unit (powers of 1000)."""
    if count is None:
        return "-"
    value, unit = float(count), "B"
    for larger in ("KB", "MB", "GB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"


def curve_points(curve: Sequence[float] | NDArray[np.float64]) -> str:
    """SVG points of a precision-recall curve at 101 recalls, in the frame of the macro ``plot``."""
    return " ".join(f"{10 + 1.2 * i:.1f},{86 - 80 * float(value):.1f}" for i, value in enumerate(curve))


def _latex(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    special |= {character: f"\\{character}" for character in "&%$#_{}"}
    return "".join(special.get(character, character) for character in text)


_PROVENANCE = (
    "seed", "seeds", "device", "method", "clip", "dino", "downscale", "iterations", "photos", "platform", "cpu",
    "cores", "gpu",
)  # fmt: skip


def _provenance(config: Mapping[str, Any], machine: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Facts needed to reproduce the numbers: seed, models, machine, ground truth, versions."""
    known = {**config, **machine}
    pairs = [(name, _words(known[name])) for name in _PROVENANCE if known.get(name) is not None]
    if ground_truth := known.get("ground_truth"):
        prompt_list = ground_truth.get("prompt_list")
        prompts = f"prompts of the list {prompt_list}" if prompt_list else "prompts of the ground truth"
        pairs.append(("ground truth", f"{ground_truth.get('folder')}, {prompts}"))
    pairs += [("warning", warning) for warning in known.get("warnings", ())]
    if versions := machine.get("versions"):
        pairs.append(("versions", ", ".join(f"{name} {value}" for name, value in versions.items())))
    return pairs


def _words(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
