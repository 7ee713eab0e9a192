"""``lexsplat list``: the objects of the bundled scene, and vocabularies of all kinds."""

import csv
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.command_line import fails_in_one_line
from support.schemas import validated

from lexsplat import cli, open_scene
from lexsplat.scenes.objects import MAX_WORDS, list_document, objects_of
from lexsplat.scenes.scene import Scene

PLACES = {  # tools/demo_scene/layouts.py
    "apple": (-0.55, -0.75), "rubber duck": (0.35, -0.8), "mug": (-0.15, -0.1), "stack of books": (1.25, 0.2),
    "vase": (-1.1, 0.45), "ring": (1.0, -0.8), "traffic cone": (-1.55, -0.5), "potted plant": (0.2, 0.95),
    "table lamp": (1.5, 0.95), "banana": (-0.55, -1.25), "teddy bear": (-0.6, 0.75), "pumpkin": (0.65, 0.1),
    "toy car": (1.55, -0.5), "bottle": (-1.6, 0.9),
}  # fmt: skip
COLORS = {"apple": "red", "rubber duck": "yellow", "mug": "blue", "vase": "white", "traffic cone": "orange",
          "potted plant": "green", "banana": "yellow", "teddy bear": "brown", "pumpkin": "orange", "toy car": "red",
          "bottle": "green"}  # fmt: skip


@pytest.fixture(scope="module")
def demo() -> Scene:
    return open_scene("demo", device="cpu")


