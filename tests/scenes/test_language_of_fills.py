"""What a fill under a deleted thing is, and what a later edit takes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.language_scene import make_codebook

from lexsplat.geometry.boxes import Up
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.geometry.world import World
from lexsplat.language.fields import CodeField
from lexsplat.language.segments import Segments
from lexsplat.queries.selection import Selection
from lexsplat.queries.visibility import whole_things, with_remains
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.scene import Scene, open_scene

WOOD, CLOTH = np.array([0.45, 0.3, 0.15]), np.array([0.8, 0.1, 0.1])
TABLE, BALL, SHEET, ROOM = 0, 1, 2, 3
"""Segments."""
EDGE = -0.06
"""Where the cloth ends; it lies beyond, at smaller x."""


def ball_at_the_edge_of_a_cloth() -> Scene:
    """A table, a cloth on a part of it, and a ball over the edge; most of the table is its legs, far away."""
    side = np.linspace(-1.5, 1.5, 76)
    top = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    top = np.insert(top[np.linalg.norm(top, axis=1) > 0.2], 2, 0.0, 1)
    is_cloth = top[:, 0] < EDGE
    legs = np.random.default_rng(1).uniform([1.4, -1.5, -1.5], [1.5, 1.5, -0.3], (4000, 3))
    room = np.random.default_rng(2).uniform([-9, -9, 5], [9, 9, 6], (25000, 3))
    ball = np.random.default_rng(0).normal(size=(600, 3))
    ball = 0.3 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0, 0, 0.3]
    labels = np.concatenate(
        [np.where(is_cloth, SHEET, TABLE), np.repeat([TABLE, BALL, ROOM], [4000, 600, 25000])]
    )
    colors = np.array([WOOD, [0.5, 0.5, 0.5], CLOTH, [0.5, 0.5, 0.5]])[labels]
    points = np.concatenate([top, legs, ball, room])
    gaussians = gaussians_from_points(points, colors, sh_degree=0, opacity=0.95)
    gaussians.log_scales.fill_(float(np.log(0.025)))
    shown = torch.zeros(len(labels)).bool()
    segments = Segments(torch.from_numpy(labels), torch.ones(len(labels)), torch.arange(4)[None], shown)
    codes = torch.zeros(len(labels), 1, dtype=torch.uint8)
    field = CodeField(make_codebook(2), codes, torch.ones(len(codes), 1), torch.zeros(len(codes)))
    field.segments = segments
    return Scene(gaussians, field, {}, "bundled")


def selected(scene: Scene, segment: int) -> Selection:
    segments = scene.field.segments
    assert segments is not None
    mask = (segments.labels == segment) & ~scene.hidden
    return Selection(scene.gaussians, {}, mask, mask.float(), world=World(Up(np.array([0, 0, 1.0]), True)))


@pytest.fixture(scope="module")
def without_ball() -> Editor:
    scene = ball_at_the_edge_of_a_cloth()
    editor = Editor(scene)
    editor.delete(selected(scene, BALL))
    return editor


@pytest.mark.slow
def test_a_fill_is_a_part_of_what_it_continues_by_place_and_color(without_ball):
    segments, gaussians = without_ball.scene.field.segments, without_ball.scene.gaussians
    fill = segments.added
    assert int(fill.sum()) > 100
    assert set(segments.labels[fill].tolist()) == {TABLE, SHEET}
    red = gaussians.sh0[:, 0, 0] > gaussians.sh0[:, 0, 2] + (0.5 / 0.2820948)
    clear = fill & ((gaussians.means[:, 0] - EDGE).abs() > 0.05)
    agree = (segments.labels == SHEET) == red
    assert float(agree[clear].float().mean()) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("extend", [whole_things, with_remains])
def test_an_edit_takes_a_fill_with_its_own_surface_and_no_other(without_ball, extend):
    scene = without_ball.scene
    segments = scene.field.segments
    for segment in (SHEET, TABLE):
        taken = extend(selected(scene, segment), scene.hidden, segments).mask
        assert torch.equal(taken[segments.added], segments.labels[segments.added] == segment)


def test_hidden_gaussians_that_are_no_fill_are_taken_as_before(without_ball):
    scene = without_ball.scene
    segments = replace(scene.field.segments, added=None)
    cloth = selected(scene, SHEET)
    taken = with_remains(cloth, scene.hidden, segments).mask
    known = with_remains(cloth, scene.hidden, scene.field.segments).mask
    assert int(taken.sum()) > int(known.sum()), "of fills alone it is known what they are"


@pytest.mark.slow
def test_recoloring_the_cloth_leaves_the_wood_where_a_bear_stood():
    editor = Editor(open_scene("demo", device="cpu"))
    editor.delete(editor.scene.select("teddy bear"))
    before = editor.scene
    fill = before.field.segments.added
    wood = fill & (before.gaussians.means[:, 1] > 0.45)  # the cloth ends at 0.34
    assert int(wood.sum()) > 500
    cloth = editor.planned_mask("recolor", before.select("tablecloth"))
    assert int((cloth & wood).sum()) < 0.08 * int(wood.sum()), "only what lies next to the cloth"
    table = editor.planned_mask("recolor", before.select("table"))
    assert int((table & wood).sum()) > 0.9 * int(wood.sum())
