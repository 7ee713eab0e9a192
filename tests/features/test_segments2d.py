"""2D segments of photos, and features pooled by them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from support.refusals import assert_reports, build_refused
from support.tiny_capture import QUICK_BUILD, camera_poses, trace

from lexsplat import cli
from lexsplat.captures import Capture, View, load_annotations, load_capture
from lexsplat.captures.images.undistortion import Lens, pinhole_of
from lexsplat.evaluation.demo import demo_capture
from lexsplat.features import FeatureConfig, extract_features
from lexsplat.features.encoders import load_clip
from lexsplat.features.extraction import size_of_map
from lexsplat.features.segments2d import (
    SUPERPIXELS,
    SegmentFolder,
    check_segments,
    load_segmenter,
    pool,
    pooled_features,
    segments_identity,
)
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.provenance import settings_identity
from lexsplat.runtime.errors import LexsplatError, ModelError
from lexsplat.runtime.fingerprints import fingerprint

VIEWS, SIZE = 12, (96, 72)


def unit(*shape: int) -> torch.Tensor:
    return F.normalize(torch.randn(*shape, generator=torch.Generator().manual_seed(1)), dim=-1)


# -- pooling


def pooled_by_loops(features: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Pixel by pixel in float64."""
    found = features.astype(np.float64)
    for row, column in np.ndindex(features.shape[:2]):
        if not features[row, column].any():
            continue
        means = []
        for level in levels:
            if level[row, column] >= 0:
                total = features.astype(np.float64)[level == level[row, column]].sum(0)
                means.append(total / np.linalg.norm(total))
        if means:
            found[row, column] = np.mean(means, axis=0)
    return found


@pytest.mark.parametrize("levels", [1, 3])
def test_pooling_equals_loops_over_all_pixels(levels):
    features = unit(6, 9, 5)
    features[2:4, 3:5] = 0
    labels = np.random.default_rng(0).integers(-1, 5, (levels, 6, 9)) * 1000  # gaps between numbers
    labels[labels < 0] = -1
    found = pool(features, torch.from_numpy(labels))
    np.testing.assert_allclose(found, pooled_by_loops(features.numpy(), labels), atol=1e-6)


def test_ignored_cells_stay_zero_and_change_no_segment():
    features, labels = unit(4, 6, 3), torch.zeros(1, 4, 6, dtype=torch.int32)
    features[:, 3:] = 0
    found = pool(features, labels)
    assert not found[:, 3:].any()
    expected = F.normalize(features[:, :3].sum((0, 1)), dim=0)
    torch.testing.assert_close(found[:, :3], expected.expand(4, 3, 3))


def test_cells_in_no_segment_keep_their_features():
    features = unit(4, 6, 3)
    assert torch.equal(pool(features, torch.full((2, 4, 6), -1)), features)
    assert torch.equal(pool(features, torch.zeros(0, 4, 6)), features), "no level"


def test_segments_of_equal_features_change_nothing():
    labels = torch.arange(24).reshape(1, 4, 6) // 5
    features = unit(24, 3)[labels[0]]
    torch.testing.assert_close(pool(features, labels), features)


def test_each_level_is_an_observation():
    """Part and thing differ: the mean of both is shorter than a unit vector, as that of two views is."""
    features = torch.eye(2)[torch.tensor([[0, 1, 1, 1]])]
    parts, thing = torch.tensor([[0, 1, 1, 1]]), torch.tensor([[0, 0, 0, 0]])
    found = pool(features, torch.stack([parts, thing]))
    whole = np.array([1, 3]) / 10**0.5
    np.testing.assert_allclose(found[0, 0], (np.array([1, 0]) + whole) / 2, rtol=1e-6)
    assert found[0, 0].norm() < 0.9


# -- where segments come from


@pytest.fixture
def view(tiny_capture) -> View:
    return load_capture(tiny_capture).views["view_03.png"]


def test_superpixels_are_those_of_scikit_image(view):
    from skimage.segmentation import slic

    found = load_segmenter("slic").labels(view, SIZE)
    assert found.shape == (len(SUPERPIXELS), SIZE[1], SIZE[0])
    with Image.open(view.image_path) as image:
        photo = np.asarray(image, np.float32) / 255
    for level, number in zip(found, SUPERPIXELS):
        np.testing.assert_array_equal(level, slic(photo, number, compactness=10.0, start_label=0))
    np.testing.assert_array_equal(load_segmenter("slic").labels(view, SIZE), found)


