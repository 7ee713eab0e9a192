"""Features of other programs: from a folder of arrays through ``build`` to an answer."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from support.noise_photos import HEIGHT, WIDTH, make_capture
from support.refusals import assert_reports, build_refused
from support.tiny_capture import SPHERES, camera_poses, trace

from lexsplat import cli
from lexsplat.captures import Capture, load_capture
from lexsplat.codebook import Codebook
from lexsplat.features import FeatureMap, check_external_features, external_identity, load_external_features
from lexsplat.features.encoders import load_clip
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import FileFormatError, MemoryBudgetError

VIEWS, SIZE = 12, (96, 72)


@pytest.fixture
def capture(tmp_path) -> Capture:
    return make_capture(tmp_path / "images", count=2)


def write_arrays(folder: Path, array: np.ndarray) -> Path:
    for stem in ("left/0", "left/1"):
        (folder / stem).parent.mkdir(parents=True, exist_ok=True)
        np.save(folder / f"{stem}.npy", array)
    return folder


def numbered(height: int, width: int) -> np.ndarray:
    """Unit vectors that encode row and column."""
    row, column = np.mgrid[:height, :width] + 0.5
    angle, tilt = 0.5 + row / height, 0.5 + column / width
    parts = [np.cos(angle) * np.cos(tilt), np.cos(angle) * np.sin(tilt), np.sin(angle)]
    return np.stack(parts, -1).astype(np.float32)


@pytest.mark.parametrize("ending", ["npy", "safetensors", "pair"])
def test_arrays_finer_than_the_working_images_are_read_at_their_pixels(capture, tmp_path, ending):
    for name, view in capture.views.items():
        capture.views[name] = dataclasses.replace(view, camera=view.camera.downscaled(4))
    large = numbered(HEIGHT * 2, WIDTH * 2)
    folder = write_arrays(tmp_path / "arrays", large)
    for path in folder.rglob("*.npy"):
        if ending == "safetensors":
            save_file({"clip": torch.from_numpy(large)}, path.with_suffix(".safetensors"))
            path.unlink()
        elif ending == "pair":
            np.save(path.with_name(path.stem + "_f.npy"), large.reshape(-1, 3))
            pixels = np.arange(large[..., 0].size).reshape(1, *large.shape[:2])
            np.save(path.with_name(path.stem + "_s.npy"), pixels)
            path.unlink()
    found = load_external_features(folder, capture)["left/0.png"].clip
    assert found.shape == (8, 12, 3)
    np.testing.assert_allclose(found, large[4::8, 4::8], atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "fits"),
    [((16, 24), True), ((15, 24), True), ((16, 25), True), ((24, 16), False), ((3, 24), False)],
)
def test_an_array_has_the_photos_aspect_up_to_one_cell(capture, tmp_path, shape, fits):
    folder = write_arrays(tmp_path / "arrays", numbered(*shape))
    maps = load_external_features(folder, capture)
    if fits:
        assert maps["left/0.png"].clip.shape == (*shape, 3)
    else:
        with pytest.raises(FileFormatError, match="photo's aspect, 48x32, found"):
            maps["left/0.png"]


def test_features_of_another_depth_than_the_text_embeddings_are_refused(capture, tmp_path):
    maps = load_external_features(write_arrays(tmp_path, numbered(4, 6)), capture, dimension=512)
    with pytest.raises(
        FileFormatError, match=r"depth 512, like the embeddings of the text.*found 3; give the encoder"
    ):
        maps["left/0.png"]


def test_a_map_beyond_the_memory_is_refused_before_it_is_read(capture, tmp_path):
    maps = load_external_features(write_arrays(tmp_path, numbered(HEIGHT, WIDTH)), capture, memory=1 << 20)
    with pytest.raises(MemoryBudgetError, match="features of 48x32x3 of a view"):
        maps["left/0.png"]


def test_pixels_without_a_feature_have_no_code(capture, tmp_path):
    array = numbered(HEIGHT, WIDTH)
    array[:, :10] = 0
    folder = write_arrays(tmp_path, array)
    found = load_external_features(folder, capture)["left/0.png"]
    codes = Codebook(torch.eye(3)).assign(found)
    assert (codes[:, :10] == 255).all()
    assert (codes[:, 10:] < 3).all()
    with pytest.raises(FileFormatError, match=r"num-codes 255"):
        load_external_features(folder, capture, allow_holes=False)["left/0.png"]
    # With 256 codes, index maps have no value for pixels without a feature.
    assert Codebook(torch.eye(256)).assign(FeatureMap(torch.zeros(1, 1, 256))).item() == 0


def test_values_whose_norm_overflows_are_refused(capture, tmp_path):
    folder = write_arrays(tmp_path, np.full((4, 6, 3), 1e30, np.float32))
    with pytest.raises(FileFormatError, match="beyond 1e19"):
        load_external_features(folder, capture)["left/0.png"]


def test_the_identity_follows_every_file_that_is_read(capture, tmp_path):
    for stem in ("left/0", "left/1"):
        (tmp_path / stem).parent.mkdir(exist_ok=True)
        np.save(tmp_path / f"{stem}_f.npy", np.eye(3))
        np.save(tmp_path / f"{stem}_s.npy", np.zeros((1, 4, 6)))
    before = external_identity(tmp_path, capture)
    assert len(before) == 4
    np.save(tmp_path / "left/1_s.npy", np.zeros((2, 4, 6)))
    assert external_identity(tmp_path, capture) != before


# -- through the command line


@pytest.fixture(scope="module")
def segments(tmp_path_factory) -> Path:
    """What LangSplat's preprocessing writes of the tiny capture: four levels, -1 for none, features of words."""
    folder = tmp_path_factory.mktemp("language")
    features = load_clip("bundled").encode_text(["table top", *SPHERES, "object"]).numpy()
    for number, (rotation, translation) in enumerate(camera_poses(VIEWS), start=1):
        hit = trace(rotation, translation, 1.1 * SIZE[0], *SIZE)[1].astype(int)
        levels = np.full((4, *hit.shape), -1, np.float32)
        levels[0] = np.where(hit > 0, hit, -1)
        levels[1] = hit
        levels[:, :, -8:] = -1
        np.save(folder / f"view_{number:02d}_f.npy", features.astype(np.float16))
        np.save(folder / f"view_{number:02d}_s.npy", levels)
    return folder


