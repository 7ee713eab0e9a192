"""A process that is forked from one that has asked a scene answers as that one does."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
import torch
from support.forks import outcome

import lexsplat
from lexsplat.scenes.scene import Scene

Answers = tuple[int, float]


def answers(scene: Scene) -> Answers:
    relevancy = scene.relevancy(["apple"], next(iter(scene.views)))
    return scene.find("duck").num_gaussians, round(float(relevancy.mean()), 5)


def answers_alike(expected: Answers, opened: Callable[[], Scene]) -> str:
    """How a fork ends that asks a scene twice."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            scene = opened()
            scene.find("banana")
            status = 0 if answers(scene) == expected else 3
        finally:
            os._exit(status)
    return outcome(child, 300)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_process_answers_as_its_parent_does():
    """Whether it has the scene from its parent or opens it again."""
    torch.set_num_threads(2)
    scene = lexsplat.open_scene("demo", device="cpu")
    expected = answers(scene)
    assert answers_alike(expected, lambda: scene) == "finished"
    assert answers_alike(expected, lambda: lexsplat.open_scene("demo", device="cpu")) == "finished"
