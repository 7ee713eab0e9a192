"""Arguments of the editor that have no meaning are refused by what they are, and nothing is edited."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.viewer_scene import BallScene, ball_scene

from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.editing import Editor, Motion


@pytest.fixture(scope="module")
def scene() -> BallScene:
    return ball_scene()[0]


@pytest.mark.parametrize("motion", [Motion(), Motion((0, 0, 0), np.eye(3), 1.0)])
def test_a_motion_that_moves_nothing_is_refused(scene, motion):
    editor = Editor(scene)
    for change in (editor.move, editor.duplicate):
        with pytest.raises(QueryError, match="motion: expected a translation, a rotation or a scale"):
            change(scene.select("ball 1"), motion)
    assert not editor.steps


@pytest.mark.parametrize("values", [{"translation": (1, 2)}, {"translation": 1.0}, {"rotation": np.eye(2)}])
def test_a_motion_of_a_wrong_shape_is_refused_where_it_is_made(values):
    with pytest.raises(ValueError, match=f"{next(iter(values))} must have the shape"):
        Motion(**values)


def test_what_is_no_selection_or_no_motion_is_a_type_error(scene):
    editor = Editor(scene)
    chosen = scene.select("ball 1")
    for wrong in (None, "mug"):
        for change in (editor.delete, editor.keep, lambda each: editor.move(each, Motion(scale=2.0))):
            with pytest.raises(TypeError, match="expected a Selection"):
                change(wrong)
        with pytest.raises(TypeError, match="expected a Selection"):
            chosen.distance_to(wrong)
    for change in (editor.move, editor.duplicate):
        with pytest.raises(TypeError, match="expected a Motion"):
            change(chosen, (1, 0, 0))


def test_a_color_may_have_a_name(scene):
    editor, by_name = Editor(scene), Editor(scene)
    editor.recolor(scene.select("ball 1"), (1, 0, 0))
    by_name.recolor(scene.select("ball 1"), "red")
    assert torch.equal(editor.scene.gaussians.sh0, by_name.scene.gaussians.sh0)
    with pytest.raises(ValueError, match="a name such as orange, found 'rde'"):
        by_name.recolor(scene.select("ball 1"), "rde")


def test_selections_of_two_scenes_have_no_distance_and_edit_only_their_own(scene):
    other = scene.with_content(replace(scene.gaussians, means=scene.gaussians.means + 1), scene.field)
    own, others = scene.select("ball 1"), other.select("ball 1")
    with pytest.raises(ValueError, match="different scenes"):
        own.distance_to(others)
    with pytest.raises(ValueError, match="of another scene, or was made before the last edit"):
        Editor(scene).delete(others)