def write(folder: Path, stem: str, ending: str, numbers: np.ndarray) -> Path:
    """Segments ``[h, w]`` or ``[L, h, w]`` from 0, in one of the forms that are read."""
    path = folder / f"{stem}{ending.removesuffix('16')}"
    if ending == ".png":
        Image.fromarray((numbers + 1).astype(np.uint8)).save(path)
    elif ending == ".png16":
        Image.fromarray((numbers + 1).astype(np.uint16)).save(path)
    else:
        np.save(path, numbers.astype(np.float32 if ending == "_s.npy" else np.int16))
    return path


@pytest.mark.parametrize("ending", [".png", ".png16", ".npy", "_s.npy"])
def test_a_folder_may_hold_any_of_four_forms(ending, view, tmp_path):
    numbers = np.arange(72 * 96).reshape(72, 96) // (3000 if ending != ".png16" else 11)
    numbers[:20] = -1
    write(tmp_path, "view_03", ending, numbers)
    segmenter = load_segmenter(str(tmp_path))
    np.testing.assert_array_equal(segmenter.labels(view, SIZE), numbers[None])
    np.testing.assert_array_equal(segmenter.labels(view, (32, 24)), numbers[None, 1::3, 1::3])


@pytest.mark.parametrize("ending", [".npy", "_s.npy"])
def test_levels_of_a_folder_are_kept_apart(ending, view, tmp_path):
    numbers = np.stack([np.arange(72 * 96).reshape(72, 96) // step for step in (100, 500, 3000, 7000)])
    write(tmp_path, "view_03", ending, numbers)
    np.testing.assert_array_equal(load_segmenter(str(tmp_path)).labels(view, SIZE), numbers)


def test_segments_drawn_on_a_distorted_photo_are_undistorted_like_masks(view, tmp_path):
    lens = Lens("SIMPLE_RADIAL", 96, 72, (100.0, 48.0, 36.0, -0.15))
    width, height, _ = pinhole_of(lens)
    bent = replace(view, lens=lens, capture_size=(width, height))
    numbers = np.add.outer(np.arange(72) // 8 * 12, np.arange(96) // 8)
    path = write(tmp_path, "view_03", ".npy", numbers)
    found = load_segmenter(str(tmp_path)).labels(bent, (width, height))[0]
    assert (height, width) != numbers.shape, "the lens bends"
    for number in (0, 40, 107):
        mask = bent.undistort_mask(numbers == number, path, (width, height))
        assert ((found == number) != mask).sum() <= 2, "a pixel at equal distances from two"


# -- what is refused, and when


@pytest.fixture(scope="module")
def exact(tmp_path_factory) -> Path:
    """The exact segments of every photo of the tiny capture: floor and background, and two spheres."""
    folder = tmp_path_factory.mktemp("exact")
    for number, (rotation, translation) in enumerate(camera_poses(VIEWS), start=1):
        hit = trace(rotation, translation, 1.1 * SIZE[0], *SIZE)[1].astype(int)
        write(folder, f"view_{number:02d}", ".png", hit)
    return folder


AGAIN = "write the map of segments again"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda path: path.unlink(), ["view_03.png, view_03.npy or view_03_s.npy", "none of them"]),
        (
            lambda path: Image.new("L", (50, 50), 1).save(path),
            ["view_03.png", "a map of segments of view_03.png, 96x72", "50x50", AGAIN],
        ),
        (lambda path: Image.new("RGB", SIZE).save(path), ["view_03.png", "one number a pixel", "mode RGB"]),
        (lambda path: path.write_text("none"), ["view_03.png", "an image", AGAIN]),
        (
            lambda path: (path.unlink(), np.save(path.with_suffix(".npy"), np.full((72, 96), 0.5))),
            ["view_03.npy", "integers", "0.5"],
        ),
        (
            lambda path: (path.unlink(), np.save(path.with_suffix(".npy"), np.zeros(96))),
            ["view_03.npy", "[levels, h, w]", "[96]"],
        ),
        (
            lambda path: (path.unlink(), np.save(path.with_suffix(".npy"), np.zeros((3, 72, 96)))),
            ["view_03.npy", "1 level, as view_0", "3 levels"],
        ),
    ],
    ids=["none", "another size", "colors", "no image", "fractions", "a row", "other levels"],
)
def test_wrong_segments_are_reported_before_structure_from_motion_and_reconstruction(
    tiny_capture, exact, tmp_path, monkeypatch, change, told
):
    for late in ("geometry.reconstruct", "inputs.poses_from_photos"):
        monkeypatch.setattr(f"lexsplat.pipeline.{late}", lambda *_, **__: pytest.fail("too late"))
    folder = shutil.copytree(exact, tmp_path / "segments")
    change(folder / "view_03.png")
    features = FeatureConfig(segments=str(folder))
    config = BuildConfig(clip="bundled", dino="none", device="cpu", iterations=2, features=features)
    build_refused(
        (tiny_capture, tiny_capture / "images"), tmp_path / "scene", config, *told, kind=LexsplatError
    )


