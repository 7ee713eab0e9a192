"""Scale from one known distance and the up direction: setting, storage and use."""

import json
import shutil

import numpy as np
import pytest
from support.command_line import fails_in_one_line

from lexsplat import cli, open_scene
from lexsplat.geometry.boxes import gravity_up
from lexsplat.geometry.world import World
from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder
from lexsplat.scenes.scale import store_world


@pytest.fixture
def old_demo_copy(tmp_path):
    """A copy of the scene that ships; one built before worlds were stored."""
    folder = shutil.copytree(BUNDLED_SCENE, tmp_path / "scene")
    record = json.loads((folder / "scene.json").read_text())
    record.pop("world", None)
    (folder / "scene.json").write_text(json.dumps(record))
    return folder


def run(*arguments) -> int:
    return cli.main([str(argument) for argument in arguments])


def stored(old_demo_copy) -> dict:
    return json.loads((old_demo_copy / "scene.json").read_text())["world"]


def test_up_is_estimated_from_the_cameras_and_the_scale_is_unknown(old_demo_copy, capsys):
    assert run("scale", old_demo_copy) == 0
    assert "scale: not known" in capsys.readouterr().out
    assert run("info", old_demo_copy, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    expected = gravity_up(view.camera for view in SceneFolder.open(old_demo_copy).read_cameras().values())
    assert facts["up"]["direction"] == pytest.approx(expected.direction, abs=1e-5)
    assert (facts["up"]["from"], facts["meters_per_unit"]) == ("cameras", None)


@pytest.mark.slow
def test_one_known_distance_gives_sizes_in_meters(old_demo_copy, capsys):
    pygltflib = pytest.importorskip("pygltflib")
    assert run("scale", old_demo_copy, "--distance", 0.35, "--points", "0,0,0", "0,-0.7,0") == 0
    assert stored(old_demo_copy)["meters_per_unit"] == pytest.approx(0.5)
    assert run("find", old_demo_copy, "red apple", "--json") == 0
    answer = json.loads("{" + capsys.readouterr().out.partition("{")[2])
    assert answer["meters_per_unit"] == pytest.approx(0.5)
    thing = answer["phrases"][0]["instances"][0]
    assert thing["size_meters"] == pytest.approx([side / 2 for side in thing["size"]], abs=1e-4)
    assert run("find", old_demo_copy, "red apple") == 0
    assert " m, score" in capsys.readouterr().out
    found = open_scene(old_demo_copy).select("red apple")
    assert found.size_meters == pytest.approx(found.size / 2)
    assert run("export", old_demo_copy, old_demo_copy.parent / "all.glb") == 0
    assert pygltflib.GLTF2().load(str(old_demo_copy.parent / "all.glb")).nodes[0].scale == pytest.approx(
        [0.5] * 3
    )
    assert run("export", old_demo_copy, old_demo_copy.parent / "all.ply") == 0
    files = (old_demo_copy.parent / "all.ply", old_demo_copy / "gaussians.ply")
    exported, kept = (file.read_bytes().partition(b"end_header\n")[2] for file in files)
    is_same = exported == kept  # a plain value: a difference of megabytes takes minutes to print
    assert is_same


@pytest.mark.slow
def test_a_distance_can_be_given_between_two_phrases(old_demo_copy, capsys):
    assert run("scale", old_demo_copy, "--distance", 0.3, "--between", "red apple", "banana", "--json") == 0
    world = json.loads(capsys.readouterr().out)
    found = [open_scene(old_demo_copy).find(phrase).largest() for phrase in ("red apple", "banana")]
    measured = float(np.linalg.norm(found[0].center - found[1].center))
    assert world["meters_per_unit"] == pytest.approx(0.3 / measured)
    assert run("scale", old_demo_copy, "--distance", 0.08, "--height-of", "red apple") == 0
    assert stored(old_demo_copy)["meters_per_unit"] == pytest.approx(0.08 / found[0].size[2])


@pytest.mark.slow
def test_what_is_not_found_and_what_has_no_length_are_refused_with_a_remedy(old_demo_copy, capsys):
    scale = ["scale", str(old_demo_copy), "--distance", "1m"]
    fails_in_one_line(capsys, [*scale, "--height-of", "violin"], "violin: ", "found nothing; try other words")
    same = ["--between", "red apple", "red apple"]
    fails_in_one_line(capsys, [*scale, *same], "red apple and red apple: ", "found 0; ")


@pytest.mark.slow
def test_up_can_be_set_and_is_used_everywhere(old_demo_copy, capsys):
    pygltflib = pytest.importorskip("pygltflib")
    assert run("scale", old_demo_copy, "--up=-1,0,0") == 0
    assert "from the user" in capsys.readouterr().out
    opened = open_scene(old_demo_copy)
    assert opened.world.up.direction.tolist() == [-1, 0, 0]
    assert opened.select("red apple").box.axes[2] == pytest.approx([-1, 0, 0])
    assert run("export", old_demo_copy, old_demo_copy.parent / "all.glb") == 0
    x, y, z, w = pygltflib.GLTF2().load(str(old_demo_copy.parent / "all.glb")).nodes[0].rotation
    turned = np.array([[1 - 2 * (y * y + z * z)], [2 * (x * y + w * z)], [2 * (x * z - w * y)]]) @ [-1.0]
    assert turned == pytest.approx([0, 1, 0], abs=1e-6), "glTF has y up"


@pytest.mark.slow
def test_a_rebuild_keeps_up_and_scale_while_the_cameras_are_unchanged(tiny_capture, tmp_path, caplog):
    build = ["reconstruct", tiny_capture, "--output", tmp_path, "--device", "cpu", "--iterations", 3]
    assert run(*build) == 0
    assert stored(tmp_path)["up"]["direction"] == pytest.approx([0, 0, 1], abs=1e-3)
    assert run("scale", tmp_path, "--distance", 1, "--points", "0,0,0", "2,0,0", "--up", "0,0.6,0.8") == 0
    assert run(*build) == 0
    assert stored(tmp_path)["meters_per_unit"] == 0.5
    assert stored(tmp_path)["up"]["direction"] == pytest.approx([0, 0.6, 0.8])
    store_world(SceneFolder.open(tmp_path), meters_per_unit=0.5, measured="height")
    assert run(*build, "--up", "0,0,2") == 0
    assert (
        "the scale was measured as a height along another up direction, (0.000, 0.600, 0.800)" in caplog.text
    )
    assert stored(tmp_path)["up"] == {"direction": [0, 0, 1], "reliable": True, "from": "user"}
    assert stored(tmp_path)["meters_per_unit"] == 0.5
    record = json.loads((tmp_path / "scene.json").read_text())
    record["world"]["poses"] = "those of another capture"
    (tmp_path / "scene.json").write_text(json.dumps(record))
    assert run(*build) == 0
    assert stored(tmp_path)["meters_per_unit"] is None
    assert "the scale no longer holds" in caplog.text


def test_invalid_up_and_scale_are_refused(old_demo_copy, capsys):
    for arguments in (
        ["--distance", "1"],
        ["--between", "a", "b"],
        ["--distance", "1", "--between", "a", "b", "--height-of", "a"],
        ["--distance", "0", "--height-of", "a"],
        ["--distance", "1", "--points", "0,0", "1,1,1"],
        ["--up", "0,0,0,0"],
    ):
        with pytest.raises(SystemExit) as caught:
            run("scale", old_demo_copy, *arguments)
        assert caught.value.code == 2
    assert run("scale", old_demo_copy, "--distance", 1, "--points", "1,1,1", "1,1,1") == 1
    assert "expected a positive distance, found 0" in capsys.readouterr().err
    assert run("scale", "demo", "--distance", 1, "--points", "1,1,1", "1,1,0") == 1
    told = capsys.readouterr().err
    assert "found the bundled scene; build a scene of the same photos with: lexsplat demo" in told


def test_a_scale_out_of_all_bounds_is_a_mistyped_distance(old_demo_copy, capsys):
    before = (old_demo_copy / "scene.json").read_bytes()
    points = ["--points", "0,0,0", "1,0,0"]
    with pytest.raises(SystemExit):
        run("scale", old_demo_copy, "--distance", "1e300", *points)
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert "distance must be positive and at most 1e+09 m, got 1e+300" in said
    for far, distance in (("1,0,0", "1e-30"), ("1e300,0,0", "1"), ("1e-30,0,0", "1")):
        assert run("scale", old_demo_copy, "--distance", distance, "--points", "0,0,0", far) == 1
        assert "scale: expected a unit of 1e-09 to 1e+09 m, found" in capsys.readouterr().err
    assert (old_demo_copy / "scene.json").read_bytes() == before


@pytest.mark.parametrize(
    ("option", "given"),
    [("up", ["--up", "0,0"]), ("points", ["--distance", "1", "--points", "0,0", "1,1,1"])],
)
def test_a_vector_that_is_none_is_refused_with_the_name_of_its_option(old_demo_copy, capsys, option, given):
    with pytest.raises(SystemExit):
        run("scale", old_demo_copy, *given)
    said = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert f"{option}: expected three numbers such as 0,0,1, found '0,0'" in said


@pytest.fixture
def scaled_by_a_height(old_demo_copy):
    """A scale from a height along (0, 1, 0), as --height-of stores it."""
    store_world(SceneFolder.open(old_demo_copy), up=(0, 1, 0), meters_per_unit=0.5, measured="height")
    return old_demo_copy


def test_an_up_direction_that_contradicts_the_cameras_is_set_with_a_warning(old_demo_copy, caplog):
    assert run("scale", old_demo_copy, "--up", "0,1,0") == 0
    assert (
        "up is 90 degrees from what the cameras agree on; if that is wrong, give: --up=0,0,1" in caplog.text
    )
    assert stored(old_demo_copy)["up"]["direction"] == [0, 1, 0]
    caplog.clear()
    assert run("scale", old_demo_copy, "--up", "0,0.1,1") == 0
    assert caplog.messages == [], "a small correction is what the option is for"


def test_cameras_that_do_not_agree_contradict_no_up_direction(old_demo_copy, monkeypatch, caplog):
    unsure = World.of_cameras(())
    assert not unsure.up.reliable
    monkeypatch.setattr(World, "of_cameras", lambda cameras: unsure)
    assert run("scale", old_demo_copy, "--up", "0,1,0") == 0
    assert caplog.messages == []


def test_a_scale_that_was_a_height_along_another_up_direction_is_noted_when_up_is_set(
    scaled_by_a_height, caplog
):
    caplog.clear()
    assert run("scale", scaled_by_a_height, "--up", "0,0,1") == 0
    (told,) = caplog.messages
    assert "measured as a height along another up direction, (0.000, 1.000, 0.000); measure again: " in told
    assert stored(scaled_by_a_height)["meters_per_unit"] == 0.5
    caplog.clear()
    assert run("scale", scaled_by_a_height, "--distance", 0.5, "--points", "0,0,0", "1,0,0") == 0
    assert run("scale", scaled_by_a_height, "--up", "0,0.1,1") == 0
    assert caplog.messages == [], "a distance between two points has no direction"


def test_a_scale_of_an_earlier_version_may_have_been_a_height(scaled_by_a_height, caplog):
    record = json.loads((scaled_by_a_height / "scene.json").read_text())
    record["world"].pop("measured")
    (scaled_by_a_height / "scene.json").write_text(json.dumps(record))
    caplog.clear()
    assert run("scale", scaled_by_a_height, "--up", "0,0,1") == 0
    (told,) = caplog.messages
    assert told.startswith("if the scale was measured as a height, that was along another up direction")
    caplog.clear()
    assert run("scale", scaled_by_a_height, "--up", "0,0,1") == 0
    assert caplog.messages == [], "nothing has changed"


def test_a_height_is_measured_along_the_up_direction_of_the_same_command(old_demo_copy, monkeypatch):
    directions = []

    def height_of(scene, phrase):
        directions.append((phrase, scene.world.up.direction.tolist()))
        return 2.0

    monkeypatch.setattr("lexsplat.scenes.scale.height_of", height_of)
    assert run("scale", old_demo_copy, "--up", "0,1,0", "--distance", "1m", "--height-of", "mug") == 0
    assert directions == [("mug", [0.0, 1.0, 0.0])]
    assert stored(old_demo_copy)["measured"] == {"as": "height", "up": [0.0, 1.0, 0.0]}
    assert stored(old_demo_copy)["meters_per_unit"] == 0.5


@pytest.mark.parametrize(
    ("meters", "absurd"), [("1", False), ("1km", True), ("0.1mm", True)], ids=["rooms", "cities", "grains"]
)
def test_the_meters_that_the_cameras_span_are_printed_with_a_warning_where_they_are_absurd(
    old_demo_copy, capsys, caplog, meters, absurd
):
    cameras = [view.camera for view in SceneFolder.open(old_demo_copy).read_cameras().values()]
    places = np.array([-camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3] for camera in cameras])
    span = np.sqrt(((places.max(0) - places.min(0)) ** 2).sum())
    assert run("scale", old_demo_copy, "--distance", meters, "--points", "0,0,0", "1,0,0") == 0
    out = capsys.readouterr().out
    if not absurd:
        assert f"one unit is 1 m; the {len(cameras)} cameras span {span:.2g} m" in out
    assert ("check the distance, its unit" in caplog.text) == absurd
