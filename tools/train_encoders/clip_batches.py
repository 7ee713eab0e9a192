"""Batches of crops and phrases, and what is true, false and open in them."""

from __future__ import annotations

import math
import queue
import threading
from dataclasses import dataclass

import numpy as np
import torch
from clip_settings import ClipTraining
from crops import GRID, Crop, Frames, part_crops, patch_crop, random_crop
from numpy.typing import NDArray
from torch import Tensor
from truth import TruthTable
from vocabulary import CANONICAL, COLORS, HELD_OUT_PAIRS, HUES, NAMES, PARTS, QUALITIES
from words import (
    FALSE,
    OPEN,
    Label,
    Phrase,
    any_part,
    any_phrase,
    in_sentence,
    near_miss,
    parallelogram,
    phrase_for,
)

KINDS, TINTS, PART_NAMES = list(NAMES), list(COLORS), [None, *PARTS]
PLACES = 8
"""Patches of a crop that are asked about."""
UNKNOWN = -100
"""An answer that the loss leaves out."""
NEAR_HUE = 25.0
"""Degrees within which a turned hue may pass for a color."""
MEAN = torch.tensor([0.48145466, 0.4578275, 0.40821073]).view(3, 1, 1)
STD = torch.tensor([0.26862954, 0.26130258, 0.27577711]).view(3, 1, 1)


@dataclass(frozen=True)
class Batch:
    """Crops ``[B, 3, s, s]`` uint8, texts (the canonical phrases last), truth ``[B, T]`` of the others; kind,
    color and part of every patch ``[B, P, 3]``, -100 where unknown; kinds it is not asked about ``[B, P, 22]``."""

    pixels: Tensor
    texts: list[str]
    corners: list[str]
    """Of parallelograms of kinds and colors, four and four."""
    truth: Tensor
    patches: Tensor
    left_out: Tensor
    places: Tensor
    """Truth at single patches ``[B, P, T]``, ``OPEN`` where they are not asked; ``[B, P, 0]`` if none is."""


