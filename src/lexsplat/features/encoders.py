"""Encoders: images and words to one space (CLIP, SigLIP), and images to dense features (DINO, DINOv2,
DINOv3).

Built by transformers from a folder or a name. Every size (image, text length, projection, patch) is read from
the model's configuration. Resizing and normalisation are done here in torch, so no image library is needed
for them.
"""

from __future__ import annotations

import functools
import inspect
import logging
import re
import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.errors import ModelError
from lexsplat.features.hub import content_hash, model_folder, read_json

log = logging.getLogger("lexsplat")

DEFAULT_CLIP = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"
DEFAULT_DINO = "facebook/dino-vits8"

Facet = Literal["key", "token"]

_CLIP_MEAN, _CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_HALF = (0.5, 0.5, 0.5)
_TEXT_BATCH = 64
_FEW_PATCHES = 64


class ImageTextEncoder(Protocol):
    """Images and words to unit vectors of one space."""

    name: str
    content_hash: str
    image_size: int
    dim: int
    device: torch.device

    def encode_images(self, images: Tensor) -> Tensor:
        """``[B, 3, h, w]`` in 0..1 to ``[B, D]``, float32 on the CPU, unit length."""
        ...

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Prompts to ``[B, D]``, float32 on the CPU, unit length."""
        ...


class DenseEncoder(Protocol):
    """An image to a grid of unit vectors."""

    name: str
    content_hash: str
    dim: int
    device: torch.device

    def encode_dense(
        self,
        image: Tensor,
        *,
        short_side: int = 224,
        stride: int | None = None,
        facet: Facet = "key",
        layer: int | None = None,
        max_tokens: int = 4096,
    ) -> Tensor:
        """``[3, h, w]`` in 0..1 to ``[h', w', D]``, float32 on the CPU, unit length; see `DinoEncoder`."""
        ...


def resize_images(images: Tensor, height: int, width: int) -> Tensor:
    """Antialiased bicubic resize of ``[B, 3, h, w]`` in 0..1; the overshoot of the filter is cut off."""
    if images.shape[-2:] == (height, width):
        return images
    return F.interpolate(images, (height, width), mode="bicubic", antialias=True, align_corners=False).clamp(
        0, 1
    )


class ClipEncoder:
    """A CLIP-like model of transformers: CLIP, SigLIP, SigLIP 2 and other models with both
    ``get_*_features``.

    Args:
        folder: Local model folder.
        name: What to call it in messages and records.
        device: Where it runs.

    Raises:
        ModelError: If the folder is not such a model.
    """

    def __init__(self, folder: Path, name: str, device: torch.device | str = "cpu") -> None:
        from transformers import AutoTokenizer

        self.name, self.device = name, torch.device(device)
        self.content_hash = content_hash(folder)
        self._model = _load_model(folder, name, self.device)
        config = self._model.config
        if not (hasattr(self._model, "get_image_features") and hasattr(config, "vision_config")):
            raise ModelError(
                f"model {name}",
                expected="a CLIP-like model with an image and a text tower",
                found=f"a {config.model_type!r} model",
                remedy=f"try {DEFAULT_CLIP} or `--clip embedded`",
            )
        self._siglip = config.model_type.startswith("siglip")
        self.image_size = _image_size(config.vision_config)
        if self.device.type == "cpu":
            _plain_attention(self._model, config.vision_config, self.image_size)
        self._text_length = int(config.text_config.max_position_embeddings)
        default = (_HALF, _HALF) if self._siglip else (_CLIP_MEAN, _CLIP_STD)
        self._mean, self._std = _normalisation(folder, default, self.device)
        try:
            self._tokenizer = AutoTokenizer.from_pretrained(
                folder, local_files_only=True, trust_remote_code=False
            )
        except Exception as error:  # tokenizers raise a different type for each file they miss
            raise ModelError(
                f"model {name}",
                expected="a tokenizer beside the weights",
                found=str(error)[:120],
                remedy="fetch it again",
            ) from error
        self.dim = int(self.encode_text(["object"]).shape[-1])

    @torch.inference_mode()
    def encode_images(self, images: Tensor) -> Tensor:
        """``[B, 3, h, w]`` in 0..1, of any size, to ``[B, D]``, float32 on the CPU, unit length."""
        _check_images(images)
        images = resize_images(images.to(self.device, torch.float32), self.image_size, self.image_size)
        pixels = (images - self._mean) / self._std
        with _precision(self.device, crops=True):
            features = _pooled(self._model.get_image_features(**self._vision_inputs(pixels)))
        return F.normalize(features.float(), dim=-1).cpu()

    @torch.inference_mode()
    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """Prompts to ``[B, D]``, float32 on the CPU, unit length; words beyond the model's text length are
        cut.

        Raises:
            ValueError: If there is no prompt or one is empty.
        """
        if not prompts or any(not prompt.strip() for prompt in prompts):
            raise ValueError("prompts must be one or more texts that are not empty")
        batches = [
            list(prompts[start : start + _TEXT_BATCH]) for start in range(0, len(prompts), _TEXT_BATCH)
        ]
        features = [_pooled(self._model.get_text_features(**self._text_inputs(batch))) for batch in batches]
        return F.normalize(torch.cat(features).float(), dim=-1).cpu()

    def _text_inputs(self, prompts: list[str]) -> dict[str, Tensor]:
        if self._siglip:  # trained on lower case, padded to full length, and without an attention mask
            prompts = [prompt.lower() for prompt in prompts]
        tokens = self._tokenizer(
            prompts,
            padding="max_length" if self._siglip else True,
            truncation=True,
            max_length=self._text_length,
            return_tensors="pt",
        )
        keys = ("input_ids",) if self._siglip else ("input_ids", "attention_mask")
        return {key: tokens[key].to(self.device) for key in keys}

    def _vision_inputs(self, pixels: Tensor) -> dict[str, Tensor]:
        """What the image tower wants: pixels, or for SigLIP 2 of free size ("NaFlex") a list of patches."""
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


class DinoEncoder:
    """A vision transformer without words: DINO (``vit``), DINOv2 with or without registers, DINOv3.

    Args:
        folder: Local model folder.
        name: What to call it in messages and records.
        device: Where it runs.

    Raises:
        ModelError: If the folder is not such a model.
    """

    def __init__(self, folder: Path, name: str, device: torch.device | str = "cpu") -> None:
        self.name, self.device = name, torch.device(device)
        self.content_hash = content_hash(folder)
        self._model = _load_model(folder, name, self.device)
        config = self._model.config
        self._keys = _key_projections(self._model)
        if not self._keys or not isinstance(getattr(config, "patch_size", None), int):
            raise ModelError(
                f"model {name}",
                expected="a vision transformer such as DINO, DINOv2 or DINOv3 (ViT)",
                found=f"a {config.model_type!r} model",
                remedy=f"try {DEFAULT_DINO}, `--dino embedded` or `--dino none`",
            )
        self.patch_size = int(config.patch_size)
        self.dim = int(config.hidden_size)
        self.num_layers = len(self._keys)
        self._mean, self._std = _normalisation(folder, (_IMAGENET_MEAN, _IMAGENET_STD), self.device)
        self._caught = threading.local()  # several threads may evaluate the model, each wants its own keys
        for projection in self._keys:
            projection.register_forward_hook(self._catch)
        self._options: dict[str, Any] = {}
        if "interpolate_pos_encoding" in inspect.signature(self._model.forward).parameters:
            self._options["interpolate_pos_encoding"] = True  # the others always do, or use rotary positions

    @torch.inference_mode()
    def encode_dense(
        self,
        image: Tensor,
        *,
        short_side: int = 224,
        stride: int | None = None,
        facet: Facet = "key",
        layer: int | None = None,
        max_tokens: int = 4096,
    ) -> Tensor:
        """Dense features on a regular grid of cells that tiles the image.

        A stride below the patch size is reached by evaluating shifted copies of the image, each on the
        model's own patch grid, and interleaving the results: patch centres lie exactly on cell centres, and
        attention sees ``(patch / stride)**2`` times fewer tokens at once than with a changed convolution
        stride.

        Args:
            image: ``[3, h, w]`` in 0..1.
            short_side: The image is resized to this many pixels on its short side (rounded to whole patches).
            stride: Pixels of the resized image between cells; the patch is divided into a whole number of
                strides, at most this long. None is the patch size.
            facet: "key", the attention keys of a layer, or "token", the last layer's output tokens.
            layer: Which layer's keys, 0-based; None is the last. Ignored for tokens.
            max_tokens: Most patches that attention sees at once; a larger image is evaluated in overlapping
                windows.

        Returns:
            Features ``[h', w', D]``, float32 on the CPU, unit length.
        """
        _check_images(image[None])
        if stride is not None and stride < 1:
            raise ValueError(f"stride must be at least 1, got {stride}")
        if facet not in ("key", "token"):
            raise ValueError(f"facet must be 'key' or 'token', got {facet!r}")
        if layer is not None and not -self.num_layers <= layer < self.num_layers:
            raise ValueError(f"layer must be below {self.num_layers}, got {layer}")
        patch = self.patch_size
        scale = short_side / min(image.shape[-2:])
        rows, cols = (max(1, round(length * scale / patch)) for length in image.shape[-2:])
        image = resize_images(image[None].to(self.device, torch.float32), rows * patch, cols * patch)
        pixels = (image - self._mean) / self._std
        phases = -(-patch // min(stride or patch, patch))
        # Cell centres of the fine grid; the shift of a phase brings its patch centres onto them.
        shifts = [round((phase + 0.5) * patch / phases - patch / 2) for phase in range(phases)]
        margin = max(abs(shift) for shift in shifts)
        padded = F.pad(pixels, (margin, margin, margin, margin), mode="replicate")
        fine = torch.empty(rows, phases, cols, phases, self.dim)
        for i, down in enumerate(shifts):
            for j, right in enumerate(shifts):
                top, left = margin + down, margin + right
                shifted = padded[..., top : top + rows * patch, left : left + cols * patch]
                fine[:, i, :, j] = self._windowed(shifted, facet, layer, max_tokens)
        return F.normalize(fine.reshape(rows * phases, cols * phases, self.dim), dim=-1)

    def _windowed(self, pixels: Tensor, facet: Facet, layer: int | None, max_tokens: int) -> Tensor:
        """Patch features ``[rows, cols, D]`` of ``[1, 3, H, W]``, at most ``max_tokens`` patches at once."""
        patch = self.patch_size
        rows, cols = pixels.shape[-2] // patch, pixels.shape[-1] // patch
        if rows * cols <= max_tokens:
            return self._forward(pixels, facet, layer)
        side = max(1, int(max_tokens**0.5))
        height = min(rows, max(side, max_tokens // cols))
        width = min(cols, max(1, max_tokens // height))
        total = torch.zeros(rows, cols, self.dim)
        weight = torch.zeros(rows, cols, 1)
        ramp = torch.minimum(_ramp(height)[:, None], _ramp(width)[None, :])[..., None]
        for top in _window_starts(rows, height):
            for left in _window_starts(cols, width):
                window = pixels[
                    ..., top * patch : (top + height) * patch, left * patch : (left + width) * patch
                ]
                features = F.normalize(self._forward(window, facet, layer), dim=-1)
                total[top : top + height, left : left + width] += ramp * features
                weight[top : top + height, left : left + width] += ramp
        return total / weight

    def _catch(self, projection: torch.nn.Module, inputs: Any, output: Tensor) -> None:
        if getattr(self._caught, "layer", None) is projection:
            self._caught.keys = output

    def _forward(self, pixels: Tensor, facet: Facet, layer: int | None) -> Tensor:
        """Patch features ``[rows, cols, D]`` of one evaluation of the model on ``[1, 3, H, W]``."""
        rows, cols = pixels.shape[-2] // self.patch_size, pixels.shape[-1] // self.patch_size
        self._caught.layer = self._keys[-1 if layer is None else layer] if facet == "key" else None
        with _precision(self.device):
            tokens = self._model(pixel_values=pixels, **self._options).last_hidden_state
        if facet == "key":
            tokens = self._caught.__dict__.pop("keys").reshape(1, -1, self.dim)
        # The class token and registers come first in all these models; the patches are the last rows * cols.
        return tokens[0, -rows * cols :].reshape(rows, cols, self.dim).float().cpu()


def load_clip(name: str = DEFAULT_CLIP, device: torch.device | str = "cpu") -> ClipEncoder:
    """A CLIP-like encoder by name, folder, or "embedded".

    Raises:
        ModelError: If it is not here and cannot be fetched, or is not a CLIP-like model.
    """
    return ClipEncoder(model_folder(name, "clip"), name, device)


def load_dino(name: str = DEFAULT_DINO, device: torch.device | str = "cpu") -> DinoEncoder:
    """A DINO-like encoder by name, folder, or "embedded".

    Raises:
        ModelError: If it is not here and cannot be fetched, or is not a vision transformer.
    """
    return DinoEncoder(model_folder(name, "dino"), name, device)


def _load_model(folder: Path, name: str, device: torch.device) -> Any:
    from transformers import AutoModel
    from transformers.utils import logging as transformers_logging

    verbosity = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()  # it would list every unused head
    bars = transformers_logging.is_progress_bar_enabled()
    transformers_logging.disable_progress_bar()
    try:
        model = AutoModel.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, trust_remote_code=False
        )
    except (
        Exception
    ) as error:  # transformers raises KeyError, OSError, ValueError, SafetensorError, RuntimeError ...
        raise ModelError(
            f"model {name}",
            expected="a model that transformers can load",
            found=str(error)[:160],
            remedy="fetch it again, or choose another model",
        ) from error
    finally:
        transformers_logging.set_verbosity(verbosity)
        if bars:
            transformers_logging.enable_progress_bar()
    return model.float().eval().requires_grad_(False).to(device)  # some are stored in half precision


def _pooled(output: Any) -> Tensor:
    """The embedding: newer transformers return an object that holds it, older ones the tensor."""
    return output if isinstance(output, Tensor) else output.pooler_output


def _precision(device: torch.device, *, crops: bool = False) -> AbstractContextManager:
    """Half precision where the device computes in it and gains by it; the angles change by less than 1e-2.

    Float16 on CUDA. Bfloat16 on processors with instructions for it, for many small crops only (1.8 times as fast;
    dense images gain nothing). Texts are always encoded in float32.
    """
    if device.type == "cuda":
        return torch.autocast("cuda", dtype=torch.float16)
    return torch.autocast("cpu", dtype=torch.bfloat16) if crops and _computes_in_bfloat16() else nullcontext()


@functools.cache
def _computes_in_bfloat16() -> bool:
    """Whether the processor has instructions for bfloat16; without them it is emulated, and slow."""
    names = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(getattr(torch.cpu, name, bool)() for name in names)


def _plain_attention(model: Any, vision_config: Any, image_size: int) -> None:
    """For a handful of patches on a CPU, attention written out takes less time than the fused kernel.

    Only the image tower changes; a model whose tower or patches are not where CLIP's are stays as it is.
    """
    tower, patch = getattr(model, "vision_model", None), getattr(vision_config, "patch_size", None)
    if tower is None or not isinstance(patch, int) or (image_size // patch) ** 2 > _FEW_PATCHES:
        return
    for module in tower.modules():
        if hasattr(module, "config"):
            module.config._attn_implementation = "eager"


def _image_size(vision_config: Any) -> int:
    """Side in pixels of the square images that the model was trained on."""
    size = getattr(vision_config, "image_size", None)
    if size is None:  # SigLIP 2 of free size states the number of patches
        return round(int(vision_config.num_patches) ** 0.5) * int(vision_config.patch_size)
    return int(min(size)) if isinstance(size, Sequence) else int(size)


def _normalisation(folder: Path, default: tuple, device: torch.device) -> tuple[Tensor, Tensor]:
    """Mean and deviation ``[3, 1, 1]`` from the model's preprocessing file, or its family's usual ones."""
    mean, std = default
    for file in ("preprocessor_config.json", "processor_config.json"):
        if not (folder / file).is_file():
            continue
        content = read_json(folder / file)
        content = content.get("image_processor", content)
        if "image_mean" in content and "image_std" in content:
            mean, std = content["image_mean"], content["image_std"]
            break
    else:
        log.warning(
            "%s: no preprocessing file; the usual image normalisation of its family is used", folder.name
        )
    return tuple(torch.tensor(v, dtype=torch.float32, device=device).reshape(3, 1, 1) for v in (mean, std))  # type: ignore[return-value]


def _key_projections(model: torch.nn.Module) -> list[torch.nn.Module]:
    """The linear layers that make attention keys, by layer; transformers has called them by two names."""
    found = {}
    for path, module in model.named_modules():
        if match := re.search(r"(?:^|\.)layers?\.(\d+)\..*\b(?:k_proj|key)$", path):
            found[int(match.group(1))] = module
    return [found[index] for index in sorted(found)]


def _check_images(images: Tensor) -> None:
    if images.ndim != 4 or images.shape[1] != 3:
        raise ValueError(f"images must be [B, 3, h, w], got {list(images.shape)}")


def _ramp(length: int) -> Tensor:
    """Weights that fall off towards both ends, so that windows blend without seams; never zero."""
    position = torch.arange(length, dtype=torch.float32)
    return torch.minimum(position, length - 1 - position) + 1


def _window_starts(total: int, window: int) -> list[int]:
    """Starts of windows that cover ``total`` evenly; several overlap by at least a quarter."""
    if window >= total:
        return [0]
    step = max(1, window - max(1, window // 4))
    count = -(-(total - window) // step) + 1
    return [round(index * (total - window) / (count - 1)) for index in range(count)]
