"""The finished scene that ships: small, whole, answers at once, and is never written to."""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.encoder_folders import write_clip

from lexsplat import cli, open_scene
from lexsplat.captures.images.reading import read_mask
from lexsplat.evaluation.demo import demo_capture
from lexsplat.features.encoders import load_clip
from lexsplat.features.hub import BUNDLED_ENCODERS
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import ModelError, SceneFolderError
from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder
from lexsplat.scenes.records import read_record
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.serving import OpenScene
from lexsplat.scenes.words import Word, of_part, things_with_parts


@pytest.fixture(scope="module")
def demo() -> Scene:
    return open_scene("demo", device="cpu")


def test_its_record_has_the_present_names():
    path = BUNDLED_SCENE / "scene.json"
    assert read_record(json.loads(path.read_text()), path) == json.loads(path.read_text())


def test_weights_sum_to_one_or_to_zero_where_no_photo_shows_a_gaussian(demo):
    sums = demo.field.weights.sum(1)
    unseen = sums == 0
    assert int(unseen.sum()) == demo.field.unseen > 0
    assert torch.allclose(sums[~unseen], torch.ones(1), atol=1e-3)


def snapshot() -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in BUNDLED_SCENE.rglob("*")}


def test_it_takes_at_most_six_and_a_half_megabytes_on_disk():
    assert sum(path.stat().st_size for path in BUNDLED_SCENE.rglob("*")) <= 6_500_000


def test_it_contains_no_information_about_the_build_machine():
    text = (BUNDLED_SCENE / "scene.json").read_text()
    assert not re.search(r'"/[a-z]', text)
    assert json.loads(text)["capture"] is None


def test_its_language_uses_the_bundled_encoder(demo):
    assert demo.folder.record["stages"]["features"]["clip_hash"] == load_clip("bundled").content_hash


def test_the_earlier_name_of_the_bundled_encoder_means_it_everywhere():
    assert open_scene("demo", clip="embedded").clip == "bundled"
    assert BuildConfig(clip="embedded", dino="embedded").clip == "bundled"


@pytest.mark.slow
def test_an_encoder_that_is_given_is_checked_when_the_scene_is_opened_wherever_it_lies(tmp_path):
    moved = shutil.copytree(BUNDLED_ENCODERS / "clip", tmp_path / "moved")
    assert open_scene("demo", clip=str(moved)).ask("red apple").presences == ("yes",)
    copied = shutil.copytree(BUNDLED_SCENE, tmp_path / "scene")
    record = json.loads((copied / "scene.json").read_text())
    record["config"]["clip"] = str(moved)  # the same encoder under another name
    (copied / "scene.json").write_text(json.dumps(record))
    assert [each.phrase for each in open_scene(copied).objects] == [
        each.phrase for each in open_scene("demo").objects
    ]
    with pytest.raises(ModelError, match="expected the encoder that the scene was built with, found another"):
        open_scene("demo", clip=str(write_clip(tmp_path / "other")))
    with pytest.raises(ModelError, match="found no such folder"):
        open_scene("demo", clip=str(tmp_path / "nowhere"))


@pytest.mark.parametrize(
    ("part", "thing"), [("mug handle", "mug"), ("bear nose", "bear"), ("car wheels", "car")]
)
def test_a_part_lies_within_its_thing_and_is_the_smaller_share_of_it(demo, part, thing):
    inside, whole = (demo.ask(phrase).chosen(0) for phrase in (part, thing))
    assert demo.ask(part).presences == ("yes",)
    assert 0 < int(inside.sum()) < 0.5 * int(whole.sum())
    assert int((inside & ~whole).sum()) <= 0.1 * int(inside.sum())


@pytest.mark.parametrize(
    ("alone", "whole"),
    [("handle", "mug handle"), ("nose", "teddy bear nose"), ("wheel", "toy car wheel")],
)
def test_a_part_without_its_thing_is_that_of_the_object_that_has_it(demo, alone, whole):
    found, named = demo.ask(alone), demo.ask(whole)
    assert found.presences[0] != "no"
    assert torch.equal(found.scores, named.scores)
    thing = whole.removesuffix(f" {alone}")
    assert demo.find(alone).note == f"the {alone} of the {thing}"
    assert torch.equal(demo.find(alone).mask, demo.find(whole).mask)
    assert torch.equal(demo.ask(f"the {alone}").scores, found.scores)


def test_the_first_question_about_a_part_searches_no_neighbors_in_a_warm_process():
    served = OpenScene("demo")
    served.warm()
    scene, things = served.scene, things_with_parts(served.scene)
    assert {"mug", "teddy bear", "toy car"} < set(things)
    assert not {"table", "wall", "floor"} & set(things)
    known = len(scene.graphs)
    assert known >= len(things)
    assert scene.ask(["mug handle", "bear nose", "car wheels"]).presences == ("yes", "yes", "yes")
    assert len(scene.graphs) == known


def test_a_part_that_several_objects_have_is_that_of_each(demo):
    apple, pumpkin = (
        next(each for each in demo.objects if each.phrase == name) for name in ("apple", "pumpkin")
    )
    scores = 0.4 + 0.5 * (apple.mask | pumpkin.mask).float()
    found = of_part(demo, "stalk", Word(scores, scores, "unsure"))
    assert torch.equal(found.scores, demo.ask(["apple stalk", "pumpkin stalk"]).scores.amax(0))
    assert found.note == "the stalk of the apple and the pumpkin"
    absent = Word(scores, scores, "no")
    assert of_part(demo, "stalk", absent) is absent


