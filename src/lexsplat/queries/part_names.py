"""Whether a place is the part that a phrase names, or another one: "bear eye" finds the nose where it knows no eye.

What names a part is compared with everyday words and with its thing (`lexsplat.queries.presence`), which another
part of the thing may pass. So the names of parts are compared with each other at the place, without the thing: at the
nose, "nose" is higher than "eye", and has a larger share of its best height in the scene. The border was chosen on
the second bundled scene with the bundled encoder and three of ``benchmarks/web_like.py``, and checked on the demo
(docs/lab-notes/2026-11-objects.md). Dimension letters: K codes, W names of parts.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lexsplat.queries.everyday import peaks
from lexsplat.queries.vocabulary import PARTS, words

NAMES = tuple(sorted(PARTS))
"""The names that are compared."""
RIVAL = 1.15
"""Factor by which another name describes a place better than that of the part, from which the part is doubtful."""
_ALIKE = "stem stalk, wheel tire, lid cap cork, foot paw leg, leaf petal, cord string, head face, stand base"
ALIKE = tuple(group.split() for group in words(_ALIKE))
"""Names that people give to one part, of which the best counts."""
DOUBTFUL = "names of other parts fit this place better"
"""The note on a part that is taken for another one."""
_LEAST = 1e-6


def fits_of(heights: Tensor) -> Tensor:
    """How well texts fit the codes ``[K, W]``, from their heights there (`lexsplat.queries.everyday`).

    It is the geometric mean of the height and of its share of the text's best height.
    """
    return heights / peaks(heights).clamp_min(_LEAST).sqrt()


def is_doubtful(part: str, place: Tensor, fits: Tensor) -> bool:
    """Whether another name of a part describes a place better than the one that was asked for.

    Args:
        part: One of `NAMES`.
        place: Distribution of the place over the codes ``[K]``.
        fits: How well `NAMES` fit the codes ``[K, W]`` (`fits_of`).
    """
    fit = (place.to(fits) @ fits).clamp_min(0).cpu()
    same = next((group for group in ALIKE if part in group), [part])
    asked = torch.tensor([name in same for name in NAMES])
    return bool(fit[~asked].max() > RIVAL * fit[asked].max())
