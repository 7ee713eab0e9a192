"""The language of the splats of a page: four codes of each, their weights, and the segments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from lexsplat.language.segments import Segments
from lexsplat.queries.selection import Selection
from lexsplat.scenes.formats.language import StoredLanguage

NO_OBJECT = 255
"""Of a Gaussian that belongs to no object of the list."""


def splat_codes(language: StoredLanguage) -> bytes:
    """Codes ``[N, 4]`` uint8 followed by shares ``[N, 4]`` uint8: eight bytes a Gaussian.

    The first share is the sum of the four weights in 255ths. The others are the weights of the second to fourth code
    in 255ths of the largest value that they can have: weights are sorted, so these are 1/2, 1/3 and 1/4. The weight
    of the first code is what remains. Scores differ by at most 0.55/255 from those of the exact weights.
    """
    weights = language.weights.double()
    largest = torch.tensor([1.0, 1 / 2, 1 / 3, 1 / 4], dtype=torch.float64)
    shares = torch.cat([weights.sum(1, keepdim=True), weights[:, 1:]], dim=1) / largest
    quantized = (shares * 255).round().clamp(0, 255).to(torch.uint8)
    return language.codes.numpy().tobytes() + quantized.numpy().tobytes()


def segments_file(segments: Segments, uncertainties: torch.Tensor, hidden: torch.Tensor) -> bytes:
    """The segments of N splats, little-endian: the numbers of levels L and of segments S, then five arrays.

    They are the segment at each level of each lowest segment ``[L, S]`` uint32; the lowest segment of each splat
    ``[N]`` uint16, or uint32 for more than 65,536 segments; the masses ``[N]`` float16, as the scene stores them;
    u_G in 255ths ``[N]`` uint8, as in the scene; and ``[N]`` uint8, 1 for each splat that no view shows and 2 for
    those of fills, both of which selections leave out.
    """
    levels = segments.levels.cpu().numpy().astype("<u4")
    labels = segments.labels.cpu().numpy().astype("<u2" if levels.shape[1] <= 1 << 16 else "<u4")
    masses = segments.masses.clamp(max=6e4).cpu().numpy().astype("<f2")
    uncertain = (uncertainties.cpu() * 255).round().numpy().astype(np.uint8)
    unseen = hidden.cpu().numpy().astype(np.uint8)
    if segments.added is not None:
        unseen += segments.added.cpu().numpy()
    head = np.array(levels.shape, "<u4")
    return b"".join(array.tobytes() for array in (head, levels, labels, masses, uncertain, unseen))


def objects_file(objects: Sequence[Selection], kept: torch.Tensor) -> bytes:
    """The object of each splat: its place in the list, or `NO_OBJECT`, ``[M]`` uint8.

    Args:
        objects: At most 255 selections that share no Gaussian.
        kept: Indices ``[M]`` of the Gaussians of the page.
    """
    found = np.full(len(kept), NO_OBJECT, np.uint8)
    for place, each in enumerate(objects):
        found[each.mask.cpu()[kept].numpy()] = place
    return found.tobytes()