# 8 codes: with 12, 16, 24 and 32 of them one of two things of this small scene is missed since it starts from fewer
# points (mIoU .53). Why is not understood.
def embed(capture: Path, output: Path, built: Path, features: Path, *options: str) -> int:
    return cli.main([
        "language", str(capture), "--output", str(output), "--splats", str(built / "gaussians.ply"),
        "--clip", "bundled", "--device", "cpu", "--codebook.num-codes", "8",
        "--features-from", str(features), *options,
    ])  # fmt: skip


def test_segments_of_another_program_answer_queries(tiny_capture, built, segments, tmp_path, capsys):
    output = tmp_path / "scene"
    assert embed(tiny_capture, output, built, segments) == 0  # averaged, the default
    measure(output)
    stages = json.loads((output / "scene.json").read_text())["stages"]
    capsys.readouterr()
    assert embed(tiny_capture, output, built, segments) == 0
    assert "features: 1/1 kept" in capsys.readouterr().err
    assert json.loads((output / "scene.json").read_text())["stages"] == stages


def test_segments_of_another_program_have_a_code_each(tiny_capture, built, segments, tmp_path):
    output = tmp_path / "scene"
    assert (
        embed(tiny_capture, output, built, segments, "--method", "trained", "--trained.iterations", "2") == 0
    )
    with Image.open(output / "codes" / "view_01.png") as image:
        codes = np.asarray(image)
    assert codes.shape == SIZE[::-1]
    assert (codes[:, -8:] == 255).all(), "pixels without a feature"
    levels = np.load(segments / "view_01_s.npy")[0][:, :-8]
    of_segments = [set(codes[:, :-8][levels == number]) for number in (-1, 1, 2)]
    assert [len(found) for found in of_segments] == [1, 1, 1]
    assert len(set.union(*of_segments)) == 3


def measure(output: Path) -> None:
    """Most of every object is found."""
    assert cli.main(["evaluate", str(output)]) == 0
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["language"]["strict"]["auto"]["mIoU"] > 0.7
    assert metrics["language"]["strict"]["mAP"] > 0.9


def removed(path: Path) -> None:
    path.with_name("view_03_s.npy").unlink()


