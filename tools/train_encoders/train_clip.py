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
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
import torch.distributed
import torch.nn.functional as F
from clip_batches import KINDS, MEAN, PART_NAMES, STD, TINTS, Batch, batches, jittered, mirrored
from clip_losses import asking_losses, composition_loss, dense_loss, patch_loss
from clip_scores import calibration, parts_found, zero_shot
from clip_settings import ClipTraining
from crops import Crop, Frames, dominated_crops, part_crops, random_crop
from numpy.typing import NDArray
from tokenizer import LENGTH, learn_tokenizer
from torch import Tensor
from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel, CLIPTokenizer
from truth import TruthTable
from vocabulary import HELD_OUT_PAIRS, NAMES, OWNERS
from words import Phrase, near_miss, phrase_for
from workers import average_gradients


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
