"""The colors of objects by their pixels, as the views show them (`lexsplat.queries.colors`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from lexsplat.queries.colors import SEEN, color_shares, color_words
from lexsplat.queries.selection import Selection
from lexsplat.scenes.formats.tables import colors_of

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene


def object_colors(scene: Scene, thing: Selection) -> list[str]:
    """The color words of an object, the most frequent first (`lexsplat.queries.colors`)."""
    return color_words(*_pixels(scene, thing))


def seen_colors(scene: Scene, thing: Selection) -> list[str]:
    """Every color that an object is seen in, also those of a small part of it; kept with the selection."""
    known: dict[str, list[str]] = thing.__dict__
    if "_seen_colors" not in known:
        shares = color_shares(*_pixels(scene, thing))
        known["_seen_colors"] = [color for color, share in shares.items() if share >= SEEN]
    return known["_seen_colors"]


def _pixels(scene: Scene, thing: Selection) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The colors of an object's Gaussians ``[M, 3]`` in 0..1, and what the views show of each ``[M]``."""
    colors = colors_of(thing.selected).astype(np.float64) / 255
    return colors, shown_weights(scene)[thing.indices].double().cpu().numpy()


def shown_weights(scene: Scene) -> torch.Tensor:
    """Visible weight of each Gaussian in the training views ``[N]``; its opacity if that is not known."""
    segments = scene.field.segments
    return scene.gaussians.opacities.detach() if segments is None else segments.masses