def replaced(array: np.ndarray, ending: str = "_s.npy"):
    return lambda path: np.save(path.with_name(f"view_03{ending}"), array)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (removed, ["view_03_s.npy", "the segments of view_03_f.npy", "no such file"]),
        (replaced(np.zeros((4, 50, 50))), ["view_03_s.npy", "the photo's aspect, 96x72", "50x50"]),
        (replaced(np.zeros(96)), ["view_03_s.npy", "[levels, h, w]", "[96]"]),
        (replaced(np.zeros((0, 72, 96))), ["view_03_s.npy", "[levels, h, w]", "[0, 72, 96]"]),
        (replaced(np.zeros((0, 128)), "_f.npy"), ["view_03_f.npy", "[n, D]", "[0, 128]"]),
        (replaced(np.array(["a"]), "_f.npy"), ["view_03_f.npy", "an array of numbers"]),
    ],
    ids=["none", "another aspect", "a row", "no level", "no segment", "words"],
)
def test_segments_of_another_size_are_reported_before_structure_from_motion_and_reconstruction(
    tiny_capture, segments, tmp_path, monkeypatch, change, told
):
    monkeypatch.setattr("lexsplat.pipeline.geometry.reconstruct", lambda *_, **__: pytest.fail("too late"))
    monkeypatch.setattr(
        "lexsplat.pipeline.inputs.poses_from_photos", lambda *_, **__: pytest.fail("too late")
    )
    folder = shutil.copytree(segments, tmp_path / "segments")
    change(folder / "view_03_f.npy")
    config = BuildConfig(clip="bundled", dino="none", device="cpu", iterations=2, features_from=folder)
    build_refused(
        (tiny_capture, tiny_capture / "images"), tmp_path / "scene", config, *told, kind=FileFormatError
    )


@pytest.mark.slow
def test_features_of_another_depth_are_reported_before_the_reconstruction(
    tiny_capture, segments, tmp_path, monkeypatch
):
    monkeypatch.setattr("lexsplat.pipeline.geometry.reconstruct", lambda *_, **__: pytest.fail("too late"))
    told = ["view_03", "features of depth 128", "17"]
    pairs, arrays = shutil.copytree(segments, tmp_path / "segments"), tmp_path / "arrays"
    np.save(pairs / "view_03_f.npy", np.ones((4, 17), np.float32))
    arrays.mkdir()
    for name in load_capture(tiny_capture).views:
        depth = 17 if name.startswith("view_03") else 128
        np.save(arrays / f"{Path(name).stem}.npy", np.ones((72, 96, depth), np.float32))
    for folder in (pairs, arrays):
        config = BuildConfig(clip="bundled", dino="none", device="cpu", iterations=2, features_from=folder)
        build_refused((tiny_capture,), tmp_path / "scene", config, *told, kind=FileFormatError)


@pytest.mark.slow
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_features_with_one_number_that_is_not_finite_are_reported_before_the_cameras_of_photos(
    tiny_capture, tmp_path, monkeypatch, value
):
    for place in ("pipeline.geometry.reconstruct", "pipeline.inputs.poses_from_photos"):
        monkeypatch.setattr(f"lexsplat.{place}", lambda *_, **__: pytest.fail("too late"))
    folder = tmp_path / "arrays"
    folder.mkdir()
    for name in load_capture(tiny_capture).views:
        array = np.ones((72, 96, 128), np.float32)
        array[70, 3, 5] = value if name.startswith("view_03") else 1
        np.save(folder / f"{Path(name).stem}.npy", array)
    config = BuildConfig(clip="bundled", dino="none", device="cpu", iterations=2, features_from=folder)
    told = ["view_03.npy", "expected finite numbers", "NaN or infinity"]
    build_refused(
        (tiny_capture, tiny_capture / "images"), tmp_path / "scene", config, *told, kind=FileFormatError
    )


