"""``lexsplat evaluate`` and ``lexsplat info``."""

import errno
import json
import os
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch
from support.command_line import fails_in_one_line
from support.tiny_capture import QUICK_BUILD

from lexsplat import cli
from lexsplat.runtime.files import read_tensors
from lexsplat.scenes.folder import SceneFolder


def test_evaluate_writes_metrics_and_a_report_without_external_files(built, capsys):
    assert cli.main(["evaluate", str(built), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((built / "metrics.json").read_text())
    assert printed == written
    assert written["quality"]["psnr"] > 15
    strict = written["language"]["strict"]
    for form in ("auto", "fixed", "oracle"):
        assert set(strict[form]) >= {"mIoU", "mPA", "mP"}
    assert strict["oracle"]["mIoU"] >= max(strict["auto"]["mIoU"], strict["fixed"]["mIoU"])
    assert set(written) >= {"quality", "language", "speed", "size", "config", "machine"}
    html = (built / "report.html").read_text()
    HTMLParser().feed(html)
    assert 'src="http' not in html
    assert "red apple" in html


def test_info_prints_the_contents_of_a_scene(built, capsys):
    assert cli.main(["info", str(built), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    views = facts["views"]
    assert (views["training"], views["held out"]) == (9, 3)
    assert 1 <= views["with features"] <= 9
    assert facts["gaussians"] > 0
    assert cli.main(["info", str(built)]) == 0
    assert "gaussian bytes" in capsys.readouterr().out


def test_info_states_the_method_and_its_codes(built, capsys):
    assert cli.main(["info", str(built), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["method"], facts["codes"], facts["dino"]) == ("averaged", 16, "not used")
    assert "weight_dropped" not in facts


@pytest.mark.parametrize("option", ["--ground-truth", "--masks"])
def test_ground_truth_that_is_given_and_missing_ends_in_one_line(option, built, tmp_path, capsys):
    fails_in_one_line(
        capsys, ["evaluate", str(built), option, str(tmp_path / "nowhere")], "nowhere", "; check"
    )


def test_given_ground_truth_of_training_views_only_is_refused(built, tiny_capture, tmp_path, capsys):
    given = tmp_path / "given"
    source = next(path for path in sorted((tiny_capture / "segmentations").iterdir()) if path.is_dir())
    views = SceneFolder.open(built).read_cameras()
    trained = next(name for name, view in views.items() if view.split == "train")
    shutil.copytree(source, given / Path(trained).stem)
    fails_in_one_line(
        capsys, ["evaluate", str(built), "--ground-truth", str(given)], "given", "held-out views"
    )


def test_a_scene_folder_that_takes_no_file_is_refused_before_anything_is_measured(built, monkeypatch, capsys):
    def refuse(dir):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), f"{dir}/tmp1")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    monkeypatch.setattr("lexsplat.evaluation.scenes.evaluate", lambda *_, **__: pytest.fail("measured"))
    fails_in_one_line(capsys, ["evaluate", str(built)], f"error: {built}: Read-only", "give another place")


def test_photos_of_another_place_are_not_measured(built, tiny_capture, tmp_path, capsys):
    """They have the names of the build's, as photos of cameras that count from 1 do."""
    other = shutil.copytree(tiny_capture, tmp_path / "other")
    images = {path.name: path for path in sorted((other / "images").iterdir())}
    first, *rest = images.values()
    for path in rest:
        shutil.copy(first, path)
    before = (built / "metrics.json").read_bytes() if (built / "metrics.json").exists() else b""
    asked = ["evaluate", str(built), "--capture", str(other)]
    fails_in_one_line(capsys, asked, str(other), "of 3 held-out photos changed", "--capture")
    assert ((built / "metrics.json").read_bytes() if before else b"") == before


def test_a_scene_without_held_out_views_says_that_nothing_is_measured(built, tmp_path, caplog):
    shutil.copytree(built, tmp_path / "scene")
    cameras = tmp_path / "scene" / "cameras.json"
    cameras.write_text(cameras.read_text().replace('"test"', '"train"'))
    assert cli.main(["evaluate", str(tmp_path / "scene")]) == 0
    assert "no held-out views" in caplog.text
    assert "build it with --test-every or --test-views" in caplog.text


def without_times(result: dict) -> dict:
    """``metrics.json`` without times and memory."""
    size = {key: value for key, value in result["size"].items() if not key.startswith("peak_")}
    return {**result, "speed": None, "size": size}


def test_the_same_seed_gives_the_same_metrics_except_for_times(built, tiny_capture, tmp_path):
    again = tmp_path / "again"
    # Features are the slow part and have no seed: they are shared, the rest is made anew.
    shutil.copytree(built / "checkpoints" / "features", again / "checkpoints" / "features")
    assert cli.main(["build", str(tiny_capture), "--output", str(again), *QUICK_BUILD]) == 0
    results = []
    for scene in (built, again):
        assert cli.main(["evaluate", str(scene)]) == 0
        results.append(without_times(json.loads((scene / "metrics.json").read_text())))
    assert results[0] == results[1]
    assert set(results[0]["language"]) >= {"strict", "official", "lerf_2d", "lerf_3d"}


def test_trained_fields_are_bit_identical_for_the_same_seed(built, built_trained, tiny_capture, tmp_path):
    again = tmp_path / "again"
    # Geometry and features are shared; codebook and language are made anew.
    shutil.copytree(built, again)
    features = Path("checkpoints", "features")  # with those of DINO, which `built` lacks
    shutil.copytree(built_trained / features, again / features, dirs_exist_ok=True)
    arguments = ["build", str(tiny_capture), "--output", str(again), *QUICK_BUILD, "--method", "trained"]
    assert cli.main(arguments) == 0
    fields = [read_tensors(scene / "language.safetensors")[0] for scene in (built_trained, again)]
    assert fields[0].keys() == fields[1].keys()
    assert all(torch.equal(tensor, fields[1][name]) for name, tensor in fields[0].items())


def test_evaluate_writes_rows_for_tables(built, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(built, copy)
    assert cli.main(["evaluate", str(copy), "--protocols", "strict"]) == 0
    result = json.loads((copy / "metrics.json").read_text())
    assert "official" not in result["language"]
    header, row = (copy / "metrics.csv").read_text().splitlines()
    values = dict(zip(header.split(","), row.split(",")))
    assert float(values["mIoU"]) == pytest.approx(result["language"]["strict"]["auto"]["mIoU"], abs=1e-6)
    assert r"\begin{tabular}" in (copy / "metrics.tex").read_text()


def test_prompt_lists_apply_only_to_the_scenes_of_the_paper(built, tiny_capture, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(built, copy)
    assert cli.main(["evaluate", str(copy), "--prompt-list", "paper"]) == 1
    assert "bonsai" in capsys.readouterr().err
    bonsai = tmp_path / "bonsai"
    shutil.copytree(tiny_capture, bonsai)
    for folder in (bonsai / "segmentations").iterdir():
        (folder / "red apple.png").rename(folder / "black stool.png")
    arguments = ["evaluate", str(copy), "--prompt-list", "paper", "--capture", str(bonsai)]
    assert cli.main(arguments) == 0
    result = json.loads((copy / "metrics.json").read_text())
    assert list(result["language"]["per_prompt"]) == ["black stool"], "the blue ball is in no list"
    assert result["config"]["ground_truth"] == {
        "folder": str(bonsai / "segmentations"), "layout": "segmentations", "prompt_list": "paper",
    }  # fmt: skip
    report = (copy / "report.html").read_text()
    assert f"<td>ground truth</td><td>{bonsai / 'segmentations'}, prompts of the list paper</td>" in report
