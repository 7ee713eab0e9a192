"""Captures and encoders that cannot be used: one line, status 1, nothing half written."""

import os
import shutil
from pathlib import Path

import pytest
from PIL import Image
from support.command_line import fails_in_one_line
from support.tiny_capture import QUICK_BUILD as QUICK
from support.tiny_capture import write_capture

from lexsplat import cli


@pytest.mark.slow
def test_an_unknown_encoder_is_refused_with_three_remedies(tiny_capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    output = tmp_path / "out"
    arguments = [
        "language",
        str(tiny_capture),
        "--output",
        str(output),
        "--iterations",
        "2",
        "--device",
        "cpu",
    ]
    fails_in_one_line(capsys, [*arguments, "--clip", "nobody/nothing"], "nobody/nothing", "bundled", "folder")
    assert not (output / "language.safetensors").exists()
    arguments = [
        "build",
        *arguments[1:],
        "--clip",
        "bundled",
        "--dino",
        "nobody/nothing",
        "--method",
        "trained",
    ]
    fails_in_one_line(capsys, arguments, "nobody/nothing", "--dino bundled")
    assert not (output / "gaussians.ply").exists(), "the error precedes the reconstruction"


def broken(tmp_path: Path, damage) -> Path:
    capture = write_capture(tmp_path / "capture", views=4, width=32, height=24)
    damage(capture)
    return capture


def truncate_image(capture: Path) -> None:
    path = capture / "images" / "view_01.png"
    path.write_bytes(path.read_bytes()[:300])


def resize_image(capture: Path) -> None:
    path = capture / "images" / "view_01.png"
    Image.open(path).resize((32, 40)).save(path)


def poison_pose(capture: Path) -> None:
    path = capture / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines()
    parts = lines[0].split()
    parts[5] = "nan"
    path.write_text("\n".join([" ".join(parts), *lines[1:]]) + "\n")


def orphan_mask(capture: Path) -> None:
    path = capture / "segmentations" / "view_77" / "mug.png"
    path.parent.mkdir(parents=True)
    Image.new("L", (32, 24)).save(path)


DAMAGES = {
    "no such folder": (shutil.rmtree, "capture"),
    "empty folder": (lambda c: [shutil.rmtree(c), os.mkdir(c)], "capture"),
    "no cameras": (lambda c: shutil.rmtree(c / "sparse"), "capture"),
    "truncated image": (truncate_image, "view_01.png"),
    "image of another shape": (resize_image, "view_01.png"),
    "NaN in a pose": (poison_pose, "view_01.png"),
    "mask without a view": (orphan_mask, "view_77"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", DAMAGES)
def test_invalid_captures_end_in_one_line_without_output(tmp_path, capsys, kind):
    damage, word = DAMAGES[kind]
    capture, output = broken(tmp_path, damage), tmp_path / "out"
    arguments = ["build", str(capture), "--output", str(output), *QUICK, "--iterations", "5"]
    fails_in_one_line(capsys, arguments, word)
    assert not output.exists(), sorted(output.rglob("*"))


def test_an_invalid_capture_leaves_an_existing_folder_unchanged(built, tmp_path, capsys):
    capture, output = broken(tmp_path, poison_pose), tmp_path / "out"
    shutil.copytree(built, output)
    before = {
        path: path.read_bytes() for path in output.rglob("*") if path.is_file() and path.name != ".lock"
    }
    fails_in_one_line(capsys, ["build", str(capture), "--output", str(output), *QUICK], "view_01.png")
    assert {path: path.read_bytes() for path in before} == before
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    fails_in_one_line(capsys, ["build", str(capture), "--output", str(mine), *QUICK], "view_01.png")
    assert (mine / "notes.txt").read_text() == "mine"


@pytest.mark.slow
def test_a_downscale_that_is_too_large_is_refused_before_training(tiny_capture, tmp_path, capsys):
    arguments = ["build", str(tiny_capture), "--output", str(tmp_path / "out"), *QUICK]
    fails_in_one_line(capsys, [*arguments, "--downscale", "100"], "6 pixels", "--downscale")
    # Eight pixels are enough, though half of them, as in the warm-up of a training, are not.
    assert cli.main(["reconstruct", *arguments[1:], "--downscale", "9", "--iterations", "10"]) == 0


def test_file_names_outside_utf8_end_in_one_line(tmp_path, capsys):
    capture = write_capture(tmp_path / "capture\udcff", views=4, width=32, height=24)
    fails_in_one_line(capsys, ["build", str(capture), "--output", str(tmp_path / "out"), *QUICK], "UTF-8")


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("nowhere", "no such folder"),
        ("walk.mp4", "no such file"),
        ("empty", "found 0"),
        ("notes.txt", "found a file"),
    ],
)
def test_poses_of_nothing_end_in_one_line_without_output(name, found, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("no photo")
    arguments = ["poses", str(tmp_path / name), "--output", str(tmp_path / "out")]
    fails_in_one_line(capsys, arguments, f"{name}: expected", found)
    assert not (tmp_path / "out").exists()