def test_a_misspelt_word_gets_a_suggestion_and_a_model_is_loaded_before_structure_from_motion(
    tiny_capture, tmp_path, monkeypatch
):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr(
        "lexsplat.pipeline.inputs.poses_from_photos", lambda *_, **__: pytest.fail("too late")
    )
    for name, told in (("slik", "did you mean slic?"), ("nobody/sam2", "--features.segments slic")):
        features = FeatureConfig(segments=name)
        config = BuildConfig(clip="bundled", dino="none", device="cpu", features=features)
        with pytest.raises(ModelError) as caught:
            build(tiny_capture / "images", tmp_path / "scene", config)
        assert_reports(caught.value, name, told)


def test_segments_of_held_out_photos_are_not_needed(tiny_capture, exact, tmp_path):
    capture = load_capture(tiny_capture)
    folder = shutil.copytree(exact, tmp_path / "segments")
    for view in capture.test_views:
        (folder / f"{view.stem}.png").unlink()
    check_segments(FeatureConfig(segments=str(folder)), capture)


def test_features_of_another_program_are_not_pooled():
    with pytest.raises(ValueError, match=r"leave --features\.segments out"):
        BuildConfig(features_from=Path("there"), features=FeatureConfig(segments="slic"))
    with pytest.raises(ValueError, match="got nothing"):
        FeatureConfig(segments=" ")


# -- what is kept


def test_without_segments_stages_have_the_fingerprints_of_before(tiny_capture):
    """The hashes were computed at 08d5981, which has no segments."""
    capture = load_capture(tiny_capture)
    for config, before in (
        (FeatureConfig.bundled(), "a85202a76450d64c49bc38cf"),
        (FeatureConfig(), "2badea7242143a5e9615e379"),
    ):
        stage = ["photos", *settings_identity(config, capture), [["bundled"], ["none"]]]
        assert fingerprint(stage) == before
        with_segments = settings_identity(replace(config, segments="slic"), capture)
        assert fingerprint(["photos", *with_segments, [["bundled"], ["none"]]]) != before


def test_the_identity_follows_the_content_of_the_folder(tiny_capture, exact, tmp_path):
    capture = load_capture(tiny_capture)
    folder = shutil.copytree(exact, tmp_path / "segments")
    before = segments_identity(str(folder), capture)
    assert segments_identity(str(exact), capture) == before, "a copy"
    view = capture.train_views[0]
    Image.new("L", SIZE, 1).save(folder / f"{view.stem}.png")
    assert segments_identity(str(folder), capture) != before
    assert SegmentFolder(folder).key(view) != SegmentFolder(exact).key(view)


@pytest.fixture(scope="module")
def two_levels(exact, tmp_path_factory) -> Path:
    """The exact segments of every photo, and both spheres as one thing."""
    folder = tmp_path_factory.mktemp("two_levels")
    for path in sorted(exact.glob("*.png")):
        parts = np.asarray(Image.open(path)).astype(int) - 1
        write(folder, path.stem, ".npy", np.stack([parts, np.minimum(parts, 1)]))
    return folder


def few_views(capture: Capture, names: list[str]) -> Capture:
    return replace(
        capture, views={name: capture.views[name] for name in names}, train_names=tuple(names), test_names=()
    )


