"""CLIP and related models: images and texts to one space."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.features.clip_image import ClipImages
from lexsplat.features.clip_text import (
    LEGACY_END,
    UNLIKE,
    UNLIKE_WORDS,
    ClipText,
    is_vocabulary,
    light_tower,
    misnumbered,
    warn_truncated,
)
from lexsplat.features.hub import local_folder, tokenizer_files
from lexsplat.features.portable import TextWeights, tokenizer_content
from lexsplat.features.pretrained import PretrainedModel, check_images, normalization, resize_images
from lexsplat.features.towers import clip_images
from lexsplat.features.weights import excerpt, load_weights, read_config
from lexsplat.runtime.errors import ModelError

DEFAULT_CLIP = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"
"""The CLIP of the paper's released code."""

_CLIP_MEAN, _CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
_HALF = (0.5, 0.5, 0.5)
_TEXT_BATCH = 64
_ACTIVATIONS = ("quick_gelu", "gelu", "gelu_pytorch_tanh")
"""Of text towers that other programs can compute."""
_WITH_PATCHES = "a model of CLIP's architecture for patch-level embeddings"
_WITHOUT_PATCHES = "use image-level embeddings only: `--features.crop-tokens class`"


class ClipEncoder(PretrainedModel):
    """A CLIP-like model: CLIP, SigLIP, SigLIP 2, and others of transformers with both ``get_*_features``.

    CLIP's own architecture is computed here, without transformers.
    """

    tower = "clip"

    def __init__(self, folder: Path, name: str, device: torch.device | str = "cpu") -> None:
        super().__init__(folder, name, device)
        config = self._model.config
        both = hasattr(self._model, "get_image_features") and hasattr(config, "vision_config")
        if self._texts is None and not both:
            raise self._refusal(
                "a CLIP-like model with an image and a text tower", f"try {DEFAULT_CLIP} or `--clip bundled`"
            )
        self._siglip = config.model_type.startswith("siglip")
        self.image_size = _image_size(config.vision_config)
        default = (_HALF, _HALF) if self._siglip else (_CLIP_MEAN, _CLIP_STD)
        self._mean, self._std = normalization(folder, default, self.device)
        self._images = None
        if config.model_type == "clip":
            self._images, self._model.vision_model = ClipImages(self._model), None
        if self._texts is None:
            self._text_length = int(config.text_config.max_position_embeddings)
            self._tokenizer = _load_tokenizer(folder, name, config)
            self._check_text(config, folder)
        words = self.encode_text(UNLIKE_WORDS)
        self.dim = int(words.shape[-1])
        if F.pdist(words).min() < UNLIKE:
            raise self._refusal(
                "unlike words with unlike embeddings",
                "fetch the whole model again, or choose another model",
                f"the same embedding for {', '.join(UNLIKE_WORDS[:3])} ...",
            )

    def _check_text(self, config: Any, folder: Path) -> None:
        """Refuse a text tower with numbers that are not finite, and prompts without the end where CLIP reads them."""
        named = self._model.named_parameters()
        if not all(bool(value.isfinite().all()) for key, value in named if key.startswith("text_")):
            raise self._refusal("finite weights of the text tower", "fetch it again", "NaN or infinity")
        if config.model_type != "clip":
            return
        ids, end = self._tokenizer(UNLIKE_WORDS[0])["input_ids"], config.text_config.eos_token_id
        if ids[-1] == (max(ids) if end == LEGACY_END else end):
            return
        if type(end) is int and 0 <= end < config.text_config.vocab_size:
            wanted = f"a tokenizer that ends prompts with the model's end token ({end} in config.json)"
            raise self._refusal(wanted, "fetch the model again with its tokenizer files", f"token {ids[-1]}")
        raise ModelError(
            f"{folder / 'config.json'}: text_config.eos_token_id",
            expected=f"the number of the token that ends prompts ({ids[-1]} by the tokenizer)",
            found=excerpt(end) + ("" if _declares_end(folder) else ", as it is where the file gives none"),
            remedy="fetch config.json again",
        )

    def _own_model(self, folder: Path) -> Any:
        self._texts = None
        try:  # the settings, which the light tower does not read
            for path in tokenizer_files(folder)[1:]:
                if path.suffix == ".json":
                    read_config(path, "a tokenizer")
        except ModelError:
            return None
        weights = functools.cache(lambda: load_weights(folder, self.name))
        self._texts = light_tower(folder, weights, self.device)
        if self._texts is None:
            return None
        self._texts.content_hash = self.content_hash
        return clip_images(read_config(folder / "config.json", "a model configuration"), weights())

    @torch.inference_mode()
    def encode_images(self, images: Tensor) -> Tensor:
        """``[B, 3, h, w]`` in 0..1, of any size, to ``[B, D]``, float32 on the CPU, unit length."""
        check_images(images)
        pixels = self._pixels(images)
        if (tower := self._images) is not None:
            features = self._finite(lambda: tower(pixels, patches=False)[:, 0], crops=True)
        else:
            inputs = self._vision_inputs(pixels)
            features = self._finite(lambda: _pooled(self._model.get_image_features(**inputs)), crops=True)
        return F.normalize(features.float(), dim=-1).cpu()

    @property
    def patches(self) -> int:
        """Patches along a side of an image in `encode_patches`; 0 for architectures it does not support."""
        return 0 if self._images is None else self._images.patches

    @torch.inference_mode()
    def encode_patches(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Embeddings of images and of each of their patches, from one forward pass.

        Args:
            images: ``[B, 3, h, w]`` in 0..1, of any size.

        Returns:
            The embeddings of `encode_images` ``[B, D]``, and those of the patches ``[B, P, P, D]``, row-major;
            float32 on the CPU, unit length.

        Raises:
            ModelError: If the model is not of CLIP's own architecture.
        """
        check_images(images)
        if (tower := self._images) is None:
            raise self._refusal(_WITH_PATCHES, _WITHOUT_PATCHES)
        pixels = self._pixels(images)
        found = F.normalize(
            self._finite(lambda: tower(pixels, patches=True), crops=True).float(), dim=-1
        ).cpu()
        return found[:, 0], found[:, 1:].unflatten(1, (tower.patches, tower.patches))

    @torch.inference_mode()
    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Prompts to ``[B, D]``, float32 on the CPU, unit length; long prompts are truncated.

        Raises:
            ValueError: If there is no prompt, or one is empty.
        """
        if not prompts or any(not prompt.strip() for prompt in prompts):
            raise ValueError("prompts must be one or more texts that are not empty")
        if self._texts is not None:
            found = self._texts.encode_text(prompts)
        else:
            batches = [
                list(prompts[start : start + _TEXT_BATCH]) for start in range(0, len(prompts), _TEXT_BATCH)
            ]
            features = [
                _pooled(self._model.get_text_features(**self._text_inputs(batch))) for batch in batches
            ]
            found = F.normalize(torch.cat(features).float(), dim=-1).cpu()
        if not bool(found.isfinite().all()):
            raise self._refusal("finite text embeddings", "choose another model", "NaN or infinity")
        return found

    def text_only(self, device: torch.device | str) -> ClipText | ClipEncoder:
        """The text tower of this model as `load_text` returns it, without loading the model again.

        Of other architectures than CLIP's own it is this encoder, which gives its image tower away.
        """
        if self._texts is None:
            self._model.vision_model = self._images = None
            return self
        return self._texts.on(device)

    def text_tower(self) -> TextWeights | None:
        """The text tower for other programs; None if it is neither of CLIP's nor of SigLIP's architecture."""
        if self._texts is not None:
            return self._texts.text_tower()
        config = self._model.config.text_config
        kind = self._model.config.model_type
        tokenizer = tokenizer_content(self._tokenizer)
        if kind not in ("clip", "siglip") or config.hidden_act not in _ACTIVATIONS or tokenizer is None:
            return None
        tensors = {
            name.replace("head.", "text_projection."): tensor.detach().cpu()
            for name, tensor in self._model.text_model.state_dict().items()
        }
        if kind == "clip":
            tensors["text_projection.weight"] = self._model.text_projection.weight.detach().cpu()
        tensors.pop("embeddings.position_ids", None)
        return TextWeights(
            tensors,
            int(config.num_attention_heads),
            str(config.hidden_act),
            float(config.layer_norm_eps),
            tokenizer,
            int(self._tokenizer.pad_token_id) if self._siglip else None,
        )

    def _text_inputs(self, prompts: list[str]) -> dict[str, Tensor]:
        if self._siglip:  # trained on lower case with padding to full length, without an attention mask
            prompts = [prompt.lower() for prompt in prompts]
        # At once: a call for each prompt would take as long as the model.
        for prompt, ids in zip(prompts, self._tokenizer(prompts, verbose=False)["input_ids"]):
            if len(ids) > self._text_length:
                warn_truncated(prompt, len(ids), self._text_length)
        tokens = self._tokenizer(
            prompts,
            padding="max_length" if self._siglip else True,
            truncation=True,
            max_length=self._text_length,
            return_tensors="pt",
        )
        keys = ("input_ids",) if self._siglip else ("input_ids", "attention_mask")
        return {key: tokens[key].to(self.device) for key in keys}

    def tokens_over(self, prompt: str) -> int:
        """Number of tokens by which a prompt exceeds the limit of the model and is truncated."""
        if self._texts is not None:
            return self._texts.tokens_over(prompt)
        return max(len(self._tokenizer(prompt, verbose=False)["input_ids"]) - self._text_length, 0)

    def _pixels(self, images: Tensor) -> Tensor:
        """Normalized pixels ``[B, 3, S, S]`` of the model's size."""
        images = resize_images(images.to(self.device, torch.float32), self.image_size, self.image_size)
        return (images - self._mean) / self._std

    def _vision_inputs(self, pixels: Tensor) -> dict[str, Tensor]:
        """Input of the image tower: pixels, or a list of patches for SigLIP 2 of variable size ("NaFlex")."""
        if self._model.config.model_type != "siglip2":
            return {"pixel_values": pixels}
        patch = int(self._model.config.vision_config.patch_size)
        side = pixels.shape[-1] // patch
        cells = pixels.reshape(len(pixels), 3, side, patch, side, patch)
        patches = cells.permute(0, 2, 4, 3, 5, 1).reshape(len(pixels), side * side, patch * patch * 3)
        return {
            "pixel_values": patches,
            "pixel_attention_mask": torch.ones(patches.shape[:2], dtype=torch.int32, device=pixels.device),
            "spatial_shapes": torch.full((len(pixels), 2), side, dtype=torch.long, device=pixels.device),
        }


def _declares_end(folder: Path) -> bool:
    config = read_config(folder / "config.json", "a model configuration")
    return "eos_token_id" in (config.get("text_config") or config.get("text_config_dict") or {})


def _load_tokenizer(folder: Path, name: str, config: Any) -> Any:
    """The tokenizer of a model."""
    from transformers import AutoTokenizer

    refusal = functools.partial(ModelError, f"model {name}")
    size = int(config.text_config.vocab_size)
    try:
        tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
    except Exception as error:  # tokenizers raise a different type for each missing file
        found, remedy = str(error)[:120], "fetch it again"
        if list(folder.glob("*.model")) and not all(map(_is_installed, ("sentencepiece", "google.protobuf"))):
            found = "one of SentencePiece, which is not installed"
            remedy = 'run: pip install "lexsplat[siglip]"'
        else:
            _check_tokenizer_files(folder)
        raise refusal(expected="a tokenizer beside the weights", found=found, remedy=remedy) from error
    tokenizer.padding_side = "right"  # as in training; transformers' default for SigLIP 2 is "left"
    if not is_vocabulary(len(tokenizer), size):
        raise refusal(
            expected=f"a tokenizer with the {size:,} words of the model",
            found=f"{len(tokenizer):,} words",
            remedy=f"fetch the model again with its tokenizer files; they are read from {folder}",
        )
    fault = misnumbered(tokenizer.get_vocab(), tokenizer(UNLIKE_WORDS[0])["input_ids"], size)
    if fault:
        raise ModelError(
            tokenizer_files(folder)[0],
            expected=f"another number below {size} for each token (vocab_size in config.json)",
            found=fault,
            remedy="fetch the model again with its tokenizer files",
        )
    return tokenizer


def _check_tokenizer_files(folder: Path) -> None:
    """Name the file for which a tokenizer cannot be loaded.

    Raises:
        ModelError: If one is damaged.
    """
    from tokenizers import Tokenizer

    for path in tokenizer_files(folder):
        if path.suffix == ".json":
            read_config(path, "a tokenizer")
    path = folder / "tokenizer.json"
    try:
        if path.is_file():
            Tokenizer.from_file(str(path))
    except Exception as error:  # its errors have no type of their own
        found = f"other content ({str(error)[:120]})"
        raise ModelError(path, expected="a tokenizer", found=found, remedy="fetch the model again") from error


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # not even the package around it
        return False


def check_patches(folder: Path, name: str) -> None:
    """Check from its configuration that a model has patch-level embeddings.

    Raises:
        ModelError: If it is not of CLIP's own architecture.
    """
    try:
        kind = json.loads((folder / "config.json").read_text()).get("model_type")
    except (OSError, ValueError, AttributeError):
        return  # loading the model reports the error
    if kind != "clip":
        raise ModelError(f"model {name}", expected=_WITH_PATCHES, found=str(kind), remedy=_WITHOUT_PATCHES)


def patch_grid(name: str) -> int:
    """Patches along a side of a model's input, from its configuration.

    0 for architectures without patch-level embeddings, and for a model that is not on this machine.
    """
    folder = local_folder(name)
    try:
        config = json.loads((folder / "config.json").read_text()) if folder else {}
        vision = config.get("vision_config") or {}
        # transformers leaves out what equals its defaults
        grid = int(vision.get("image_size", 224)) // int(vision.get("patch_size", 32))
    except (OSError, ValueError, TypeError, AttributeError, ZeroDivisionError):
        return 0  # loading the model reports the error
    return max(0, grid) if config.get("model_type") == "clip" else 0


def _pooled(output: Any) -> Tensor:
    """The embedding: newer versions of transformers return an object that holds it, older ones the tensor."""
    return output if isinstance(output, Tensor) else output.pooler_output


def _image_size(vision_config: Any) -> int:
    """Side in pixels of the model's square input images."""
    size = getattr(vision_config, "image_size", None)
    if size is None:  # SigLIP 2 of variable size states the number of patches
        return round(int(vision_config.num_patches) ** 0.5) * int(vision_config.patch_size)
    return int(min(size)) if isinstance(size, Sequence) else int(size)