def test_each_thing_of_the_layout_is_listed_once_at_its_place_in_its_color(capsys):
    assert cli.main(["list", "demo", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    validated("list", document)
    things = {thing["name"]: thing for thing in document["objects"] if not thing["surface"]}
    assert len(things) == sum(not thing["surface"] for thing in document["objects"])
    assert things.keys() == PLACES.keys()
    for name, place in PLACES.items():
        assert things[name]["center"][:2] == pytest.approx(place, abs=0.25), name
        assert things[name]["names"][0]["name"] == name
    assert {name: things[name]["colors"][0] for name in COLORS} == COLORS


def test_objects_share_no_gaussian(demo):
    shared = torch.stack([thing.mask for thing in demo.objects]).sum(0)
    assert int(shared.max()) == 1


@pytest.mark.slow
def test_a_thing_that_no_view_shows_is_not_listed_and_the_others_are(demo, monkeypatch):
    unseen = next(thing for thing in demo.objects if thing.phrase == "rubber duck").mask | demo.hidden
    monkeypatch.setattr(type(demo), "hidden", property(lambda _: unseen))
    assert {thing.phrase for thing in objects_of(demo)} >= PLACES.keys() - {"rubber duck"}
    assert "rubber duck" not in {thing.phrase for thing in objects_of(demo)}


def test_a_vocabulary_names_the_things(demo, tmp_path, capsys):
    file = tmp_path / "names.txt"
    file.write_text("\ufeff# fruit\n\n apple \nbanana\nbanana\n", encoding="utf-8")
    assert cli.main(["list", "demo", "--vocabulary", str(file), "--csv"]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert {"apple", "banana"} == {row["name"] for row in rows}
    assert float(rows[0]["center_x"]) == pytest.approx(float(rows[0]["center_x"]))
    assert rows[0]["size_meters_x"] == "", "the scale is unknown"
    assert objects_of(demo, ["unicorn", "swimming pool"]) == ()


def test_the_table_has_the_likeliest_names_their_probabilities_and_how_each_box_is_turned(capsys, demo):
    assert cli.main(["list", "demo", "--csv"]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [row["names"].split(";") for row in rows] == [[name for name, _ in o.names] for o in demo.objects]
    for row, thing in zip(rows, demo.objects, strict=True):
        shares = [float(share) for share in row["probabilities"].split(";")]
        assert shares == pytest.approx([share for _, share in thing.names], abs=1e-4)
        assert (row["name"], float(row["probability"])) == (row["names"].split(";")[0], shares[0])
        turned = np.radians(float(row["box_angle_degrees"]))
        along = np.array([np.cos(turned), np.sin(turned), 0])  # the demo's z axis points up
        assert abs(thing.box.axes[0] @ along) == pytest.approx(1, abs=1e-4)


def test_a_name_in_another_case_is_the_same_name_in_its_first_spelling(demo, tmp_path, capsys):
    file = tmp_path / "names.txt"
    file.write_text("Mug\nMUG\n mug\napple\nAPPLE \n", encoding="utf-8")
    assert cli.main(["list", "demo", "--vocabulary", str(file), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["words"] == 2
    found = [(thing["name"], thing["names"][0]["probability"]) for thing in document["objects"]]
    alone = [
        (thing.phrase.replace("mug", "Mug"), round(thing.names[0][1], 4))
        for thing in objects_of(demo, ["mug", "apple"])
    ]
    assert found == alone, "one name is as likely as in a vocabulary that has it once"
    assert "Mug" in dict(found)
    assert {thing.phrase for thing in objects_of(demo, ["mug", " MUG", "apple"])} == {"mug", "apple"}
    assert list_document(demo, ["mug", "MUG"])["words"] == 1


def test_a_vocabulary_of_few_names_is_told_to_call_things_by_the_nearest_one(demo):
    few = list_document(demo, ["apple", "mug"])
    assert [each["name"] for each in few["objects"]].count("apple") > 1, "the banana is one, too"
    assert "few names" in few["note"]
    assert list_document(demo)["note"] == ""


@pytest.mark.slow
def test_thumbnails_show_the_objects_and_dim_what_is_around(demo, tmp_path):
    document = list_document(demo, (), tmp_path / "new" / "sheet.png")
    with Image.open(document["picture"]) as sheet:
        pixels = np.asarray(sheet)
    assert pixels.shape[1] == 5 * 240
    number = next(n for n, thing in enumerate(document["objects"]) if thing["name"] == "apple")
    top, left = number // 5 * 198, number % 5 * 240
    tile = pixels[top : top + 180, left : left + 240].astype(float)
    middle = tile[70:110, 100:140].reshape(-1, 3).mean(0)
    assert middle[0] > 2 * middle[1:].max(), "red"
    assert tile[:, :10].max() < 0.5 * 255, "what is around has at most .45 of its brightness"
    lit = (tile.max(2) > 0.5 * 255).mean()
    assert 0.1 < lit < 0.5, "as large as its tile lets it be"


@pytest.mark.slow
def test_an_object_of_a_scene_without_segments_is_found_by_its_word_and_the_list_says_so(demo):
    field = demo.field.select(torch.arange(len(demo.gaussians)))
    field.segments = None
    plain = demo.with_content(demo.gaussians, field)
    document = list_document(plain)
    assert "no segments" in document["note"]
    assert "lexsplat language CAPTURE --output SCENE" in document["note"], "how to get them"
    validated("list", document)
    assert {"mug", "pumpkin", "teddy bear"} <= {thing["name"] for thing in document["objects"]}


@pytest.mark.slow
def test_a_table_is_alone_on_standard_output_and_the_rest_is_told_beside_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("lexsplat.scenes.objects.NO_SEGMENTS", "how to get them")
    old = Path(__file__).parents[1] / "data" / "scene_d4e65b3" / "averaged"
    scene, sheet = str(shutil.copytree(old, tmp_path / "scene")), str(tmp_path / "sheet.png")
    assert cli.main(["list", scene, "--csv", "--images", "--output", sheet]) == 0
    found = capsys.readouterr()
    assert {len(row) for row in csv.reader(io.StringIO(found.out))} == {20}
    assert found.err.splitlines()[-2:] == ["no segments: each word is looked for; how to get them", sheet]


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "none"), (b"# nothing\n\n", "none"), (b"\xff\xfe\x00a", "UTF-8"),
        (b"mug\n\x00\x01\n", "printable characters, found '\\x00\\x01'"),
        (b"a" * 200, "at most 120 characters, found one of 200, 'aaaaaaaaaaaaaaaaaaaa...'"),
        (b"word\n" * 300_000, "bytes"),
        ("\n".join(map(str, range(MAX_WORDS + 1))).encode(), "2,001"),
    ],
    ids=["empty", "comments alone", "not UTF-8", "not text", "a long name", "a huge file", "too many names"],
)  # fmt: skip
def test_a_damaged_vocabulary_is_refused_in_one_line(tmp_path, capsys, content, told):
    file = tmp_path / "names.txt"
    file.write_bytes(content)
    fails_in_one_line(
        capsys, ["list", "demo", "--vocabulary", str(file)], "names.txt", "one name a line", told
    )


def test_a_missing_vocabulary_and_a_folder_are_refused(tmp_path, capsys):
    for path, found in ((tmp_path, "found a folder"), (tmp_path / "nothing", "found no such file")):
        fails_in_one_line(capsys, ["list", "demo", "--vocabulary", str(path)], "a readable file", found)


@pytest.mark.parametrize(
    "options", [["--csv", "--json"], ["--output", "a.png"], ["--images", "--output", "a.jpg"]]
)
def test_options_that_contradict_each_other_are_refused(options):
    with pytest.raises(SystemExit) as stop:
        cli.main(["list", "demo", *options])
    assert stop.value.code == 2
