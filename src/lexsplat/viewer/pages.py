"""Pieces of the page. Every text that comes from a user, a file or a scene is escaped here."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape

import numpy as np
from PIL import Image

from lexsplat.queries.heatmaps import color_scale
from lexsplat.viewer.coloring import Mode
from lexsplat.viewer.session import Answer, Question

_MUTED = "color:#6b7280"
_ROW = "display:flex;align-items:center;gap:.5em;padding:.15em 0"
_BOX = "font-size:.8rem;line-height:1.45;padding:.1em .75em;color:#1f2937"
_PRESENT = {"yes": ("found", "#15803d"), "unsure": ("unsure", "#b45309"), "no": ("not here", "#b91c1c")}


def box(content: str) -> str:
    """A block of the panel around trusted ``content``."""
    return f'<div style="{_BOX}">{content}</div>'


def note(text: str) -> str:
    """A quiet sentence."""
    return box(f'<span style="{_MUTED}">{escape(text)}</span>')


def warning(text: str) -> str:
    """Something that went wrong, in one line."""
    return box(f'<span style="color:#b91c1c">{escape(text)}</span>')


def legend(questions: Sequence[Question], mode: Mode, scale: tuple[float, float], hint: str) -> str:
    """What the colors mean."""
    if mode == "relevancy":
        shown = [question for question in questions if question.layer.shown]
        if not shown:
            return note(hint)
        rows = "".join(_question_row(question, alone=len(shown) == 1) for question in shown)
        if len(shown) == 1:
            layer = shown[0].layer
            rows += _bar(f"{layer.threshold:.2f}", "relevancy", f"{layer.high:.2f}", start=0.3)
        return box(rows)
    if mode == "uncertainty":
        return box(_bar(f"{scale[0]:.2f}", "uncertainty", f"{scale[1]:.2f}"))
    if mode == "depth":
        return box(_bar(f"{scale[1]:.2f}", "distance, world units", f"{scale[0]:.2f}"))
    words = {
        "photo": "Colors of the photos.",
        "language": "Alike colors mean alike things: the three main directions of the language as red, green, blue.",
        "codes": "One color for each code of the codebook; gray where nothing is known.",
    }
    return note(words[mode])


def _question_row(question: Question, alone: bool) -> str:
    layer = question.layer
    color = "#{:02x}{:02x}{:02x}".format(*layer.color)
    chip = (
        "" if alone else f'<span style="width:.8em;height:.8em;border-radius:50%;background:{color}"></span>'
    )
    if question.selection is None:
        state = f'<span style="{_MUTED}">…</span>'
    else:
        word, tint = _PRESENT[question.selection.present]
        state = f'<span style="{_MUTED}">{len(question.selection):,} splats</span>'
        if layer.text == question.selection.phrase:
            state = f'<span style="color:{tint}">{word}</span> ' + state
    text = f'<b style="flex:1;overflow-wrap:anywhere">{escape(layer.text)}</b>'
    return f'<div style="{_ROW}">{chip}{text}{state}</div>'


def _bar(low: str, label: str, high: str, start: float = 0.0) -> str:
    ends = f'<div style="display:flex;justify-content:space-between;{_MUTED}">'
    words = "".join(f"<span>{escape(word)}</span>" for word in (low, label, high))
    picture = f'<img alt="" style="width:100%;height:.7em;border-radius:3px" src="{_scale_image(start)}">'
    return f"{picture}{ends}{words}</div>"


def _scale_image(start: float) -> str:
    colors = color_scale()[np.linspace(255 * start, 255, 128).round().astype(int)]
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(colors[None])).save(stream, format="PNG")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def answer(found: Answer) -> str:
    """What a click found: phrases with bars."""
    rows = ""
    for phrase, score in found.phrases:
        bar = (
            f'<div style="width:{100 * score:.0f}%;height:.55em;border-radius:3px;background:#00a896"></div>'
        )
        rows += (
            f'<div style="{_ROW}"><span style="width:45%;overflow-wrap:anywhere">{escape(phrase)}</span>'
            f'<div style="flex:1;background:#eef1f4;border-radius:3px">{bar}</div>'
            f'<span style="{_MUTED}">{score:.2f}</span></div>'
        )
    place = ", ".join(f"{value:.2f}" for value in found.point)
    count = f"{len(found.selection):,}"
    return box(f'{rows}<div style="{_MUTED}">{count} splats belong to it; at ({place})</div>')


def selection_facts(question: Question | None) -> str:
    """Count, instances, size and place of the current selection."""
    selection = question.selection if question else None
    if question is None or selection is None:
        return note("Ask for something or click on the scene.")
    if not selection:
        return box(f"<b>{escape(question.text)}</b><br>Nothing is selected.")
    size = " x ".join(f"{value:.2f}" for value in selection.size)
    center = ", ".join(f"{value:.2f}" for value in selection.center)
    parts = len(selection.instances)
    return box(
        f"<b>{escape(question.text)}</b><br>{len(selection):,} splats in {parts} "
        f"{'piece' if parts == 1 else 'pieces'}<br>"
        f'<span style="{_MUTED}">size {size}, center ({center}), world units</span>'
    )
