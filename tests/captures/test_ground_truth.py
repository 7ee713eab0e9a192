"""Readers of the ground truth of public data sets, on small fixtures written by the descriptions of their layouts."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.draw import polygon2mask
from support.written_captures import HEIGHT, WIDTH, save, write_colmap

from lexsplat.captures import load_annotations, load_capture
from lexsplat.captures.ground_truth.layouts import layout_of, load_ground_truth, polygon_mask
from lexsplat.captures.ground_truth.prompt_lists import SCENES, prompt_names
from lexsplat.evaluation.demo import demo_capture
from lexsplat.runtime.errors import CaptureError, FileFormatError

NAMES = [f"{number:02d}.jpg" for number in range(6)]
FRAMES = [f"frame_{number:05d}.jpg" for number in range(1, 7)]


def prompts_of(scene: str, prompt_list: str = "released") -> tuple[str, ...]:
    return tuple(dict.fromkeys(prompt_names(scene, prompt_list).values()))


def disk(x, y, radius):
    ys, xs = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (xs - x) ** 2 + (ys - y) ** 2 < radius**2


def save_mask(path: Path, mask: np.ndarray) -> None:
    save(path, np.repeat(mask[..., None], 3, axis=2).astype(float))


# The authors' folders


@pytest.fixture
def authors(tmp_path):
    """Mip-NeRF 360 as the authors share it: images/, sparse/0/, segmentations/STEM/PROMPT.png."""
    root = tmp_path / "room"
    write_colmap(root, ["DSCF4670.JPG", "DSCF4671.JPG", "DSCF4680.JPG", "DSCF4690.JPG"])
    for stem, prompts in {
        "DSCF4670": ["silver gray curtain", "windows"],
        "DSCF4690": ["windows", "green Yucca plant"],
    }.items():
        for number, prompt in enumerate(prompts):
            save_mask(root / "segmentations" / stem / f"{prompt}.png", disk(20 + 9 * number, 20, 8))
    return root


def test_the_authors_folders_are_read_as_they_are(authors):
    capture = load_capture(authors)
    assert capture.test_names == ("DSCF4670.JPG", "DSCF4690.JPG"), "views with masks are held out"
    found = load_annotations(capture)
    assert found.layout == "segmentations"
    assert {view: list(prompts) for view, prompts in found.masks.items()} == {
        "DSCF4670.JPG": ["silver gray curtain", "windows"],
        "DSCF4690.JPG": ["green Yucca plant", "windows"],
    }
    ground_truth = load_ground_truth(capture.views["DSCF4690.JPG"], found.masks["DSCF4690.JPG"]["windows"])
    np.testing.assert_array_equal(ground_truth, disk(20, 20, 8))


def test_two_masks_of_one_prompt_in_one_view_are_refused(authors):
    folder = authors / "segmentations" / "DSCF4670"
    shutil.copy(folder / "silver gray curtain.png", folder / "silver_gray_curtain.png")
    told = "DSCF4670: .* found silver gray curtain.png and silver_gray_curtain.png, which mean the same one"
    with pytest.raises(CaptureError, match=told):
        load_annotations(load_capture(authors))


def test_masks_of_the_released_code_can_be_renamed_to_the_papers_prompts(authors):
    found = load_annotations(load_capture(authors)).renamed(prompt_names("room", "paper"))
    assert found.prompts() == ("curtain", "windows", "yucca plant")
    released = load_annotations(load_capture(authors)).renamed(prompt_names("room", "released"))
    assert released.prompts() == ("green Yucca plant", "silver gray curtain", "windows")


def test_prompts_outside_a_list_are_dropped(authors):
    save_mask(authors / "segmentations" / "DSCF4680" / "teapot.png", disk(20, 20, 8))
    found = load_annotations(load_capture(authors)).renamed(prompt_names("room", "released"))
    assert "DSCF4680.JPG" not in found.masks


def test_masks_named_after_the_papers_list_match_either_list(authors):
    folder = authors / "segmentations" / "DSCF4690"
    (folder / "green Yucca plant.png").rename(folder / "yucca plant.png")
    capture = load_capture(authors)
    assert load_annotations(capture, prompt_list="released").prompts() == (
        "green Yucca plant", "silver gray curtain", "windows",
    )  # fmt: skip
    assert load_annotations(capture, prompt_list="paper").prompts() == ("curtain", "windows", "yucca plant")


def test_masks_outside_a_list_are_reported_and_none_inside_is_refused(authors, caplog):
    save_mask(authors / "segmentations" / "DSCF4690" / "teapot.png", disk(20, 20, 8))
    capture = load_capture(authors)
    assert "teapot" not in load_annotations(capture, prompt_list="paper").prompts()
    (message,) = [record.getMessage() for record in caplog.records]
    assert "teapot" in message
    assert "windows" not in message
    for folder in ("DSCF4670", "DSCF4690"):
        for path in (authors / "segmentations" / folder).iterdir():
            path.rename(path.with_name(f"tea {path.name}"))
    with pytest.raises(CaptureError, match="prompts of the list 'paper'"):
        load_annotations(capture, prompt_list="paper")


def test_the_papers_list_is_the_table_of_its_supplement():
    """Counted by hand in the supplement's table, and compared with it where the paper is available."""
    assert {scene: len(prompts_of(scene, "paper")) for scene in SCENES} == {
        "bicycle": 6, "bonsai": 6, "counter": 11, "garden": 9, "kitchen": 5, "room": 11,
    }  # fmt: skip
    paper = Path(__file__).parents[2].parent / "shared" / "paper" / "legaussians.tex"
    if not paper.is_file():
        pytest.skip("the paper's source is not here")
    table = paper.read_text(encoding="utf-8").split(r"Scene   & Positive Words")[1].split(r"\bottomrule")[0]
    plain = re.sub(r"\\begin\{tabular\}\[c\]\{@\{\}c@\{\}\}|\\end\{tabular\}|\\\\|\\midrule", " ", table)
    for scene in SCENES:
        rows = re.search(rf"\b{scene}\s*&(.*?)(?=\b(?:{'|'.join(SCENES)})\s*&|$)", plain, flags=re.DOTALL)
        words = [" ".join(word.split()) for word in rows[1].split(",")]
        assert tuple(words) == prompts_of(scene, "paper"), scene


