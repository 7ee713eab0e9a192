"""Train the image-text encoder: contrast between crops and phrases, and LERF's relevancy.

Five losses on a batch of crops and phrases; `truth.py` states which phrase is true of which crop:

- contrast: among all phrases, softmax of a crop's similarities falls on those that are true of it, and for a
  phrase on the crops it is true of (several right answers a row);
- patches: every patch token tells kind, color and part of what its middle shows, by linear heads that are
  thrown away afterwards; 36 answers a crop instead of one make the image tower learn several times faster;
- composition: the words of two kinds in two colors form a parallelogram, so pairs never seen have their place;
- relevancy: sigmoid(10 (cos(crop, phrase) - max over the canonical phrases of cos(crop, canonical))), which is
  LERF's relevancy, is a probability: cross-entropy with the truth. So the right phrase comes to lie above
  "object", "things", "stuff", "texture", and a wrong one below them;
- dense, in one phase only: contrast and relevancy again, of single patches, read as in MaskCLIP.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import queue
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.distributed
import torch.nn.functional as F
from clip_scores import calibration, parts_found, zero_shot
from crops import GRID, Crop, Frames, dominated_crops, part_crops, patch_crop, random_crop
from numpy.typing import NDArray
from tokenizer import LENGTH, learn_tokenizer
from torch import Tensor
from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel, CLIPTokenizer
from truth import BESIDE, LACKS_PART, TruthTable
from words import (
    CANONICAL,
    COLORS,
    FALSE,
    HELD_OUT_PAIRS,
    HUES,
    NAMES,
    OPEN,
    OWNERS,
    PARTS,
    QUALITIES,
    TRUE,
    Label,
    Phrase,
    any_part,
    any_phrase,
    in_sentence,
    near_miss,
    parallelogram,
    phrase_for,
)
from workers import average_gradients

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


def contrastive_loss(logits: Tensor, truth: Tensor) -> Tensor:
    """Cross-entropy of rows with several right answers ``[B, T]``; open answers are left out."""
    right = (truth == TRUE).float()
    rows = right.sum(1) > 0
    log_probabilities = logits.masked_fill(truth == OPEN, -torch.inf).log_softmax(1)
    picked = torch.where(right > 0, log_probabilities, 0.0)
    return -(picked.sum(1)[rows] / right.sum(1)[rows]).mean()


def patch_loss(answers: Tensor, truth: Tensor, left_out: Tensor) -> Tensor:
    """Cross-entropy of kind, color and part of the patches ``[B, P, 3]``; kinds left out are no answer."""
    kinds, *others = answers.split([len(KINDS), len(TINTS), len(PART_NAMES)], dim=-1)
    split = [kinds.masked_fill(left_out, -torch.inf), *others]
    losses = [
        F.cross_entropy(part.flatten(0, 1), truth[..., place].flatten()) for place, part in enumerate(split)
    ]
    return losses[0] + 0.5 * (losses[1] + losses[2])


def composition_loss(corners: Tensor) -> Tensor:
    """Deviation of texts of kinds and colors from parallelograms: |t(k, c) - t(k, d) - t(l, c) + t(l, d)|^2.

    Args:
        corners: Unit vectors ``[4 n, D]``, in the order of ``words.parallelogram``.
    """
    first, second, third, fourth = corners.unflatten(0, (-1, 4)).unbind(1)
    return (first - second - third + fourth).square().sum(-1).mean()


def relevancy_loss(similarity: Tensor, canonical: Tensor, truth: Tensor, temperature: float) -> Tensor:
    """Cross-entropy of LERF's relevancy with the truth; right and wrong phrases weigh the same.

    Args:
        similarity: Of crops and phrases ``[B, T]``.
        canonical: Of crops and canonical phrases ``[B, C]``.
        truth: ``[B, T]``.
        temperature: Of the relevancy.
    """
    sharpness = 40.0  # a maximum that lets gradients reach all canonical phrases
    above = (
        torch.logsumexp(sharpness * canonical, 1, keepdim=True) - math.log(canonical.shape[1])
    ) / sharpness
    logits = temperature * (similarity - above)
    return F.softplus(-logits[truth == TRUE]).mean() + F.softplus(logits[truth == FALSE]).mean()


def asking_losses(
    similarity: Tensor, truth: Tensor, scale: Tensor, temperature: float
) -> tuple[Tensor, Tensor]:
    """Contrast, of images among phrases plus of phrases among images, and relevancy.

    Args:
        similarity: Of crops or patches and texts ``[B, T + C]``, the canonical phrases last.
        truth: Of the phrases before those ``[B, T]``.
        scale: Of the similarities in the contrast; a scalar, which is trained too.
        temperature: Of the relevancy.
    """
    phrases, canonical = similarity[:, : -len(CANONICAL)], similarity[:, -len(CANONICAL) :]
    # Canonical phrases stand among the wrong answers, so a right phrase is drawn above them.
    with_canonical = F.pad(truth, (0, len(CANONICAL)), value=FALSE)
    contrast = contrastive_loss(scale * similarity, with_canonical) + contrastive_loss(
        scale * phrases.T, truth.T
    )
    return contrast, relevancy_loss(phrases, canonical, truth, temperature)


def dense_loss(values: Tensor, texts: Tensor, places: Tensor, scale: Tensor, temperature: float) -> Tensor:
    """Contrast and relevancy of single patches, as for crops.

    Args:
        values: What the patches say ``[B, P, D]`` (`Trainer.see`), of any length.
        texts: Unit vectors of the phrases, the canonical ones last ``[T + C, D]``.
        places: Truth of the phrases ``[B, P, T]``; a patch of which all is ``OPEN`` is not asked.
        scale: As in `asking_losses`.
        temperature: Of the relevancy.
    """
    asked = (places != OPEN).any(-1)
    similarity = F.normalize(values[asked].float(), dim=-1) @ texts.T
    contrast, relevancy = asking_losses(similarity, places[asked], scale, temperature)
    return 0.5 * contrast + relevancy


class Trainer:
    """The model, its average over the steps, and encoding with either."""

    def __init__(self, tokenizer: CLIPTokenizer, config: ClipTraining, start: Path | None = None) -> None:
        torch.manual_seed(config.seed)
        self.config, self.tokenizer = config, tokenizer
        if start is None:
            self.model = CLIPModel(model_config(tokenizer, config))
        else:
            self.model = CLIPModel.from_pretrained(start, attn_implementation="eager").train()
        self.average = copy.deepcopy(self.model).eval().requires_grad_(False)
        self.patch_heads = torch.nn.Linear(config.width, len(KINDS) + len(TINTS) + len(PART_NAMES))
        self.trained = [*self.model.parameters(), *self.patch_heads.parameters()]
        decayed = [p for p in self.trained if p.ndim >= 2]
        others = [p for p in self.trained if p.ndim < 2]
        groups = [{"params": decayed, "weight_decay": 0.05}, {"params": others, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=config.rate, betas=(0.9, 0.98))
        self.generator = torch.Generator().manual_seed(config.seed)
        self.done = 0

    def rate(self) -> float:
        warm = 0.03 * self.config.steps
        if self.done < warm:
            return self.config.rate * (self.done + 1) / warm
        along = (self.done - warm) / (self.config.steps - warm)
        return self.config.rate * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * along)))

    def step(self, batch: Batch) -> dict[str, float]:
        """One step of the optimizer and of the average; returns each loss before the step, by name."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate()
        losses = self.losses(batch)
        weights = {"contrast": 0.5, "composition": self.config.composition, "dense": self.config.dense}
        loss = sum(weights.get(name, 1.0) * value for name, value in losses.items())
        self.optimizer.zero_grad()
        loss.backward()
        average_gradients(self.trained)
        torch.nn.utils.clip_grad_norm_(self.trained, 1.0)
        self.optimizer.step()
        self.done += 1
        keep = min(0.999, self.done / (self.done + 20))
        with torch.no_grad():
            for slow, fast in zip(self.average.parameters(), self.model.parameters()):
                slow.lerp_(fast, 1 - keep)
        return {name: round(value.item(), 3) for name, value in losses.items()}

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The losses by name, unweighted; ``dense`` only if its weight is not 0."""
        words = self.tokens([*batch.texts, *batch.corners])
        with torch.autocast("cpu", dtype=torch.bfloat16):
            pixels, patches, left_out, places = mirrored(batch, self.config, self.generator)
            kept = self.kept_patches(len(pixels))
            patches, left_out, places = (
                values.gather(1, kept[..., None].expand(-1, -1, values.shape[-1]))
                for values in (patches, left_out, places)
            )
            images, tokens, values = self.see(jittered(pixels, self.generator, self.config.light), kept)
            if self.done < self.config.heads_alone:
                tokens = tokens.detach()
            answers = self.patch_heads(tokens).float()
            texts = pooled(self.model.get_text_features(**words))
        texts, corners = F.normalize(texts.float(), dim=-1).split([len(batch.texts), len(batch.corners)])
        similarity = F.normalize(images.float(), dim=-1) @ texts.T
        scale = self.model.logit_scale.exp().clamp(max=50)
        contrast, relevancy = asking_losses(similarity, batch.truth, scale, self.config.temperature)
        losses = {
            "contrast": contrast,
            "relevancy": relevancy,
            "patches": patch_loss(answers, patches, left_out),
            "composition": composition_loss(corners),
        }
        if self.config.dense:
            losses["dense"] = dense_loss(values, texts, places, scale, self.config.temperature)
        return losses

    def kept_patches(self, count: int) -> Tensor:
        """The patches that the image tower receives ``[count, P]``: half of them at first, all at the end.

        Half of the patches take little more than half of the time and still show the object; the last quarter of
        the steps uses whole crops.
        """
        patches = (self.config.image_size // self.config.patch) ** 2
        share = self.config.kept if self.done < 0.75 * self.config.steps else 1.0
        order = torch.rand(count, patches, generator=self.generator).argsort(1)
        return order[:, : max(1, round(share * patches))]

    def see(self, images: Tensor, kept: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What the image tower makes of the kept patches ``[B, P']`` of images ``[B, 3, s, s]``.

        What a patch says by itself is read as in MaskCLIP (and as in lexsplat's own `ClipEncoder.encode_patches`):
        its value in the last attention, which is what it would give to the class token, projected like that one.

        Returns:
            Embeddings of the images ``[B, D]``, patch tokens ``[B, P', width]``, and what the patches say by
            themselves ``[B, P', D]``.
        """
        tower, project = self.model.vision_model, self.model.visual_projection
        hidden = tower.embeddings(images)
        chosen = hidden[:, 1:].gather(1, kept[..., None].expand(-1, -1, hidden.shape[-1]))
        hidden = tower.pre_layrnorm(torch.cat([hidden[:, :1], chosen], 1))
        last, caught = tower.encoder.layers[-1], []
        # What the last attention sees is no output of the tower.
        with last.layer_norm1.register_forward_hook(lambda _, __, output: caught.append(output)):
            hidden = tower.encoder(inputs_embeds=hidden).last_hidden_state
        (seen,) = caught
        values = last.self_attn.out_proj(last.self_attn.v_proj(seen[:, 1:]))
        whole, said = (project(tower.post_layernorm(part)) for part in (hidden[:, 0], values))
        return whole, hidden[:, 1:], said

    def tokens(self, texts: list[str]) -> dict[str, Tensor]:
        encoded = self.tokenizer(texts, padding=True, truncation=True, max_length=LENGTH, return_tensors="pt")
        return {key: encoded[key] for key in ("input_ids", "attention_mask")}

    @torch.inference_mode()
    def encode_images(self, crops: list[Crop]) -> Tensor:
        parts = []
        for start in range(0, len(crops), 256):
            pixels = np.stack([crop.pixels(self.config.image_size) for crop in crops[start : start + 256]])
            images = (torch.from_numpy(pixels).permute(0, 3, 1, 2).float() / 255 - MEAN) / STD
            parts.append(F.normalize(pooled(self.average.get_image_features(pixel_values=images)), dim=-1))
        return torch.cat(parts)

    @torch.inference_mode()
    def encode_text(self, texts: list[str]) -> Tensor:
        return F.normalize(pooled(self.average.get_text_features(**self.tokens(list(texts)))), dim=-1)


