"""Edits by the name of their action, as the command line, the viewer and language models ask for them."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.language_scene import make_scene

from lexsplat.language.fields import CodeField
from lexsplat.queries.selection import Selection
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.editing import Editor, Motion
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.views import StoredView


@pytest.fixture(scope="module")
def balls_to_edit() -> Scene:
    made = make_scene(per_ball=30)
    codes = torch.from_numpy(made.labels.astype(np.uint8))[:, None]
    field = CodeField(made.codebook, codes, torch.ones(150, 1), torch.zeros(150))
    views = {name: StoredView(name, camera, "train") for name, camera in made.cameras.items()}
    return Scene(made.gaussians, field, views, "bundled")


def first(scene: Scene, count: int) -> Selection:
    """The first Gaussians of a scene."""
    mask = torch.arange(len(scene.gaussians)) < count
    return Selection(scene.gaussians, scene.cameras, mask, mask.float(), phrase="things")


TURNED = Motion(rotation=Rotation.from_euler("x", 20, degrees=True).as_matrix())
STEPS = {
    "delete": lambda editor, chosen: editor.delete(chosen, fill=False),
    "keep": lambda editor, chosen: editor.keep(chosen),
    "recolor": lambda editor, chosen: editor.recolor(chosen, (1, 0, 0), 0.5),
    "move": lambda editor, chosen: editor.move(chosen, TURNED, fill=False),
    "duplicate": lambda editor, chosen: editor.duplicate(chosen, TURNED),
}


@pytest.mark.parametrize("action", STEPS)
def test_an_action_by_its_name_is_that_of_the_method(balls_to_edit, action):
    named, called = Editor(balls_to_edit), Editor(balls_to_edit)
    named.change(action, first(balls_to_edit, 30), motion=TURNED, color=(1, 0, 0), strength=0.5, fill=False)
    STEPS[action](called, first(balls_to_edit, 30))
    tensors = called.scene.gaussians.tensors()
    assert all(torch.equal(tensors[name], value) for name, value in named.scene.gaussians.tensors().items())
    assert [str(step) for step in named.steps] == [str(step) for step in called.steps]


@pytest.mark.parametrize(
    ("action", "count", "left"), [("delete", 150, 0), ("delete", 149, 1), ("keep", 1, 1)]
)
def test_no_edit_leaves_a_scene_that_no_page_draws(balls_to_edit, tmp_path, action, count, left):
    editor = Editor(balls_to_edit, tmp_path / "edits.jsonl")
    told = f"{action}: expected at least 2 Gaussians after the edit, found {left}; select "
    with pytest.raises(QueryError, match=told):
        editor.change(action, first(balls_to_edit, count), fill=False)
    assert (len(editor.scene.gaussians), editor.steps) == (150, [])
    assert not (tmp_path / "edits.jsonl").exists()
    editor.change("keep", first(balls_to_edit, 2))
    assert len(editor.scene.gaussians) == 2


def test_a_turn_is_about_the_up_direction_of_the_selection_after_the_rotation(balls_to_edit):
    chosen = first(balls_to_edit, 30)
    tilt = Rotation.from_euler("x", 20, degrees=True)
    values = Motion(rotation=tilt.as_matrix(), turn=90).values(chosen)
    about_up = Rotation.from_rotvec(np.radians(90) * chosen.up.direction)
    assert np.array(values["rotation"]) == pytest.approx((about_up * tilt).as_matrix())


@pytest.mark.parametrize(
    ("action", "values", "told"),
    [
        ("paint", {}, "action: expected delete, keep, recolor, move, duplicate, found paint"),
        ("recolor", {"color": (2, 0, 0)}, "Gaussians that can be drawn after the edit, found a color"),
        ("recolor", {}, "recolor: expected Gaussians that can be drawn"),
        ("move", {"motion": Motion(scale=-1.0)}, "move: expected Gaussians that can be drawn"),
        ("duplicate", {"motion": Motion(scale=1e300)}, "duplicate: expected Gaussians that can be drawn"),
    ],
)  # fmt: skip
def test_values_without_meaning_are_refused_in_one_line(balls_to_edit, action, values, told):
    editor = Editor(balls_to_edit)
    with pytest.raises(QueryError, match=told):
        editor.change(action, first(balls_to_edit, 30), **values)
    assert not editor.steps


def test_the_command_line_the_viewer_and_language_models_edit_by_name():
    from lexsplat.cli import edit
    from lexsplat.mcp import writing
    from lexsplat.viewer import session

    for module in (edit, writing, session):
        text = inspect.getsource(module)
        assert text.count("editor.change(") == 1, module.__name__
        assert not [action for action in STEPS if f"editor.{action}(" in text], module.__name__
