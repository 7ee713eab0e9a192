"""The command ``evaluate``: files it writes, words it can ask, and that the same seed gives the same numbers."""

import json
import shutil

import pytest
import torch
from conftest import QUICK_BUILD

from lexsplat import cli
from lexsplat.runtime.files import read_tensors

pytestmark = pytest.mark.xdist_group("built")


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


def test_trained_fields_are_bit_identical_for_the_same_seed(built, tiny_capture, tmp_path):
    results, fields = [], []
    for name in ("one", "two"):
        scene = tmp_path / name
        # Geometry and features are shared; codebook and language are made anew.
        shutil.copytree(
            built, scene, ignore=shutil.ignore_patterns("codes", "codebook.safetensors", "language*")
        )
        arguments = ["build", str(tiny_capture), "--output", str(scene), *QUICK_BUILD, "--method", "trained"]
        assert cli.main(arguments) == 0
        assert cli.main(["evaluate", str(scene)]) == 0
        fields.append(read_tensors(scene / "language.safetensors")[0])
        results.append(without_times(json.loads((scene / "metrics.json").read_text())))
    assert fields[0].keys() == fields[1].keys()
    assert all(torch.equal(tensor, fields[1][name]) for name, tensor in fields[0].items())
    assert results[0] == results[1]


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