def model_config(tokenizer: CLIPTokenizer, config: ClipTraining) -> CLIPConfig:
    text = {
        "vocab_size": len(tokenizer),
        "hidden_size": config.text_width,
        "intermediate_size": 4 * config.text_width,
        "num_hidden_layers": config.text_layers,
        "num_attention_heads": config.text_width // 32,
        "max_position_embeddings": LENGTH,
        "projection_dim": config.dim,
        # The text tower takes its output at the end mark: its number must be said, CLIP's own is another.
        "bos_token_id": tokenizer.bos_token_id,
        "eos_token_id": tokenizer.eos_token_id,
        "pad_token_id": tokenizer.pad_token_id,
    }
    vision = {
        "hidden_size": config.width,
        "intermediate_size": 4 * config.width,
        "num_hidden_layers": config.layers,
        "num_attention_heads": config.width // 32,
        "image_size": config.image_size,
        "patch_size": config.patch,
        "projection_dim": config.dim,
    }
    made = CLIPConfig(text_config=text, vision_config=vision, projection_dim=config.dim)
    made._attn_implementation = "eager"  # at so few tokens faster than the fused kernels
    return made


def pooled(output: object) -> Tensor:
    return output if isinstance(output, Tensor) else output.pooler_output  # type: ignore[attr-defined]


