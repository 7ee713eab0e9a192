"""Scene folders of format version 1 that were written before the renames (at commit d4e65b3) open and answer."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from support.command_line import fails_in_one_line

from lexsplat import cli, open_scene
from lexsplat.queries.selection import Selection
from lexsplat.runtime.files import read_tensors
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.facts import NO_SEGMENTS, scene_facts
from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder
from lexsplat.scenes.records import read_record

OLD = Path(__file__).parents[1] / "data" / "scene_d4e65b3"
METHODS = ("averaged", "lifted", "trained")


@pytest.mark.parametrize("method", METHODS)
def test_an_old_folder_opens_with_the_current_names(method):
    scene = open_scene(OLD / method, device="cpu")
    record = scene.folder.record
    assert scene.field.method == method
    assert len(scene.gaussians) == len(scene.field.uncertainties) == 400
    assert "language" in record["stages"]
    assert "embed" not in record["stages"]
    assert (scene.clip, record["config"]["dino"]) == ("bundled", "bundled")
    assert {"averaged", "trained", "lifted"} <= record["config"].keys()
    assert record["config"]["trained"]["normalize_rendering"] is False
    assert "meters_per_unit" in record["world"]
    assert scene_facts(scene.folder)["method"] == method
    assert '"embedd' not in json.dumps(record)


@pytest.mark.parametrize("method", METHODS)
def test_an_old_folder_answers(method, tmp_path):
    # A copy: embeddings of texts are cached in the folder.
    scene = open_scene(shutil.copytree(OLD / method, tmp_path / "scene"), device="cpu")
    answers = scene.ask(["red apple", "blue ball"])
    assert answers.scores.shape == (2, 400)
    assert bool(((answers.scores >= 0) & (answers.scores <= 1)).all())
    assert float(answers.scores.max()) > float(answers.scores.median()) > 0
    assert scene.relevancy("red apple", next(iter(scene.views))).shape[0] == 1


@pytest.mark.slow
def test_an_old_folder_says_how_to_get_segments(tmp_path, capsys):
    folder = str(shutil.copytree(OLD / "averaged", tmp_path / "scene"))
    assert cli.main(["info", folder]) == 0
    assert f"segments         none: {NO_SEGMENTS}" in capsys.readouterr().out
    for command in (["query", folder, "red apple", "--no-images"], ["find", folder, "red apple"]):
        assert cli.main(command) == 0
        assert capsys.readouterr().out.endswith(f"in this scene\nno segments: {NO_SEGMENTS}\n")
        assert cli.main([*command, "--json"]) == 0
        json.loads(capsys.readouterr().out)
    assert cli.main(["edit", folder, "delete", "--select", "red apple", "--yes"]) == 0
    assert f"note: borders of things may stay behind, no segments: {NO_SEGMENTS}\n" in capsys.readouterr().err
    assert cli.main(["edit", folder, "discard", "--yes"]) == 0
    assert cli.main(["query", folder, "red apple", "--no-images", "--form", "code"]) == 0
    assert "no segments" not in capsys.readouterr().out, "asked for"
    assert cli.main(["find", "demo", "red apple"]) == 0
    assert "no segments" not in capsys.readouterr().out


def test_a_scale_stored_in_the_old_spelling_is_kept(tmp_path):
    folder = shutil.copytree(OLD / "averaged", tmp_path / "scene")
    record = json.loads((folder / "scene.json").read_text())
    record["world"]["metres_per_unit"] = 0.25
    (folder / "scene.json").write_text(json.dumps(record))
    assert open_scene(folder, device="cpu").world.meters_per_unit == 0.25


def test_reading_an_old_folder_does_not_write_it(tmp_path):
    folder = shutil.copytree(OLD / "averaged", tmp_path / "scene")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    open_scene(folder, device="cpu")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_saved_record_has_the_current_names(tmp_path):
    folder = SceneFolder(Path(shutil.copytree(OLD / "trained", tmp_path / "scene")))
    folder.save()
    written = (folder.root / "scene.json").read_text()
    for word in ('"embed"', '"embedded"', "normalise", "neighbours", "metres", '"embedding"', '"averaging"'):
        assert word not in written


def test_facts_about_poses_are_renamed():
    poses = {"fingerprint": "f", "placed": 5, "left_out": ["placed.jpg"]}
    record = read_record({"format_version": 1, "stages": {"poses": poses}}, Path("scene.json"))
    assert record["stages"]["poses"] == {
        "fingerprint": "f", "registered": 5, "unregistered": ["placed.jpg"],
    }  # fmt: skip


def test_a_normalized_rendering_of_an_old_trained_field_stays_normalized():
    from lexsplat.language.fields import TrainedField

    field = open_scene(OLD / "trained", device="cpu").field
    metadata = {"method": "trained", "normalise_rendering": "true"}
    assert TrainedField.from_tensors(field.tensors(), metadata).normalize_rendering
    assert not field.normalize_rendering


def test_an_old_journal_is_replayed(tmp_path):
    scene = open_scene(OLD / "averaged", device="cpu")
    mask = torch.arange(400) < 50
    journal = tmp_path / "edits.jsonl"
    editor = Editor(scene, journal)
    editor.recolor(Selection(scene.gaussians, scene.cameras, mask, mask.float()), (0.1, 0.2, 0.9))
    journal.write_text(journal.read_text().replace('"recolor"', '"recolour"'))
    again = Editor(scene, journal)
    assert torch.equal(again.scene.gaussians.sh0, editor.scene.gaussians.sh0)
    assert [step.kind for step in again.steps] == ["recolor"]


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("masses", torch.zeros(39998).half(), "masses must be finite, and some of them positive"),
        ("labels", torch.zeros(39998), "segments.labels must be integers"),
        ("levels", torch.tensor([[0, 0, 1], [0, 1, 1]]), "levels must be nested"),
    ],
)
def test_segments_made_by_hand_without_a_checksum_are_refused_in_one_line(
    tmp_path, capsys, name, value, told
):
    scene = shutil.copytree(BUNDLED_SCENE, tmp_path / "scene")
    tensors, metadata = read_tensors(scene / "language.safetensors")
    earlier = {
        "labels": torch.zeros(39998, dtype=torch.uint16),
        "masses": torch.ones(39998).half(),
        "levels": torch.zeros(1, 3, dtype=torch.int32),
    }
    by_hand = {key: tensor for key, tensor in tensors.items() if not key.startswith("segments.")}
    by_hand |= {f"segments.{key}": tensor for key, tensor in (earlier | {name: value}).items()}
    save_file(by_hand, scene / "language.safetensors", metadata)
    fails_in_one_line(capsys, ["list", str(scene)], "language.safetensors", told)
