"""Shared by the encoders: loading a model from a folder, its precision, and preprocessing of images.

Resizing and normalization are done in torch, without an image library.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from lexsplat.features.declared_sizes import check_sizes
from lexsplat.features.hub import content_hash, preprocessing, preprocessing_file
from lexsplat.features.weights import build_model, excerpt
from lexsplat.runtime.device import one_thread
from lexsplat.runtime.errors import ModelError

log = logging.getLogger("lexsplat")

IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of the colors of ImageNet."""

_CLEARLY = 0.8
"""Share of the time in float32 below which bfloat16 is chosen, so that noise does not decide."""
_STD = 1e-4, 1.01
"""Deviations of colors in 0..1, from a fortieth of a step of 8 bits to none by rounded numbers."""


class PretrainedModel:
    """A pretrained vision model, frozen: of `lexsplat.features.towers`, or of transformers.

    Args:
        folder: Local model folder.
        name: Its name in messages and records.
        device: Device of the model.

    Raises:
        ModelError: If neither can load the folder, a weight is missing, or ``config.json`` has sizes of no model.
    """

    tower: ClassVar[str]
    """Role of the model: "clip", "dino" or "segments"."""
    _spare: ClassVar[str] = r"(position_ids|logit_scale|logit_bias)$"
    """Pattern of tensors that are not used, so that they may be missing."""

    def __init__(self, folder: Path, name: str, device: torch.device | str = "cpu") -> None:
        self.name, self.device = name, torch.device(device)
        check_sizes(folder)
        self.content_hash = content_hash(folder, self.tower)
        model = self._own_model(folder)
        if model is None:
            with _quiet_transformers():
                model = build_model(folder, name, self._spare)
        self._model = model.eval().requires_grad_(False).to(self.device)
        self._full_precision = False

    def _own_model(self, folder: Path) -> Any:
        """The model without transformers; None if `lexsplat.features.towers` does not have it."""
        return None

    def _refusal(self, expected: str, remedy: str, found: str = "") -> ModelError:
        """The error for a model of another architecture, or with other outputs."""
        found = found or f"a {self._model.config.model_type!r} model"
        return ModelError(f"model {self.name}", expected=expected, found=found, remedy=remedy)

    def _finite(self, compute: Callable[[], Tensor], *, crops: bool = False) -> Tensor:
        """Features in half precision where that is faster, or in full precision from the first overflow on."""
        if not self._full_precision:
            with precision(self.device, crops=crops):
                features = compute()
            if bool(features.isfinite().all()):
                return features
            self._full_precision = True
        features = compute()
        if not bool(features.isfinite().all()):
            raise self._refusal("finite features", "choose another model", "NaN or infinity")
        return features


@contextlib.contextmanager
def _quiet_transformers() -> Iterator[None]:
    """Without the reports and progress bars of transformers."""
    from transformers.utils import logging as transformers_logging

    verbosity = transformers_logging.get_verbosity()
    bars = transformers_logging.is_progress_bar_enabled()
    transformers_logging.set_verbosity_error()
    transformers_logging.disable_progress_bar()
    try:
        yield
    finally:
        transformers_logging.set_verbosity(verbosity)
        if bars:
            transformers_logging.enable_progress_bar()


def precision(device: torch.device, *, crops: bool = False) -> AbstractContextManager:
    """Half precision where it is faster; angles between embeddings change by less than 1e-2.

    Float16 on CUDA. Bfloat16 on processors where it is faster (`bfloat16_is_faster`), for many small crops only:
    dense images gain nothing. Texts are always encoded in float32.
    """
    if device.type == "cuda":
        return torch.autocast("cuda", dtype=torch.float16)
    if device.type != "cpu":
        return nullcontext()
    return torch.autocast("cpu", dtype=torch.bfloat16) if crops and bfloat16_is_faster() else nullcontext()


