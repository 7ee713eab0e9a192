"""What a notebook shows of a selection: a table of facts, and its best view with the mask marked."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape

import torch
from PIL import Image
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.heatmaps import overlay_mask
from lexsplat.queries.selection import Selection
from lexsplat.rendering import render

_WIDTH = 400
_LISTED = 5
"""Instances whose sizes are listed, at most."""


def selection_html(selection: Selection) -> str:
    """A selection as HTML."""
    found = selection.to_dict()
    sizes = []
    for one in found["instances"][:_LISTED]:
        unit = "m" if "size_meters" in one else "units"
        sizes.append(" x ".join(f"{v:.3g}" for v in one.get("size_meters", one["size"])) + f" {unit}")
    more = [f"and {found['count'] - _LISTED} more"] if found["count"] > _LISTED else []
    shown = ("phrase", "present", "count", "gaussians", "threshold", "best_view")
    facts = {**{name.replace("_", " "): found[name] for name in shown}, "sizes": ", ".join([*sizes, *more])}
    name = found["best_view"]
    image = view_image(selection.gaussians, selection.cameras[name], selection.mask) if name else ""
    return facts_html({**facts, "note": selection.note}) + image


def facts_html(facts: Mapping[str, object]) -> str:
    """A table of facts; those that are empty or None are left out."""
    rows = (f"<tr><th>{escape(k)}</th><td>{escape(str(v))}</td></tr>" for k, v in facts.items())
    kept = (row for row, value in zip(rows, facts.values()) if value not in ("", None))
    return f"<table>{''.join(kept)}</table>"


@torch.no_grad()
def view_image(gaussians: Gaussians, camera: Camera, mask: Tensor | None = None) -> str:
    """A view as an image element, with the Gaussians of a mask ``[N]`` marked."""
    camera = camera.downscaled(max(1.0, camera.width / _WIDTH))
    drawn = render(gaussians, camera, features=None if mask is None else mask[:, None].float())
    pixels = (drawn.image.clamp(0, 1).cpu().numpy() * 255).round().astype("uint8")
    if mask is not None:
        pixels = overlay_mask(pixels, drawn.features[..., 0].cpu().numpy() >= 0.5)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return f'<img src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode("ascii")}">'
