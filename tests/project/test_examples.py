"""Each example runs and prints the expected output."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("built")]


def run(name: str, folder: Path, *arguments: object) -> str:
    """Standard output of an example, run in a folder."""
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_01_renders_a_ball(tmp_path):
    assert "Gaussians are visible" in run("01_render.py", tmp_path)
    assert (tmp_path / "output" / "examples" / "ball.png").stat().st_size > 1000


def test_02_draws_a_heatmap_for_each_prompt(tmp_path):
    output = run("02_search.py", tmp_path)
    assert output.count("of the image above") == 2
    assert (tmp_path / "output" / "examples" / "red_apple.png").exists()


def test_02_searches_a_given_scene(built, tmp_path):
    assert run("02_search.py", tmp_path, built, "blue ball").startswith("blue ball: best")


def test_03_cuts_out_an_object(tmp_path):
    output = run("03_cut_out.py", tmp_path)
    assert "Gaussians around" in output
    assert (tmp_path / "output" / "examples" / "cut_out.ply").exists()


def test_04_labels_the_right_gaussians(tmp_path):
    output = run("04_labels_into_gaussians.py", tmp_path)
    assert float(output.split("%")[0]) > 95
    assert "shows label 0" in output


def test_05_builds_a_scene(tiny_capture, tmp_path):
    output = run("05_build.py", tmp_path, tiny_capture, "scene", 20)
    assert "reconstruct: 20 of 20" in output
    assert "blue ball: present" in output
    assert (tmp_path / "scene" / "language.safetensors").exists()


def test_every_example_is_listed_and_tested():
    listed = (EXAMPLES / "README.md").read_text()
    tested = Path(__file__).read_text()
    for path in EXAMPLES.glob("[0-9]*.py"):
        assert path.name in listed
        assert f'"{path.name}"' in tested