class Examination:
    """The crops and phrases of the scores, drawn once."""

    def __init__(self, seen: Frames, unseen: Frames, *, seed: int = 7) -> None:
        rng = np.random.default_rng(seed)
        self.seen = dominated_crops(seen, 1500, rng)
        drawn = dominated_crops(unseen, 2500, rng)
        self.unseen = [(crop, label) for crop, label in drawn if (label.kind, label.color) in HELD_OUT_PAIRS]
        self.crops = [random_crop(seen, rng) for _ in range(600)]
        self.phrases: list[Phrase] = []
        for crop in self.crops[:200]:
            label = seen.labels[crop.codes[crop.weights.argmax()]]
            self.phrases += [phrase_for(label, rng), near_miss(label, rng)]
        table = TruthTable(seen.labels)
        self.truth: NDArray[np.int8] = table.of(self.phrases, self.crops)
        self.parts = part_crops(seen, 1200, rng)
        self.part_phrases = [
            Phrase(f"{NAMES[kind][0].split()[-1]} {part}", kind=kind, part=part)
            for part, kinds in OWNERS.items()
            for kind in kinds
        ]
        self.part_truth: NDArray[np.int8] = table.of(self.part_phrases, self.parts)

    def scores(self, trainer: Trainer) -> dict[str, float]:
        found = zero_shot(self.seen, self.unseen, trainer.encode_images, trainer.encode_text)
        found |= calibration(self.crops, self.phrases, self.truth, trainer.encode_images, trainer.encode_text)
        found |= parts_found(
            self.parts, self.part_phrases, self.part_truth, trainer.encode_images, trainer.encode_text
        )
        return {name: round(value, 4) for name, value in found.items()}


