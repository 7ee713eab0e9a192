"""``lexsplat query`` and ``lexsplat find``: answers for people and as JSON."""

import json
from pathlib import Path

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from PIL import Image
from support.command_line import fails_in_one_line

from lexsplat import cli, open_scene


def test_query_writes_images_and_json(built, tmp_path, capsys):
    arguments = ["query", str(built), "red apple", "blue ball", "--view", "view_02.png", "--json"]
    assert cli.main([*arguments, "--output", str(tmp_path)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [p["prompt"] for p in answer["prompts"]] == ["red apple", "blue ball"]
    for prompt in answer["prompts"]:
        view = prompt["views"]["view_02.png"]
        heatmap, mask = Image.open(view["heatmap"]), np.array(Image.open(view["mask"]))
        assert heatmap.size == (96, 72)
        assert set(np.unique(mask)) <= {0, 255}
        assert view["mask_share"] == pytest.approx((mask > 0).mean(), abs=1e-4)
        assert 0 <= prompt["threshold"] <= 1


def test_query_without_images_writes_no_file(built, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = [
        "query",
        str(built),
        "red apple",
        "--view",
        "view_02.png",
        "--output",
        "images",
        "--no-images",
    ]
    assert cli.main([*arguments, "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["prompts"][0]["views"]["view_02.png"]) == {
        "peak", "peak_pixel", "mask_share",
    }  # fmt: skip
    assert cli.main(arguments) == 0
    assert "images" not in capsys.readouterr().out
    assert not (tmp_path / "images").exists()


def test_query_writes_the_features_of_a_view(built, tmp_path, capsys):
    arguments = [
        "query",
        str(built),
        "red apple",
        "--view",
        "view_02",
        "--output",
        str(tmp_path),
        "--features",
    ]
    assert cli.main([*arguments, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    schema = Path(__file__).resolve().parents[2] / "docs" / "schemas" / "query.json"
    assert not list(Draft202012Validator(json.loads(schema.read_text())).iter_errors(answer))
    assert Image.open(answer["features"]["view_02.png"]["picture"]).size == (96, 72)
    assert cli.main(arguments) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        f"images in {tmp_path}",
        f"features, and their colors, in {tmp_path / 'features'}",
    ]
    with pytest.raises(SystemExit):
        cli.main([*arguments, "--no-images"])
    assert "leave --no-images out" in capsys.readouterr().err


def test_find_prints_positions_in_3d(built, capsys):
    assert cli.main(["find", str(built), "red apple", "red apple left of the blue ball", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    scene = open_scene(built)
    first, second = answer["phrases"]
    assert answer["up"]["direction"] == pytest.approx([0, 0, 1], abs=1e-3), (
        "the cameras of the capture are level"
    )
    apple = scene.select("red apple")
    expected = [] if apple.present == "no" else apple.instances
    assert first["present"] == apple.present
    assert first["count"] == len(first["instances"]) == len(expected)
    for found, instance in zip(first["instances"], expected):
        assert np.allclose(found["center"], instance.center, atol=1e-4)
    assert second["understood"] == '("red apple" left of "blue ball")'
    assert first["present"] in ("yes", "no", "unsure")
    assert cli.main(["find", str(built), "red apple"]) == 0
    printed = capsys.readouterr().out
    assert f"{first['count']} found" in printed
    assert f"understood as {first['understood']}" in printed
    assert cli.main(["find", str(built), 'the "table']) == 1


def test_an_empty_prompt_is_refused(built, capsys):
    fails_in_one_line(capsys, ["query", str(built), "  "], "prompt")


def test_an_unknown_view_is_refused_with_the_names_of_views(built, capsys):
    fails_in_one_line(capsys, ["query", str(built), "x", "--view", "nowhere"], "nowhere", "view_01.png")


@pytest.mark.slow
def test_a_long_prompt_is_shortened_for_display_and_whole_in_json(capsys):
    prompt = " ".join(["apple"] * 90)
    for command in (["find", "demo", prompt], ["query", "demo", prompt, "--no-images"]):
        assert cli.main(command) == 0
        printed = capsys.readouterr().out
        assert printed.startswith(f"{prompt[:60]}...: ")
        assert max(map(len, printed.splitlines())) < 400
    assert cli.main(["find", "demo", prompt, "--json"]) == 0
    (answer,) = json.loads(capsys.readouterr().out)["phrases"]
    assert answer["phrase"] == prompt
    assert answer["understood"] == f'"{prompt}"'
