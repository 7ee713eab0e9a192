"""Pictures and orbit videos as bytes to download."""

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
    """Cameras on a circle around ``target``, starting at ``position``, at its height.

    Where the photos leave a third of the circle or more unseen, the cameras swing to and fro over the rest of it: a
    scene looks like nothing from where it was never photographed.

    Args:
        position: Start ``[3]``.
        target: What stays in the middle ``[3]``.
        up: Axis of the circle ``[3]``.
        frames: How many; after the last comes the first again.
        seen_from: Where the photos were taken, ``[3]`` each; none means from everywhere.

    Returns:
        ``(position, rotation)``: rotation is camera to world ``[3, 3]`` with OpenCV axes.

    Raises:
        ValueError: If there is no frame, or the camera stands above or in the target.
    """
    if frames < 1:
        raise ValueError(f"frames must be positive, got {frames}")
    axis = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    offset = np.asarray(position, dtype=np.float64) - target
    height = offset @ axis
    flat = offset - height * axis
    if np.linalg.norm(flat) < 1e-9:
        raise ValueError("the camera stands above what it looks at: there is no circle around it")
    side = np.cross(axis, flat)
    places = np.reshape([np.asarray(place) - target for place in seen_from], (-1, 3))
    turns = _turns(np.arctan2(places @ side, places @ flat), frames)
    poses = []
    for angle in turns:
        place = target + np.cos(angle) * flat + np.sin(angle) * side + height * axis
        poses.append((place, looking_at(place, np.asarray(target, dtype=np.float64), axis)))
    return poses


def _turns(seen: NDArray[np.float64], frames: int) -> NDArray[np.float64]:
    """Angles of the cameras; ``seen`` are those of the photos. The start is at 0."""
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


def looking_at(position: NDArray, target: NDArray, up: NDArray) -> NDArray[np.float64]:
    """Camera to world rotation ``[3, 3]``, OpenCV axes, of a camera that looks at ``target``."""
    return looking_along(target - position, up).T


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """A picture ``[H, W, 3 or 4]`` as PNG."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def encode_video(frames: Sequence[NDArray[np.uint8]], fps: int = 20) -> tuple[str, bytes]:
    """Frames ``[H, W, 3]`` as a file: its suffix and content.

    It is an MP4 where PyAV is installed (``lexsplat[video]``), else a GIF. An MP4 has even sizes: a last odd row or
    column is left out.

    Raises:
        ValueError: If there is no frame.
    """
    if not frames:
        raise ValueError("a video needs at least one frame")
    if importlib.util.find_spec("av") is not None:
        return ".mp4", _mp4(frames, fps)
    pictures = [Image.fromarray(frame[..., :3]).quantize(128) for frame in frames]
    stream = io.BytesIO()
    pictures[0].save(
        stream, format="GIF", save_all=True, append_images=pictures[1:], duration=1000 // fps, loop=0
    )
    return ".gif", stream.getvalue()


def _mp4(frames: Sequence[NDArray[np.uint8]], fps: int) -> bytes:
    """H.264, or MPEG-4 where FFmpeg was built without it; the index comes first, so that browsers play it at once."""
    import av

    h264 = "libx264" in av.codecs_available
    height, width = (size // 2 * 2 for size in frames[0].shape[:2])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "orbit.mp4"
        with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("libx264", fps) if h264 else container.add_stream("mpeg4", fps)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for frame in frames:
                picture = np.ascontiguousarray(frame[:height, :width, :3])
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode(None))
        return path.read_bytes()
