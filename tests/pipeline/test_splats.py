"""Gaussians of another program: the file is checked before any work (agreement: test_early_checks)."""

import gzip
import logging
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.sog_files import write_streamed
from support.splats import tame

from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.splats import existing_splats, splats_hash, with_filter_of_photos
from lexsplat.pipeline.viewpoints import candidates, choosing
from lexsplat.rendering import render
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.progress import NOTE
from lexsplat.scenes.exporting import export_gaussians
from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder
from lexsplat.scenes.formats.ply import write_ply
from lexsplat.scenes.formats.reading import read_splats


@pytest.mark.parametrize(
    ("name", "found"),
    [
        (None, "no such file"),
        ("absent.ply", "no such file"),
        (".", "a folder without meta.json and lod-meta.json"),
    ],
)
def test_only_an_existing_file_is_taken(tmp_path, name, found):
    with pytest.raises(FileFormatError, match=f"found {found}"):
        existing_splats(None if name is None else tmp_path / name)
    (tmp_path / "there.ply").write_bytes(b"")
    assert existing_splats(tmp_path / "there.ply") == tmp_path / "there.ply"


def test_the_hash_of_a_sog_in_a_folder_depends_on_each_of_its_parts(tmp_path):
    tree = {"lods": {"0": {"file": 0, "offset": 0, "count": 10}}}
    write_streamed(tmp_path, {"0_0": 10}, tree)
    found = {splats_hash(tmp_path)}
    for part in ("0_0/meta.json", "0_0/quats.webp", "lod-meta.json"):
        (tmp_path / part).write_bytes((tmp_path / part).read_bytes() + b" ")
        found.add(splats_hash(tmp_path))
    assert len(found) == 4
    assert splats_hash(tmp_path) == splats_hash(tmp_path / "lod-meta.json") in found


def test_sizes_of_zero_are_a_warning_and_refused_where_most_gaussians_are_points_or_lines(tmp_path, caplog):
    g = tame(40)
    g.log_scales[:30, 0] = -200  # flat
    g.log_scales[:20, 1] = -200  # lines
    write_ply(g, tmp_path / "g.ply")
    with caplog.at_level(logging.WARNING):
        assert len(read_splats(tmp_path / "g.ply")) == 40
    assert "g.ply: 30 of 40 Gaussians have a size of 0, read as 1e-12" in caplog.text
    g.log_scales[20, 1] = -200
    write_ply(g, tmp_path / "g.ply")
    with pytest.raises(FileFormatError, match="found 21 of 40 Gaussians with two or three sizes of 0"):
        read_splats(tmp_path / "g.ply")


@pytest.mark.slow
def test_a_build_warns_once_of_what_it_drops_and_keeps_the_warning(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(choosing, "SIZE", (240, 180))
    monkeypatch.setattr(choosing, "_MOST_CANDIDATES", 30)
    monkeypatch.setattr(candidates, "_MOST_PLACES", 5)
    monkeypatch.setattr(candidates, "_AZIMUTHS", 6)
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (3000, 3)) * [1.5, 1.5, 0.002]
    points[:800, 2] += 0.3 - 0.3 * (points[:800, :2] ** 2).sum(1)  # a hill on the ground
    g = gaussians_from_points(points, rng.random((3000, 3)), sh_degree=0, opacity=0.98)
    g.quats[:7], g.log_scales[7:12, 2], g.means[12, 0] = 0, -200, 1e9
    write_ply(g, tmp_path / "g.ply")
    config = BuildConfig(clip="bundled", dino="none", device="cpu", up="0,0,1")
    folder = build(None, tmp_path / "scene", config, until="reconstruct", splats=tmp_path / "g.ply")
    for words in (
        "7 of 3000 Gaussians have a rotation",
        "5 of 3000 Gaussians have a size",
        "1 of 3000 Gaussians drop",
    ):
        assert caplog.text.count(words) == 1
        assert sum(words in warning for warning in folder.record["stages"]["views"]["warnings"]) == 1
    assert folder.record["stages"]["reconstruct"]["gaussians"] == 2999


@pytest.mark.parametrize("name", ["g.ply", "g.ply.gz", "g.glb"])
def test_a_packed_file_is_to_be_unpacked(tmp_path, name):
    (tmp_path / name).write_bytes(gzip.compress(b"ply\nformat ascii 1.0\n"))
    with pytest.raises(FileFormatError, match="found gzip; unpack it first"):
        read_splats(tmp_path / name)


@pytest.mark.slow
@pytest.mark.parametrize("filtered", [True, False])
def test_photos_tell_whether_splats_need_the_filter_that_their_format_cannot_name(tmp_path, caplog, filtered):
    folder = SceneFolder(BUNDLED_SCENE)
    original = replace(folder.read_gaussians(), antialiased=filtered)
    with caplog.at_level(NOTE):
        export_gaussians(original, tmp_path / "g.splat")
        export_gaussians(original, tmp_path / "g.ply")
    assert ("g.splat: .splat cannot say that the Gaussians need the mip filter" in caplog.text) == filtered
    assert "g.ply" not in caplog.text
    views = []
    for stored in list(folder.read_cameras().values())[:2]:
        camera = stored.camera.downscaled(2)
        photo = render(original, camera, color=True).image.cpu().numpy()
        views.append(SimpleNamespace(camera=camera, load_image=lambda size, photo=photo: photo))
    caplog.clear()
    with caplog.at_level(NOTE):
        found = with_filter_of_photos(read_splats(tmp_path / "g.splat"), views, tmp_path / "g.splat")
    assert found.antialiased == filtered
    assert ("g.splat: read as trained with the mip filter" in caplog.text) == filtered
    stated = replace(read_splats(tmp_path / "g.ply"), antialiased=not filtered)
    assert with_filter_of_photos(stated, views, tmp_path / "g.ply") is stated, "the format says it"
