"""Values of other programs' files: bounds on counts, bytes as opacities, and numbers that cannot be rendered.

Formats allow more than rendering does: opacities of 0 and 1 have infinite logits, sizes of 0 infinite logarithms,
rotations of 0 no direction. Those are moved to the nearest number that renders alike, sizes and rotations with a
warning. Gaussians with NaN, and those too far or too large for cameras, are dropped, with a warning.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import struct
import zlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.captures.readers.camera_files import MAX_COORDINATE
from lexsplat.geometry.gaussians import LARGEST, Gaussians
from lexsplat.runtime.errors import FileFormatError

logger = logging.getLogger("lexsplat")

MOST_DROPPED = 0.1
"""Share of invalid Gaussians above which a file counts as damaged."""

AROUND = 5
"""Cameras around a scene are at most this many times as far from its middle as the farthest Gaussian."""

AGAIN, EXPORT_AGAIN = "copy the file again or export it again", "export the file again"
"""The remedies for damage, and for content that copying cannot have changed."""

_CAUSED: tuple[type[Exception], ...] = (
    ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, OSError,
    struct.error, zlib.error,
)  # fmt: skip
"""Errors that damaged content causes."""
_logged: ContextVar[set[str] | None] = ContextVar("logged", default=None)
_LARGEST_LOGIT = 20.0
_COARSE = 0.1
"""Largest error of centers without a warning, as a share of the usual standard deviation."""
_SMALLEST_LOG_SCALE = math.log(1e-12)
_SMALLEST_QUAT = 1e-18  # squares of smaller ones are 0 in float32
_SMALLER = np.array([(1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)])
"""The three other components of a quaternion."""
_ALWAYS_ALLOWED = 10_000
_MOST_PER_BYTE = 8


def damaged(path: Path, expected: str, found: str, remedy: str = AGAIN) -> FileFormatError:
    """The error of a file with other content than expected."""
    return FileFormatError(path, expected=expected, found=found, remedy=remedy)


class Damage(ValueError):
    """The content of a file is damaged; the message is for its user."""


def reason(error: Exception) -> str:
    """An error from reading damaged content, in words for the user; Python's own texts are left out."""
    text = ""
    if isinstance(error, Damage):
        text = str(error)
    elif isinstance(error, json.JSONDecodeError):
        text = "no valid JSON"
    elif isinstance(error, FileNotFoundError) and error.filename:
        text = f"no file {Path(error.filename).name}"
    elif isinstance(error, OSError) and error.strerror:
        text = error.strerror
    elif isinstance(error, KeyError) and error.args:
        text = f"no {error.args[0]!r:.80}"
    return " ".join(f"damaged content{': ' if text else ''}{text}".split())[:240]


@contextlib.contextmanager
def parsing(path: Path, expected: str, *further: type[Exception]) -> Iterator[None]:
    """Errors that damaged content causes in this block, and ``further`` ones, as errors of the file."""
    caused = _CAUSED + further
    try:
        yield
    except caused as error:
        raise damaged(path, expected, reason(error)) from error


@contextlib.contextmanager
def warnings_once() -> Iterator[None]:
    """Give each warning once in this block, even if a file is read twice."""
    token = _logged.set(set())
    try:
        yield
    finally:
        _logged.reset(token)


def warn(message: str, path: Path, *values: object) -> None:
    """Log a warning of a file; see `warnings_once`."""
    text, logged = message % (path, *values), _logged.get()
    if logged is None or text not in logged:
        logger.warning("%s", text)
    if logged is not None:
        logged.add(text)


