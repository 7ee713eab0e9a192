"""Every example runs and says what it promises."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
pytestmark = pytest.mark.xdist_group("built")


def run(name: str, *arguments: object) -> str:
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_01_renders_a_ball(tmp_path):
    assert "Gaussians are in sight" in run("01_render.py", tmp_path / "ball.png")
    assert (tmp_path / "ball.png").stat().st_size > 1000


def test_02_answers_each_prompt(built):
    output = run("02_search_a_scene.py", built, "red apple", "blue ball")
    assert output.count("of the picture above") == 2
    assert (built / "heatmaps" / "red_apple.png").exists()


def test_03_cuts_out_what_answers(built, tmp_path):
    output = run("03_cut_out_an_object.py", built, "something red", tmp_path / "apple.ply")
    assert "Gaussians around" in output
    assert (tmp_path / "apple.ply").exists()


def test_04_labels_reach_the_right_gaussians():
    output = run("04_labels_into_gaussians.py")
    assert float(output.split("%")[0]) > 95
    assert "left third shows label 0" in output


def test_every_example_is_listed_and_tested():
    listed = (EXAMPLES / "README.md").read_text()
    tested = Path(__file__).read_text()
    for path in EXAMPLES.glob("[0-9]*.py"):
        assert path.name in listed
        assert f'"{path.name}"' in tested
