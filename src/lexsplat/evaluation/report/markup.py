"""Pieces of a page that loads nothing: tables, pictures, curves. Texts given as cells are HTML already."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.evaluation.report.style import PAGE, STYLE
from lexsplat.runtime.files import atomic_path


def write_page(path: Path, title: str, sections: Sequence[str], style: str = "") -> None:
    """Write a page, whole or not at all; empty sections are left out."""
    body = "\n".join(section for section in sections if section)
    page = PAGE.format(title=escape(title), style=STYLE + style, body=body)
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def section(heading: str, content: str) -> str:
    """A part of the page with its heading; nothing if there is no content."""
    return f"<section><h2>{heading}</h2>{content}</section>" if content else ""


def table(names: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML."""
    head = "".join(f"<th>{name}</th>" for name in names)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def facts_table(rows: Sequence[tuple[str, str]]) -> str:
    """Names and values, both HTML; long values are broken, so that a narrow window shows them too."""
    body = "".join(f"<tr><td>{name}</td><td>{value}</td></tr>" for name, value in rows)
    return f'<table class="facts"><tbody>{body}</tbody></table>'


def cards(facts: Sequence[tuple[str, str, str]]) -> str:
    """Large numbers: name, value and a note for each."""
    inner = "".join(
        f'<div class="card"><b>{value}</b><span>{name}</span><small>{note}</small></div>'
        for name, value, note in facts
    )
    return f'<div class="cards">{inner}</div>'


def header(title: str, subtitle: str, content: str) -> str:
    """Heading of the page, a line under it, and what follows."""
    return f"<header><h1>{escape(title)}</h1><p>{escape(subtitle)}</p>{content}</header>"


def image(jpeg: bytes, description: str, caption: str = "") -> str:
    """A picture that lies inside the page."""
    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    picture = f'<img src="{data_uri(jpeg)}" alt="{escape(description)}">'
    return f"<figure>{picture}{text}</figure>"


def data_uri(jpeg: bytes) -> str:
    """A JPEG as an address."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


def meter(share: float | None) -> str:
    """A bar for a number in 0..1."""
    filled = 100 * max(0.0, min(1.0, share or 0.0))
    return f'<span class="meter"><i style="width:{filled:.1f}%"></i></span>'


def curve_points(curve: Sequence[float] | NDArray[np.float64]) -> str:
    """Points of a precision-recall curve at 101 recalls, in the frame of `plot`."""
    return " ".join(f"{10 + 1.2 * i:.1f},{86 - 80 * float(value):.1f}" for i, value in enumerate(curve))


def plot(name: str, lines: str, note: str = "", kind: str = "") -> str:
    """A small square of precision over recall around lines of SVG."""
    return (
        f'<figure class="plot {kind}">'
        f'<svg viewBox="0 0 140 96" role="img" aria-label="precision over recall of {escape(name)}">'
        f'<path d="M10 6V86H130M10 46H130M70 6V86" class="grid"/>{lines}</svg>'
        f"<figcaption>{escape(name)} {note}</figcaption></figure>"
    )


def folded(heading: str, content: str) -> str:
    """A part that is opened by a click."""
    return f"<details><summary>{escape(heading)}</summary>{content}</details>"


def folded_json(heading: str, content: Any) -> str:
    """A JSON document that is opened by a click."""
    return folded(heading, f"<pre>{escape(json.dumps(content, indent=2, ensure_ascii=False))}</pre>")


_PROVENANCE = (
    "seed", "seeds", "device", "method", "clip", "dino", "downscale", "iterations", "platform", "cpu", "cores", "gpu",
)  # fmt: skip


def provenance(config: Mapping[str, Any], machine: Mapping[str, Any]) -> str:
    """What somebody needs to repeat the numbers: seed, models, machine, ground truth, versions; all settings
    folded.
    """
    known = {**config, **machine}
    rows = [(name, escape(_words(known[name]))) for name in _PROVENANCE if known.get(name) is not None]
    if known.get("ground_truth"):
        rows.append(("ground truth", escape(_ground_truth_words(known["ground_truth"]))))
    versions = machine.get("versions") or {}
    if versions:
        rows.append(("versions", escape(", ".join(f"{name} {value}" for name, value in versions.items()))))
    shown = facts_table(rows) if rows else ""
    return shown + folded_json("machine", machine) + folded_json("config", config)


def _ground_truth_words(ground_truth: Mapping[str, Any]) -> str:
    asked = ground_truth.get("prompt_list")
    return f"{ground_truth.get('folder')}, " + (
        f"words of the list {asked}" if asked else "words of the masks"
    )


def _words(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
