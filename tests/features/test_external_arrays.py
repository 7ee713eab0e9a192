"""Arrays of another program become feature maps, or are refused with their defect."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from support.noise_photos import make_capture

from lexsplat.captures import Capture
from lexsplat.features import load_external_features
from lexsplat.runtime.errors import FileFormatError


@pytest.fixture
def capture(tmp_path) -> Capture:
    return make_capture(tmp_path / "images")


def _external(capture, folder, write):
    for view in capture.views.values():
        path = folder / view.stem
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path)
    return folder


def test_external_arrays_are_read_by_stem_and_normalized(capture, tmp_path):
    array = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float16)
    folder = _external(capture, tmp_path / "npy", lambda path: np.save(f"{path}.npy", array))
    maps = load_external_features(folder, capture)
    assert list(maps) == list(capture.views)
    expected = array.astype(np.float32)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(maps["left/2.png"].clip.numpy(), expected, atol=1e-6)
    tensors = {"clip": torch.from_numpy(array), "dino": torch.ones(5, 7, 2)}
    folder = _external(capture, tmp_path / "st", lambda path: save_file(tensors, f"{path}.safetensors"))
    found = load_external_features(folder, capture)["left/2.png"]
    np.testing.assert_allclose(found.clip.numpy(), expected, atol=1e-6)
    torch.testing.assert_close(found.dino, torch.full((5, 7, 2), 0.5**0.5))


def test_segment_features_become_maps_and_levels_are_averaged(capture, tmp_path):
    features = np.array([[2.0, 0], [0, 3.0]], np.float32)
    segments = np.array([[[0, 1], [-1, 0]], [[1, 1], [-1, -1]]], np.float32)

    def write(path):
        np.save(f"{path}_f.npy", features)
        np.save(f"{path}_s.npy", segments)

    found = load_external_features(_external(capture, tmp_path / "fs", write), capture)["left/0.png"]
    half = 0.5**0.5
    expected = torch.tensor([[[half, half], [0, 1]], [[0, 0], [1, 0]]])  # no segment: zero
    torch.testing.assert_close(found.clip, expected)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((4, 4, 3)), "expected features, found zeros alone"),
        (np.zeros((4, 4)), r"expected features \[h, w, D\]"),
        (np.full((2, 2, 3), np.nan), "NaN"),
        (np.zeros((2, 2, 3), "U1"), "array of numbers"),
        (np.array([[["a", {}]]], dtype=object), "without pickled objects"),
        (np.ones((3, 4, 3), np.uint8), "features as floating-point numbers, found uint8"),
        (np.ones((3, 4, 3), np.int64), "features as floating-point numbers, found int64"),
        (np.ones((1, 1, 3), np.float32), "expected a map of the photo, found one feature for all of it"),
    ],
)
def test_invalid_external_arrays_are_refused(array, message, capture, tmp_path):
    folder = _external(
        capture, tmp_path / "bad", lambda path: np.save(f"{path}.npy", array, allow_pickle=True)
    )
    with pytest.raises(FileFormatError, match=message):
        load_external_features(folder, capture)["left/0.png"]


def test_missing_and_mismatched_external_arrays_are_refused(capture, tmp_path):
    with pytest.raises(FileFormatError, match="no folder"):
        load_external_features(tmp_path / "nowhere", capture)
    folder = _external(
        capture, tmp_path / "x", lambda path: np.save(f"{path}.npy", np.ones((2, 2, 3), np.float32))
    )
    np.save(folder / "left/1.npy", np.ones((2, 2, 5), np.float32))
    maps = load_external_features(folder, capture)
    _ = maps["left/0.png"]
    with pytest.raises(FileFormatError, match="depth"):
        maps["left/1.png"]
    (folder / "left/1.npy").unlink()
    with pytest.raises(FileFormatError, match=r"left/1\.npy"):
        load_external_features(folder, capture)
    (folder / "left/1.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(FileFormatError, match="npy array"):
        load_external_features(folder, capture)["left/1.png"]
    np.save(folder / "left/0_s.npy", np.full((2, 2), 4))
    np.save(folder / "left/0_f.npy", np.ones((4, 3)))
    (folder / "left/0.npy").unlink()
    with pytest.raises(FileFormatError, match="integers from -1 to 3"):
        load_external_features(folder, capture)["left/0.png"]


def test_a_text_in_place_of_an_array_is_refused_without_advice_to_load_pickles(capture, tmp_path):
    folder = _external(
        capture, tmp_path / "x", lambda path: path.with_name(f"{path.name}.npy").write_text("1 2 3")
    )
    with pytest.raises(FileFormatError, match="found another format") as refused:
        load_external_features(folder, capture)["left/0.png"]
    assert "allow_pickle" not in str(refused.value)


def test_two_arrays_of_one_view_are_refused(capture, tmp_path):
    def write(path):
        np.save(f"{path}.npy", np.ones((3, 4, 3), np.float32))
        np.save(f"{path}_f.npy", np.ones((1, 3), np.float32))
        np.save(f"{path}_s.npy", np.zeros((3, 4), np.int32))

    with pytest.raises(FileFormatError, match=r"one array of the view left/0, found 0\.npy and 0_f\.npy"):
        load_external_features(_external(capture, tmp_path / "x", write), capture)
