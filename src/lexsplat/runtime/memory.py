"""Memory needs of the stages in bytes, one function per stage, and the checks against ``--memory``.

A stage adapts to its budget with settings that do not affect the result: threads, block sizes, caches. If not even
the minimum fits, the stage fails with a one-line error before it starts. The memory of the libraries and the encoders
is not included in these numbers.
"""

from __future__ import annotations

import ctypes
import math
import re
from contextlib import suppress

from lexsplat.runtime.errors import MemoryBudgetError

DEFAULT_MEMORY = 4 << 30
"""Default budget of a stage in bytes."""

PHOTO_BYTES = 10
"""Bytes per pixel to read a large photo: four for decoded pixels, the rest for its mask or a rotated copy."""

SMALL_PHOTO_BYTES = 32
"""Bytes per pixel of a photo processed at once: decoded pixels, floats, lens map and result."""

MADE_BYTES = 24
"""Bytes per pixel of an image made from a photo: the floats and a temporary copy."""

BAND_BYTES = 24 << 20
"""Bytes of one band of a large photo, the unit of conversion to floats (`lexsplat.captures.images.bands`)."""

FRAMES_HELD = 17
"""Maximum number of reference frames of a video decoder, in addition to one per thread."""

SIFT_BYTES = 350
"""Bytes per pixel of SIFT extraction: 17 float levels of a scale space of twice the image size."""

FEATURE_BYTES = 700
"""Bytes per feature in matching: the descriptor as 128 bytes and as floats, its index and its position."""

THREAD_BYTES = 16 << 20
"""Bytes of stack and scratch memory per thread."""

CACHED_BLOCKS = 5
"""Maximum number of blocks of photos whose features pycolmap caches in exhaustive matching."""

SEQUENTIAL_BLOCKS = 5
"""The same for sequential matching, in multiples of the overlap."""

GAUSSIAN_BYTES = 1_700
"""Bytes per Gaussian in training: parameters, gradient, two optimizer moments and the last valid state."""


