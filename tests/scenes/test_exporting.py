"""Exports of a built scene: whole, a selection, its labels; and language for splats of others."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.splats import tame
from support.tiny_capture import QUICK_BUILD as QUICK

from lexsplat import cli, open_scene
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.queries.selection import Selection
from lexsplat.queries.visibility import whole_things
from lexsplat.runtime.progress import Event
from lexsplat.scenes.exporting import best_labels, export_gaussians
from lexsplat.scenes.formats import sog_writing
from lexsplat.scenes.formats.ply import read_ply
from lexsplat.scenes.formats.reading import read_splats
from lexsplat.scenes.formats.splat import write_splat


def export(*arguments) -> int:
    return cli.main(["export", *map(str, arguments)])


@pytest.mark.parametrize(
    "ending", [".ply", ".splat", ".points.ply", ".glb", ".spz", ".v3.spz", ".sog", ".compressed.ply"]
)
def test_a_scene_is_written_in_every_format(built, tmp_path, ending, capsys):
    if ending == ".compressed.ply":
        pytest.importorskip("gaussforge")
    assert export(built, tmp_path / f"all{ending}") == 0
    assert [path.name for path in tmp_path.iterdir()] == [f"all{ending}"]
    assert f"all{ending}" in capsys.readouterr().out


@pytest.mark.slow
def test_the_number_that_is_printed_is_that_of_the_file(tmp_path, capsys):
    """A duck takes along what is hidden in it; the labels name what is seen of it."""
    seen = len(open_scene("demo").find("rubber duck"))
    assert export("demo", tmp_path / "duck.json", "--select", "rubber duck") == 0
    assert capsys.readouterr().out.startswith(f"rubber duck: {seen:,} Gaussians\n")
    assert export("demo", tmp_path / "duck.ply", "--select", "rubber duck") == 0
    count = len(read_ply(tmp_path / "duck.ply"))
    told = f"rubber duck: {seen:,} Gaussians, {count:,} with the hidden ones inside it\n"
    assert capsys.readouterr().out.startswith(told)


def test_exporting_a_selection_writes_only_the_gaussians_found(built, tmp_path):
    limit = float(open_scene(built).scores(["red apple"]).quantile(0.8))
    arguments = ["--select", "red apple", "--language", "--threshold", limit]
    assert export(built, tmp_path / "apple.ply", *arguments) == 0
    scene = open_scene(built)
    chosen = scene.select("red apple", limit)
    found = whole_things(chosen, scene.hidden, scene.field.segments)
    assert 0 < len(chosen) <= len(found) < len(found.mask)
    assert torch.equal(read_ply(tmp_path / "apple.ply").means, found.selected.means)
    vertex = pytest.importorskip("plyfile").PlyData.read(tmp_path / "apple.ply")["vertex"]
    codes = open_scene(built).field.select(found.mask).code_probabilities().argmax(1)
    assert np.array_equal(vertex["lang_code_0"], codes.numpy())
    assert (tmp_path / "apple.codebook.safetensors").exists()


def test_exported_selections_equal_those_of_find_and_are_reported(built, tmp_path, monkeypatch, capsys):
    """Relations, a viewer, what was found of each phrase: as find and edit have it, not the bare words."""
    asked = []
    limit = float(open_scene(built).scores(["red apple"]).quantile(0.8))

    def find(scene, phrase, view=None, *, threshold=None):
        asked.append((phrase, view))
        found = scene.select("red apple", 1.0 if "giraffe" in phrase else limit)
        return replace(found, phrase="as understood", present="no" if "giraffe" in phrase else "yes")

    monkeypatch.setattr("lexsplat.scenes.scene.Scene.find", find)
    view = next(iter(open_scene(built).views))
    phrases = ["apple left of the ball", "giraffe"]
    assert export(built, tmp_path / "l.json", "--select", *phrases, "--view", view) == 0
    assert asked == [(phrase, view) for phrase in phrases]
    labels = json.loads((tmp_path / "l.json").read_text())["labels"]
    assert [entry["phrase"] for entry in labels] == phrases
    first, second, _ = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"apple left of the ball: [\d,]+ Gaussians", first)
    assert second == "giraffe: 0 Gaussians; probably not in this scene"


def test_labels_assign_gaussians_to_phrases(built, tmp_path):
    phrases = ["red apple", "blue ball"]
    for name in ("l.csv", "l.json"):
        assert export(built, tmp_path / name, "--select", *phrases) == 0
    with open(tmp_path / "l.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    answer = json.loads((tmp_path / "l.json").read_text())
    assert len(rows) == answer["gaussians"]
    claimed = {entry["phrase"]: set() for entry in answer["labels"]}
    for entry in answer["labels"]:
        for instance in entry["instances"]:
            claimed[entry["phrase"]] |= set(instance["indices"])
    assert list(claimed) == phrases
    for row in rows:
        claims = {phrase for phrase in phrases if int(row["index"]) in claimed[phrase]}
        assert (row["label"] in claims) if claims else row["label"] == ""


def test_the_phrase_furthest_above_its_threshold_determines_the_label(built):
    gaussians = open_scene(built).gaussians.select(torch.arange(3))

    def make(scores, limit):
        values = torch.tensor(scores)
        return Selection(gaussians, {}, values >= limit, values, limit)

    labels, scores = best_labels([make([0.6, 0.9, 0.1], 0.5), make([0.35, 0.3, 0.1], 0.2)])
    # (0.6 - 0.5) / 0.5 = 0.2 against (0.35 - 0.2) / 0.8 = 0.19; then 0.8 against 0.125; then nobody.
    assert labels.tolist() == [0, 0, -1]
    assert scores[:2].tolist() == pytest.approx([0.6, 0.9])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["x.obj"], "ends in"),
        (["x.csv"], "phrases to label by"),
        (["x.splat", "--language"], "without room for language"),
        (["x.csv", "--select", "apple", "--language"], "without room for language"),
        (["x.ply", "--select", "red apple", "blue ball", "--threshold", "1"],
         "red apple, blue ball: expected something to write, found nothing"),
        (["x.csv", "--select", "apple", "--threshold", "1"], "apple: expected something to write, found nothing"),
        (["x.json", "--select", "apple", "--threshold", "1"], "apple: expected something to write, found nothing"),
    ],
)  # fmt: skip
def test_impossible_exports_are_refused_in_one_line(built, tmp_path, arguments, words, capsys):
    assert export(built, tmp_path / arguments[0], *arguments[1:]) == 1
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def written_by_others(ending: str, gaussians: Gaussians, path: Path) -> None:
    """Splats as gsplat writes them (PLY, .splat), or as lexsplat does."""
    if ending in (".spz", ".sog", ".glb"):
        export_gaussians(gaussians, path)
        return
    exporter = pytest.importorskip("gsplat.exporter")
    g = gaussians
    if ending == ".ply":
        exporter.export_splats(
            g.means, g.log_scales, g.quats, g.opacity_logits, g.sh0, g.shN, format="ply", save_to=str(path)
        )
    else:
        path.write_bytes(
            exporter.splat2splat_bytes(g.means, g.log_scales, g.quats, g.opacity_logits, g.sh0[:, 0])
        )


@pytest.mark.parametrize("ending", [".ply", ".splat", ".spz", ".sog", ".glb"])
def test_splats_of_another_program_receive_language_and_keep_their_geometry(
    built, tiny_capture, tmp_path, ending
):
    original = read_ply(built / "gaussians.ply")
    file, scene = tmp_path / f"foreign{ending}", tmp_path / "scene"
    written_by_others(ending, original, file)
    foreign = read_splats(file)
    assert len(foreign) == len(original)
    shutil.copytree(built / "checkpoints", scene / "checkpoints")
    arguments = ["language", str(tiny_capture), "--output", str(scene), "--splats", str(file)]
    assert cli.main([*arguments, *QUICK]) == 0
    made = open_scene(scene)
    assert torch.equal(made.gaussians.means, foreign.means)
    assert "splats" in json.loads((scene / "scene.json").read_text())["stages"]["reconstruct"]
    scores = made.scores(["red apple"])[0]
    assert scores.shape == (len(foreign),)
    assert float(scores.max()) > float(scores.median()) > 0, "the Gaussians got language"


def test_splats_that_the_cameras_do_not_see_are_refused(built, tiny_capture, tmp_path, capsys):
    foreign = read_ply(built / "gaussians.ply")
    foreign.means += 1000
    write_splat(foreign, tmp_path / "far.splat")
    arguments = ["language", str(tiny_capture), "--output", str(tmp_path / "s"), "--splats"]
    assert cli.main([*arguments, str(tmp_path / "far.splat"), *QUICK]) == 1
    assert "in the axes and units of the cameras" in capsys.readouterr().err
    assert cli.main([*arguments, str(tmp_path / "absent.ply"), *QUICK]) == 1
    assert "no such file" in capsys.readouterr().err


def test_the_palette_of_a_large_sog_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(sog_writing, "_MOST_INDICES", 100)
    monkeypatch.setattr(sog_writing, "_BLOCK", 64)
    events: list[Event] = []
    export_gaussians(tame(320, 1), tmp_path / "g.sog", listener=events.append)
    steps = sog_writing._PALETTE_STEPS + 1  # the last one finds the entry of every Gaussian
    assert events == [Event("palette", done, steps * 5) for done in range(steps * 5 + 1)]
    few: list[Event] = []
    export_gaussians(tame(20, 1), tmp_path / "few.sog", listener=few.append)
    assert few == [], "each has an entry of its own"
