"""The scenes that ship with the package are whole: pictures, poses, points, masks and prompts agree."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from lexsplat.captures import load_capture
from lexsplat.captures.ground_truth.layouts import load_annotations

CAPTURES = Path(str(resources.files("lexsplat"))) / "demo" / "captures"
EXPECTED = {
    # size, views, held out, points at least, bytes at most
    "tabletop": ((480, 360), 72, 12, 6000, 6_500_000),
    "second": ((320, 240), 30, 6, 2000, 1_600_000),
}
KINDS = {"name", "color", "material", "attribute", "part"}

pytestmark = pytest.mark.parametrize("name", EXPECTED)


def held_out(name: str) -> list[str]:
    return json.loads((CAPTURES / name / "test_views.json").read_text())


def masks(name: str) -> list[Path]:
    return sorted((CAPTURES / name / "segmentations").glob("*/*.png"))


def read_mask(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


@pytest.mark.slow
def test_pictures_are_complete_and_of_one_size(name):
    size, views, _, _, _ = EXPECTED[name]
    pictures = sorted((CAPTURES / name / "images").glob("*.jpg"))
    assert len(pictures) == views
    for picture in pictures:
        with Image.open(picture) as image:
            image.load()
            assert (image.size, image.mode) == (size, "RGB")


@pytest.mark.slow
def test_pictures_are_neither_over_exposed_nor_flat(name):
    for picture in sorted((CAPTURES / name / "images").glob("*.jpg"))[::5]:
        image = np.asarray(Image.open(picture))
        assert (image.min(-1) >= 250).mean() < 0.01
        assert (image.max(-1) <= 5).mean() < 0.05
        assert image.mean(-1).std() > 30


def test_every_held_out_view_lies_between_training_views(name):
    _, views, count, _, _ = EXPECTED[name]
    stems = sorted(path.stem for path in (CAPTURES / name / "images").glob("*.jpg"))
    out = held_out(name)
    assert len(out) == len(set(out)) == count
    assert set(out) < set(stems)
    for stem in out:
        i = stems.index(stem)
        assert 0 < i < views - 1
        assert not {stems[i - 1], stems[i + 1]} & set(out)


def test_all_views_are_posed_and_points_come_from_training_views_only(name):
    (width, height), views, _, points, _ = EXPECTED[name]
    model = pycolmap.Reconstruction(CAPTURES / name / "sparse" / "0")
    assert model.num_reg_images() == views
    assert model.num_points3D() >= points
    (camera,) = model.cameras.values()
    assert (camera.model_name, camera.width, camera.height) == ("PINHOLE", width, height)
    seen_in = {image.name: image.num_points3D for image in model.images.values()}
    assert set(seen_in) == {path.name for path in (CAPTURES / name / "images").glob("*.jpg")}
    out = {f"{stem}.jpg" for stem in held_out(name)}
    assert all((count == 0) == (image in out) for image, count in seen_in.items())


@pytest.mark.slow
def test_points_project_to_where_they_were_seen(name):
    model = pycolmap.Reconstruction(CAPTURES / name / "sparse" / "0")
    (camera,) = model.cameras.values()
    K = camera.calibration_matrix()
    places = {number: point.xyz for number, point in model.points3D.items()}
    errors = []
    for image in model.images.values():
        world_to_camera = image.cam_from_world().matrix()
        points = np.array([[*places[seen.point3D_id], 1.0] for seen in image.points2D]).reshape(-1, 4)
        x, y, z = K @ world_to_camera @ points.T
        assert (z > 0).all()
        found = np.array([seen.xy for seen in image.points2D]).reshape(-1, 2)
        errors.append(np.hypot(x / z - found[:, 0], y / z - found[:, 1]))
    assert np.mean(np.concatenate(errors)) < 1.0


@pytest.mark.slow
def test_masks_are_binary_nonempty_and_of_the_pictures_size(name):
    size = EXPECTED[name][0]
    found = masks(name)
    assert {path.parent.name for path in found} == set(held_out(name))
    for path in found:
        mask = read_mask(path)
        assert mask.shape == size[::-1]
        assert mask.dtype == np.uint8
        assert set(np.unique(mask)) == {0, 255}


def test_every_mask_has_a_prompt_and_every_prompt_a_mask(name):
    prompts = json.loads((CAPTURES / name / "prompts.json").read_text())
    assert {path.stem.replace("_", " ") for path in masks(name)} == set(prompts)
    assert set(prompts.values()) == KINDS


def test_parts_lie_within_wholes_and_fruit_is_apple_and_banana(name):
    whole_of = {
        "tabletop": {"mug_handle": "blue_mug", "bear_nose": "brown_teddy_bear"},
        "second": {"mug_handle": "red_mug", "bear_nose": "teddy_bear"},
    }[name]
    fruits = {"tabletop": ("red_apple", "banana"), "second": ("green_apple",)}[name]
    compared = 0
    for stem in held_out(name):
        folder = CAPTURES / name / "segmentations" / stem
        for part, whole in whole_of.items():
            if (folder / f"{part}.png").exists():
                inside, outside = read_mask(folder / f"{part}.png"), read_mask(folder / f"{whole}.png")
                assert np.all(outside[inside > 0] == 255)
                assert (inside > 0).sum() < (outside > 0).sum()
                compared += 1
        fruit = read_mask(folder / "fruit.png")
        union = np.max([read_mask(folder / f"{one}.png") for one in fruits], axis=0)
        np.testing.assert_array_equal(fruit, union)
    assert compared >= len(held_out(name))


def test_masks_agree_with_the_colors_in_the_pictures(name):
    """A mask shifted or flipped against its picture would not select a red apple."""
    prompt, channel = {"tabletop": ("red_apple", 0), "second": ("green_apple", 1)}[name]
    for stem in held_out(name):
        image = np.asarray(Image.open(CAPTURES / name / "images" / f"{stem}.jpg")).astype(int)
        mask = read_mask(CAPTURES / name / "segmentations" / stem / f"{prompt}.png") > 0
        assert (image[mask].argmax(-1) == channel).mean() > 0.95


def test_scene_is_small(name):
    files = [path for path in (CAPTURES / name).rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < EXPECTED[name][4]


@pytest.mark.slow
def test_loads_as_a_scene_with_its_own_split_and_masks(name):
    _, views, count, points, _ = EXPECTED[name]
    scene = load_capture(CAPTURES / name)
    assert len(scene.views) == views
    assert {scene.views[view].stem for view in scene.test_names} == set(held_out(name))
    assert len(scene.train_names) == views - count
    assert len(scene.points) >= points
    prompts = json.loads((CAPTURES / name / "prompts.json").read_text())
    by_view = load_annotations(scene).masks
    assert set(by_view) == set(scene.test_names)
    for view, files in by_view.items():
        assert set(files) <= set(prompts)
        for path in files.values():
            assert scene.views[view].load_mask(path).shape == (
                scene.views[view].camera.height,
                scene.views[view].camera.width,
            )
