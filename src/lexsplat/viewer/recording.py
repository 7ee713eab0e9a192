"""Orbit camera paths, and screenshots and videos as bytes to download."""

from __future__ import annotations

import importlib.util
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lexsplat.geometry.rotations import looking_along

_FULL_TURN_GAP = 2 * np.pi / 3


def orbit(
    position: NDArray, target: NDArray, up: NDArray, frames: int, seen_from: Sequence[NDArray] = ()
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Camera poses on a horizontal circle around ``target``, starting at ``position``.

    If the photos leave a gap of a third of the circle or more, the cameras swing back and forth over the rest of it,
    because a reconstruction is poor where no photo was taken.

    Args:
        position: First camera position ``[3]``.
        target: Look-at point ``[3]``.
        up: Axis of the circle ``[3]``.
        frames: Number of poses; the sequence loops.
        seen_from: Camera positions of the photos, ``[3]`` each; empty means no gap.

    Returns:
        ``(position, rotation)`` of each pose; the rotation is camera to world ``[3, 3]`` with OpenCV axes.

    Raises:
        ValueError: If ``frames`` is not positive, or if the camera is in or vertically above the target.
    """
    if frames < 1:
        raise ValueError(f"frames must be positive, got {frames}")
    axis = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    offset = np.asarray(position, dtype=np.float64) - target
    height = offset @ axis
    flat = offset - height * axis
    if np.linalg.norm(flat) < 1e-9:
        raise ValueError(
            "the camera is vertically above its look-at point: an orbit needs a horizontal distance"
        )
    side = np.cross(axis, flat)
    places = np.reshape([np.asarray(place) - target for place in seen_from], (-1, 3))
    turns = _turns(np.arctan2(places @ side, places @ flat), frames)
    poses = []
    for angle in turns:
        place = target + np.cos(angle) * flat + np.sin(angle) * side + height * axis
        poses.append((place, looking_along(target - place, axis).T))
    return poses


def _turns(seen: NDArray[np.float64], frames: int) -> NDArray[np.float64]:
    """Angles of the cameras in radians, starting at 0; ``seen`` are the angles of the photos."""
    times = 2 * np.pi * np.arange(frames) / frames
    if len(seen) == 0:
        return times
    angles = np.sort(np.append(seen, 0.0))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] < _FULL_TURN_GAP:
        return times
    low = angles[(widest + 1) % len(angles)]
    low -= 2 * np.pi * (low > 0)
    high = low + 2 * np.pi - gaps[widest]
    middle, half = (low + high) / 2, (high - low) / 2
    if half < 1e-9:
        return np.zeros(frames)
    return np.asarray(middle + half * np.sin(times + np.arcsin(np.clip(-middle / half, -1, 1))))


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Encode an image ``[H, W, 3 or 4]`` as PNG."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def encode_video(frames: Sequence[NDArray[np.uint8]], fps: int = 20) -> tuple[str, bytes]:
    """Encode frames ``[H, W, 3]`` as MP4 if PyAV is installed (``lexsplat[video]``), else as GIF.

    MP4 needs even sizes, so an odd last row or column is dropped.

    Returns:
        The suffix and the content of the file.

    Raises:
        ValueError: If there is no frame.
    """
    if not frames:
        raise ValueError("a video needs at least one frame")
    if importlib.util.find_spec("av") is not None:
        return ".mp4", _mp4(frames, fps)
    images = [Image.fromarray(frame[..., :3]).quantize(128) for frame in frames]
    stream = io.BytesIO()
    images[0].save(
        stream, format="GIF", save_all=True, append_images=images[1:], duration=1000 // fps, loop=0
    )
    return ".gif", stream.getvalue()


def _mp4(frames: Sequence[NDArray[np.uint8]], fps: int) -> bytes:
    """H.264, or MPEG-4 if FFmpeg lacks it. The index comes first, so browsers can play while loading."""
    import av

    h264 = "libx264" in av.codecs_available
    height, width = (size // 2 * 2 for size in frames[0].shape[:2])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "orbit.mp4"
        with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("libx264", fps) if h264 else container.add_stream("mpeg4", fps)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for frame in frames:
                image = np.ascontiguousarray(frame[:height, :width, :3])
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode(None))
        return path.read_bytes()
