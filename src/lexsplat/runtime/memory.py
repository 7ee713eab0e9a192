"""What each stage needs of the memory that ``--memory`` grants: a function a stage, in bytes.

A stage fits itself in by what decides nothing about its result (threads, blocks, what is kept between steps); where
the least of that is too much, it is refused in one line before it starts. What the libraries and the encoders take
by existing comes beside these numbers.
"""

from __future__ import annotations

import math
import re

from lexsplat.runtime.errors import MemoryBudgetError

DEFAULT_MEMORY = 4 << 30
"""Bytes that stages may take where nobody says otherwise."""

PHOTO_BYTES = 10
"""A large photo on its way, a pixel: four bytes as it is decoded, and its mask or a turned copy."""

SMALL_PHOTO_BYTES = 32
"""A photo that is worked on at once, a pixel: decoded, as floats, the map of its lens, and the result."""

MADE_BYTES = 24
"""A picture that is made of a photo, a pixel: as floats, and once more while it is handed on."""

BAND_BYTES = 24 << 20
"""The band of a large photo that is in work as floats (`lexsplat.captures.images.bands`)."""

FRAMES_HELD = 17
"""Frames that a decoder of videos refers to at most, beside one a thread."""

SIFT_BYTES = 350
"""Bytes a pixel of a photo in which features are sought: 17 levels of a scale space of twice the size, in floats."""

FEATURE_BYTES = 700
"""A feature that waits to be matched: 128 bytes, the same as floats, their index, and its place."""

THREAD_BYTES = 16 << 20
"""Stack and scratch of a thread."""

CACHED_BLOCKS = 5
"""pycolmap keeps the features of so many blocks of photos at most while it compares all pairs."""

SEQUENTIAL_BLOCKS = 5
"""And so many times the overlap while it compares each photo with the next ones."""

GAUSSIAN_BYTES = 1_700
"""A Gaussian in training, with gradient, two moments of the optimizer and the last good state."""


def photo_bytes(photo: tuple[int, int], made: tuple[int, int] = (0, 0)) -> int:
    """One photo read, turned, undistorted, masked, and made into a picture of another size.

    Args:
        photo: Width and height of the photo.
        made: Of the picture.
    """
    pixels, result = photo[0] * photo[1], made[0] * made[1] * MADE_BYTES
    return min(pixels * SMALL_PHOTO_BYTES, pixels * PHOTO_BYTES + BAND_BYTES) + result


def video_bytes(frame: tuple[int, int], threads: int) -> int:
    """Reading a video: frames that the decoder holds, of up to 10 bits, and one as a picture."""
    return frame[0] * frame[1] * (3 * (FRAMES_HELD + threads) + 14) + threads * THREAD_BYTES


def extraction_bytes(
    photo: tuple[int, int], max_side: int, max_features: int, threads: int, *, masked: bool = False
) -> int:
    """Seeking features in photos of a size, so many at once.

    Args:
        photo: Width and height of the largest photo.
        max_side: Longest side to which photos are reduced first.
        max_features: Features a photo.
        threads: How many photos at once.
        masked: Whether a mask of each photo is held too.
    """
    pixels = photo[0] * photo[1]
    sought = pixels * min(1.0, max_side / max(photo)) ** 2
    waiting = (threads + 2) * pixels * (5 if masked else 4)  # being read, in the queue, being reduced
    return int(waiting + threads * (sought * SIFT_BYTES + max_features * 2 * FEATURE_BYTES + THREAD_BYTES))


def matching_bytes(features: int, photos: int, threads: int) -> int:
    """Comparing photos of up to ``features`` features, ``photos`` of which are held at a time."""
    return photos * features * FEATURE_BYTES + threads * (2 * THREAD_BYTES + features * 2 * FEATURE_BYTES)


def mapping_bytes(features: int, matches: int) -> int:
    """Placing photos that have so many features and verified matches in all: the graph, the model, its adjustment."""
    observations = min(features, 2 * matches)
    return features * 120 + matches * 48 + observations * 900


def sample_bytes(rows: int, dimensions: int, codes: int, batch: int) -> int:
    """Fitting ``codes`` codes to a sample of features: the sample, itself again as joint vectors, blocks, a batch."""
    return 4 * (rows * (2 * dimensions + 8) + 4 * batch * (dimensions + codes) + 6 * codes * dimensions)


def require_sample(
    stage: str, what: str, rows: int, dimensions: int, codes: int, batch: int, memory: int, share: float
) -> None:
    """Refuse a sample that does not fit into its share of the memory, with a sample and a budget that would.

    Args:
        stage: Its name, for people.
        what: The sample, such as "a sample of 50,000 features".
        rows: Features in it.
        dimensions: Of a feature.
        codes: How many are fitted.
        batch: Features a gradient step.
        memory: Bytes there are.
        share: Of them that the sample and the fit may take.

    Raises:
        MemoryBudgetError: If they need more.
    """
    need = sample_bytes(rows, dimensions, codes, batch)
    least = sample_bytes(0, dimensions, codes, batch)
    fewer = max(1, (int(share * memory) - least) // sample_bytes(1, dimensions, 0, 0))
    require(stage, math.ceil(need / share), memory, what, f"codebook.sample-size {fewer}")


def gaussian_bytes(count: int) -> int:
    """Training so many Gaussians on the host."""
    return count * GAUSSIAN_BYTES


def most_within(memory: int, need_of: dict[int, int]) -> int:
    """The largest choice whose need fits, or the smallest of all where none does.

    Args:
        memory: Bytes there are.
        need_of: Bytes by choice.
    """
    fitting = [choice for choice, need in need_of.items() if need <= memory]
    return max(fitting) if fitting else min(need_of)


def require(stage: str, need: int, memory: int, what: str, remedy: str) -> None:
    """Refuse a stage that cannot be done within the budget.

    Args:
        stage: Its name, for people.
        need: Bytes of the least it can do with.
        memory: Bytes there are.
        what: What needs them, such as "photos of 8000x6000 pixels".
        remedy: What to do besides giving more memory.

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
    """Refuse a photo that cannot be read, and made into a picture, within the budget.

    Raises:
        MemoryBudgetError: With the memory it takes.
    """
    what = f"a photo of {photo[0]}x{photo[1]} pixels"
    require("photos", photo_bytes(photo, made), memory, what, "scale the photos down first")


def size_text(count: int, *, up: bool = False) -> str:
    """Bytes as ``--memory`` takes them: whole megabytes of 2^20, rounded up to the next where wanted."""
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
