"""Scores of the image-text encoder on scenes outside the training set."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from crops import Crop
from torch import Tensor
from vocabulary import CANONICAL, COLORS, NAMES, SYNONYMS, UNKNOWN_TESTED
from words import FALSE, OPEN, TRUE, Label, Phrase

_METALS = ("gold", "silver", "copper")
_MANY_COLORED = ("books", "floor")
"""Kinds whose color is not asked."""

EncodeImages = Callable[[Sequence[Crop]], Tensor]
EncodeText = Callable[[Sequence[str]], Tensor]


def color_is_asked(label: Label) -> bool:
    """Whether a color is tested for a kind: metal colors are, for rings only. Matte gold looks yellow."""
    return label.kind not in _MANY_COLORED and (label.color not in _METALS or label.kind == "ring")


def _top1(images: Tensor, texts: Tensor, owners: Sequence, truths: Sequence) -> float:
    best = (images @ texts.T).argmax(1).tolist()
    return float(np.mean([owners[place] == truth for place, truth in zip(best, truths)]))


def _questions(encode_text: EncodeText) -> tuple[list[str], Tensor, list[tuple[str, str]], Tensor]:
    """All kinds with their phrases, and all pairs of kind and color."""
    kinds = list(NAMES)
    pairs = [(kind, color) for kind in kinds for color in COLORS if color_is_asked(Label(kind, color))]
    return (
        kinds,
        encode_text([f"a photo of a {NAMES[kind][0]}" for kind in kinds]),
        pairs,
        encode_text([f"a photo of a {color} {NAMES[kind][0]}" for kind, color in pairs]),
    )


def zero_shot(
    seen: Sequence[tuple[Crop, Label]],
    unseen: Sequence[tuple[Crop, Label]],
    encode_images: EncodeImages,
    encode_text: EncodeText,
) -> dict[str, float]:
    """Top-1 accuracies of classifying crops.

    Args:
        seen: Dominated crops of scenes like those of training.
        unseen: Dominated crops of pairs of kind and color that no training scene holds.
        encode_images: Crops to unit vectors.
        encode_text: Texts to unit vectors.
    """
    kinds, usual, pair_keys, pair_texts = _questions(encode_text)
    images, labels = encode_images([crop for crop, _ in seen]), [label for _, label in seen]
    scores = {"kind": _top1(images, usual, kinds, [label.kind for label in labels])}
    asked = [row for row, label in enumerate(labels) if color_is_asked(label)]
    truths = [(labels[row].kind, labels[row].color) for row in asked]
    scores["kind_and_color"] = _top1(images[asked], pair_texts, pair_keys, truths)
    if unseen:
        new, news = encode_images([crop for crop, _ in unseen]), [label for _, label in unseen]
        scores["unseen_kind"] = _top1(new, usual, kinds, [label.kind for label in news])
        scores["unseen_pair"] = _top1(new, pair_texts, pair_keys, [(la.kind, la.color) for la in news])
    never, known = [], []
    for kind, names in SYNONYMS.items():
        rows = [row for row, label in enumerate(labels) if label.kind == kind]
        for name in names:
            texts = usual.clone()
            texts[kinds.index(kind)] = encode_text([f"a photo of a {name}"])[0]
            right = _top1(images[rows], texts, kinds, [kind] * len(rows)) if rows else float("nan")
            (known if name in NAMES[kind] else never).append(right)
    scores["synonyms"] = float(np.nanmean([*known, *never]))
    scores["synonyms_never_read"] = float(np.nanmean(never))
    return scores


def by_pair(
    unseen: Sequence[tuple[Crop, Label]], encode_images: EncodeImages, encode_text: EncodeText
) -> dict[str, tuple[float, float, int]]:
    """For each held-out pair of kind and color: top-1 accuracy of the kind and of the pair, and the number of crops.

    The classes are those of `zero_shot`.
    """
    kinds, usual, pairs, pair_texts = _questions(encode_text)
    images = encode_images([crop for crop, _ in unseen])
    asked = [(label.kind, label.color) for _, label in unseen]
    found = {}
    for pair in sorted(set(asked)):
        rows = [row for row, other in enumerate(asked) if other == pair]
        kind = _top1(images[rows], usual, kinds, [pair[0]] * len(rows))
        both = _top1(images[rows], pair_texts, pairs, [pair] * len(rows))
        found[" ".join(reversed(pair))] = (kind, both, len(rows))
    return found


def calibration(
    crops: Sequence[Crop],
    phrases: Sequence[Phrase],
    truth: np.ndarray,
    encode_images: EncodeImages,
    encode_text: EncodeText,
    *,
    temperature: float = 10.0,
) -> dict[str, float]:
    """How often right phrase > canonical phrases > wrong phrase, the assumption behind the relevancy threshold 0.5.

    Args:
        crops: Any crops.
        phrases: Any phrases.
        truth: ``[len(crops), len(phrases)]``.
        encode_images: Crops to unit vectors.
        encode_text: Texts to unit vectors.
        temperature: That of the relevancy (LERF's).
    """
    images = encode_images(crops)
    canonical = (images @ encode_text(CANONICAL).T).max(1).values
    margin = images @ encode_text([phrase.words for phrase in phrases]).T - canonical[:, None]
    right, wrong = torch.from_numpy(truth == TRUE), torch.from_numpy((truth != TRUE) & (truth != OPEN))
    unknown = images @ encode_text(UNKNOWN_TESTED).T - canonical[:, None]
    relevancy = torch.sigmoid(temperature * margin)
    return {
        "right_above_canonical": float((margin[right] > 0).float().mean()),
        "wrong_below_canonical": float((margin[wrong] < 0).float().mean()),
        "absent_words_below_canonical": float((unknown < 0).float().mean()),
        "relevancy_of_right": float(relevancy[right].mean()),
        "relevancy_of_wrong": float(relevancy[wrong].mean()),
    }


def parts_found(
    crops: Sequence[Crop],
    phrases: Sequence[Phrase],
    truth: np.ndarray,
    encode_images: EncodeImages,
    encode_text: EncodeText,
) -> dict[str, float]:
    """How often the name of a part scores above the canonical phrases where it is true, and below where it is false.

    Args:
        crops: Of parts, and of the same things beside them.
        phrases: One for each kind and part ("mug handle").
        truth: ``[len(crops), len(phrases)]``.
        encode_images: Crops to unit vectors.
        encode_text: Texts to unit vectors.

    Returns:
        ``part_right`` and ``part_wrong``, means over the phrases, and the same of handles alone, the hardest.
    """
    images = encode_images(crops)
    canonical = (images @ encode_text(CANONICAL).T).max(1).values
    above = (images @ encode_text([phrase.words for phrase in phrases]).T > canonical[:, None]).numpy()
    right = [float(above[truth[:, n] == TRUE, n].mean()) for n in range(len(phrases)) if TRUE in truth[:, n]]
    wrong = [float((~above[truth[:, n] == FALSE, n]).mean()) for n in range(len(phrases))]
    handle = [phrase.part for phrase in phrases].index("handle")
    return {
        "part_right": float(np.mean(right)),
        "part_wrong": float(np.mean(wrong)),
        "handle_right": float(above[truth[:, handle] == TRUE, handle].mean()),
        "handle_wrong": float((~above[truth[:, handle] == FALSE, handle]).mean()),
    }