@pytest.mark.parametrize("ending", [".npy", ".safetensors", "_f.npy"])
@pytest.mark.parametrize(
    ("value", "told"), [(np.nan, "NaN"), (0.0, "zeros alone"), (1e30, "beyond 1e19")], ids=str
)
def test_wrong_numbers_of_each_form_are_found_before_a_build_starts(
    tiny_capture, segments, tmp_path, ending, value, told
):
    folder = shutil.copytree(segments, tmp_path / "maps")
    for path in [] if ending == "_f.npy" else list(folder.glob("*_f.npy")):
        stem = path.name.removesuffix("_f.npy")
        array = np.full((9, 12, 128), value if stem == "view_03" else 1.0, np.float32)
        path.unlink()
        if ending == ".npy":
            np.save(folder / f"{stem}.npy", array)
        else:
            save_file({"clip": torch.from_numpy(array)}, folder / f"{stem}.safetensors")
    if ending == "_f.npy":
        np.save(folder / "view_03_f.npy", np.full((4, 128), value, np.float32))
    with pytest.raises(FileFormatError) as caught:
        check_external_features(folder, load_capture(tiny_capture), 128)
    assert_reports(caught.value, f"view_03{ending}", told)


@pytest.mark.parametrize("form", ["depth", "square", "dino"])
def test_tensors_of_another_depth_or_shape_are_found_before_a_build_starts(tiny_capture, tmp_path, form):
    capture = load_capture(tiny_capture)
    for name in capture.views:
        tensors = {"clip": torch.ones(9, 9 if form == "square" else 12, 64 if form == "depth" else 128)}
        tensors |= {"dino": torch.full((9, 12, 4), torch.nan)} if form == "dino" else {}
        save_file(tensors, tmp_path / f"{Path(name).stem}.safetensors")
    with pytest.raises(FileFormatError) as caught:
        check_external_features(tmp_path, capture, 128)
    told = {"depth": "found 64", "square": "the photo's aspect", "dino": "NaN"}[form]
    assert_reports(caught.value, ".safetensors", told)


def test_segment_numbers_are_read_before_a_build_starts(tiny_capture, segments, tmp_path):
    folder, capture = shutil.copytree(segments, tmp_path / "segments"), load_capture(tiny_capture)
    check_external_features(folder, capture, 128)
    for path in folder.glob("*_s.npy"):
        np.save(path, np.full((72, 96), -1))
    with pytest.raises(FileFormatError, match="segments in some photo, found none in any"):
        check_external_features(folder, capture, 128)
    np.save(folder / "view_03_s.npy", np.full((72, 96), 4))
    with pytest.raises(FileFormatError, match="integers from -1 to 3, found 4 to 4"):
        check_external_features(folder, capture, 128)


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        (np.full((72, 96), 4), "integers from -1 to 3, found 4 to 4"),
        (np.full((72, 96), -2), "integers from -1 to 3, found -2 to -2"),
        (np.full((72, 96), 0.5), "integers from -1 to 3, found 0.5 to 0.5"),
        (np.full((72, 96), np.nan), "integer segment ids, found NaN"),
        (np.full((72, 96), 2**40), "up to 2^31, found 1.09951e+12 to 1.09951e+12"),
    ],
)
def test_segments_with_wrong_numbers_are_refused_with_what_to_do(
    tiny_capture, segments, tmp_path, numbers, told
):
    folder = shutil.copytree(segments, tmp_path / "segments")
    np.save(folder / "view_03_s.npy", numbers)
    with pytest.raises(FileFormatError) as caught:
        load_external_features(folder, load_capture(tiny_capture))["view_03.png"]
    assert_reports(caught.value, "view_03_s.npy", told)


def test_a_view_without_an_array_is_reported_before_anything_is_written(
    tiny_capture, built, tmp_path, capsys
):
    (tmp_path / "empty").mkdir()
    assert embed(tiny_capture, tmp_path / "scene", built, tmp_path / "empty") == 1
    assert "expected view_01.npy, view_01.safetensors or view_01_f.npy" in capsys.readouterr().err
    assert not (tmp_path / "scene" / "gaussians.ply").exists()


def test_photos_without_segments_are_told_and_a_capture_without_any_is_refused(
    tiny_capture, built, segments, tmp_path, capsys, caplog
):
    folder = shutil.copytree(segments, tmp_path / "segments")
    paths = sorted(folder.glob("*_s.npy"))
    np.save(paths[0], np.full((72, 96), -1))
    assert embed(tiny_capture, tmp_path / "scene", built, folder) == 0
    assert f"{folder}: 1 of 9 photos have no segment, and so no features" in caplog.text
    for path in paths:
        np.save(path, np.full((72, 96), -1))
    assert embed(tiny_capture, tmp_path / "other", built, folder) == 1
    assert f"{folder}: expected segments in some photo, found none in any" in capsys.readouterr().err