def test_the_released_lists_have_as_many_prompts_as_the_papers():
    for scene in SCENES:
        assert len(set(prompts_of(scene))) == len(prompts_of(scene, "paper"))
    assert "stale bread" in prompts_of("counter")
    assert "stable bread" in prompts_of("counter", "paper")
    with pytest.raises(ValueError, match="stump"):
        prompts_of("stump")


# 3D-OVS


@pytest.fixture
def ovs3d(tmp_path):
    root = tmp_path / "bench"
    write_colmap(root, NAMES)
    folder = root / "segmentations"
    for view in ("00", "03"):
        save_mask(folder / view / "wall.png", ~disk(30, 20, 12))
        save_mask(folder / view / "mini offroad car.png", disk(30, 20, 12))
    (folder / "classes.txt").write_text("wall\nmini offroad car\n")
    return root


def test_3d_ovs_is_read_with_its_class_list(ovs3d):
    capture = load_capture(ovs3d)
    assert capture.test_names == ("00.jpg", "03.jpg")
    found = load_annotations(capture)
    assert found.layout == "3d-ovs"
    assert found.prompts() == ("mini offroad car", "wall")
    assert list(found.masks) == ["00.jpg", "03.jpg"]
    total = sum(load_ground_truth(capture.views["03.jpg"], mask) for mask in found.masks["03.jpg"].values())
    np.testing.assert_array_equal(total, 1)


def test_3d_ovs_numbers_are_indices_unless_an_image_has_that_name(ovs3d):
    for number, name in enumerate(NAMES):
        (ovs3d / "images" / name).rename(ovs3d / "images" / f"DSC{number:03d}.jpg")
    write_colmap(ovs3d, [f"DSC{number:03d}.jpg" for number in range(6)], images=False)
    capture = load_capture(ovs3d)
    assert capture.test_names == ("DSC000.jpg", "DSC003.jpg")
    assert list(load_annotations(capture).masks) == ["DSC000.jpg", "DSC003.jpg"]


def test_3d_ovs_numbers_that_are_ambiguous_are_refused(ovs3d):
    (ovs3d / "images" / "00.jpg").unlink()  # now 03.jpg is the image of that name, 04.jpg the third counted
    with pytest.raises(CaptureError, match=r"03\.jpg and 04\.jpg"):
        load_annotations(load_capture(ovs3d), ovs3d / "segmentations")


