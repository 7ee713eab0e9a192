"""Whose left it is: the views that show two things decide."""

import numpy as np
import pytest
import torch
from support.phrases import parse

from lexsplat.geometry.cameras import look_at
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.queries.answering import Searched, answer
from lexsplat.queries.selection import Selection

UP = [0.0, 0.0, 1.0]
NEAR, FAR = (-0.4, -0.5, 0.0), (0.0, 0.3, 0.0)
"""An apple, and a mug 63 degrees to the right of straight ahead of it."""


def around(*degrees, target=(0.0, 0.0, 0.0), distance=6.0):
    """Cameras that look at a place, by their azimuth from the front."""
    made = {}
    for angle in degrees:
        turn = np.radians(angle)
        place = np.array([np.sin(turn) * distance, -np.cos(turn) * distance, 2.0]) + target
        made[f"view_{angle:+04d}"] = look_at(place, target, UP, 64, 48, 0.8)
    return made


def asking(cameras, chosen=None, places=(NEAR, FAR)):
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(place, 0.05, (200, 3)) for place in places])
    gaussians = gaussians_from_points(points, np.full((400, 3), 0.5), sh_degree=0, opacity=0.8)
    words = {}
    for number, word in enumerate(("apple", "mug")):
        mask = torch.arange(400) // 200 == number
        words[word] = Selection(gaussians, cameras, mask, mask.float(), phrase=word)
    searched = Searched(words.__getitem__, lambda _: cameras.get(chosen))
    return lambda text: answer(parse(text), searched)


def test_most_views_decide_and_one_of_them_is_named():
    ask = asking(around(-60, 20, 30, 40))
    found = ask("is the apple left of the mug?")
    assert found.present == "yes"
    assert found.note in [f"as seen from view_{angle}" for angle in ("+020", "+030", "+040")]
    assert ask("is the apple right of the mug?").present == "no"
    assert ask("is the mug right of the apple?").present == "yes"
    assert ask("is the mug left of the apple?").present == "no"


def test_a_view_that_does_not_show_both_things_has_no_say():
    away = around(-60, -70, -80, target=(50.0, 0.0, 0.0))
    found = asking({**away, **around(30)})("is the apple left of the mug?")
    assert (found.present, found.note) == ("yes", "as seen from view_+030")


def test_the_view_that_is_asked_for_decides_alone_and_is_named():
    cameras = around(-60, 20, 30, 40)
    found = asking(cameras, "view_-060")("is the apple left of the mug?")
    assert (found.present, found.note) == ("no", "as seen from view_-060")


@pytest.mark.parametrize("start", [0, 10, 45, 170])
def test_views_all_around_agree_on_nothing_and_one_of_them_decides(start):
    """The one that decides for two things decides both ways round: never are both to the left of each other."""
    ask = asking(around(*range(start, start + 360, 30)))
    answers = {way: ask(f"is the {way}?") for way in ("apple left of the mug", "mug left of the apple")}
    assert [found.present for found in answers.values()].count("yes") <= 1
    assert all(found.note.startswith("as seen from view_") for found in answers.values())


def test_front_and_behind_are_decided_alike():
    ask = asking(around(-30, -20, 0, 80))
    assert ask("is the mug behind the apple?").present == "yes"
    assert ask("is the apple in front of the mug?").present == "yes"
    assert ask("is the mug in front of the apple?").present == "no"


def test_what_depends_on_gravity_alone_names_no_viewer():
    ask = asking(around(-60, 20, 30, 40))
    assert ask("is the apple on the mug?").note == ""


def test_a_scene_without_views_has_some_left():
    assert asking({})("is the apple left of the mug?").note == ""
