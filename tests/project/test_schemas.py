"""The answers of the commands with ``--json`` are what docs/schemas states."""

import json
import shutil

import pytest
from jsonschema import Draft202012Validator
from support.schemas import SCHEMAS, validated

from lexsplat import cli
from lexsplat.scenes.folder import BUNDLED_SCENE


def answer(capsys, *arguments: str) -> dict:
    capsys.readouterr()
    assert cli.main([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("path", sorted(SCHEMAS.glob("*.json")), ids=lambda path: path.stem)
def test_schemas_are_valid_and_describe_every_key(path):
    schema = json.loads(path.read_text())
    Draft202012Validator.check_schema(schema)

    def check(part: object, place: str) -> None:
        if isinstance(part, dict):
            for key, value in part.get("properties", {}).items():
                assert "description" in value or "$ref" in value, f"{place}.{key}"
            for key, value in part.items():
                check(value, f"{place}.{key}")
        elif isinstance(part, list):
            for value in part:
                check(value, place)

    check(schema, path.stem)


@pytest.mark.parametrize("more", [[], ["--no-images"]], ids=["images", "no images"])
def test_query_answers_in_its_schema(built, tmp_path, capsys, more):
    validated(
        "query", answer(capsys, "query", str(built), "red apple", "x", "--output", str(tmp_path), *more)
    )


def test_find_answers_in_its_schema(capsys):
    found = answer(capsys, "find", "demo", "red apple", "unicorn", "lamp next to the books")
    validated("find", found)
    assert [bool(phrase["instances"]) for phrase in found["phrases"]] == [True, False, True]


def test_find_in_a_scene_with_a_known_scale_answers_in_its_schema(tmp_path, capsys):
    copy = tmp_path / "scene"
    shutil.copytree(BUNDLED_SCENE, copy)
    points = ["--points", "0,0,0", "1,0,0"]
    scale = answer(capsys, "scale", str(copy), "--distance", "9.5cm", *points)
    validated("scale", scale)
    assert scale["meters_per_unit"] == pytest.approx(0.095)
    found = answer(capsys, "find", str(copy), "red apple")
    validated("find", found)
    assert found["phrases"][0]["instances"][0]["size_meters"]


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["built", "demo"])
def test_info_and_scale_answer_in_their_schemas(request, capsys, scene):
    folder = "demo" if scene == "demo" else str(request.getfixturevalue("built"))
    validated("info", answer(capsys, "info", folder))
    validated("scale", answer(capsys, "scale", folder))


def test_evaluate_answers_in_the_schema_of_metrics(built, capsys):
    metrics = answer(capsys, "evaluate", str(built))
    validated("metrics", metrics)
    assert metrics["language"]["per_prompt"]