def test_3d_ovs_needs_a_mask_for_every_class(ovs3d):
    (ovs3d / "segmentations" / "03" / "wall.png").unlink()
    with pytest.raises(CaptureError, match=r"no wall\.png"):
        load_annotations(load_capture(ovs3d))


# LERF-OVS


def label(name, objects, size=(WIDTH, HEIGHT)):
    return {
        "info": {"name": name, "width": size[0], "height": size[1], "depth": 3, "note": ""},
        "objects": [
            {"category": category, "group": 1, "segmentation": polygon, "area": 1.0, "layer": 1.0,
             "bbox": box, "iscrowd": False, "note": ""}
            for category, polygon, box in objects
        ],
    }  # fmt: skip


SQUARE = [[10.7, 5.2], [20.9, 5.2], [20.9, 15.9], [10.7, 15.9]]
OTHER = [[40, 30], [50, 30], [50, 40], [40, 40]]


@pytest.fixture
def lerf_ovs(tmp_path):
    """lerf_ovs/SCENE with the photos, lerf_ovs/label/SCENE with the labels of two of them."""
    write_colmap(tmp_path / "teatime", FRAMES)
    folder = tmp_path / "label" / "teatime"
    folder.mkdir(parents=True)
    two = [("sheep", SQUARE, [10, 5, 21, 16]), ("sheep", OTHER, [50, 40, 40, 30])]
    one = [("apple", OTHER, [40, 30, 50, 40])]
    for name, objects in ((FRAMES[1], [*two, *one]), (FRAMES[4], one)):
        (folder / f"{Path(name).stem}.json").write_text(json.dumps(label(name, objects)))
    return tmp_path / "teatime"


def test_lerf_ovs_labels_beside_the_capture_are_found_and_their_views_held_out(lerf_ovs):
    capture = load_capture(lerf_ovs)
    assert capture.test_names == (FRAMES[1], FRAMES[4])
    found = load_annotations(capture)
    assert found.layout == "lerf-ovs"
    assert {view: list(prompts) for view, prompts in found.masks.items()} == {
        FRAMES[1]: ["apple", "sheep"],
        FRAMES[4]: ["apple"],
    }


def test_lerf_ovs_objects_of_one_name_are_one_mask_with_several_boxes(lerf_ovs):
    found = load_annotations(load_capture(lerf_ovs))
    sheep = np.zeros((HEIGHT, WIDTH), bool)
    sheep[5:16, 10:21] = sheep[30:41, 40:51] = True  # corners truncated to whole pixels, edges included
    np.testing.assert_array_equal(found.masks[FRAMES[1]]["sheep"], sheep)
    np.testing.assert_array_equal(found.boxes[FRAMES[1]]["sheep"], [[10, 5, 21, 16], [50, 40, 40, 30]])


def test_polygons_outside_the_photo_or_of_two_corners_are_masks_without_a_pixel(lerf_ovs):
    path = lerf_ovs.parent / "label" / "teatime" / "frame_00005.json"
    outside = [[x - 900, y] for x, y in SQUARE]
    objects = [("apple", outside, [0, 0, 1, 1]), ("sheep", SQUARE[:2], [0, 0, 1, 1])]
    path.write_text(json.dumps(label(FRAMES[4], objects)))
    found = load_annotations(load_capture(lerf_ovs)).masks[FRAMES[4]]
    assert [mask.any() for mask in found.values()] == [False, False]


def test_lerf_ovs_masks_and_boxes_are_undistorted_with_their_photo(lerf_ovs):
    params = (60.0, 60.0, 32.0, 24.0, 0.15, 0.0, 0.0, 0.0)
    write_colmap(lerf_ovs, FRAMES, model=4, params=params, images=False)
    capture = load_capture(lerf_ovs)
    found = load_annotations(capture)
    mask, box = found.masks[FRAMES[4]]["apple"], found.boxes[FRAMES[4]]["apple"][0]
    width, height = capture.views[FRAMES[4]].capture_size
    assert mask.shape == (height, width) != (HEIGHT, WIDTH)
    rows, columns = np.nonzero(mask)
    assert box.tolist() == [columns.min(), rows.min(), columns.max(), rows.max()]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.pop("info"), "info"),
        (lambda c: c["objects"][0].pop("bbox"), "bbox"),
        (lambda c: c["objects"][0].update(bbox=[1, 2, 3]), "objects"),
        (lambda c: c["objects"][0].update(segmentation=[[1, float("nan")]]), "finite"),
        (lambda c: c["info"].update(width=0), "finite"),
    ],
)
def test_damaged_labels_are_refused_by_name(lerf_ovs, change, words):
    path = lerf_ovs.parent / "label" / "teatime" / "frame_00002.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=words) as error:
        load_annotations(load_capture(lerf_ovs))
    assert "frame_00002.json" in str(error.value)


