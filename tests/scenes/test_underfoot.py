"""Segments of a thing that are the surface it stands on."""

import numpy as np
import pytest
import torch

from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.queries.selection import Selection
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.scene import open_scene
from lexsplat.scenes.underfoot import Ground, underfoot

UNKNOWN = np.zeros(3, bool)
"""No segment that the table's name describes clearly better than the ring's."""
WOOD, GOLD, WHITE = (0.62, 0.37, 0.23), (0.7, 0.45, 0.02), (0.95, 0.95, 0.95)


def ring_on_a_table(inside=WOOD, height=0.0, tube=0.07, table=2000):
    """A ring on a table, whose mask also has what lies within it; the segments are table 0, ring 1 and inside 2."""
    rng = np.random.default_rng(0)
    top = np.c_[rng.uniform(-1, 1, (table, 2)), rng.normal(0, 0.004, table)]
    top = top[np.linalg.norm(top[:, :2], axis=1) > 0.14]
    angle, turn = rng.uniform(0, 2 * np.pi, (2, 400))
    radius = 0.24 + tube * np.cos(turn)
    ring = np.c_[radius * np.cos(angle), radius * np.sin(angle), tube * (1 + np.sin(turn))]
    hole = np.c_[rng.uniform(-0.09, 0.09, (60, 2)), height + rng.normal(0, 0.004, 60)]
    points = np.concatenate([top, ring, hole])
    labels = np.repeat([0, 1, 2], [len(top), len(ring), len(hole)])
    colors = np.array([WOOD, GOLD, inside])[labels] + rng.normal(0, 0.02, points.shape)
    gaussians = gaussians_from_points(points, colors.clip(0, 1), sh_degree=0, opacity=0.9)
    labels = torch.from_numpy(labels)
    thing = Selection(gaussians, {}, labels > 0, torch.ones(len(points)))
    ground = Ground(gaussians, labels == 0, thing.up.direction)
    return thing, ground.around(thing), labels


@pytest.mark.parametrize("tube", [0.05, 0.07, 0.1])
def test_the_wood_within_a_ring_is_the_table(tube):
    thing, table, labels = ring_on_a_table(tube=tube)
    found = underfoot(thing, table, labels, UNKNOWN)
    assert torch.equal(found, (labels == 2).nonzero()[:, 0])


@pytest.mark.parametrize(
    "other",
    [{"inside": WHITE}, {"height": 0.08}, {"tube": 0.002}, {"table": 20}],
    ids=["a white coin", "wood above the table", "a sheet on the table", "hardly any table"],
)
def test_what_is_not_like_the_surface_in_color_and_height_stays(other):
    assert not len(underfoot(*ring_on_a_table(**other), UNKNOWN))


@pytest.mark.parametrize(("height", "goes"), [(0.0, True), (0.08, False)])
def test_what_is_called_the_table_goes_back_to_it_in_any_color_if_it_is_level(height, goes):
    thing, table, labels = ring_on_a_table(inside=WHITE, height=height)
    found = underfoot(thing, table, labels, np.array([False, False, True]))
    assert torch.equal(found, (labels == 2).nonzero()[:, 0] if goes else found[:0])


def test_recoloring_the_ring_leaves_the_wood_and_the_cloth_within_it_alone():
    scene = open_scene("demo", device="cpu")
    editor = Editor(scene)
    editor.recolor(scene.select("gold ring"), "blue")
    means = scene.gaussians.means
    within = ((means[:, :2] - torch.tensor([1.0, -0.8])).norm(dim=1) < 0.13) & (means[:, 2].abs() < 0.02)
    within &= ~scene.hidden
    changed = (editor.scene.gaussians.sh0 != scene.gaussians.sh0).flatten(1).any(1)
    assert int(within.sum()) > 30
    assert float(changed[within].float().mean()) < 0.15
    assert int(changed.sum()) > 800
