"""Each example runs and prints the expected output."""

import json
import os
import runpy
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.forked_commands import startable
from support.tiny_capture import write_capture

EXAMPLES = Path(__file__).parents[2] / "examples"
pytestmark = pytest.mark.slow


@pytest.fixture
def run(monkeypatch, tmp_path, capsys) -> Callable[..., str]:
    """Runs an example as a script in an empty folder; returns what it prints."""

    def run_example(name: str, *arguments: object) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        capsys.readouterr()
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run_example


def test_01_renders_a_ball(run, tmp_path):
    assert "Gaussians are visible" in run("01_render.py")
    assert (tmp_path / "output" / "examples" / "ball.png").stat().st_size > 1000


def test_02_draws_a_heatmap_for_each_prompt(run, tmp_path):
    output = run("02_search.py")
    assert output.count("of the image above") == 2
    assert (tmp_path / "output" / "examples" / "red_apple.png").exists()


def test_02_searches_a_given_scene(run, built):
    assert run("02_search.py", built, "blue ball").startswith("blue ball: best")


def test_03_cuts_out_an_object(run, tmp_path):
    output = run("03_cut_out.py")
    assert "Gaussians around" in output
    assert (tmp_path / "output" / "examples" / "cut_out.ply").exists()


def test_04_labels_the_right_gaussians(run, tmp_path):
    output = run("04_labels_into_gaussians.py")
    assert float(output.split("%")[0]) > 95
    assert "shows label 0" in output


def test_05_builds_a_scene(run, tmp_path):
    write_capture(tmp_path / "capture", views=2)
    output = run("05_build.py", "capture", "scene", 20)
    assert "reconstruct: 20 of 20" in output
    assert "blue ball: present" in output
    assert (tmp_path / "scene" / "language.safetensors").exists()


def test_06_asks_while_it_moves(run):
    output = run("06_robot.py")
    assert "red apple: yes: red apple at" in output
    assert "fruit closest to me: yes" in output
    assert "of 20 answers were late" in output


def test_07_reports_which_scenes_hold_a_thing(run, tmp_path):
    output = run("07_library.py")
    assert "red apple: present: yes, in 1 of 1 scene" in output
    assert "fire extinguisher: present: no, in 0 of 1 scene" in output
    assert "phrase | scene | present | count | x | y | z | width | depth | height | view" in output
    assert "red apple | demo | yes | 1" in output
    assert (tmp_path / "output" / "examples" / "found" / "demo" / "red_apple.jpg").stat().st_size > 1000


def test_08_asks_from_a_shell(tmp_path):
    environment = {**os.environ, "LEXSPLAT": f"sh {tmp_path}/lexsplat", "PYTHON": f"{sys.executable} -I -S"}
    arguments = ["sh", EXAMPLES / "08_shell.sh", "demo", "apple", "unicorn", 'the "mug', 'a "mug"', "\\"]
    with startable("info", "demo") as info, startable("ask", "demo", "--stdin") as ask:
        lines = (
            f'[ "$*" = "{words}" ] && exec {shlex.join(command)}'
            for words, command in (("info demo", info), ("ask demo --stdin", ask))
        )
        (tmp_path / "lexsplat").write_text("\n".join([*lines, "exit 9"]))
        done = subprocess.run(arguments, capture_output=True, text=True, env=environment, timeout=300)
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    assert done.returncode == 0, done.stderr
    assert [row[0] for row in rows] == arguments[3:]
    assert rows[0][1:3] == ["yes", "1"]
    assert rows[1][1:] == ["no", "0", "-"]
    assert [row[1] for row in rows[2:4]] == ["error", "yes"]


def test_09_asks_in_a_notebook(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    cells = json.loads((EXAMPLES / "09_notebook.ipynb").read_text())["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    printed = capsys.readouterr().out
    assert 'where is the mug? ("mug"): yes, mug' in printed
    assert "is there a dog?" in printed.splitlines()[3]
    assert printed.splitlines()[3].endswith("no, nothing")
    table = [line for line in printed.splitlines() if line.startswith("│")]
    cells = [[cell.strip() for cell in line.split("│")[1:5]] for line in table]
    assert cells == [["red apple", "demo", "yes", "1"], ["mug", "demo", "yes", "1"]]


def test_every_example_is_listed_and_tested():
    listed = (EXAMPLES / "README.md").read_text()
    tested = Path(__file__).read_text()
    for path in EXAMPLES.glob("[0-9]*"):
        assert path.name in listed
        assert f'"{path.name}"' in tested
