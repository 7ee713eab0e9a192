"""A scene answers prompts once, the same way everywhere, and refuses what it cannot answer."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.viewer_scene import BallScene, ball_scene

import lexsplat
from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import look_at
from lexsplat.language.segments import Segments
from lexsplat.queries import thresholds as threshold_rule
from lexsplat.queries.everyday import EverydayScale
from lexsplat.queries.picking import surface_at
from lexsplat.queries.relevancy import QueryConfig, gaussian_relevancy, render_relevancy
from lexsplat.runtime.errors import QueryError, SceneFolderError
from lexsplat.scenes import answers as answers_module
from lexsplat.scenes.answers import default_views, find_phrases
from lexsplat.scenes.exporting import export_gaussians, export_scene
from lexsplat.scenes.folder import BUNDLED_SCENE
from lexsplat.scenes.scene import open_scene
from lexsplat.scenes.views import StoredView

BALLS = ["ball 0", "ball 1", "ball 2"]


@pytest.fixture
def scene_with_facts():
    """A scene of five balls, "ball 0" to "ball 4", and what is known about it."""
    return ball_scene(per_ball=80)


@pytest.fixture
def scene(scene_with_facts) -> BallScene:
    return scene_with_facts[0]


def test_answers_contain_scores_thresholds_and_presences(scene):
    answers = scene.ask(BALLS)
    question = scene.question(BALLS)
    assert question.scale is not None
    assert torch.equal(answers.scores, gaussian_relevancy(scene.field, question))
    assert answers.thresholds.tolist() == [0.5] * 3
    assert answers.presences == scene.presence_classifier.classify(
        answers.prompts, question.positives, answers.scores
    )
    assert answers.prompts == tuple(BALLS)
    assert len(answers) == 3


def test_relevancy_over_given_negatives_has_its_threshold_from_training_views(scene):
    scene.query = QueryConfig(negatives=("object", "stuff"))
    answers, question = scene.ask(BALLS), scene.question(BALLS)
    assert question.scale is None
    training = [view.camera for view in scene.views.values() if view.split == "train"]
    expected = threshold_rule.scene_thresholds(
        lambda camera: render_relevancy(scene.field, scene.gaussians, camera, question),
        training,
        answers.presences,
    )
    torch.testing.assert_close(answers.thresholds, expected)


def test_threshold_and_presence_are_the_same_everywhere(scene):
    answers = scene.ask(BALLS)
    for index, prompt in enumerate(BALLS):
        limit = pytest.approx(float(answers.thresholds[index]))
        assert float(scene.thresholds(prompt)[0]) == limit
        for found in (scene.select(prompt), scene.find(prompt), answers.selection(index)):
            assert (found.threshold, found.present) == (limit, answers.presences[index])
            assert torch.equal(found.mask, answers.selection(index).mask)
        (entry,) = find_phrases(scene, prompt)["phrases"]
        assert entry["threshold"] == pytest.approx(float(answers.thresholds[index]), abs=1e-4)
        assert entry["present"] == answers.presences[index]


def test_the_requested_ball_is_selected(scene_with_facts):
    scene, ground_truth = scene_with_facts
    found = scene.find("ball 2")
    assert (found.count, len(found), found.num_gaussians) == (1, 80, 80)
    assert np.array_equal(found.mask.numpy(), ground_truth.labels == 2)
    both = scene.find("ball 0 and ball 1")
    assert both.count == 2


def test_a_known_prompt_renders_no_views_again(scene, monkeypatch):
    rendered = []
    original = answers_module.render_relevancy

    def render(field, gaussians, camera, question):
        rendered.append(len(question))
        return original(field, gaussians, camera, question)

    monkeypatch.setattr(answers_module, "render_relevancy", render)
    scene.query = replace(scene.query, negatives=("object", "things"))  # everyday words need no views
    training = sum(view.split == "train" for view in scene.views.values())
    first = scene.ask(["ball 0", "ball 1"])
    assert rendered == [2] * training
    again = scene.ask(["ball 1", "ball 2", "ball 0"])
    assert rendered == [2] * training + [1] * training
    assert float(again.thresholds[2]) == float(first.thresholds[0])
    scene.ask(BALLS, 0.3)
    scene.find("ball 0 nearest to ball 1")
    assert len(rendered) == 2 * training
    scene.query = replace(scene.query, temperature=20.0)
    scene.ask("ball 0")
    assert len(rendered) == 3 * training, "other settings, other thresholds"


def test_a_given_threshold_is_used_unchanged(scene):
    answers = scene.ask(BALLS, 0.25)
    assert answers.thresholds.tolist() == [0.25] * 3
    assert not answers.automatic
    assert scene.select("ball 1", 0.25).threshold == 0.25


def test_a_single_text_is_one_prompt(scene):
    view = next(iter(scene.views))
    assert scene.embed("ball 1").shape == (1, 32)
    assert scene.scores("ball 1").shape == (1, 400)
    assert scene.thresholds("ball 1").shape == (1,)
    assert scene.relevancy("ball 1", view).shape == (1, 72, 96)
    assert scene.ask("ball 1").prompts == ("ball 1",)


def test_a_view_is_named_with_or_without_suffix_or_given_as_a_camera(scene):
    stored = scene.views["view2"]
    expected = scene.relevancy(BALLS, "view2")
    for view in (stored, stored.camera, "view2.jpg"):
        assert torch.equal(scene.relevancy(BALLS, view), expected)
        assert scene.render(view).image.shape == (72, 96, 3)
        assert scene.find("ball 0 left of ball 1", view) is not None


def test_the_point_of_a_pixel_is_that_of_a_click_there_and_none_in_the_sky(scene):
    camera = scene.camera("view2")
    x, y = camera.project(scene.select("ball 0").center[None])[0][0]
    assert scene.point("view2", x, y) == pytest.approx(surface_at(scene.gaussians, camera, x, y).point)
    apart = min(
        np.linalg.norm(scene.point("view2.jpg", x, y) - thing.center) for thing in map(scene.select, BALLS)
    )
    assert apart < 1
    sky = look_at([0.0, -6.0, 6.0], [0.0, 0.0, 8.0], np.array([0.0, 0, 1]), 40, 30, 0.5)
    assert scene.point(sky, 20.0, 15.0) is None
    with pytest.raises(QueryError, match="outside"):
        scene.point("view2", -1.0, 0.0)


@pytest.mark.parametrize("wrong", ["nowhere", 3, None, ("view2",)])
def test_an_unknown_view_is_refused(scene, wrong):
    with pytest.raises(QueryError, match="view"):
        scene.relevancy("ball 0", wrong)
    with pytest.raises(QueryError, match="view"):
        scene.render(wrong)


@pytest.mark.parametrize("wrong", [-0.1, 2, float("nan"), float("inf"), "high"])
def test_a_threshold_outside_the_unit_interval_is_refused(scene, wrong):
    for ask in (scene.ask, scene.select):
        with pytest.raises(QueryError, match=r"threshold: expected a number in 0\.\.1"):
            ask("ball 0", wrong)
    with pytest.raises(QueryError, match="threshold"):
        scene.find("ball 0", threshold=wrong)


@pytest.mark.parametrize("wrong", [["ball 0"], 7, None, ""])
def test_a_selection_has_one_phrase(scene, wrong):
    for ask in (scene.select, scene.find):
        with pytest.raises(QueryError):
            ask(wrong)


@pytest.mark.parametrize("wrong", [[], "", ["ball 0", " "], [None], 5])
def test_invalid_prompts_are_refused(scene, wrong):
    for ask in (scene.ask, scene.scores, scene.embed):
        with pytest.raises(QueryError):
            ask(wrong)


def test_an_absent_object_has_no_instances_in_json(scene):
    scene.presence_classifier.classify = lambda phrases, texts, scores: ("no",) * len(scores)
    (entry,) = find_phrases(scene, "ball 0")["phrases"]
    assert (entry["present"], entry["count"], entry["instances"]) == ("no", 0, [])
    assert entry["threshold"] == 0.5
    assert scene.ask("ball 0").to_dict()["answers"][0]["count"] == 0


def test_representations_are_short(scene):
    assert repr(scene) == "Scene(gaussians=400, views=6, method='averaged')"
    assert repr(scene.ask(["ball 0"], 0.5)) == "Answers('ball 0': yes (threshold 0.5))"
    assert len(repr(scene.find("ball 0"))) < 100
    assert repr(scene.field.codebook) == "Codebook(5 codes, CLIP 32, DINO 8)"
    assert repr(Codebook(torch.eye(9))) == "Codebook(9 codes, CLIP 9, no DINO)"
    assert repr(scene.question(BALLS)) == "Question(3 prompts, form 'segment')"
    assert repr(EverydayScale(torch.ones(3), torch.ones(7), 0.25)) == "EverydayScale(7 codes, peak 0.25)"
    segments = Segments(
        torch.zeros(4, dtype=torch.int64), torch.ones(4), torch.zeros(2, 1, dtype=torch.int64)
    )
    assert repr(segments) == "Segments(4 Gaussians, 1 segments, 2 levels)"


def testdefault_views_are_evenly_spaced_held_out_views(scene):
    camera = scene.views["view0"].camera
    scene.views = {f"v{n:02}": StoredView(f"v{n:02}", camera, "test") for n in range(11)}
    assert default_views(scene) == ["v00", "v02", "v04", "v06", "v08", "v10"]


def test_an_export_replaces_a_file_only_with_overwrite(scene, tmp_path):
    file = tmp_path / "all.ply"
    file.write_bytes(b"of another program")
    for write in (lambda **options: export_scene(scene, file, **options),
                  lambda **options: export_gaussians(scene.gaussians, file, **options)):  # fmt: skip
        with pytest.raises(SceneFolderError, match="expected a new file, found one that exists"):
            write()
    assert file.read_bytes() == b"of another program"
    labels = tmp_path / "labels.json"
    labels.write_text("{}")
    with pytest.raises(SceneFolderError, match="expected a new file"):
        export_scene(scene, labels, found=[scene.find("ball 0")])
    assert export_scene(scene, file, overwrite=True) == [file]
    assert file.stat().st_size > 1000


def test_an_export_never_replaces_a_file_of_the_scene(tmp_path):
    opened = open_scene("demo", device="cpu")
    with pytest.raises(SceneFolderError, match="scene's own files"):
        export_scene(opened, BUNDLED_SCENE / "gaussians.ply", overwrite=True)


def test_a_folder_of_another_kind_is_refused_with_its_kind(tmp_path):
    with pytest.raises(SceneFolderError, match="found a file"):
        open_scene(BUNDLED_SCENE / "gaussians.ply")
    with pytest.raises(SceneFolderError, match="no such folder"):
        open_scene(tmp_path / "nowhere")
    with pytest.raises(SceneFolderError, match=r"no scene\.json"):
        open_scene(tmp_path)


@pytest.mark.parametrize("wrong", [5, None, ["demo"], b"demo"])
def test_a_folder_that_is_no_path_is_refused_in_one_line(wrong):
    with pytest.raises(SceneFolderError, match="expected a scene folder's path"):
        open_scene(wrong)


@pytest.mark.parametrize("wrong", [5, -4, 1.0, "ball 0", None])
def test_an_answer_of_another_number_is_refused_in_one_line(scene, wrong):
    with pytest.raises(QueryError, match="answer: expected a number from 0 to 2"):
        scene.ask(BALLS, 0.5).selection(wrong)


@pytest.mark.parametrize("wrong", ["x", -1, float("nan"), [1]])
def test_a_distance_that_is_none_is_refused_in_one_line(scene, wrong):
    found = scene.select("ball 0", 0.5)
    for change in (found.grow, found.shrink):
        with pytest.raises(QueryError, match="distance: expected a number from 0"):
            change(wrong)


def test_an_unknown_device_is_refused():
    for device in ("gpu", "cuda:1", "", "CPU"):
        with pytest.raises(ValueError, match="device must be auto, cpu or cuda"):
            open_scene("demo", device=device)


def test_the_package_exports_the_public_names():
    names = {"Library", "Scene", "Selection", "build", "open_library", "open_scene"}
    assert names <= set(dir(lexsplat))
    assert names <= set(lexsplat.__all__)
    assert all(callable(getattr(lexsplat, name)) for name in names)
    with pytest.raises(AttributeError):
        _ = lexsplat.nothing