def test_objects_that_certainly_have_a_part_are_preferred_to_those_that_may_have_it(demo):
    mug, car = (next(each for each in demo.objects if each.phrase == name) for name in ("mug", "toy car"))
    scores = 0.4 + 0.5 * (mug.mask | car.mask).float()
    handles = demo.ask(["mug handle", "toy car handle"])
    assert handles.presences[0] == "yes"
    assert handles.presences[1] != "yes"
    found = of_part(demo, "handle", Word(scores, scores, "yes"))
    assert found.presence == "yes"
    assert torch.equal(found.scores, handles.scores[0])
    unlikely = of_part(demo, "wheel", Word(*[0.4 + 0.5 * mug.mask.float()] * 2, "yes"))
    assert unlikely.presence == "unsure"
    assert unlikely.note == "the wheel of the mug"


@pytest.mark.parametrize(
    ("part", "present"),
    [
        *((part, "yes") for part in ("mug handle", "bear nose", "duck beak", "lamp shade", "bear ears")),
        *((part, "yes") for part in ("car wheels", "bottle cork", "pumpkin stem", "pumpkin stalk")),
        *((part, "unsure") for part in ("bear eye", "duck nose", "mug wheel", "car roof", "bottle neck")),
    ],
)
def test_a_part_that_is_another_one_by_its_name_is_not_certain(demo, part, present):
    answer = demo.ask(part)
    assert answer.presences == (present,)
    assert answer.note(0) == ("" if present == "yes" else "names of other parts fit this place better")


@pytest.mark.parametrize(
    ("phrase", "present"),
    [
        ("brown teddy bear", "yes"),
        ("blue teddy bear", "unsure"),  # language says yes
        ("red apple", "yes"),
        ("yellow apple", "unsure"),  # the banana
        ("white vase", "yes"),
        ("green vase", "unsure"),  # the bottle
        ("gray vase", "yes"),  # white in shade
    ],
)
def test_a_thing_is_certainly_in_a_color_only_if_its_pixels_are(demo, phrase, present):
    assert demo.ask(phrase).presences == (present,)


def test_single_gaussians_and_the_form_of_the_paper_cut_no_parts(demo):
    alone = open_scene("demo", device="cpu")
    alone.query = replace(alone.query, form="code")
    for part in ("mug handle", "handle"):
        answer = alone.ask(part)
        assert torch.equal(answer.scores[0], answer.words[0].own)


@pytest.mark.parametrize("prompt", ["red apple", "blue mug", "rubber duck", "pumpkin"])
def test_relevancy_agrees_with_the_exact_mask(demo, prompt):
    found = []
    for folder in sorted((demo_capture() / "segmentations").iterdir())[::4]:
        mask = read_mask(folder / f"{prompt.replace(' ', '_')}.png")
        relevancy = demo.relevancy([prompt], folder.name)[0]
        y, x = np.unravel_index(int(torch.argmax(relevancy)), relevancy.shape)
        scale = mask.shape[0] / relevancy.shape[0]
        found.append(bool(mask[int((y + 0.5) * scale), int((x + 0.5) * scale)]))
    assert found
    assert all(found)


@pytest.mark.slow
def test_the_command_line_writes_to_the_working_folder_and_not_to_the_package(tmp_path, monkeypatch, capsys):
    before = snapshot()
    monkeypatch.chdir(tmp_path)
    assert cli.main(["query", "demo", "red apple", "red mug"]) == 0
    apple, mug, *_, last = capsys.readouterr().out.splitlines()
    assert "probably not" not in apple
    assert mug.endswith("probably not in this scene")  # the mug is blue
    assert "demo_heatmaps" in last
    assert list((tmp_path / "demo_heatmaps").rglob("*.png"))
    assert cli.main(["evaluate", "demo"]) == 1
    assert "lexsplat demo" in capsys.readouterr().err
    assert cli.main(["info", "demo"]) == 0
    assert "None" not in capsys.readouterr().out
    assert snapshot() == before


def test_a_scene_named_demo_takes_precedence_and_another_folder_does_not(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkdir("demo")
    assert SceneFolder.open("demo").is_bundled
    shutil.copy(BUNDLED_SCENE / "scene.json", "demo")
    assert not SceneFolder.open("demo").is_bundled


def test_a_missing_language_file_is_reported_by_its_name(tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(BUNDLED_SCENE, folder)
    (folder / "language.safetensors").unlink()
    with pytest.raises(SceneFolderError, match=r"found no language\.safetensors") as told:
        open_scene(folder)
    assert "finished stages" not in str(told.value)


@pytest.mark.parametrize("kind", ["toy", "animal", "fruit"])
def test_the_mask_of_a_kind_holds_each_of_its_members(demo, kind):
    mask = demo.relevancy(kind, "view_036")[0] >= 0.5
    for each in demo.find(kind).instances:
        own = demo.relevancy(each.phrase, "view_036")[0] >= 0.5
        assert int((mask & own).sum()) > 0.8 * int(own.sum()), each.phrase
