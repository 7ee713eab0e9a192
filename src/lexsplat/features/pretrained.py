"""Shared by the encoders: loading a transformers model from a folder, its precision, and preprocessing of images.

Resizing and normalization are done in torch, without an image library.
"""

from __future__ import annotations

import functools
import logging
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.features.hub import content_hash, read_config
from lexsplat.runtime.errors import ModelError

log = logging.getLogger("lexsplat")


class PretrainedModel:
    """A pretrained vision model of transformers, frozen.

    Args:
        folder: Local model folder.
        name: Its name in messages and records.
        device: Device of the model.

    Raises:
        ModelError: If transformers cannot load the folder.
    """

    def __init__(self, folder: Path, name: str, device: torch.device | str = "cpu") -> None:
        self.name, self.device = name, torch.device(device)
        self.content_hash = content_hash(folder)
        self._model = _load_model(folder, name, self.device)

    def _refusal(self, expected: str, remedy: str) -> ModelError:
        """The error for a model of another architecture."""
        found = f"a {self._model.config.model_type!r} model"
        return ModelError(f"model {self.name}", expected=expected, found=found, remedy=remedy)


def _load_model(folder: Path, name: str, device: torch.device) -> Any:
    from transformers import AutoModel
    from transformers.utils import logging as transformers_logging

    verbosity = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()  # it lists every unused head
    bars = transformers_logging.is_progress_bar_enabled()
    transformers_logging.disable_progress_bar()
    try:
        model = AutoModel.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, trust_remote_code=False
        )
    except Exception as error:  # KeyError, OSError, ValueError, SafetensorError, RuntimeError ...
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
    return model.float().eval().requires_grad_(False).to(device)  # some models are stored in half precision


def precision(device: torch.device, *, crops: bool = False) -> AbstractContextManager:
    """Half precision where it is faster; angles between embeddings change by less than 1e-2.

    Float16 on CUDA. Bfloat16 on processors with instructions for it, for many small crops only (1.8 times as fast, no
    gain for dense images). Texts are always encoded in float32.
    """
    if device.type == "cuda":
        return torch.autocast("cuda", dtype=torch.float16)
    return torch.autocast("cpu", dtype=torch.bfloat16) if crops and _computes_in_bfloat16() else nullcontext()


@functools.cache
def _computes_in_bfloat16() -> bool:
    """Whether the processor has bfloat16 instructions; without them, emulation is slow."""
    names = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(getattr(torch.cpu, name, bool)() for name in names)


def normalization(folder: Path, default: tuple, device: torch.device) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation ``[3, 1, 1]`` from the model's preprocessing file, or ``default``."""
    mean, std = default
    for file in ("preprocessor_config.json", "processor_config.json"):
        if not (folder / file).is_file():
            continue
        content = read_config(folder / file)
        content = content.get("image_processor", content)
        if "image_mean" in content and "image_std" in content:
            mean, std = content["image_mean"], content["image_std"]
            break
    else:
        log.warning(
            "%s: no preprocessing file; using the default image normalization of its family", folder.name
        )
    return tuple(torch.tensor(v, dtype=torch.float32, device=device).reshape(3, 1, 1) for v in (mean, std))  # type: ignore[return-value]


def check_images(images: Tensor) -> None:
    """Raises ValueError if images are not ``[B, 3, h, w]``."""
    if images.ndim != 4 or images.shape[1] != 3:
        raise ValueError(f"images must be [B, 3, h, w], got {list(images.shape)}")


def resize_images(images: Tensor, height: int, width: int) -> Tensor:
    """Antialiased bicubic resize of ``[B, 3, h, w]`` in 0..1; overshoot of the filter is clamped."""
    if images.shape[-2:] == (height, width):
        return images
    return F.interpolate(images, (height, width), mode="bicubic", antialias=True, align_corners=False).clamp(
        0, 1
    )
