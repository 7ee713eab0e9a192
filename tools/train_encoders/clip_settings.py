"""Settings of the training of the image-text encoder, and its phases."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from truth import BESIDE, LACKS_PART


@dataclass(frozen=True)
class ClipTraining:
    """Settings of the training.

    Args:
        steps: Optimizer steps.
        batch: Crops a step and process; contrast is within these.
        rate: Largest learning rate; raised over the first 3 %, then lowered along a cosine.
        image_size, patch, width, layers: Of the image tower.
        text_width, text_layers: Of the text tower.
        dim: Numbers of an embedding.
        temperature: Of the relevancy that is trained: that of queries.
        gray: Share of the crops shown in gray, of which color words are open.
        turned: Share of the crops whose hues are turned, of which color words are open too.
        composition: Weight of the loss that makes colors add to kinds alike in all texts.
        parts: Share of the crops that are of parts and of the rest of their things.
        near: Whether what is near the things belongs to these crops, and as many phrases ask for parts.
        handles: How often handles are among these, and asked for, for once any other part.
        center: Whether a part also counts as shown where it lies in the very middle (`truth.TruthTable`).
        dense: Weight of the loss of what patches say by themselves, as MaskCLIP reads them.
        beside: Share of the weight below which a part beside the middle is not what a crop shows.
        light: Standard deviation of the logarithm of the light on a crop.
        kept: Share of the patches that the image tower sees in the first three quarters of the steps.
        heads_alone: Steps at first in which patch labels train the linear heads only, not the tower.
        seed: Of everything random.
    """

    steps: int = 7000
    batch: int = 96
    rate: float = 1e-3
    image_size: int = 48
    patch: int = 8
    width: int = 192
    layers: int = 4
    text_width: int = 128
    text_layers: int = 3
    dim: int = 128
    temperature: float = 10.0
    gray: float = 0.12
    turned: float = 0.25
    composition: float = 1.0
    parts: float = 0.0
    near: bool = False
    handles: int = 1
    center: bool = False
    dense: float = 0.0
    beside: float = LACKS_PART
    light: float = 0.2
    kept: float = 0.5
    heads_alone: int = 0
    seed: int = 0


REFINEMENT = ClipTraining(
    steps=2000, rate=4e-4, gray=0.06, turned=0.15, parts=0.3, light=0.1, kept=1.0, heads_alone=150, seed=1
)
"""What follows on the first training: parts as often as things, whole crops, and light that changes less, or
gray could not be told from white."""
PARTS_AGAIN = dataclasses.replace(
    REFINEMENT, steps=1200, rate=3e-4, parts=0.4, near=True, center=True, seed=2
)
"""Parts against what only looks like them."""
DENSE = dataclasses.replace(PARTS_AGAIN, steps=1600, parts=0.45, handles=4, dense=1.0, seed=5)
"""The end, after `PARTS_AGAIN`: patches learn to speak for themselves, asked the same phrases as crops."""
HANDLES = dataclasses.replace(PARTS_AGAIN, parts=0.45, handles=8, seed=3)
"""An experiment, after the third phase. Of crops beside handles two in five are taken for one, in the scenes of the
training as well (ROC area .88): a fourteenth of the part crops is too little to learn better from."""
EDGES = dataclasses.replace(HANDLES, steps=700, rate=2e-4, beside=BESIDE, seed=4)
"""An experiment, after that one. Where a part ends: a place beside it answers as surely as the part itself."""
PHASES = {
    "first": ClipTraining(), "refine": REFINEMENT, "parts": PARTS_AGAIN, "dense": DENSE,
    "handles": HANDLES, "edges": EDGES,
}  # fmt: skip
"""The first four, in this order, made the weights that ship; each goes on from the averaged weights of the last.
``handles``, which went on from ``parts``, and ``edges``, from ``handles``, are experiments that are not in them."""
