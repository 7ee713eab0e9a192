"""Memory needs of the stages in bytes, one function per stage, and the checks against ``--memory``.

A stage adapts to its budget with settings that do not affect the result: threads, block sizes, caches. If not even
the minimum fits, the stage fails with a one-line error before it starts. The memory of the libraries and the encoders
is not included in these numbers.
"""

from __future__ import annotations

import math
import re

from lexsplat.runtime.errors import MemoryBudgetError

DEFAULT_MEMORY = 4 << 30
"""Default budget of a stage in bytes."""

PHOTO_BYTES = 10
"""Bytes per pixel of a large photo being read: four decoded, the rest for its mask or a rotated copy."""

SMALL_PHOTO_BYTES = 32
"""Bytes per pixel of a photo processed as a whole: decoded, as floats, the lens map, and the result."""

MADE_BYTES = 24
"""Bytes per pixel of an image made from a photo: as floats, and a copy while it is passed on."""

BAND_BYTES = 24 << 20
"""Bytes of the band of a large photo that is processed as floats (`lexsplat.captures.images.bands`)."""

FRAMES_HELD = 17
"""Upper limit of the reference frames of a video decoder, in addition to one per thread."""

SIFT_BYTES = 350
"""Bytes per pixel of SIFT extraction: 17 float levels of a scale space of twice the image size."""

FEATURE_BYTES = 700
"""Bytes per feature to match: the descriptor as 128 bytes and as floats, its index and its position."""

THREAD_BYTES = 16 << 20
"""Bytes of stack and scratch memory per thread."""

CACHED_BLOCKS = 5
"""Upper limit of the blocks of photos whose features pycolmap caches in exhaustive matching."""

SEQUENTIAL_BLOCKS = 5
"""The same for sequential matching, in multiples of the overlap."""

GAUSSIAN_BYTES = 1_700
"""Bytes per Gaussian in training: parameters, gradient, two moments of the optimizer and the last good state."""


def photo_bytes(photo: tuple[int, int], made: tuple[int, int] = (0, 0)) -> int:
    """Reading, rotating, undistorting, masking and resizing one photo.

    Args:
        photo: Width and height of the photo.
        made: Width and height of the resulting image.
    """
    pixels, result = photo[0] * photo[1], made[0] * made[1] * MADE_BYTES
    return min(pixels * SMALL_PHOTO_BYTES, pixels * PHOTO_BYTES + BAND_BYTES) + result


def video_bytes(frame: tuple[int, int], threads: int) -> int:
    """Reading a video: the decoder's frames of up to 10 bits, and one frame as an image."""
    return frame[0] * frame[1] * (3 * (FRAMES_HELD + threads) + 14) + threads * THREAD_BYTES


def extraction_bytes(
    photo: tuple[int, int], max_side: int, max_features: int, threads: int, *, masked: bool = False
) -> int:
    """SIFT extraction in several photos at once.

    Args:
        photo: Width and height of the largest photo.
        max_side: Longest side to which photos are reduced first.
        max_features: Maximum number of features per photo.
        threads: Number of photos at once.
        masked: Whether each photo has a mask.
    """
    pixels = photo[0] * photo[1]
    sought = pixels * min(1.0, max_side / max(photo)) ** 2
    waiting = (threads + 2) * pixels * (5 if masked else 4)  # being read, in the queue, being reduced
    return int(waiting + threads * (sought * SIFT_BYTES + max_features * 2 * FEATURE_BYTES + THREAD_BYTES))


def matching_bytes(features: int, photos: int, threads: int) -> int:
    """Matching photos of up to ``features`` features each, ``photos`` of which are cached at a time."""
    return photos * features * FEATURE_BYTES + threads * (2 * THREAD_BYTES + features * 2 * FEATURE_BYTES)


def mapping_bytes(features: int, matches: int) -> int:
    """Incremental mapping with the given total numbers of features and verified matches: graph, model, adjustment."""
    observations = min(features, 2 * matches)
    return features * 120 + matches * 48 + observations * 900


def sample_bytes(rows: int, dimensions: int, codes: int, batch: int) -> int:
    """Fitting ``codes`` codes to a sample of features: the sample, its joint vectors, blocks, and a batch."""
    return 4 * (rows * (2 * dimensions + 8) + 4 * batch * (dimensions + codes) + 6 * codes * dimensions)


# Eight parameters: the subject of the error, the four numbers of `sample_bytes`, and the budget with its share.
def require_sample(
    stage: str, what: str, rows: int, dimensions: int, codes: int, batch: int, memory: int, share: float
) -> None:
    """Refuse a sample that does not fit into its share of the memory; the error names a size and a budget that fit.

    Args:
        stage: Name of the stage in the error.
        what: The sample, such as "a sample of 50,000 features".
        rows: Number of features in the sample.
        dimensions: Dimensions of a feature.
        codes: Number of codes.
        batch: Features per gradient step.
        memory: Budget in bytes.
        share: Share of the budget for the sample and the fit, in 0..1.

    Raises:
        MemoryBudgetError: If they need more.
    """
    need = sample_bytes(rows, dimensions, codes, batch)
    least = sample_bytes(0, dimensions, codes, batch)
    fewer = max(1, (int(share * memory) - least) // sample_bytes(1, dimensions, 0, 0))
    require(stage, math.ceil(need / share), memory, what, f"codebook.sample-size {fewer}")


def gaussian_bytes(count: int) -> int:
    """Training ``count`` Gaussians on the host."""
    return count * GAUSSIAN_BYTES


def most_within(memory: int, need_of: dict[int, int]) -> int:
    """The largest choice that fits into the memory, or the smallest choice if none fits.

    Args:
        memory: Budget in bytes.
        need_of: Need in bytes by choice.
    """
    fitting = [choice for choice, need in need_of.items() if need <= memory]
    return max(fitting) if fitting else min(need_of)


def require(stage: str, need: int, memory: int, what: str, remedy: str) -> None:
    """Refuse a stage that does not fit into the budget.

    Args:
        stage: Name of the stage in the error.
        need: Minimum need in bytes.
        memory: Budget in bytes.
        what: What needs the memory, such as "photos of 8000x6000 pixels".
        remedy: Alternative to more memory.

    Raises:
        MemoryBudgetError: If ``need`` is more than ``memory``.
    """
    if need > memory:
        raise MemoryBudgetError(
            stage,
            expected=f"at least {size_text(need, up=True)} of memory for {what}",
            found=f"--memory {size_text(memory)}",
            remedy=f"give --memory {size_text(need, up=True)}, or {remedy}",
        )


def check_photo(photo: tuple[int, int], memory: int, made: tuple[int, int] = (0, 0)) -> None:
    """Refuse a photo that cannot be read and resized within the budget.

    Raises:
        MemoryBudgetError: With the memory that it needs.
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
    """Number of bytes in "4GB", "512 MiB" or "1000000000" (units are powers of 1024).

    Raises:
        ValueError: If the text is not a size.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?\s*", text, flags=re.IGNORECASE)
    if match is None or float(match[1]) == 0:
        raise ValueError(f"memory must be a size like 4GB or 512MB, got {text!r}")
    return int(float(match[1]) * 1024 ** " KMGT".index(match[2].upper() or " "))