def test_labels_of_no_view_or_of_another_aspect_are_refused(lerf_ovs):
    folder = lerf_ovs.parent / "label" / "teatime"
    path = folder / "frame_00005.json"
    path.write_text(json.dumps(label(FRAMES[4], [], size=(64, 64)) | {"objects": []}))
    assert load_annotations(load_capture(lerf_ovs)).masks[FRAMES[4]] == {}
    path.write_text(json.dumps(label(FRAMES[4], [("apple", OTHER, [1, 1, 2, 2])], size=(64, 64))))
    with pytest.raises(CaptureError, match="64x64"):
        load_annotations(load_capture(lerf_ovs))
    path.write_text(json.dumps(label("frame_00077.jpg", [])))
    with pytest.raises(CaptureError, match="no view"):
        load_annotations(load_capture(lerf_ovs))


def test_labels_can_be_given_by_folder(lerf_ovs, tmp_path):
    moved = tmp_path / "elsewhere"
    (lerf_ovs.parent / "label" / "teatime").rename(moved)
    capture = load_capture(lerf_ovs)
    assert load_annotations(capture).masks == {}
    assert layout_of(moved) == "lerf-ovs"
    assert set(load_annotations(capture, moved).masks) == {FRAMES[1], FRAMES[4]}


def test_a_given_folder_without_ground_truth_is_refused(lerf_ovs, tmp_path):
    capture = load_capture(lerf_ovs)
    with pytest.raises(CaptureError, match="no masks and no labels"):
        load_annotations(capture, lerf_ovs / "images")
    with pytest.raises(CaptureError, match=r"labels in teatime/.*give .*label/teatime"):
        load_annotations(capture, tmp_path / "label")
    for number, path in enumerate(sorted((tmp_path / "label" / "teatime").iterdir())):
        path.rename(path.with_name(f"image_{number}.json"))
    with pytest.raises(CaptureError, match=r"2 JSON files.*name labels frame_\*\.json"):
        load_annotations(capture, tmp_path / "label" / "teatime")
    assert load_annotations(capture).masks == {}  # automatic search may find nothing


def test_a_given_folder_whose_labels_hold_no_objects_is_refused(lerf_ovs, tmp_path):
    folder = tmp_path / "empty"
    folder.mkdir()
    (folder / "frame_00002.json").write_text(json.dumps(label(FRAMES[1], [])))
    with pytest.raises(CaptureError, match="labels without objects"):
        load_annotations(load_capture(lerf_ovs), folder)


@pytest.mark.slow
@given(st.lists(st.tuples(st.integers(-5, 45), st.integers(-5, 35)), min_size=3, max_size=9))
def test_a_polygon_mask_covers_its_inside_and_stays_in_its_bounding_box(points):
    found = polygon_mask(points, 40, 30)
    corners = np.array(points)
    inside = polygon2mask((30, 40), corners[:, ::-1])
    assert not (inside & ~found).any()
    x0, y0 = corners.min(0)
    x1, y1 = corners.max(0)
    rows, columns = np.nonzero(found)
    assert ((rows >= y0) & (rows <= y1) & (columns >= x0) & (columns <= x1)).all()


def test_a_polygon_by_hand():
    expected = np.zeros((6, 7), bool)
    expected[1:5, 2:5] = True
    np.testing.assert_array_equal(polygon_mask([[2, 1], [4.9, 1], [4.9, 4.9], [2, 4.9]], 7, 6), expected)
    assert not polygon_mask([], 7, 6).any()


def test_the_folder_that_holds_the_ground_truth_may_be_given_for_it(tmp_path):
    capture = load_capture(demo_capture("second"))
    shutil.copytree(demo_capture("second") / "segmentations", tmp_path / "segmentations")
    found, same = (load_annotations(capture, folder) for folder in (tmp_path, tmp_path / "segmentations"))
    assert found.origin == same.origin == tmp_path / "segmentations"
    assert found.masks == same.masks
    assert len(found.masks) == 6
