"""Before the first drawing of a machine, kernels are compiled with a bar."""

import pytest
from support.warm_starts import Program, Stage, run_warm

from lexsplat.rendering import first_drawing
from lexsplat.rendering.kernels import jit
from lexsplat.runtime.progress import Event

FIRST = """
import torch
from lexsplat.rendering.first_drawing import draw_a_little
with torch.no_grad():
    draw_a_little()
"""
DRAWING = """
import torch
from lexsplat.rendering import first_drawing
from lexsplat.rendering.kernels import jit
from lexsplat.scenes.answers import answer_queries
from lexsplat.scenes.scene import open_scene

def used():
    return {(kernel.__name__, signature) for kernel in jit._dispatchers for signature in kernel.signatures}

with torch.no_grad():
    first_drawing.draw_a_little()
before = used()
answer_queries(open_scene("demo", device="cpu"), ["red apple"], [], None, None)
print(len(before), sorted(used() - before))
"""


@pytest.mark.slow
def test_a_query_needs_no_kernel_that_was_not_compiled_before_it_and_the_bar_counts_them():
    # Kernels from the cache bring those that they call along, which then have no signature of their own.
    _, run = run_warm(Stage(["torch"], [[Program(FIRST)], [Program(DRAWING)]]))
    assert run.status == 0, run.err
    assert run.out.split(maxsplit=1) == [str(first_drawing.KERNELS), "[]\n"]


@pytest.fixture
def nothing_compiled(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(jit, "_cache_folder", lambda: str(tmp_path))


def test_the_bar_is_shown_once_and_ends(nothing_compiled):
    events: list[Event] = []
    for _ in range(2):
        first_drawing.compile_drawing("cpu", events.append)
    events, kernels = [event for event in events if event.stage == "kernels"], first_drawing.KERNELS
    assert events[0] == Event("kernels", 0, kernels)
    assert events[-1] == Event("kernels", kernels, kernels)
    assert [event.done for event in events].count(0) == 1


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_nothing_is_compiled_for_a_gpu_or_after_a_training(nothing_compiled, device):
    if device == "cpu":
        jit.marker_of("training").touch()
    events: list[Event] = []
    first_drawing.compile_drawing(device, events.append)
    assert [event for event in events if event.stage == "kernels"] == []
