"""Claims about what a scene of splats without photos records and refuses."""

from __future__ import annotations

import json
import logging
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support import splats as made
from support.schemas import validated

from lexsplat import cli
from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.viewpoints import candidates, choosing
from lexsplat.pipeline.viewpoints.looking import look_from_above
from lexsplat.pipeline.viewpoints.pieces import Pieces
from lexsplat.pipeline.viewpoints.surroundings import Surroundings, find_surroundings
from lexsplat.pipeline.viewpoints.upward import ground_share
from lexsplat.runtime.errors import CaptureError
from lexsplat.scenes.folder import SceneFolder
from lexsplat.scenes.formats.ply import write_ply
from lexsplat.scenes.formats.reading import read_splats
from lexsplat.scenes.scale import store_world

UP = np.array([0.0, 0.0, 1.0])
solid = partial(made.solid, log_size=0.0)


@pytest.fixture(autouse=True)
def _few_candidates(monkeypatch) -> None:
    """Choices of a test take seconds."""
    monkeypatch.setattr(choosing, "SIZE", (240, 180))
    monkeypatch.setattr(choosing, "_MOST_CANDIDATES", 30)
    monkeypatch.setattr(candidates, "_MOST_PLACES", 6)
    monkeypatch.setattr(candidates, "_AZIMUTHS", 4)


def ball(radius: float = 1.0, count: int = 3000) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def on_table() -> np.ndarray:
    """A ball on a square table top of 3 x 3 at z = 0."""
    top = np.random.default_rng(1).uniform(-1.5, 1.5, (6000, 3)) * [1, 1, 0.002]
    return np.concatenate([top, ball(0.4) + np.array([0, 0, 0.4])])


def surroundings(gaussians: Gaussians, up: np.ndarray | None = None) -> Surroundings:
    return find_surroundings(gaussians, up, look_from_above(gaussians), Path("thing.ply"))


@pytest.mark.slow
def test_a_guessed_up_direction_stays_a_guess_in_the_scene_with_its_warning(tmp_path, capsys, caplog):
    """Chosen cameras are level with the guess: an estimate from them would be certain."""
    splats, output = tmp_path / "ball.ply", tmp_path / "scene"
    write_ply(solid(ball()), splats)
    config = BuildConfig(clip="bundled", dino="none", device="cpu")
    for _ in range(2):  # the second build keeps the views
        caplog.clear()
        with caplog.at_level(logging.WARNING, "lexsplat"):
            record = build(None, output, config, until="reconstruct", splats=splats).record
        assert caplog.text.count("up direction is a guess") == 1
        assert record["world"]["up"]["from"] == "splats"
        assert record["world"]["up"]["reliable"] is False
        assert any("up direction is a guess" in warning for warning in record["warnings"])
    capsys.readouterr()
    assert cli.main(["info", str(output), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    validated("info", facts)
    assert (facts["up"]["reliable"], facts["warnings"]) == (False, len(record["warnings"]))
    assert facts["chosen_views"]["splats"] == str(splats)
    assert facts["chosen_views"]["views"] == facts["views"]["training"]
    assert cli.main(["info", str(output)]) == 0
    assert f"none: {facts['chosen_views']['views']} views chosen from {splats}" in capsys.readouterr().out
    store_world(SceneFolder.open(output), up=(0, 0, 1))
    record = build(None, output, config, until="reconstruct", splats=splats).record
    assert (record["world"]["up"]["from"], record["world"]["up"]["direction"]) == ("user", [0, 0, 1])


@pytest.mark.slow
@pytest.mark.parametrize("thing", ["teddy bear", "red apple"])
def test_the_up_direction_of_a_thing_alone_is_a_guess_and_contradicts_nobody(tmp_path, thing, caplog):
    cli.main(["export", "demo", str(tmp_path / "thing.ply"), "--select", thing])
    gaussians = read_splats(tmp_path / "thing.ply")
    with caplog.at_level(logging.WARNING, "lexsplat"):
        found = surroundings(gaussians)
    assert not found.up.reliable
    assert "thing.ply: the up direction is a guess" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING, "lexsplat"):
        surroundings(gaussians, UP)
    assert not caplog.text


def test_a_ground_is_level_and_wide():
    """The table top is under the whole scene; caps of a ball within 15 degrees of level have 7 % of its outline."""
    assert ground_share(Pieces.of(on_table()), UP) > 0.9
    assert ground_share(Pieces.of(ball()), UP) < 0.1


@pytest.mark.slow
def test_the_up_direction_of_a_thing_on_a_ground_is_reliable():
    assert surroundings(solid(on_table())).up.reliable


@pytest.mark.slow
def test_a_scene_as_small_as_the_near_plane_is_refused_with_a_remedy():
    table = on_table() - [0, 0, 0.1]
    with pytest.raises(CaptureError) as caught:
        surroundings(solid(table * 1e-3))
    assert "expected a scene with a radius of at least 0.05 units, found 0.0011" in str(caught.value)
    assert "scale the splats up, as does: splat-transform thing.ply --scale 1000 scaled.ply" in str(
        caught.value
    )
    assert surroundings(solid(table * 0.1)).whole.radius > 0.05


@pytest.mark.parametrize(
    ("opacity", "points", "found"),
    [
        (0.05, np.random.default_rng(0).normal(size=(6000, 3)), "found 0 of 6,000 opaque"),
        (0.9, np.zeros((3000, 3)), "found 3,000 at one point"),
        (0.9, np.random.default_rng(0).normal(size=(10, 3)), "found 10 of 10 opaque"),
    ],
    ids=["fog", "one point", "few"],
)
def test_splats_without_surfaces_are_refused_with_what_they_lack(opacity, points, found):
    one = gaussians_from_points(
        np.random.default_rng(1).normal(size=points.shape), np.ones(points.shape), opacity=opacity
    )
    one.means[:] = one.means.new_tensor(points)
    with pytest.raises(CaptureError, match=found):
        surroundings(one)