def save(trainer: Trainer, folder: Path) -> None:
    """Save an ordinary Hugging Face folder."""
    size = trainer.config.image_size
    model = copy.deepcopy(trainer.average)
    model.config._attn_implementation = "sdpa"
    model.save_pretrained(folder)
    trainer.tokenizer.save_pretrained(folder)
    CLIPImageProcessor(
        size={"shortest_edge": size}, crop_size={"height": size, "width": size}
    ).save_pretrained(folder)


def train_clip(
    rank: int,
    training: list[Path],
    seen: list[Path],
    unseen: list[Path],
    folder: Path,
    config: ClipTraining,
    log: Path,
    phase: str,
    start: Path | None = None,
) -> None:
    """The work of one process; the first also saves the averaged model, and its scores as lines of JSON.

    Args:
        rank: Number of the process.
        training: Folders of frames.
        seen: Folders of frames for the scores.
        unseen: The same, of pairs that training lacks.
        folder: Where the model goes.
        config: Settings.
        log: File that gets a line of scores now and then.
        phase: Its name in the log.
        start: Folder of a model to go on from; none: from nothing, tokenizer and all.
    """
    if rank == 0 and start is None:
        learn_tokenizer(folder, seed=config.seed)
    torch.distributed.barrier()
    tokenizer = CLIPTokenizer.from_pretrained(start or folder)
    trainer, source = Trainer(tokenizer, config, start), batches(Frames(training), config, rank)
    examination = Examination(Frames(seen), Frames(unseen)) if rank == 0 else None
    began, every = time.perf_counter(), max(1, config.steps // 16)
    count = config.batch * torch.distributed.get_world_size()
    for step in range(1, config.steps + 1):
        losses = trainer.step(source.get())
        if examination is None:
            continue
        if step % 50 == 0:
            print(
                f"step {step} of {config.steps}, {step * count / (time.perf_counter() - began):.0f} crops/s, {losses}"
            )
        if step % every == 0 or step == config.steps:
            save(trainer, folder)
            scores = {
                "phase": phase,
                "step": step,
                "seconds": round(time.perf_counter() - began),
                **examination.scores(trainer),
            }
            print(scores, flush=True)
            with log.open("a") as lines:
                lines.write(json.dumps(scores) + "\n")
