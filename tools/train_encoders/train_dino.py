"""Train the dense encoder: patches of one object attract each other across views, patches of others repel.

DINO learns from a hundred million images that the parts of an object belong together. A small model does not learn
it from a few thousand renderings: self-distillation alone grouped by color (the prototype's purity was
below that of raw color). Positives are therefore taken from the renderings: patches that show the same thing of
the same scene, in two views of it, seen in different light, cut and size. No words and no names of kinds are
used, save that things of the same kind in different scenes neither attract nor repel.
"""

from __future__ import annotations

import json
import math
import queue
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from clip_batches import MEAN, STD, jittered
from crops import Frame, Frames
from dense_scores import grouping, mean_colors
from numpy.typing import NDArray
from torch import Tensor
from transformers import ViTConfig, ViTImageProcessor, ViTModel
from workers import average_gradients


@dataclass(frozen=True)
class DinoTraining:
    """Settings of the training.

    Args:
        steps: Optimizer steps.
        scenes: Scenes a step and process, two views of each.
        tokens: Patches of a crop that take part in the loss, shared out evenly over the things in it.
        side: Pixels of the square crops.
        zoom: Smallest and largest side of a crop in the frame, pixels.
        patch, width, layers: Of the model.
        rate: Largest learning rate.
        temperature: Of the contrast.
        gray: Share of the crops shown in gray.
        seed: Of everything random.
    """

    steps: int = 1500
    scenes: int = 14
    tokens: int = 64
    side: int = 160
    zoom: tuple[float, float] = (110, 230)
    patch: int = 8
    width: int = 128
    layers: int = 4
    rate: float = 1e-3
    temperature: float = 0.1
    gray: float = 0.15
    seed: int = 0


@dataclass(frozen=True)
class Batch:
    """Crops ``[B, 3, s, s]`` uint8; of the chosen patches their crop, place, scene, thing and kind ``[M]``."""

    pixels: Tensor
    crop: Tensor
    place: Tensor
    scene: Tensor
    thing: Tensor
    kind: Tensor


