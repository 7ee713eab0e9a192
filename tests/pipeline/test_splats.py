"""Gaussians of another program: those that the cameras do not see are refused before any work."""

from pathlib import Path

import pytest
import torch
from support.language_scene import make_scene

from lexsplat.pipeline.splats import check_in_view, existing_splats
from lexsplat.runtime.errors import CaptureError, FileFormatError


@pytest.mark.parametrize("name", [None, "absent.ply", "."])
def test_only_an_existing_file_is_taken(tmp_path, name):
    with pytest.raises(FileFormatError, match="no such file"):
        existing_splats(None if name is None else tmp_path / name)
    (tmp_path / "there.ply").write_bytes(b"")
    assert existing_splats(tmp_path / "there.ply") == tmp_path / "there.ply"


@pytest.mark.parametrize(
    "change",
    [lambda means: means + 50, lambda means: means * 100, lambda means: means * 0.001],
    ids=["elsewhere", "larger units", "smaller units"],
)
def test_gaussians_that_cover_too_little_of_the_views_are_refused(change):
    balls = make_scene(per_ball=40, views=3)
    cameras = list(balls.cameras.values())
    check_in_view(balls.gaussians, cameras, Path("mine.ply"))
    moved = balls.gaussians.map(torch.clone)
    moved.means = change(moved.means)
    with pytest.raises(CaptureError, match=r"mine\.ply.*axes and units of the cameras"):
        check_in_view(moved, cameras, Path("mine.ply"))
