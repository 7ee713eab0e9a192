"""Samples frames of a video as photos: a given number of sharp frames, evenly spaced by camera motion.

The video is decoded twice and never held in memory. The first pass measures the sharpness of each frame and its
change from the previous one on small gray copies; the second pass writes the chosen frames. Needs PyAV (the extra
``video``).
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lexsplat.runtime import memory as budget
from lexsplat.runtime.errors import BackendError, CaptureError
from lexsplat.runtime.files import atomic_path, write_file
from lexsplat.runtime.fingerprints import digest
from lexsplat.runtime.progress import Event, Listener, silent

STAGE = "video"
DEFAULT_FRAMES = 150
"""Default number of frames: enough for a walk around a place or an object."""

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")

_SHARPNESS_SIDE = 480
"""Longest side in pixels for measuring sharpness: blur that affects features is still visible."""
_MOTION_SIDE = 64
"""Longest side in pixels for measuring motion: noise and sharpness have no effect."""
_TAPER = 0.3
"""Relative reduction of the score of a frame at the border of its window."""
_WHOLE = 0.9
"""Least share of its frames that must be readable for a video to count as complete."""
_MANIFEST = "frames.json"
_JPEG_QUALITY = 95


def is_video(path: Path) -> bool:
    """Whether a path has the suffix of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()


def videos_in(folder: Path) -> list[str]:
    """Names of the videos in a folder, sorted, without hidden files."""
    return sorted(path.name for path in folder.iterdir() if is_video(path) and not path.name.startswith("."))


def require_video(video: Path, folder: Path) -> None:
    """Refuse a video that cannot be sampled into a folder, before anything takes time.

    Raises:
        BackendError: If PyAV is not installed and the folder holds no frames.
        CaptureError: If there is no such file.
    """
    if not video.is_file():
        raise CaptureError(video, expected="a video", found="no such file", remedy="check the path")
    if not (folder / _MANIFEST).is_file():
        _require_pyav(video)


def _require_pyav(video: Path) -> Any:
    try:
        import av
    except ImportError as error:
        raise BackendError(
            video,
            expected="PyAV, which reads videos",
            found="not installed",
            remedy='pip install "lexsplat[video]", or give a folder of photos',
        ) from error
    return av


def sample_video(
    video: Path,
    folder: Path,
    count: int = DEFAULT_FRAMES,
    *,
    memory: int = budget.DEFAULT_MEMORY,
    listener: Listener = silent,
) -> list[str]:
    """Write frames of a video as ``frame_NUMBER.jpg``, where NUMBER is the index in the video.

    Frames that an earlier call wrote from the same video with the same count are kept.

    Args:
        video: The file.
        folder: Output folder; other ``frame_*.jpg`` in it are deleted.
        count: Number of frames; a shorter video yields all of its frames.
        memory: Bytes of host memory available for decoding; determines the number of threads.
        listener: Receives events of stage "video": one unit per frame read.

    Returns:
        Names of the frames, in order.

    Raises:
        BackendError: If PyAV is not installed.
        CaptureError: If the file is missing, damaged, not a video, or has fewer than three frames.
        MemoryBudgetError: If ``memory`` is too little for frames of this size.
        ValueError: If ``count`` is below 3.
    """
    if count < 3:
        raise ValueError(f"count must be at least 3, got {count}")
    require_video(video, folder)
    inputs = {"video": _identity(video), "count": count, "version": 1}
    kept = _written_before(folder, inputs)
    if kept is not None:
        return kept
    sharpness, motion = measure_frames(video, listener, memory=memory)
    chosen = choose_frames(sharpness, motion, count)
    names = [f"frame_{index:06d}.jpg" for index in chosen]
    (folder / _MANIFEST).unlink(missing_ok=True)
    for stale in folder.glob("frame_*.jpg"):
        if stale.name not in names:
            stale.unlink()
    _write_frames(video, folder, dict(zip(chosen, names)), len(motion), memory, listener)
    write_file(folder / _MANIFEST, json.dumps({**inputs, "names": names}, indent=1))
    return names


