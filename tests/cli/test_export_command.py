"""``lexsplat export``: which files it writes and which it never replaces."""

import shutil

import pytest
from support.command_line import Terminal, fails_in_one_line

from lexsplat import cli
from lexsplat.scenes.folder import SceneFolder


def test_a_page_that_would_be_a_folder_named_html_is_refused(tmp_path, capsys):
    target = tmp_path / "page.html"
    fails_in_one_line(capsys, ["publish", "demo", str(target)], "page.html", "--single-file")
    assert not target.exists()


def test_a_page_is_not_written_into_a_scene(tmp_path, capsys):
    SceneFolder(tmp_path / "scene").save()
    target = tmp_path / "scene" / "page"
    fails_in_one_line(
        capsys, ["publish", "demo", str(target)], f"one in the scene {tmp_path / 'scene'}", "beside it"
    )
    assert not target.exists()


def test_export_writes_the_standard_ply(built, tmp_path):
    assert cli.main(["export", str(built), str(tmp_path / "a.ply")]) == 0
    assert (tmp_path / "a.ply").read_bytes() == (built / "gaussians.ply").read_bytes()


@pytest.mark.parametrize("name", ["gaussians.ply", "codes/../gaussians.ply", "metrics.json", "scene.json"])
def test_an_export_never_replaces_a_file_of_its_scene(built, tmp_path, capsys, name):
    copy = tmp_path / "scene"
    shutil.copytree(built, copy)
    before = (copy / "gaussians.ply").read_bytes()
    fails_in_one_line(
        capsys, ["export", str(copy), str(copy / name), "--select", "blue ball"], "another name"
    )
    assert (copy / "gaussians.ply").read_bytes() == before
    assert cli.main(["export", str(copy), str(copy / "copy.ply")]) == 0


def test_an_export_asks_before_it_replaces_a_file(built, tmp_path, monkeypatch, capsys):
    file = tmp_path / "mine.ply"
    file.write_text("mine")
    command = ["export", str(built), str(file)]
    fails_in_one_line(capsys, command, "mine.ply", "--force")  # pytest gives no terminal
    monkeypatch.setattr("sys.stdin", Terminal("\n"))
    fails_in_one_line(capsys, command, "mine.ply", "--force")
    assert file.read_text() == "mine"
    monkeypatch.setattr("sys.stdin", Terminal("yes\n"))
    assert cli.main(command) == 0
    assert file.read_bytes() == (built / "gaussians.ply").read_bytes()
    file.write_text("mine")
    monkeypatch.setattr("sys.stdin", Terminal("n\n"))
    assert cli.main([*command, "--force"]) == 0
    assert file.read_bytes() == (built / "gaussians.ply").read_bytes()


@pytest.mark.parametrize("option", [("--threshold", "0.3"), ("--view", "view_06")])
def test_an_option_about_phrases_without_phrases_is_refused(built, tmp_path, capsys, option):
    with pytest.raises(SystemExit) as ended:
        cli.main(["export", str(built), str(tmp_path / "a.ply"), *option])
    assert ended.value.code == 2
    assert "--view and --threshold need --select PHRASE" in capsys.readouterr().err


def test_an_export_in_a_folder_with_a_scene_named_demo_says_once_which_one_it_is(
    built, tmp_path, monkeypatch, capsys
):
    shutil.copytree(built, tmp_path / "demo")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["export", "demo", "ball.ply", "--select", "blue ball", "--threshold", "0.05"]) == 0
    assert capsys.readouterr().err.count("not what is bundled") == 1