def kept_bytes(memory: int) -> int:
    """Bytes of a budget that results kept from step to step may take: a quarter, and at most 1 GiB."""
    return min(1 << 30, memory // 4)


def photo_bytes(photo: tuple[int, int], made: tuple[int, int] = (0, 0)) -> int:
    """Memory to read, rotate, undistort, mask and resize one photo.

    Args:
        photo: Width and height of the photo.
        made: Width and height of the resulting image.
    """
    pixels, result = photo[0] * photo[1], made[0] * made[1] * MADE_BYTES
    return min(pixels * SMALL_PHOTO_BYTES, pixels * PHOTO_BYTES + BAND_BYTES) + result


def video_bytes(frame: tuple[int, int], threads: int) -> int:
    """Memory to read a video: the decoder's frames of up to 10 bits, and one frame as an image."""
    return frame[0] * frame[1] * (3 * (FRAMES_HELD + threads) + 14) + threads * THREAD_BYTES


def extraction_bytes(
    photo: tuple[int, int], max_side: int, max_features: int, threads: int, *, masked: bool = False
) -> int:
    """Memory of SIFT extraction from several photos at once.

    Args:
        photo: Width and height of the largest photo.
        max_side: Longest side to which photos are reduced first.
        max_features: Maximum number of features per photo.
        threads: Number of photos processed at once.
        masked: Whether each photo has a mask.
    """
    pixels = photo[0] * photo[1]
    reduced = pixels * min(1.0, max_side / max(photo)) ** 2
    # Photos in decoding, in the queue and in reduction.
    waiting = (threads + 2) * pixels * (5 if masked else 4)
    return int(waiting + threads * (reduced * SIFT_BYTES + max_features * 2 * FEATURE_BYTES + THREAD_BYTES))


def matching_bytes(features: int, photos: int, threads: int) -> int:
    """Memory to match photos of up to ``features`` features each, with ``photos`` of them in the cache."""
    return photos * features * FEATURE_BYTES + threads * (2 * THREAD_BYTES + features * 2 * FEATURE_BYTES)


def mapping_bytes(features: int, matches: int) -> int:
    """Memory of incremental mapping: correspondence graph, model and bundle adjustment; arguments are totals."""
    observations = min(features, 2 * matches)
    return features * 120 + matches * 48 + observations * 900


def sample_bytes(rows: int, dimensions: int, codes: int, batch: int) -> int:
    """Memory to fit ``codes`` codes to a sample of features: the sample, its joint vectors, blocks and a batch."""
    return 4 * (rows * (2 * dimensions + 8) + 4 * batch * (dimensions + codes) + 6 * codes * dimensions)


# Eight parameters: the subject of the error, the four numbers of `sample_bytes`, and the budget with its share.
def require_sample(
    stage: str, what: str, rows: int, dimensions: int, codes: int, batch: int, memory: int, share: float
) -> None:
    """Check that a sample fits into its share of the memory; the error states a size and a budget that fit.

    Args:
        stage: Name of the stage in the error.
        what: Description of the sample, such as "a sample of 50,000 features".
        rows: Number of features in the sample.
        dimensions: Dimensions of a feature.
        codes: Number of codes.
        batch: Features per gradient step.
        memory: Budget in bytes.
        share: Share of the budget for the sample and the fit, in 0..1.

    Raises:
        MemoryBudgetError: If sample and fit exceed their share.
    """
    need = sample_bytes(rows, dimensions, codes, batch)
    least = sample_bytes(0, dimensions, codes, batch)
    fewer = max(1, (int(share * memory) - least) // sample_bytes(1, dimensions, 0, 0))
    require(stage, math.ceil(need / share), memory, what, f"codebook.sample-size {fewer}")


def most_within(memory: int, need_of: dict[int, int]) -> int:
    """The largest option whose need in bytes fits into the budget, or the option of smallest need if none fits."""
    fitting = [choice for choice, need in need_of.items() if need <= memory]
    return max(fitting) if fitting else min(need_of)


def require(stage: str, need: int, memory: int, what: str, remedy: str) -> None:
    """Check that a stage fits into the budget.

    Args:
        stage: Name of the stage in the error.
        need: Minimum need in bytes.
        memory: Budget in bytes.
        what: Data that needs the memory, such as "photos of 8000x6000 pixels".
        remedy: Alternative to more memory.

    Raises:
        MemoryBudgetError: If ``need`` is more than ``memory``.
    """
    if need > memory:
        raise MemoryBudgetError(
            stage,
            expected=f"at least {size_text(need, up=True)} of memory for {what}",
            found=f"--memory {size_text(memory)}",
            remedy=f"use --memory {size_text(need, up=True)}, or {remedy}",
        )


def check_photo(photo: tuple[int, int], memory: int, made: tuple[int, int] = (0, 0)) -> None:
    """Check that a photo can be read and resized within the budget.

    Raises:
        MemoryBudgetError: If it needs more; the error states how much.
    """
    what = f"a photo of {photo[0]}x{photo[1]} pixels"
    require("photos", photo_bytes(photo, made), memory, what, "scale the photos down first")


def size_text(count: int, *, up: bool = False) -> str:
    """A size in the form that ``--memory`` accepts: whole megabytes of 2^20 bytes, rounded down, or up if ``up``."""
    megabyte = 1 << 20
    if up:
        return f"{-(-count // megabyte)}MB"
    return f"{count // megabyte}MB" if count >= megabyte else f"{count}B"


def parse_bytes(text: str) -> int:
    """Parse a size such as "4GB", "512 MiB" or "1000000000" into bytes; units are powers of 1024.

    Raises:
        ValueError: If the text is not a positive size.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?\s*", text, flags=re.IGNORECASE)
    if match is None or float(match[1]) == 0:
        raise ValueError(f"memory must be a size like 4GB or 512MB, got {text!r}")
    return int(float(match[1]) * 1024 ** " KMGT".index(match[2].upper() or " "))


def give_back_freed() -> None:
    """Return freed memory to the system, which glibc otherwise keeps; nothing on macOS, Windows and musl."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
