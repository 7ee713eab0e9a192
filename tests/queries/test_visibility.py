"""Hidden Gaussians: a core inside a ball is hidden, and is taken with the ball."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.language_scene import make_scene

from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.language.segments import Segments
from lexsplat.queries.selection import Selection
from lexsplat.queries.visibility import hidden_gaussians, whole_things, with_remains
from lexsplat.rendering import accumulate_weights


@pytest.fixture(scope="module")
def ball():
    """A dense opaque shell of 400 Gaussians, 20 in its middle and 20 far away; views from all sides."""
    rng = np.random.default_rng(0)
    shell, core = rng.normal(size=(400, 3)), 0.05 * rng.normal(size=(20, 3))
    shell *= 0.4 / np.linalg.norm(shell, axis=1, keepdims=True)
    points = np.concatenate([shell, core, 0.05 * rng.normal(size=(20, 3)) + [0, 0, 1.0]])
    gaussians = gaussians_from_points(points, np.full_like(points, 0.5), sh_degree=0, opacity=0.95)
    gaussians = replace(gaussians, log_scales=torch.full_like(gaussians.log_scales, np.log(0.05)))
    cameras = list(make_scene(per_ball=1).cameras.values())
    masses = sum(accumulate_weights(gaussians, camera) for camera in cameras)
    return gaussians, cameras, masses


def test_what_no_view_shows_is_hidden_in_any_unit_of_the_masses(ball):
    gaussians, cameras, masses = ball
    for unit in (1.0, 0.01):
        hidden = hidden_gaussians(gaussians, cameras, unit * masses)
        assert hidden[400:420].all()
        assert not hidden[:400].float().mean() > 0.02
        assert not hidden[420:].float().mean() > 0.5, "they hide each other, but not all"


def test_without_views_nothing_is_known_to_be_hidden(ball):
    gaussians, _, masses = ball
    assert not hidden_gaussians(gaussians, [], masses).any()


def selected(gaussians, mask):
    return Selection(gaussians, {}, mask, mask.float())


def test_a_thing_is_taken_with_its_border_and_its_core_alone(ball):
    gaussians, cameras, masses = ball
    hidden = hidden_gaussians(gaussians, cameras, masses)
    labels = (torch.arange(440) >= 400).long() + (torch.arange(440) >= 420).long()
    segments = Segments(labels, masses, torch.tensor([[0, 1, 2]]))
    most = torch.arange(440) < 300  # the segment of the shell is selected for the most part
    whole = whole_things(selected(gaussians, most), hidden, segments).mask
    assert whole[:400].all()
    assert whole[400:420].all()
    assert not whole[420:].any()
    few = torch.arange(440) < 50
    assert not whole_things(selected(gaussians, few), torch.zeros_like(hidden), segments).mask[50:].any()


def test_a_scene_without_segments_keeps_the_selection(ball):
    gaussians, *_ = ball
    mask = torch.arange(440) < 300
    chosen = selected(gaussians, mask)
    assert whole_things(chosen, torch.zeros(440, dtype=torch.bool), None) is chosen


def test_hidden_gaussians_beside_a_thing_stay_but_do_not_remain_where_it_is_deleted(ball):
    gaussians, _, masses = ball
    hidden = torch.arange(440) >= 400  # the core, and what lies twice as far out as the shell
    labels = (torch.arange(440) >= 400).long()
    segments = Segments(labels, masses, torch.tensor([[0, 1]]))
    chosen = selected(gaussians, ~hidden)
    whole = whole_things(chosen, hidden, segments).mask
    assert torch.equal(whole, torch.arange(440) < 420), "the nearest Gaussians of all others are the thing's"
    assert with_remains(chosen, hidden, segments).mask.all()


def test_what_hides_in_a_thing_does_not_remain_whatever_lies_next_to_it(ball):
    gaussians, _, masses = ball
    segments = Segments((torch.arange(440) >= 400).long(), masses, torch.tensor([[0, 1]]))
    chosen, hidden = selected(gaussians, torch.arange(440) < 400), torch.arange(440) == 405
    assert not whole_things(chosen, hidden, segments).mask[405], "its neighbors are those of the core"
    assert with_remains(chosen, hidden, segments).mask[405]