def renderable(gaussians: Gaussians, path: Path) -> Gaussians:
    """The Gaussians with infinite logits and logarithms made finite, and without those that cannot be rendered.

    Raises:
        FileFormatError: If there are none, more than `MOST_DROPPED` of them cannot be rendered, or more than half are
            points or lines of size 0.
    """
    if len(gaussians) == 0:
        raise FileFormatError(
            path, expected="at least one Gaussian", found="none", remedy="export a scene that is not empty"
        )
    _check_sizes(gaussians, path)
    gaussians = replace(
        gaussians,
        quats=_turned(gaussians.quats, path),
        log_scales=gaussians.log_scales.clamp_min(_SMALLEST_LOG_SCALE),  # NaN stays NaN
        opacity_logits=gaussians.opacity_logits.clamp(-_LARGEST_LOGIT, _LARGEST_LOGIT),
    )
    gaussians = _near(gaussians, path)
    damage = gaussians.find_invalid()
    if not damage:
        return gaussians
    valid = _valid(gaussians)
    count = int((~valid).sum())
    if count > MOST_DROPPED * len(gaussians):
        found = f"{count:,} of {len(gaussians):,} Gaussians that cannot be rendered: {damage}"
        raise damaged(path, "finite numbers", found, EXPORT_AGAIN)
    warn("%s: %d of %d Gaussians dropped: %s", path, count, len(gaussians), damage)
    return gaussians.select(valid)


def _turned(quats: Tensor, path: Path) -> Tensor:
    """Quaternions ``[N, 4]`` in which those of four zeros are no rotation, with a warning."""
    empty = (quats.abs() < _SMALLEST_QUAT).all(1)
    if count := int(empty.sum()):
        warn(
            "%s: %d of %d Gaussians have a rotation of four zeros, read as no rotation",
            path,
            count,
            len(quats),
        )
    return torch.where(empty[:, None], quats.new_tensor([1.0, 0, 0, 0]), quats)


def _near(gaussians: Gaussians, path: Path) -> Gaussians:
    """Drop Gaussians so distant or large that a camera around them would exceed `MAX_COORDINATE`.

    Map coordinates, millions of meters from their origin, are kept.

    Raises:
        FileFormatError: If they are more than `MOST_DROPPED` of them.
    """
    means, sizes = gaussians.means.double(), gaussians.log_scales.double().exp().amax(1)
    middle = means.nanmedian(0).values
    reach = middle.abs().max() + AROUND * torch.maximum((means - middle).abs().amax(1), sizes)
    far = (reach > MAX_COORDINATE) & torch.isfinite(reach)
    count = int(far.sum())
    if not count:
        return gaussians
    limit = f"centers and sizes that cameras within {MAX_COORDINATE:,.0f} units of the origin can look at"
    if count > MOST_DROPPED * len(gaussians):
        median = float(torch.maximum(means.abs().amax(1), sizes)[far].median())
        factor = np.format_float_positional(10.0 ** -math.floor(math.log10(median)))
        raise FileFormatError(
            path,
            expected=limit,
            found=f"{count:,} of {len(gaussians):,} Gaussians farther out, half of them {median:.2g} units or more",
            remedy=f"scale or move the splats, as does: splat-transform {path.name} --scale {factor} scaled.ply",
        )
    warn("%s: %d of %d Gaussians dropped: expected %s", path, count, len(gaussians), limit)
    return gaussians.select(~far)


def _check_sizes(gaussians: Gaussians, path: Path) -> None:
    """Warn of sizes of 0: a flat Gaussian has one, a line two, a point three.

    Raises:
        FileFormatError: If more than half of the Gaussians are points or lines, which show nothing.
    """
    zeros = (gaussians.log_scales < _SMALLEST_LOG_SCALE - 0.01).sum(1)  # 1e-12 itself may be rounded
    count, thin = int((zeros > 0).sum()), int((zeros > 1).sum())
    if thin > len(gaussians) / 2:
        raise damaged(
            path,
            "Gaussians with sizes",
            f"{thin:,} of {len(gaussians):,} Gaussians with two or three sizes of 0",
            EXPORT_AGAIN,
        )
    if count:
        warn("%s: %d of %d Gaussians have a size of 0, read as 1e-12", path, count, len(gaussians))


