"""Answers as data: which instances an answer keeps, and what a query says about its views."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.viewer_scene import BallScene, ball_scene

from lexsplat.scenes.answers import Answers, answer_queries, file_name
from lexsplat.scenes.words import Word

PROMPTS = ["ball 0", "ball 3"]


@pytest.fixture(scope="module")
def scene() -> BallScene:
    return ball_scene(per_ball=80)[0]


@pytest.mark.parametrize(("automatic", "kept"), [(True, [0]), (False, [0, 1])])
def test_only_an_automatic_threshold_leaves_out_what_convinces_less(automatic, kept):
    scene, known = ball_scene(per_ball=80)
    labels = torch.from_numpy(known.labels)
    scores = torch.where(labels == 0, 0.9, torch.where(labels == 1, 0.55, 0.1))
    answers = Answers(("ball",), scores[None], torch.tensor([0.5]), ("yes",), scene, automatic=automatic)
    found = answers.selection(0)
    assert np.array_equal(found.mask.numpy(), np.isin(known.labels, kept))
    assert (found.threshold, found.phrase, found.present) == (0.5, "ball", "yes")
    assert answers.to_dict() == {"answers": [found.to_dict()]}


@pytest.mark.parametrize("score", [0.9, 0.1])
def test_a_selection_is_made_once_even_if_it_is_empty(scene, monkeypatch, score):
    scores = torch.full((len(scene.gaussians),), score)
    word = Word(scores, scores, "yes" if score > 0.5 else "no")
    answers = Answers(("ball",), scores[None], torch.tensor([0.5]), (word.presence,), scene, words=(word,))
    made, make = [], Answers._selection
    monkeypatch.setattr(Answers, "_selection", lambda self, index: made.append(index) or make(self, index))
    first = answers.selection(0)
    assert bool(first) == (score > 0.5)
    assert answers.selection(0) is first
    assert made == [0]


def test_a_query_states_the_peak_of_each_view_and_the_best_of_them(scene, tmp_path):
    views = list(scene.views)[:3]
    found = answer_queries(scene, PROMPTS, views, 0.4, tmp_path)
    assert (found["scene"], found["form"]) == (None, "code")  # no segments
    maps = {view: scene.relevancy(PROMPTS, view).numpy() for view in views}
    for number, answer in enumerate(found["prompts"]):
        peaks = {view: float(values[number].max()) for view, values in maps.items()}
        assert answer["peak_view"] == max(peaks, key=peaks.get)
        assert answer["peak"] == pytest.approx(max(peaks.values()))
        assert answer["threshold"] == 0.4
        for view, entry in answer["views"].items():
            values = maps[view][number]
            column, row = entry["peak_pixel"]
            assert values[row, column] == values.max()
            assert entry["peak"] == pytest.approx(peaks[view], abs=1e-4)
            assert entry["mask_share"] == pytest.approx((values >= 0.4).mean(), abs=1e-5)
            with Image.open(entry["mask"]) as mask:
                assert np.array_equal(np.asarray(mask) > 0, values >= 0.4)


def test_a_query_without_a_folder_has_the_same_numbers_and_no_images(scene, tmp_path):
    plain, drawn = (answer_queries(scene, PROMPTS, [], None, folder) for folder in (None, tmp_path))
    for left, right in zip(plain["prompts"], drawn["prompts"]):
        for view, entry in right["views"].items():
            assert left["views"][view] == {k: v for k, v in entry.items() if k not in ("heatmap", "mask")}


def test_prompts_that_differ_in_other_characters_alone_do_not_overwrite_the_images_of_each_other(
    scene, tmp_path
):
    prompts = ["ball 0", "ball/0", "ball 0", "Ball 0?"]
    answers = answer_queries(scene, prompts, ["view0"], 0.4, tmp_path)["prompts"]
    folders = [Path(answer["views"][answer["peak_view"]]["mask"]).parent.name for answer in answers]
    assert folders[0] == folders[2] == "ball_0"
    assert len({name.lower() for name in folders}) == 3
    assert folders == [file_name(prompt) for prompt in prompts]


@pytest.mark.parametrize(
    ("prompt", "name"),
    [("red apple", "red_apple"), ("Red Apple!", "red_apple_"), ("дом сад", "дом_сад"), ("дом / сад", "дом_сад_"),
     ("?!", "prompt_"), ("a" * 99, "a" * 80 + "_"), ("\ud800", "prompt_")],
)  # fmt: skip
def test_a_prompt_makes_a_file_name_in_any_alphabet_and_a_hash_where_that_is_not_all_of_it(prompt, name):
    found = file_name(prompt)
    assert found == name or (found.startswith(name) and len(found) == len(name) + 8 and name[-1] == "_")


def test_prompts_that_differ_have_files_that_differ():
    prompts = [
        "mug",
        "Mug",
        "Mug!",
        "mug?",
        "MUG",
        " mug",
        "red mug",
        "red_mug",
        "red  mug",
        "a" * 81,
        "a" * 82,
    ]
    names = [file_name(prompt) for prompt in prompts]
    assert len({name.lower() for name in names}) == len(prompts)
    assert names == [file_name(prompt) for prompt in prompts]