def make_batch(frames: Frames, table: TruthTable, config: ClipTraining, rng: np.random.Generator) -> Batch:
    """A true phrase for every crop, a near miss for every second one, and some arbitrary phrases."""
    of_parts = round(config.parts * config.batch)
    crops = [random_crop(frames, rng) for _ in range(config.batch - of_parts)]
    crops += part_crops(frames, of_parts, rng, near=config.near, handles=config.handles)
    phrases = batch_phrases(crops, frames.labels, config, rng)
    truth = table.of(phrases, crops)
    pixels = np.stack([crop.pixels(config.image_size) for crop in crops])
    draw = rng.random(len(crops))
    gray, turned = draw < config.gray, draw > 1 - config.turned
    angles = np.zeros(len(crops))
    pixels[gray] = pixels[gray].mean(-1, keepdims=True).astype(np.uint8)
    for row in np.nonzero(turned)[0]:
        angles[row] = fair_angle([table.labels[code] for code in crops[row].codes], rng)
        pixels[row] = turned_hues(pixels[row], angles[row])
    leave_open(truth, phrases, crops, table.labels, angles)
    colorless = gray | turned
    open_colors(truth, phrases, colorless)
    texts = [in_sentence(phrase, rng) for phrase in phrases] + list(CANONICAL)
    patches, left_out = patch_answers(crops, table.labels, angles, config)
    patches[colorless, :, 1] = UNKNOWN
    corners = [text for _ in range(config.batch // 12) for text in parallelogram(rng)]
    places = place_truth(phrases, crops, table, angles, colorless, config, rng)
    return Batch(
        torch.from_numpy(pixels).permute(0, 3, 1, 2),
        texts,
        corners,
        torch.from_numpy(truth),
        torch.from_numpy(patches),
        torch.from_numpy(left_out),
        torch.from_numpy(places),
    )


def batch_phrases(
    crops: list[Crop], labels: list[Label], config: ClipTraining, rng: np.random.Generator
) -> list[Phrase]:
    """The phrases of a batch: of what its crops show, near misses of that, about anything, and about any part."""
    phrases = []
    for number, crop in enumerate(crops):
        if not len(crop.codes):
            continue
        label = labels[crop.codes[int(rng.choice(len(crop.codes), p=crop.weights / crop.weights.sum()))]]
        phrases.append(phrase_for(label, rng))
        if number % 2:
            phrases.append(near_miss(label, rng))
    phrases += [any_phrase(rng) for _ in range(config.batch // 4)]
    of_parts = round(config.parts * config.batch)
    return phrases + [any_part(rng, config.handles) for _ in range(of_parts // 3 if config.near else 0)]


def place_truth(
    phrases: list[Phrase],
    crops: list[Crop],
    table: TruthTable,
    angles: NDArray[np.float64],
    colorless: NDArray[np.bool_],
    config: ClipTraining,
    rng: np.random.Generator,
) -> NDArray[np.int8]:
    """Truth of the phrases at up to ``PLACES`` patches of every crop, ``OPEN`` at the others.

    Half of the patches are drawn uniformly, half such that every label of a crop is covered equally often.

    Args:
        phrases: ``T`` of them.
        crops: ``B`` of them.
        table: Knows which labels a phrase is true of.
        angles: By which the hues of the crops are turned, degrees ``[B]``.
        colorless: Crops of which no color is asked ``[B]``.
        config: Says how large the patches are, and with `dense` whether they are asked at all.
        rng: Draws the patches.

    Returns:
        ``[B, P, T]``; ``[B, P, 0]`` if patches are not asked.
    """
    count = config.image_size // config.patch
    if not config.dense:
        return np.empty((len(crops), count**2, 0), np.int8)
    rows, patches = [], []
    for row, crop in enumerate(crops):
        codes = middle_codes(crop, count)
        chosen = set(rng.permutation(count**2)[: PLACES // 2].tolist())
        shown = rng.permutation(np.unique(codes[codes >= 0]))
        chosen |= {int(rng.choice(np.flatnonzero(codes == code))) for code in shown[: PLACES // 2]}
        rows += [row] * len(chosen)
        patches += sorted(chosen)
    cut = [patch_crop(crops[row], patch, count) for row, patch in zip(rows, patches)]
    found = table.at_places(phrases, cut)
    leave_open(found, phrases, cut, table.labels, angles[rows])
    open_colors(found, phrases, colorless[rows])
    truth = np.full((len(crops), count**2, len(phrases)), OPEN, np.int8)
    truth[rows, patches] = found
    return truth


def middle_codes(crop: Crop, count: int) -> NDArray[np.int32]:
    """The label at the center of each of ``count`` x ``count`` patches ``[count * count]``; -1 for none."""
    middles = ((np.arange(count) + 0.5) * GRID / count).astype(int)
    return crop.grid[np.ix_(middles, middles)].ravel()


def open_colors(truth: NDArray[np.int8], phrases: list[Phrase], colorless: NDArray[np.bool_]) -> None:
    """Set phrases with a color to open for the rows ``[B]`` whose colors differ from their labels."""
    asks_color = np.array([phrase.color is not None for phrase in phrases])
    truth[np.ix_(colorless, asks_color)] = OPEN


def fair_angle(labels: list[Label], rng: np.random.Generator) -> float:
    """A random rotation of hues in degrees that brings no kind close to a held-out color of it; 0 if none does."""
    for _ in range(20):
        angle = float(rng.uniform(30, 330))
        if not any(label.kind in looks_held_out(label, angle) for label in labels):
            return angle
    return 0.0


def turned_hues(pixels: NDArray[np.uint8], angle: float) -> NDArray[np.uint8]:
    """All hues rotated by an angle in degrees ``[s, s, 3]``; the gray axis stays fixed."""
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    # Rodrigues' rotation about (1, 1, 1) / sqrt(3), which takes red to green at 120 degrees.
    across = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / math.sqrt(3)
    rotation = cosine * np.eye(3) + sine * across + (1 - cosine) / 3
    return np.clip(pixels @ rotation.T, 0, 255).astype(np.uint8)


def looks_held_out(label: Label, angle: float = 0.0) -> set[str]:
    """The kinds whose held-out color an object has after its hue is rotated by ``angle`` degrees."""
    hue = HUES.get(label.color)
    if hue is None:
        return {kind for kind, color in HELD_OUT_PAIRS if color == label.color}
    return {
        kind
        for kind, color in HELD_OUT_PAIRS
        if color in HUES and abs((hue + angle - HUES[color] + 180) % 360 - 180) < NEAR_HUE
    }


def leave_open(
    truth: NDArray[np.int8],
    phrases: list[Phrase],
    crops: list[Crop],
    labels: list[Label],
    angles: NDArray[np.float64],
) -> None:
    """Opens, of what is false, whether a thing in a color held out for some kind is of that kind.

    Training shows no blue bear. If every blue object were a negative of "bear", blue would imply "not a bear", and a
    blue bear could not be recognized. Held-out pairs are therefore excluded in both directions.
    """
    means = [
        {phrase.kind} if phrase.kind else _KINDS_OF_QUALITY[phrase.quality] if phrase.quality else set()
        for phrase in phrases
    ]
    for row, crop in enumerate(crops):
        shown = [labels[code] for code, weight in zip(crop.codes, crop.weights) if weight > 0.15]
        unknown = set().union(*(looks_held_out(label, angles[row]) for label in shown))
        for column, kinds in enumerate(means):
            if truth[row, column] == FALSE and kinds & unknown:
                truth[row, column] = OPEN


_KINDS_OF_QUALITY = {
    key: {term.split(":")[0].split(".")[0] for term in quality.of} for key, quality in QUALITIES.items()
}


def patch_answers(
    crops: list[Crop], labels: list[Label], angles: NDArray[np.float64], config: ClipTraining
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Kind, color and part at the middle of every patch ``[B, P, 3]``, and the kinds that it is not asked about."""
    count = config.image_size // config.patch
    codes = np.stack([middle_codes(crop, count) for crop in crops])
    answers = [
        (KINDS.index(label.kind), TINTS.index(label.color), PART_NAMES.index(label.part)) for label in labels
    ]
    left_out = np.zeros((*codes.shape, len(KINDS)), np.bool_)
    for row, angle in enumerate(angles):
        for code in np.unique(codes[row][codes[row] >= 0]):
            unknown = looks_held_out(labels[code], angle) - {labels[code].kind}
            left_out[row, codes[row] == code] = [kind in unknown for kind in KINDS]
    return np.array([*answers, (UNKNOWN,) * 3])[codes], left_out


def batches(frames: Frames, config: ClipTraining, rank: int) -> queue.Queue[Batch]:
    """Batches, prepared in a background thread; each process makes different ones."""
    ready: queue.Queue[Batch] = queue.Queue(4)
    table = TruthTable(frames.labels, center=config.center, beside=config.beside)
    rng = np.random.default_rng([config.seed, rank])

    def work() -> None:
        while True:
            ready.put(make_batch(frames, table, config, rng))

    threading.Thread(target=work, daemon=True).start()
    return ready


def mirrored(
    batch: Batch, config: ClipTraining, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Half of the crops mirrored, together with the labels of their patches: pixels, patches, left out, places."""
    count = config.image_size // config.patch
    chosen = torch.rand(len(batch.pixels), generator=generator) < 0.5
    pixels = torch.where(chosen[:, None, None, None], batch.pixels.flip(-1), batch.pixels)

    def of_patches(values: Tensor) -> Tensor:
        grid = values.unflatten(1, (count, count))
        return torch.where(chosen[:, None, None, None], grid.flip(2), grid).flatten(1, 2)

    return pixels, of_patches(batch.patches), of_patches(batch.left_out), of_patches(batch.places)


def jittered(pixels: Tensor, generator: torch.Generator, light: float) -> Tensor:
    """Crops as the encoder takes them, with changed light and a little noise."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    images = pixels.float() / 255
    count = len(images)
    images = images * torch.exp(light * normal(count, 1, 1, 1) + 0.04 * normal(count, 3, 1, 1))
    middle = images.mean((1, 2, 3), keepdim=True)
    images = middle + (images - middle) * torch.exp(0.15 * normal(count, 1, 1, 1))
    images = images + 0.02 * normal(count, 1, 1, 1).abs() * torch.randn(images.shape, generator=generator)
    return (images.clamp(0, 1) - MEAN) / STD