def _valid(gaussians: Gaussians) -> Tensor:
    """Which Gaussians `Gaussians.find_invalid` accepts ``[N]``."""
    valid = torch.ones(len(gaussians), dtype=torch.bool)
    for name, tensor in gaussians.tensors().items():
        rows = tensor.flatten(1) if tensor.ndim > 1 else tensor[:, None]
        limit = math.log(LARGEST) if name == "log_scales" else LARGEST
        size = rows if name == "log_scales" else rows.abs()
        valid &= (torch.isfinite(rows) & (size <= limit)).all(1)
    return valid


def check_count(path: Path, count: int, size: int) -> None:
    """Refuse counts that a compressed file of ``size`` bytes cannot hold, before memory is taken for them.

    Raises:
        FileFormatError: If there are more than 8 Gaussians for each byte; few Gaussians are always allowed.
    """
    if count > max(_ALWAYS_ALLOWED, _MOST_PER_BYTE * size):
        raise damaged(path, f"Gaussians that fit into {size:,} bytes", f"a count of {count:,}")


def logits_of_bytes(opacities: NDArray[np.uint8]) -> Tensor:
    """Opacity logits of opacities in steps of 1/255.

    Bytes 0 and 255 are read as 0.25 and 254.75, because the logits of opacities 0 and 1 are infinite.
    """
    values = torch.from_numpy(opacities.astype(np.float32)) / 255
    return values.clamp(0.25 / 255, 1 - 0.25 / 255).logit()


def without_the_largest(quats: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """The three smaller components of unit quaternions ``[N, 3]``, and which one is left out ``[N]`` as positive."""
    largest = np.abs(quats).argmax(1)
    signs = np.where(quats[np.arange(len(quats)), largest] < 0, -1, 1)[:, None]
    return np.take_along_axis(quats * signs, _SMALLER[largest], 1), largest


def with_the_largest(small: NDArray[np.float64], largest: NDArray[np.integer]) -> NDArray[np.float64]:
    """The inverse of `without_the_largest` ``[N, 4]``; zeros where ``largest`` is none of 0 to 3."""
    quats = np.zeros((len(small), 4))
    for left_out, kept in enumerate(_SMALLER):
        rows = largest == left_out
        quats[np.ix_(rows, kept)] = small[rows]
        quats[rows, left_out] = np.sqrt(np.maximum(0, 1 - (small[rows] ** 2).sum(1)))
    return quats


def as_tensor(values: NDArray) -> Tensor:
    """A float32 tensor of its own memory; what is too large for it is infinity, which is looked for later."""
    with np.errstate(over="ignore"):
        array = np.array(values, dtype=np.float32)
    return torch.from_numpy(array)


@contextlib.contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Errors of the system in this block as errors of the file.

    Raises:
        FileFormatError: If it cannot be read.
    """
    try:
        yield
    except OSError as error:
        remedy = "check the path and its permissions"
        raise damaged(path, f"a readable {kind} file", str(error.strerror), remedy) from error


def read_content(path: Path, kind: str) -> bytes:
    """The bytes of a file; raises as `reading`."""
    with reading(path, kind):
        return path.read_bytes()


def rounded_centers(places: NDArray[np.float64], log_scales: Tensor, path: Path) -> Tensor:
    """Centers ``[N, 3]`` in float32, with a warning if that moves one by more than `_COARSE` of the usual size.

    Coordinates of a map have a step of half a unit at 5,600,000: the Gaussians of a thing come to lie in layers.
    """
    means = as_tensor(places)
    finite = torch.isfinite(means).all(1)
    size = float(log_scales[finite].nanmedian(1).values.nanmedian().exp()) if finite.any() else math.inf
    error = float(np.abs(means[finite].double().numpy() - places[finite.numpy()]).max(initial=0))
    if error > _COARSE * size:
        middle = ", ".join(f"{v:,.0f}" for v in np.round(np.median(places[finite.numpy()], axis=0), -2) + 0.0)
        warn(
            "%s: centers are rounded by up to %.2g units (float32), which is coarse for Gaussians of size %.2g; "
            "subtract %s from x, y, z before exporting, and from the cameras",
            path, error, size, middle,
        )  # fmt: skip
    return means