def measure_frames(
    video: Path, listener: Listener = silent, *, memory: int = budget.DEFAULT_MEMORY
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure all frames of a video: the first pass.

    Returns:
        Sharpness ``[F]``, the variance of the Laplacian of the gray frame relative to its contrast, and motion
        ``[F]``, the change from the frame before relative to its contrast; the first is 0.

    Raises:
        BackendError: If PyAV is not installed.
        CaptureError: As `sample_video`.
    """
    sharpness: list[float] = []
    motion: list[float] = []
    before: NDArray[np.float32] | None = None
    with _open(video, memory) as (stream, frames):
        expected = stream.frames
        for frame in frames:
            sharpness.append(_sharpness(_small_gray(frame, _SHARPNESS_SIDE)))
            now = _small_gray(frame, _MOTION_SIDE)
            motion.append(0.0 if before is None else _change(before, now))
            before = now
            if len(motion) % 50 == 0:
                listener(Event(STAGE, len(motion), 2 * max(expected, len(motion))))
    if len(motion) < _WHOLE * expected:
        raise CaptureError(
            video,
            expected=f"{expected} frames, as the file states",
            found=f"{len(motion)} readable ones",
            remedy="the video is cut off or damaged: copy it again",
        )
    if len(motion) < 3:
        raise CaptureError(video, expected="a video of at least 3 frames", found=f"{len(motion)}")
    return np.array(sharpness), np.array(motion)


def choose_frames(sharpness: NDArray[np.float64], motion: NDArray[np.float64], count: int) -> list[int]:
    """Indices of the chosen frames, ascending: the sharpest of each of ``count`` segments of equal motion.

    A segment without a frame, where the camera moved fast, is made up for by one more frame in the widest remaining
    gap, so that the result has ``count`` frames, or all.
    """
    frames = len(motion)
    if count >= frames:
        return list(range(frames))
    path = np.cumsum(motion)
    if path[-1] <= 0:  # no motion: evenly by time
        path = np.arange(frames, dtype=np.float64)
    place = path / path[-1] * count
    window = np.minimum(place.astype(np.int64), count - 1)
    score = sharpness * (1 - _TAPER * np.abs(2 * (place - window) - 1).clip(0, 1))
    order = np.lexsort((-score, window))
    first = np.unique(window[order], return_index=True)[1]
    chosen = sorted(int(index) for index in order[first])
    while len(chosen) < count:
        chosen = sorted([*chosen, _fill_widest_gap(chosen, place, score)])
    return chosen


def _fill_widest_gap(chosen: list[int], place: NDArray, score: NDArray) -> int:
    """The best frame near the middle of the widest gap between two chosen frames."""
    ends = [-1, *chosen, len(place)]
    gaps = [(a, b) for a, b in itertools.pairwise(ends) if b - a > 1]
    start, end = max(gaps, key=lambda gap: place[min(gap[1], len(place) - 1)] - place[max(gap[0], 0)])
    inside = np.arange(start + 1, end)
    quarter = len(inside) // 4
    middle = inside[quarter : len(inside) - quarter]
    return int(middle[score[middle].argmax()])


@contextlib.contextmanager
def _open(video: Path, memory: int) -> Iterator[tuple[Any, Iterator[Any]]]:
    """The video stream and its decoded frames, in order."""
    av = _require_pyav(video)
    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise CaptureError(video, expected="a video", found="a file without a video stream")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            stream.codec_context.thread_count = _threads(video, (stream.width, stream.height), memory)
            yield stream, container.decode(stream)
    except av.error.FFmpegError as error:
        raise CaptureError(
            video,
            expected="a whole video",
            found=f"damaged data ({error.strerror or error})",
            remedy="copy the file again, or convert it to an MP4",
        ) from error


def _threads(video: Path, frame: tuple[int, int], memory: int) -> int:
    """Number of decoding threads whose frames fit into the memory budget."""
    need = {
        threads: budget.video_bytes(frame, threads) for threads in range(1, min(16, os.cpu_count() or 1) + 1)
    }
    what = f"frames of {frame[0]}x{frame[1]} pixels"
    budget.require(str(video), need[1], memory, what, "scale the video down first")
    return budget.most_within(memory, need)


def _small_gray(frame: Any, side: int) -> NDArray[np.float32]:
    """A frame as gray image ``[h, w]`` in 0..255 with sides of at most ``side`` pixels."""
    factor = min(1.0, side / max(frame.width, frame.height))
    size = (max(2, round(frame.width * factor)), max(2, round(frame.height * factor)))
    small = frame.reformat(width=size[0], height=size[1], format="gray", interpolation="AREA")
    return np.asarray(small.to_ndarray(), dtype=np.float32)


def _sharpness(gray: NDArray[np.float32]) -> float:
    """Variance of the Laplacian relative to the variance of the image, so that a plain wall is not "blurred"."""
    inner = gray[1:-1, 1:-1]
    laplacian = gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:] - 4 * inner
    return float(laplacian.var() / (gray.var() + 1.0)) if laplacian.size else 0.0


def _change(before: NDArray[np.float32], now: NDArray[np.float32]) -> float:
    """Mean absolute difference of two frames without their brightness, relative to their contrast."""
    first, second = before - before.mean(), now - now.mean()
    contrast = (float(first.std()) + float(second.std())) / 2
    return float(np.abs(first - second).mean()) / (contrast + 1.0)


def _upright(frame: Any) -> NDArray[np.uint8]:
    """The pixels of a frame ``[H, W, 3]``, rotated by the video's display matrix."""
    pixels = frame.to_ndarray(format="rgb24")
    quarters = round(getattr(frame, "rotation", 0) / 90) % 4
    return np.ascontiguousarray(np.rot90(pixels, quarters))


def _write_frames(
    video: Path, folder: Path, names: dict[int, str], total: int, memory: int, listener: Listener
) -> None:
    last = max(names)
    written = 0
    with _open(video, memory) as (_, frames):
        for index, frame in enumerate(frames):
            if index in names:
                with atomic_path(folder / names[index]) as temporary:
                    image = Image.fromarray(_upright(frame))
                    image.save(temporary, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)
                written += 1
                listener(Event(STAGE, total + index, 2 * total))
            if index >= last:
                break
    if written < len(names):
        raise CaptureError(
            video, expected=f"{total} frames, as in the first pass", found="fewer", remedy="try again"
        )
    listener(Event(STAGE, 2 * total, 2 * total, {"frames": float(written)}))


def _identity(video: Path) -> list[Any]:
    """Name, size and a hash of the first and last MiB: identifies a video without reading all of it."""
    size = video.stat().st_size
    with open(video, "rb") as file:
        first = file.read(1 << 20)
        file.seek(max(0, size - (1 << 20)))
        return [video.name, size, digest([first, file.read(1 << 20)])]


def _written_before(folder: Path, inputs: dict[str, Any]) -> list[str] | None:
    """The frames of an earlier call with the same video and count, if all of them exist."""
    try:
        content = json.loads((folder / _MANIFEST).read_text(encoding="utf-8"))
        names = content.pop("names")
    except (OSError, ValueError, KeyError, AttributeError):
        return None
    whole = content == inputs and isinstance(names, list) and all((folder / str(n)).is_file() for n in names)
    return [str(name) for name in names] if whole else None
