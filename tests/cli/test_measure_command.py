"""``lexsplat measure``: lengths between two things of the bundled scene, compared with their boxes and points."""

import json
import shutil

import numpy as np
import pytest
from support.command_line import fails_in_one_line
from support.scaled_demo import METERS, scaled_demo
from support.schemas import validated

from lexsplat import cli, open_scene
from lexsplat.queries.selection import Selection
from lexsplat.scenes.folder import BUNDLED_SCENE


@pytest.fixture(scope="module")
def scaled(tmp_path_factory) -> str:
    return scaled_demo(tmp_path_factory.mktemp("known") / "scene")


@pytest.fixture(scope="module")
def mug_and_banana() -> list[Selection]:
    scene = open_scene("demo", device="cpu")
    return [scene.find(phrase) for phrase in ("mug", "banana")]


def printed(capsys, *arguments: str) -> str:
    capsys.readouterr()
    assert cli.main(["measure", *arguments]) == 0
    return capsys.readouterr().out


@pytest.mark.slow
def test_lengths_are_those_of_the_boxes_and_the_points(mug_and_banana, scaled, capsys):
    mug, banana = mug_and_banana
    points, others = (thing.selected.means.detach().double().numpy() for thing in mug_and_banana)
    expected = {
        "centers": np.linalg.norm(mug.center - banana.center),
        "gap": min(np.sqrt(((others - point) ** 2).sum(1)).min() for point in points),
        "height": banana.center[2] - mug.center[2],
    }
    unknown = json.loads(printed(capsys, "demo", "mug", "banana", "--json"))
    validated("measure", unknown)
    known = json.loads(printed(capsys, scaled, "mug", "banana", "--json"))
    validated("measure", known)
    for name, length in expected.items():
        tolerance = 0.05 if name == "gap" else 1e-3  # the gap is between samples of the points
        assert unknown[name]["units"] == known[name]["units"] == pytest.approx(length, abs=tolerance), name
        assert unknown[name]["meters"] is None
        assert known[name]["meters"] == pytest.approx(METERS * known[name]["units"], abs=1e-5), name


@pytest.mark.slow
def test_lengths_are_printed_in_scene_units_and_in_meters_where_they_are_known(
    mug_and_banana, scaled, capsys
):
    apart = float(np.linalg.norm(mug_and_banana[0].center - mug_and_banana[1].center))
    out = printed(capsys, scaled, "mug", "banana")
    assert f"between their centers: {METERS * apart:.3f} m ({apart:.3f} scene units)" in out
    out = printed(capsys, "demo", "mug", "banana")
    assert f"between their centers: {apart:.3f} scene units\n" in out
    assert " m " not in out


def test_the_command_for_meters_is_told_where_it_can_be_run(tmp_path, capsys):
    own = tmp_path / "a scene"
    shutil.copytree(BUNDLED_SCENE, own)
    assert cli.main(["measure", str(own), "mug", "banana"]) == 0
    assert f"see lexsplat scale '{own}' --help" in capsys.readouterr().err
    assert cli.main(["measure", "demo", "mug", "banana"]) == 0
    assert "lexsplat scale" not in capsys.readouterr().err, "the bundled scene is never written"


def test_of_several_things_the_nearest_pair_is_named(capsys):
    out = printed(capsys, "demo", "apple", "fruit")
    assert '"fruit" fits 2 things; measured is the nearest pair, apple and banana' in out


@pytest.mark.parametrize(
    ("phrases", "told"),
    [
        (["mug", "violin"], "violin: expected something that the scene holds, found not here"),
        (["mug", "mug"], "mug and mug: expected two different things, found one thing alone"),
        (["mug", ""], "word or phrase"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_one_line(capsys, phrases, told):
    fails_in_one_line(capsys, ["measure", "demo", *phrases], told)
