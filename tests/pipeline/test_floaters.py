"""Gaussians that float free of all surfaces are found, and what is no floater stays."""

from __future__ import annotations

import functools
import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.splats import joined, solid
from support.surfaces import on_table

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.viewpoints import candidates, choosing, floaters, stage, surroundings
from lexsplat.pipeline.viewpoints.floaters import find_floaters, isolation
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.ply import write_ply

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(autouse=True)
def _few_looks(monkeypatch) -> None:
    """A quarter as many looks from above and around as usual, and half as many for floaters."""
    monkeypatch.setattr(candidates, "_AZIMUTHS", 4)
    monkeypatch.setattr(floaters, "_VIEWS", 50)


def dusty() -> tuple[Gaussians, Gaussians]:
    """Balls on a table, and small floaters around them of which some are certainly floaters."""
    clean = solid(on_table())
    dust = solid(np.random.default_rng(3).uniform([-3, -3, 0.1], [3, 3, 4], (700, 3)))
    dust.log_scales[:] = clean.log_scales[:700]
    return clean, dust


@functools.cache
def of_dust() -> np.ndarray:
    """The floaters that are found in `dusty`, whose up direction is given."""
    return find_floaters(joined(*dusty()), Path("dusty.ply"), up=UP)


@pytest.mark.slow
def test_up_is_estimated_once_for_all_searches(monkeypatch):
    calls = []

    def counting(name, function):
        return lambda *given: [calls.append(name), function(*given)][1]

    for module, name in ((surroundings, "find_upward"), (floaters, "_before_surfaces")):
        monkeypatch.setattr(module, name, counting(name, getattr(module, name)))
    find_floaters(joined(*dusty()), Path("dusty.ply"))
    assert calls.count("_before_surfaces") > 1
    assert calls.count("find_upward") == 1


@pytest.mark.slow
def test_many_floaters_are_left_out_with_a_warning_and_few_lonely_gaussians_stay(caplog):
    clean, dust = dusty()
    distances = np.linalg.norm(dust.means.numpy()[:, None] - on_table()[None, ::10], axis=2).min(1)
    both = joined(clean, dust)
    events = []
    with caplog.at_level(logging.WARNING, "lexsplat"):
        floating = find_floaters(both, Path("dusty.ply"), listener=events.append)
    assert {event.stage for event in events} == {"floater views"}
    assert max(event.done for event in events) == max(event.total for event in events)
    assert "dusty.ply" in caplog.text
    assert "float free of all surfaces" in caplog.text
    assert (floating >= len(clean)).all()
    far = len(clean) + np.flatnonzero(distances > 1)
    assert len(far) > 300
    assert np.isin(far, floating).mean() > 0.95
    caplog.clear()
    for few in (both.select(torch.arange(len(clean) + 100)), clean):
        assert len(find_floaters(few, Path("dusty.ply"))) == 0
    assert not caplog.text


@pytest.mark.slow
def test_large_floaters_hang_in_front_of_surfaces_and_large_gaussians_behind_the_scene_stay():
    """Both are within four of their radii from their neighbors, so distances alone do not tell them apart."""
    clean, dust = dusty()
    rng = np.random.default_rng(5)
    above = solid(rng.uniform([-1, -1, 1.0], [1, 1, 1.4], (12, 3)))
    around = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    wall = solid(np.stack([9 * np.cos(around), 9 * np.sin(around), np.full(30, 0.5)], 1))
    above.log_scales[:], wall.log_scales[:] = np.log(0.25), np.log(1.5)
    scene = joined(clean, dust, above, wall)
    first = len(clean) + len(dust)
    own = isolation(scene)[1]
    assert (own[first:] < 4).all()
    floating = find_floaters(scene, Path("dusty.ply"), up=UP)
    assert np.isin(np.arange(first, first + 12), floating).mean() > 0.8
    assert not np.isin(np.arange(first + 12, len(scene)), floating).any()
    assert (floating >= len(clean)).all()


@pytest.mark.slow
def test_floaters_larger_than_the_things_they_engulf_are_found():
    """Surfaces lie before, on and behind them. Plates under a fine pattern have near neighbors, too, and stay."""
    clean, dust = dusty()
    giants = solid(np.array([[-0.6, -0.6, 1.3], [0.5, -1.0, 0.9], [1.2, -0.5, 0.8], [-0.2, 1.2, 1.1]]))
    giants.log_scales[:] = torch.log(torch.tensor([[1.2], [0.6], [0.4], [0.9]]))
    plates = solid(np.array([[-0.8, -0.8, 0.0], [0.9, -0.9, 0.0]]))
    plates.log_scales[:] = torch.log(torch.tensor([0.4, 0.4, 0.002]))
    plates.quats[:] = torch.tensor([1.0, 0, 0, 0])
    scene = joined(clean, plates, dust, giants)
    own = isolation(scene)[1]
    assert (own[len(clean) : len(clean) + 2] < 0.8).all()
    assert (own[-4:] < 2).all()
    floating = find_floaters(scene, Path("dusty.ply"), up=UP)
    assert np.isin(np.arange(len(scene) - 4, len(scene)), floating).all()
    assert (floating >= len(clean) + 2).all()


@pytest.mark.slow
def test_a_build_leaves_floaters_out_of_the_scene_unless_they_are_kept(tmp_path, monkeypatch):
    clean, dust = dusty()
    scene, splats = joined(clean, dust), tmp_path / "dusty.ply"
    write_ply(scene, splats)
    monkeypatch.setattr(stage, "choose_views", lambda *_, **__: choosing.ChosenViews((), UP, 0, 0, 0, 0))
    monkeypatch.setattr(stage, "write_chosen_capture", lambda _, __, poses, *rest: poses.mkdir(parents=True))
    monkeypatch.setattr(stage, "load_capture", lambda poses, **_: SimpleNamespace(root=poses))
    for keep, count in ((False, len(scene) - len(of_dust())), (True, len(scene))):
        folder = SceneFolder(tmp_path / str(keep))
        folder.root.mkdir()
        config = BuildConfig(keep_floaters=keep, up="0,0,1")
        capture = stage.capture_of_splats(splats, folder, config, "cpu", lambda _: None)
        assert len(stage.splats_of_capture(splats, capture, folder)) == count
        assert folder.record["stages"]["views"]["floaters"] == len(scene) - count
    photos = SimpleNamespace(root=tmp_path / "photos")
    assert len(stage.splats_of_capture(splats, photos, SceneFolder(tmp_path / "False"))) == len(scene)