@functools.cache
def bfloat16_is_faster() -> bool:
    """Whether a projection of ViT-B/16 is faster in bfloat16 on this processor; measured once a process, in 0.05 s.

    Instructions for bfloat16 are needed, because emulation is slow, but they are not enough: ViT-B/16 takes 0.3 of
    the time on an AMD EPYC with AVX-512 BF16, and 1.7 of it on an Intel Xeon with the same instructions.
    """
    if not _has_bfloat16():
        return False
    tokens, layer = torch.ones(2 * 197, 768), torch.nn.Linear(768, 768).requires_grad_(False)
    fastest = {False: math.inf, True: math.inf}
    with one_thread():  # several would wait for each other while other programs run
        for half in (False, True) * 3:
            start = time.thread_time()
            with torch.autocast("cpu", dtype=torch.bfloat16, enabled=half):
                layer(tokens)
            fastest[half] = min(fastest[half], time.thread_time() - start)
    return bool(fastest[True] < _CLEARLY * fastest[False])


def _has_bfloat16() -> bool:
    names = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(getattr(torch.cpu, name, bool)() for name in names)


def normalization(folder: Path, default: tuple, device: torch.device) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation ``[3, 1, 1]`` from the model's preprocessing file, or ``default``.

    They are those of images in 0..1, whatever the file scales colors by.

    Raises:
        ModelError: If one of the two is not three finite numbers, a deviation is not positive, or they are not of
            images in the range that the file says.
    """
    settings, keys = preprocessing(folder), ("image_mean", "image_std")
    if not all(key in settings for key in keys):
        log.warning(
            "%s: no image mean in a preprocessing file; the default of the model's family is used",
            folder.name,
        )
    given = {key: settings.get(key, list(known)) for key, known in zip(keys, default)}
    mean, std = (_three_numbers(given[key]) for key in keys)
    if mean is None or std is None or bool((std <= 0).any()):
        key = keys[mean is not None]
        raise ModelError(
            f"{preprocessing_file(folder)}: {key}",
            expected="three finite numbers" + (" above 0" if key == "image_std" else ""),
            found=excerpt(given[key]),
            remedy="fetch the model again",
        )
    scale = _scale(settings)
    mean, std = (each.reshape(3, 1, 1).to(device) / scale for each in (mean, std))
    if settings.get("do_normalize") is False:
        mean, std = torch.zeros_like(mean), torch.ones_like(std) / scale
        return mean, std
    usual = bool(((mean >= 0) & (mean <= 1)).all())
    if not usual or bool(((std < _STD[0]) | (std > _STD[1])).any()):
        key, what, least = keys[usual], ("means", "deviations")[usual], (0.0, _STD[0])[usual]
        large = bool((mean > 1).any()) or bool((std > _STD[1]).any())
        unscaled = ', or say "do_rescale": false if the images are not scaled' if large else ""
        raise ModelError(
            f"{preprocessing_file(folder)}: {key}",
            expected=f"{what} within the colors {least * scale:g} to {scale:g} of its images",
            found=excerpt(given[key]),
            remedy=f"fetch the model again{unscaled}",
        )
    return mean, std


def _scale(settings: Mapping[str, Any]) -> float:
    """The largest value of a color where a model's preprocessing subtracts the mean."""
    if settings.get("do_rescale") is False:
        return 255.0
    factor: Any = settings.get("rescale_factor")
    usable = isinstance(factor, (int, float)) and not isinstance(factor, bool) and 1e-6 < factor < 1e6
    return 255.0 * factor if usable else 1.0


def _three_numbers(value: Any) -> Tensor | None:
    """A JSON list of three numbers that are finite in float32; None for anything else."""
    if not isinstance(value, list) or len(value) != 3 or not all(type(v) in (int, float) for v in value):
        return None
    try:
        numbers = torch.tensor([float(v) for v in value], dtype=torch.float32)
    except OverflowError:  # a whole number of hundreds of digits
        return None
    return numbers if bool(numbers.isfinite().all()) else None


def check_images(images: Tensor) -> None:
    """Raises ValueError if images are not ``[B, 3, h, w]``."""
    if images.ndim != 4 or images.shape[1] != 3:
        raise ValueError(f"images must be [B, 3, h, w], got {list(images.shape)}")


def resize_images(images: Tensor, height: int, width: int) -> Tensor:
    """Antialiased bicubic resize of ``[B, 3, h, w]`` in 0..1; overshoot of the filter is clamped."""
    if images.shape[-2:] == (height, width):
        return images
    if images.device.type == "mps":  # not every torch has this filter there
        return resize_images(images.cpu(), height, width).to(images.device)
    return F.interpolate(images, (height, width), mode="bicubic", antialias=True, align_corners=False).clamp(
        0, 1
    )
