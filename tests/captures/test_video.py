import builtins
import struct
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter
from support.refusals import assert_reports

from lexsplat.captures.readers.video import (
    choose_frames,
    is_video,
    measure_frames,
    sample_video,
)
from lexsplat.runtime.errors import BackendError, CaptureError

pytestmark = pytest.mark.slow

av = pytest.importorskip("av", reason="needs the extra `video` (PyAV)")

SIZE = (192, 128)
BLURRED = {7, 8, 20, 21, 22, 33, 45, 46}


def wallpaper() -> np.ndarray:
    """A texture with detail at several scales, wider than the image."""
    rng = np.random.default_rng(3)
    total = np.zeros((SIZE[1], 1600))
    for cell, weight in ((32, 60), (8, 40), (2, 25)):
        small = rng.normal(size=(SIZE[1] // cell, 1600 // cell))
        total += weight * np.kron(small, np.ones((cell, cell)))
    return np.clip(128 + total, 0, 255).astype(np.uint8)


def positions() -> np.ndarray:
    """Position of the image on the wallpaper: slow for 30 frames, then five times as fast."""
    return np.concatenate([2.0 * np.arange(30), 58 + 10.0 * np.arange(1, 31)])


def write_video(path: Path, *, blurred=frozenset(), faststart=False) -> Path:
    texture = wallpaper()
    options = {"movflags": "faststart"} if faststart else {}
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("mpeg4", rate=Fraction(30), options={"qscale": "2", "flags": "+qscale"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for index, left in enumerate(positions().astype(int)):
            image = Image.fromarray(np.repeat(texture[:, left : left + SIZE[0], None], 3, 2))
            if index in blurred:
                image = image.filter(ImageFilter.GaussianBlur(3))
            container.mux(stream.encode(av.VideoFrame.from_image(image)))
        container.mux(stream.encode())
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    return write_video(tmp_path_factory.mktemp("video") / "walk.mp4", blurred=BLURRED)


def numbers(names: list[str]) -> list[int]:
    return [int(name.removeprefix("frame_").removesuffix(".jpg")) for name in names]


def test_blurred_frames_are_skipped_and_the_count_is_exact(video, tmp_path):
    names = sample_video(video, tmp_path, 12)
    assert len(names) == 12
    assert BLURRED.isdisjoint(numbers(names))
    assert sorted(path.name for path in tmp_path.glob("*.jpg")) == names == sorted(names)
    picture = np.asarray(Image.open(tmp_path / names[0]), dtype=float)
    left = int(positions()[numbers(names)[0]])
    difference = np.abs(picture[..., 1] - wallpaper()[:, left : left + SIZE[0]])
    assert difference.mean() < 12, "the frame is the one named"


def test_frames_follow_the_motion_and_not_the_time(video):
    chosen = choose_frames(*measure_frames(video), 12)
    fast = sum(index >= 30 for index in chosen)
    assert fast >= 8, "five sixths of the way lie in the second half of the time"
    steps = np.diff(positions()[chosen])
    assert steps.max() < 3 * np.median(steps)


def test_frames_are_kept_if_nothing_changed_and_rewritten_for_another_count(video, tmp_path):
    first = sample_video(video, tmp_path, 6)
    times = {name: (tmp_path / name).stat().st_mtime_ns for name in first}
    assert sample_video(video, tmp_path, 6) == first
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in first} == times
    (tmp_path / first[2]).unlink()
    assert sample_video(video, tmp_path, 6) == first, "a missing frame is written again"
    more = sample_video(video, tmp_path, 9)
    assert len(more) == 9
    assert {path.name for path in tmp_path.glob("*.jpg")} == set(more)


def test_a_jump_gets_no_more_frames_than_there_are_and_gaps_are_filled():
    motion = np.ones(40)
    motion[0], motion[20] = 0, 60  # a cut: most segments of equal motion have no frame
    sharpness = np.where(np.arange(40) % 2, 2.0, 1.0)
    chosen = choose_frames(sharpness, motion, 10)
    assert len(set(chosen)) == 10
    assert chosen == sorted(chosen)
    assert sum(index < 20 for index in chosen) in range(3, 8)
    assert choose_frames(sharpness, motion, 100) == list(range(40))
    still = choose_frames(sharpness, np.zeros(40), 8)
    assert len(still) == 8
    assert np.diff(still).max() <= 10, "where nothing moves, time decides"


def test_rotated_videos_yield_upright_frames(video, tmp_path):
    """The matrix of the track header (ISO 14496-12, 8.3.2): x' = a p + c q, y' = b p + d q."""
    content = bytearray(video.read_bytes())
    place = (
        content.find(b"tkhd") + 4 + 4 + 20 + 8 + 8
    )  # version and flags; times and track; reserved; layer to volume
    one = 0x10000
    assert struct.unpack(">9i", content[place : place + 36])[:5] == (one, 0, 0, 0, one)
    content[place : place + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, SIZE[1] * one, 0, 0x40000000)
    turned = tmp_path / "turned.mp4"
    turned.write_bytes(content)
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    names = sample_video(video, tmp_path / "a", 3)
    assert sample_video(turned, tmp_path / "b", 3) == names
    plain, upright = (np.asarray(Image.open(tmp_path / f / names[0]), float) for f in ("a", "b"))
    # x' = H - q, y' = p: stored rows become columns.
    expected = plain.transpose(1, 0, 2)[:, ::-1]
    assert upright.shape == expected.shape
    assert np.abs(upright - expected).mean() < 3


@pytest.mark.parametrize("share", [0.02, 0.4, 0.9])
@pytest.mark.parametrize("faststart", [False, True])
def test_truncated_videos_are_refused(tmp_path, share, faststart):
    whole = write_video(tmp_path / "whole.mp4", faststart=faststart).read_bytes()
    path = tmp_path / "cut.mp4"
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(CaptureError) as caught:
        sample_video(path, tmp_path / "out", 5)
    assert_reports(caught.value, "cut.mp4")
    assert not list(tmp_path.rglob("frame_*"))


def test_files_that_are_not_videos_are_refused(tmp_path):
    (tmp_path / "words.mp4").write_text("not a video")
    for name, found in (("words.mp4", "damaged"), ("nowhere.mov", "no such file")):
        with pytest.raises(CaptureError) as caught:
            sample_video(tmp_path / name, tmp_path / "out", 5)
        assert_reports(caught.value, name, found)
    assert is_video(Path("A.MOV"))
    assert not is_video(tmp_path)
    with pytest.raises(ValueError, match="count"):
        sample_video(tmp_path / "words.mp4", tmp_path, 2)


def test_without_the_library_the_error_names_the_extra(video, tmp_path, monkeypatch):
    real = builtins.__import__

    def without_av(name, *args, **kwargs):
        if name == "av":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_av)
    with pytest.raises(BackendError) as caught:
        sample_video(video, tmp_path, 5)
    assert_reports(caught.value, "lexsplat[video]")
