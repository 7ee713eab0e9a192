"""``lexsplat build``: what it writes, what it keeps, what it makes anew, what it never replaces."""

import json
import os
import shlex
import shutil

import pytest
from support.command_line import fails_in_one_line, modified
from support.tiny_capture import QUICK_BUILD as QUICK

from lexsplat import cli, open_scene
from lexsplat.features import hub
from lexsplat.scenes.publishing import vocabulary


def test_build_writes_the_scene_folder_of_the_design(built):
    names = {p.name for p in built.iterdir()}
    assert {"scene.json", "cameras.json", "gaussians.ply", "language.safetensors"} <= names
    record = json.loads((built / "scene.json").read_text())
    assert list(record["stages"]) == ["reconstruct", "features", "language"]
    assert record["stages"]["language"]["codes"] == 16
    views = json.loads((built / "cameras.json").read_text())["views"]
    held_out = [v["name"] for v in views if v["split"] == "test"]
    assert held_out == ["view_02.png", "view_06.png", "view_10.png"], "views with masks are held out"
    assert not list((built / "checkpoints" / "features").glob("*.dino.*")), "averaged features need no DINO"


def test_a_method_that_uses_code_maps_writes_them(built_trained):
    record = json.loads((built_trained / "scene.json").read_text())
    assert set(record["stages"]) == {"reconstruct", "features", "codebook", "language"}
    assert list((built_trained / "checkpoints" / "features").glob("*.dino.*"))
    codes = {p.stem for p in (built_trained / "codes").iterdir()}
    assert codes.isdisjoint({"view_02", "view_06", "view_10"}), "held-out views take no part in the codebook"
    assert len(codes) == 9


def test_building_again_changes_no_result(built, tiny_capture):
    before = modified(built)
    assert cli.main(["build", str(tiny_capture), "--output", str(built), *QUICK]) == 0
    after = modified(built)
    # Texts that another test has asked may still wait to be written.
    changed = {name for name in before if after[name] != before[name] and "texts" not in name}
    assert changed <= {"scene.json", "cameras.json", ".lock"}


def test_the_commands_that_are_proposed_name_a_path_with_spaces_as_one_word(
    built, tiny_capture, tmp_path, capsys, monkeypatch
):
    # The command that is proposed does not depend on the phrases; thousands of them take most of the time.
    monkeypatch.setattr(vocabulary, "everyday_phrases", lambda bundled: {"apple": vocabulary.NAME})
    scene, page = str(tmp_path / "my scene"), str(tmp_path / "my page")
    shutil.copytree(built, scene)
    assert cli.main(["build", str(tiny_capture), "--output", scene, *QUICK]) == 0
    proposed = capsys.readouterr().out.splitlines()[-1]
    assert shlex.split(proposed) == ["next:", "lexsplat", "query", scene, "something you see"]
    assert cli.main(["publish", scene, page, "--words-only"]) == 0
    assert shlex.split(capsys.readouterr().out.splitlines()[-1])[-1] == page


def test_a_changed_setting_reruns_only_the_stages_that_depend_on_it(built, tiny_capture, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(built, copy)
    before = modified(copy)
    # Features are averaged: no other way to the language, nor how much is kept in memory, has a part in it.
    idle = ["--trained.no-use-smoothing", "--features.dino-stride", "9"]
    idle += ["--features.random-crops", "7", "--memory", "3GB"]
    assert cli.main(["build", str(tiny_capture), "--output", str(copy), *QUICK, *idle]) == 0
    after = modified(copy)
    assert {name for name in before if after[name] != before[name]} <= {"scene.json", "cameras.json", ".lock"}
    arguments = [*QUICK, "--averaged.top", "3"]
    assert cli.main(["build", str(tiny_capture), "--output", str(copy), *arguments]) == 0
    after = modified(copy)
    assert after["language.safetensors"] != before["language.safetensors"]
    for kept in before:
        if kept.startswith("checkpoints/features/") or kept == "gaussians.ply":
            assert after[kept] == before[kept], kept


def test_other_bundled_encoders_make_new_features(built, tiny_capture, tmp_path, monkeypatch, capsys):
    # As after an update of lexsplat: the scene was built with the encoders of the version before.
    copy, encoders = tmp_path / "copy", tmp_path / "encoders"
    shutil.copytree(built, copy)
    shutil.copytree(hub.BUNDLED_ENCODERS, encoders)
    monkeypatch.setattr(hub, "BUNDLED_ENCODERS", encoders)
    config = json.loads((encoders / "clip" / "config.json").read_text())
    (encoders / "clip" / "config.json").write_text(json.dumps(config | {"logit_scale_init_value": 2.5}))
    before = modified(copy)
    assert cli.main(["build", str(tiny_capture), "--output", str(copy), *QUICK]) == 0
    after = modified(copy)
    assert after["language.safetensors"] != before["language.safetensors"]
    assert after["gaussians.ply"] == before["gaussians.ply"]
    assert cli.main(["query", str(copy), "red ball", "--json"]) == 0


def test_a_trained_language_makes_a_scene_that_answers(built_trained):
    scene = open_scene(built_trained, device="cpu")
    assert scene.field.method == "trained"
    relevancy = scene.relevancy(["red apple"], "view_02")
    assert relevancy.shape == (1, 72, 96)
    assert float(relevancy.max()) > float(relevancy.min())


@pytest.mark.parametrize("name", ["gaussians.ply", "cameras.json"])
def test_a_build_never_replaces_files_of_another_program(tiny_capture, tmp_path, capsys, name):
    """The folder of a 3DGS training has a cameras.json, too."""
    output = tmp_path / "output"
    output.mkdir()
    (output / name).write_text("mine")
    arguments = ["build", str(tiny_capture), "--output", str(output), *QUICK]
    fails_in_one_line(capsys, arguments, name, "another --output")
    assert [path.name for path in output.iterdir()] == [name]
    assert (output / name).read_text() == "mine"


def test_a_second_process_on_one_output_folder_is_refused(tiny_capture, tmp_path, capsys):
    from lexsplat.scenes.folder import SceneFolder

    with SceneFolder(tmp_path / "out").locked():
        for arguments in (["poses", str(tiny_capture / "images")], ["build", str(tiny_capture), *QUICK]):
            arguments += ["--output", str(tmp_path / "out")]
            fails_in_one_line(capsys, arguments, f"process {os.getpid()} at work", "another --output")


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("build", ["--test-views", "a.png"]),
        ("language", ["--splats", "x.ply"]),
        ("language", ["--test-views", "a"]),
    ],
)
def test_options_of_one_capture_are_refused_for_several_as_wrong_usage(command, option, capsys, tmp_path):
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "room", "hall", "--output", str(tmp_path / "scenes"), *option])
    assert ended.value.code == 2
    assert capsys.readouterr().err.strip() == (
        "error: --test-views and --splats belong to one CAPTURE: build the scenes one by one"
    )