@pytest.mark.slow
def test_segments_share_the_stored_crops_and_are_found_once(
    tiny_capture, exact, two_levels, tmp_path, monkeypatch
):
    config = FeatureConfig(crop_sizes=(0.5,), crop_strides=(0.5,), map_cells=18)
    capture = few_views(load_capture(tiny_capture), ["view_03.png", "view_07.png"])
    clip = load_clip("bundled")
    plain = extract_features(capture, clip, None, config, cache_dir=tmp_path)
    monkeypatch.setattr(clip, "encode_images", lambda _: pytest.fail("encoded again"))
    maps = extract_features(capture, clip, None, replace(config, segments="slic"), cache_dir=tmp_path)
    for segments, apart in (("slic", 0), (str(exact), 0), (str(two_levels), 2)):
        segmenter, events = load_segmenter(segments), []
        found = pooled_features(maps, capture, segmenter, config, cache_dir=tmp_path, listener=events.append)
        assert [(event.stage, event.done, event.total) for event in events] == [
            ("2D segments", 0, 2),
            ("2D segments", 1, 2),
            ("2D segments", 2, 2),
        ]
        for name, view in capture.views.items():
            labels = segmenter.labels(view, size_of_map(view.capture_size, config))
            expected = pooled_by_loops(plain[name].clip.numpy(), labels)
            np.testing.assert_allclose(found[name].clip, expected, atol=1e-5)
            assert len(found[name].levels) == apart, "sizes of superpixels are observations of one thing"
            for level, alone in zip(found[name].levels, labels):
                expected = pooled_by_loops(plain[name].clip.numpy(), alone[None])
                np.testing.assert_allclose(level.clip, expected, atol=1e-5)
        monkeypatch.setattr(type(segmenter), "labels", lambda *_: pytest.fail("found again"))
        again = pooled_features(maps, capture, segmenter, config, cache_dir=tmp_path)
        assert torch.equal(again["view_03.png"].clip, found["view_03.png"].clip)
        monkeypatch.undo()


# -- what they are good for


@pytest.mark.slow
def test_exact_masks_of_the_second_capture_sharpen_features_at_outlines(tmp_path):
    """Masks of a held-out photo as its segments: near outlines, more cells are nearest to the right words."""
    whole = load_capture(demo_capture("second"))
    name = whole.test_names[0]
    capture, config = few_views(whole, [name]), FeatureConfig.bundled()
    view, clip = capture.views[name], load_clip("bundled")
    masks = {
        prompt: view.load_mask(path, (320, 240))
        for prompt, path in load_annotations(whole).masks[name].items()
        if not prompt.startswith("something") and prompt not in ("fruit", "bear nose", "mug handle")
    }
    numbers = np.full((240, 320), -1)
    for number, mask in enumerate(masks.values()):
        numbers[mask] = number
    write(tmp_path, view.stem, ".png", numbers)
    cols, rows = size_of_map(view.capture_size, config)
    truth = load_segmenter(str(tmp_path)).labels(view, (cols, rows))[0]
    outline = np.zeros_like(truth, dtype=bool)
    for axis in (0, 1):
        for step in (1, 2, -1, -2):
            outline |= np.roll(truth, step, axis) != truth
    outline &= truth >= 0
    maps = extract_features(capture, clip, None, config, cache_dir=tmp_path / "cache")
    pooled = pooled_features(
        maps, capture, load_segmenter(str(tmp_path)), config, cache_dir=tmp_path / "cache"
    )
    words = clip.encode_text(list(masks))

    def right(found: torch.Tensor) -> float:
        return float(((found @ words.T).argmax(-1).numpy() == truth)[outline].mean())

    assert right(pooled[name].clip) > right(maps[name].clip) + 0.1


def measured(scene: Path) -> float:
    """The mAP of a scene of the tiny capture."""
    assert cli.main(["evaluate", str(scene), "--protocols", "strict"]) == 0
    return json.loads((scene / "metrics.json").read_text())["language"]["strict"]["mAP"]


def test_exact_masks_improve_a_scene_and_another_source_makes_it_anew(
    tiny_capture, built, exact, two_levels, tmp_path, capsys
):
    output = shutil.copytree(built, tmp_path / "scene")
    command = ["language", str(tiny_capture), "--output", str(output), *QUICK_BUILD, "--features.segments"]
    assert cli.main([*command, str(exact)]) == 0
    without = measured(built)
    assert measured(output) > without + 0.15
    record = json.loads((output / "scene.json").read_text())
    assert record["config"]["features"]["segments"] == str(exact.resolve())
    capsys.readouterr()
    assert cli.main([*command, str(exact)]) == 0
    assert "features: 1/1 kept" in capsys.readouterr().err
    assert cli.main(["info", str(output), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["language_levels"] == 1
    assert cli.main([*command, str(two_levels)]) == 0
    assert "features: 1/1 kept" not in capsys.readouterr().err
    assert cli.main(["info", str(output), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["language_levels"] == 2
    assert measured(output) > without + 0.15
