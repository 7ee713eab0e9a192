"""HTML of the panels and the script of the page, rendered from ``templates/`` with autoescaping."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from lexsplat.queries.heatmaps import color_scale
from lexsplat.viewer.coloring import Mode
from lexsplat.viewer.session import ClickAnswer, Question

_PRESENCE = {"yes": "found", "unsure": "unsure", "no": "not here"}
_MODE_NOTES = {
    "photo": "Colors of the photos.",
    "language": "Similar colors mean similar content: three principal components of the language features.",
    "codes": "One color per code of the codebook; gray where there is no language.",
}
_HEAT_START = 0.3
"""Where the heat of a single prompt starts on the color scale, see `Coloring`."""


def note(text: str) -> str:
    """A sentence in gray."""
    return _render("note.html", kind="muted", text=text)


def warning(text: str) -> str:
    """An error message."""
    return _render("note.html", kind="warning", text=text)


def legend(questions: Sequence[Question], mode: Mode, scale: tuple[float, float], hint: str) -> str:
    """Explains the colors of a mode.

    Args:
        questions: The prompts, listed in the mode "relevancy".
        mode: The mode.
        scale: `Coloring.scale`, for "uncertainty" and "depth".
        hint: What the user can do if no prompt is shown.
    """
    if mode in _MODE_NOTES:
        return note(_MODE_NOTES[mode])
    if mode == "uncertainty":
        return _render("legend.html", questions=[], scale=_scale(scale[0], "uncertainty", scale[1]))
    if mode == "depth":
        return _render("legend.html", questions=[], scale=_scale(scale[1], "distance, world units", scale[0]))
    shown = [question for question in questions if question.layer.shown]
    if not shown:
        return note(hint)
    heat = None
    if len(shown) == 1:
        layer = shown[0].layer
        heat = _scale(layer.threshold, "relevancy", layer.high, start=_HEAT_START)
    return _render("legend.html", questions=shown, scale=heat, presence=_PRESENCE)


def click_answer(answer: ClickAnswer) -> str:
    """The answer to a click: phrases with bars."""
    return _render("click.html", answer=answer)


def selection_facts(question: Question | None) -> str:
    """Number of Gaussians and pieces, size and center of the selection of a question."""
    if question is None or question.selection is None:
        return note("Ask for something or click an object in the scene.")
    selection = question.selection
    pieces = len(selection.instances) if selection else 0
    return _render("selection.html", text=question.text, selection=selection, pieces=pieces)


def view_counts(
    train: int, train_color: tuple[int, int, int], test: int, test_color: tuple[int, int, int]
) -> str:
    """The numbers of training and held-out views, with the colors of their frustums."""
    return _render("views.html", train=train, train_color=train_color, test=test, test_color=test_color)


def page_script(title: str, example: str) -> str:
    """JavaScript that sets the page title, accessible names of the controls, and an example in the search box."""
    return _render("page.js", title=title, placeholder=f"{example}, ...")


def _scale(low: float, label: str, high: float, start: float = 0.0) -> dict[str, str]:
    return {"low": f"{low:.2f}", "label": label, "high": f"{high:.2f}", "image": _scale_image(start)}


def _scale_image(start: float) -> str:
    """The color scale from ``start`` in 0..1 to its end, as a data URL."""
    colors = color_scale()[np.linspace(255 * start, 255, 128).round().astype(int)]
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(colors[None])).save(stream, format="PNG")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def _numbers(values: Iterable[float], separator: str) -> str:
    return separator.join(f"{value:.2f}" for value in values)


_TEMPLATES = Environment(
    loader=PackageLoader("lexsplat.viewer"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters |= {
    "thousands": lambda value: f"{value:,}",
    "hex": lambda color: "#{:02x}{:02x}{:02x}".format(*color),
    "numbers": _numbers,
}


def _render(template: str, **values: Any) -> str:
    return _TEMPLATES.get_template(template).render(**values)