class Source:
    """Batches, prepared in a background thread."""

    def __init__(self, frames: Frames, config: DinoTraining, rank: int) -> None:
        self.config, self.frames = config, frames
        self.by_scene: dict[str, list[Frame]] = {}
        for frame in frames.frames:
            self.by_scene.setdefault(frame.scene, []).append(frame)
        self.scene_names = [name for name, views in self.by_scene.items() if len(views) > 1]
        kinds = sorted({label.kind for label in frames.labels})
        self.kind_of_code = np.array([kinds.index(label.kind) for label in frames.labels])
        self.rng = np.random.default_rng([config.seed, rank])
        self.ready: queue.Queue[Batch] = queue.Queue(3)
        threading.Thread(target=self._work, daemon=True).start()

    def _work(self) -> None:
        while True:
            self.ready.put(self.make())

    def make(self) -> Batch:
        config, rng = self.config, self.rng
        images, rows = [], []
        chosen = rng.choice(len(self.scene_names), config.scenes, replace=False)
        for scene in chosen:
            views = self.by_scene[self.scene_names[scene]]
            for view in rng.choice(len(views), 2, replace=False):
                frame = views[view]
                height, width = frame.things.shape
                side = float(rng.uniform(*config.zoom))
                left, top = rng.uniform(0, width - side), rng.uniform(0, height - side)
                box = (left, top, left + side, top + side)
                images.append(
                    np.asarray(frame.image.resize((config.side,) * 2, 2, box=box, reducing_gap=2.0))
                )
                for place, thing, kind in self._patches(frame, left, top, side):
                    rows.append((len(images) - 1, place, int(scene), thing, kind))
        pixels = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
        return Batch(pixels, *torch.tensor(rows).T)

    def _patches(self, frame: Frame, left: float, top: float, side: float) -> list[tuple[int, int, int]]:
        """Place, thing and kind of patches that lie almost wholly on one thing."""
        config, rng = self.config, self.rng
        count, fine = config.side // config.patch, 4
        position = (np.arange(count * fine) + 0.5) * side / (count * fine)
        ys, xs = (top + position).astype(int), (left + position).astype(int)
        things = self._by_patch(frame.things[np.ix_(ys, xs)], count, fine)
        codes = self._by_patch(frame.codes[np.ix_(ys, xs)], count, fine)
        middle = things[:, fine * fine // 2 + fine // 2]
        pure = ((things == middle[:, None]).mean(1) >= 0.85) & (middle > 0)
        places: list[tuple[int, int, int]] = []
        present = np.unique(middle[pure])
        for thing in present:
            mine = np.nonzero(pure & (middle == thing))[0]
            share = max(2, config.tokens // len(present))
            for place in rng.choice(mine, min(share, len(mine)), replace=False):
                kind = self.kind_of_code[codes[place, fine * fine // 2 + fine // 2]]
                places.append((int(place), int(thing), int(kind)))
        return places

    @staticmethod
    def _by_patch(values: NDArray, count: int, fine: int) -> NDArray:
        return values.reshape(count, fine, count, fine).swapaxes(1, 2).reshape(count * count, fine * fine)


def grouping_loss(features: Tensor, batch: Batch, temperature: float) -> Tensor:
    """Contrast over patches ``[M, D]`` with all patches of the same thing as right answers."""
    similarity = features @ features.T / temperature
    same_scene = batch.scene[:, None] == batch.scene
    right = same_scene & (batch.thing[:, None] == batch.thing)
    open_ = ~same_scene & (batch.kind[:, None] == batch.kind)
    itself = torch.eye(len(features), dtype=torch.bool)
    log_probabilities = similarity.masked_fill(open_ | itself, -torch.inf).log_softmax(1)
    right = right & ~itself
    count = right.sum(1)
    return -(torch.where(right, log_probabilities, 0.0).sum(1)[count > 0] / count[count > 0]).mean()


def tokens_of(model: ViTModel, images: Tensor) -> Tensor:
    """Unit patch features ``[B, P, D]``."""
    out = model(pixel_values=images, interpolate_pos_encoding=True).last_hidden_state[:, 1:]
    return F.normalize(out.float(), dim=-1)


def train_dino(
    rank: int, training: list[Path], seen: list[Path], folder: Path, config: DinoTraining, log: Path
) -> None:
    """The work of one process; the first also saves the model, and its scores as lines of JSON.

    Args:
        rank: Number of the process.
        training: Folders of frames.
        seen: Folders of frames for the scores.
        folder: Where the model goes.
        config: Settings.
        log: File that gets a line of scores now and then.
    """
    torch.manual_seed(config.seed)
    model = ViTModel(model_config(config), add_pooling_layer=False)
    optimizer = torch.optim.AdamW(model.parameters(), lr=config.rate, weight_decay=0.05)
    generator = torch.Generator().manual_seed(1000 * config.seed + rank)
    source, test = Source(Frames(training), config, rank), Frames(seen)
    start = time.perf_counter()
    for step in range(1, config.steps + 1):
        along = step / config.steps
        for group in optimizer.param_groups:
            group["lr"] = (
                config.rate * min(1, step / 60) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * along)))
            )
        loss = _loss(model, source.ready.get(), config, generator)
        optimizer.zero_grad()
        loss.backward()
        average_gradients(model.parameters())
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        if rank:
            continue
        if step % 50 == 0:
            per_step = (time.perf_counter() - start) / step
            print(
                f"step {step} of {config.steps}, {per_step:.2f} s a step, loss {loss.item():.3f}", flush=True
            )
        if step % max(1, config.steps // 4) == 0:
            save(model, folder, config)
            scores = {
                "step": step,
                "seconds": round(time.perf_counter() - start),
                **dense_scores(model, test),
            }
            print(scores, flush=True)
            with log.open("a") as lines:
                lines.write(json.dumps(scores) + "\n")


def _loss(model: ViTModel, batch: Batch, config: DinoTraining, generator: torch.Generator) -> Tensor:
    images = jittered(batch.pixels, generator)
    gray = torch.rand(len(images), generator=generator) < config.gray
    images[gray] = images[gray].mean(1, keepdim=True)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        features = tokens_of(model, images)
    return grouping_loss(features[batch.crop, batch.place], batch, config.temperature)


def model_config(config: DinoTraining) -> ViTConfig:
    """Of the shape of DINO's models."""
    return ViTConfig(
        hidden_size=config.width,
        intermediate_size=4 * config.width,
        num_hidden_layers=config.layers,
        num_attention_heads=config.width // 32,
        image_size=config.side,
        patch_size=config.patch,
        hidden_dropout_prob=0.0,
        attention_probs_dropout_prob=0.0,
    )


def save(model: ViTModel, folder: Path, config: DinoTraining) -> None:
    """Save an ordinary Hugging Face folder."""
    model.save_pretrained(folder)
    size = {"height": config.side, "width": config.side}
    mean, std = MEAN.flatten().tolist(), STD.flatten().tolist()
    ViTImageProcessor(size=size, image_mean=mean, image_std=std).save_pretrained(folder)


def dense_scores(model: ViTModel, seen: Frames) -> dict[str, float]:
    """Grouping by the model's tokens, and by raw color."""

    @torch.inference_mode()
    def features(frame: Frame) -> NDArray:
        pixels = torch.from_numpy(np.asarray(frame.image)).permute(2, 0, 1).float() / 255
        model.eval()
        found = tokens_of(model, ((pixels - MEAN) / STD)[None])[0]
        model.train()
        rows, columns = (length // 8 for length in frame.things.shape)
        return found.reshape(rows, columns, -1).numpy()

    own = grouping(seen, features)
    color = grouping(seen, mean_colors)
    return {**own, "color_purity": color["purity"], "color_nmi": color["nmi"]}
