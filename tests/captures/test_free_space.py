"""Structure from motion asks for room before it begins: pycolmap ends the process on a full disk."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.forked_commands import Command
from support.written_captures import save

from lexsplat.captures import poses_from_photos
from lexsplat.captures.sfm.feature_budget import check_space
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import CaptureError, MemoryBudgetError

CONFIG = BuildConfig(clip="bundled", dino="none", device="cpu")


@pytest.fixture
def photos(tmp_path) -> Path:
    """Three photos of 320x240 pixels of noise."""
    random = np.random.default_rng(0)
    for index in range(3):
        save(tmp_path / "photos" / f"{index}.png", random.uniform(size=(240, 320, 3)))
    return tmp_path / "photos"


def with_free(monkeypatch, size: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=size))


def test_a_disk_without_room_for_the_features_is_reported_before_the_work(photos, tmp_path, monkeypatch):
    with_free(monkeypatch, 300_000)
    with pytest.raises(CaptureError) as caught:
        poses_from_photos(photos, tmp_path / "model")
    assert "MB of free space for the features of 3 photos, found 0.3 MB; free some space" in str(caught.value)
    assert "--poses.max-features (lexsplat poses: --max-features)" in str(caught.value)
    assert not list((tmp_path / "model").rglob("database.db"))


def test_a_build_without_room_for_the_features_leaves_no_folder(photos, tmp_path, monkeypatch):
    with_free(monkeypatch, 300_000)
    with pytest.raises(CaptureError, match=r"--poses\.max-features"):
        build(photos, tmp_path / "new" / "scene", CONFIG)
    assert not (tmp_path / "new").exists()


def test_a_build_without_memory_for_the_features_leaves_no_folder(photos, tmp_path, monkeypatch):
    def too_little(*_, **__) -> int:
        raise MemoryBudgetError("structure from motion", expected="more", found="less", remedy="give more")

    monkeypatch.setattr("lexsplat.captures.sfm.mapping.extraction_threads", too_little)
    with pytest.raises(MemoryBudgetError):
        build(photos, tmp_path / "new" / "scene", CONFIG)
    assert not (tmp_path / "new").exists()


def test_a_build_that_ends_later_keeps_its_features(photos, tmp_path, monkeypatch):
    def full(database: Path, memory: int) -> None:
        raise CaptureError(database, expected="room", found="none", remedy="make some")

    monkeypatch.setattr("lexsplat.captures.sfm.photos.check_mapping", full)
    with pytest.raises(CaptureError, match="make some"):
        build(photos, tmp_path / "scene", CONFIG)
    assert (tmp_path / "scene" / "poses" / ".poses" / "database.db").exists()


@pytest.mark.parametrize(
    ("size", "max_side", "max_features", "need"),
    [
        ((640, 480), 3200, 100, 10 * 100 * (128 + 24)),  # as many features as are allowed
        ((640, 480), 3200, 8192, 10 * 640 * 480 // 64 * 152),  # as many as such photos have
        ((1280, 960), 640, 8192, 10 * 640 * 480 // 64 * 152),  # after they are reduced
    ],
)
def test_the_room_is_that_of_the_features_without_those_of_an_earlier_run(
    tmp_path, monkeypatch, size, max_side, max_features, need
):
    database = tmp_path / "work" / "database.db"
    with_free(monkeypatch, need)
    check_space(database, 10, size, max_side, max_features)
    with_free(monkeypatch, need - 1)
    with pytest.raises(CaptureError, match=r"work: expected .* MB of free space"):
        check_space(database, 10, size, max_side, max_features)
    database.parent.mkdir()
    database.write_bytes(b"x")
    check_space(database, 10, size, max_side, max_features)


@pytest.mark.slow
def test_a_limit_of_file_sizes_ends_structure_from_motion_in_one_line(photos, tmp_path):
    resource = pytest.importorskip("resource", reason="no limit of file sizes on this system")
    with Command(
        "poses",
        str(photos),
        "--output",
        str(tmp_path / "model"),
        prepare=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000)),
    ) as command:
        done = command.ended()
    assert done.status == 1, done.err[-2000:]
    told = [line for line in done.err.splitlines() if "error: " in line]
    assert len(told) == 1, done.err[-2000:]
    assert "MB of free space for the features of 3 photos, found 0.3 MB" in told[0]
