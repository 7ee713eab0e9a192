"""Commands on a scene whose scale is known: positions and sizes are in meters, and what is printed says so."""

import csv
import io
import json
import re

import pytest
from support.scaled_demo import METERS, scaled_demo
from support.schemas import validated

from lexsplat import cli, open_scene


@pytest.fixture(scope="module")
def scaled(tmp_path_factory) -> str:
    """A copy of the scene that ships, with a known scale."""
    return scaled_demo(tmp_path_factory.mktemp("known") / "scene")


@pytest.fixture(scope="module")
def apple(scaled):
    return open_scene(scaled, device="cpu").find("red apple")


def printed(capsys, *arguments: str) -> str:
    capsys.readouterr()
    assert cli.main([*arguments]) == 0
    return capsys.readouterr().out


def in_words(values, unit: str) -> str:
    digits = 3 if unit == "m" else 2
    return f"({', '.join(f'{value:.{digits}f}' for value in values)}) {unit}"


@pytest.mark.slow
@pytest.mark.parametrize("command", [["list"], ["find", "red apple"], ["ask", "where is the red apple?"]])
def test_positions_are_printed_in_meters_where_the_scale_is_known_and_in_scene_units_elsewhere(
    scaled, apple, capsys, command
):
    name, *asked = command
    at_home = open_scene("demo", device="cpu").find("red apple").center
    for scene, place in (
        (scaled, in_words(apple.center * METERS, "m")),
        ("demo", in_words(at_home, "scene units")),
    ):
        out = printed(capsys, name, scene, *asked)
        if name != "list":  # whose apple has another box
            assert f"at {place}" in out
        unit = place.rpartition(") ")[2]
        assert set(re.findall(r"at \([-\d., ]+\)( scene units| m)?", out)) == {f" {unit}"}
        if name != "ask":
            assert set(re.findall(r"size [\d. x]+?( scene units| m),", out)) == {f" {unit}"}


@pytest.mark.slow
def test_json_has_centers_in_both_units(scaled, apple, capsys):
    found = json.loads(printed(capsys, "find", scaled, "red apple", "--json"))
    validated("find", found)
    (thing,) = found["phrases"][0]["instances"]
    assert thing["center_meters"] == pytest.approx([METERS * value for value in thing["center"]], abs=2e-5)
    listed = json.loads(printed(capsys, "list", scaled, "--json"))
    validated("list", listed)
    for each in listed["objects"]:
        assert each["center_meters"] == pytest.approx([METERS * value for value in each["center"]], abs=2e-5)


def test_a_table_has_centers_in_both_units(scaled, capsys):
    rows = list(csv.DictReader(io.StringIO(printed(capsys, "list", scaled, "--csv"))))
    assert rows
    for row in rows:
        for axis in "xyz":
            assert float(row[f"center_meters_{axis}"]) == pytest.approx(
                METERS * float(row[f"center_{axis}"]), abs=2e-5
            )


@pytest.mark.parametrize("known", [True, False])
def test_exported_labels_say_up_and_the_length_of_a_unit(scaled, tmp_path, capsys, known):
    file = tmp_path / "apple.json"
    printed(capsys, "export", scaled if known else "demo", str(file), "--select", "red apple")
    document = json.loads(file.read_text())
    assert document["meters_per_unit"] == (METERS if known else None)
    assert document["up"]["direction"] == pytest.approx([0, 0, 1], abs=0.01)
    (thing,) = document["labels"][0]["instances"]
    assert ("center_meters" in thing) == ("size_meters" in thing) == known
