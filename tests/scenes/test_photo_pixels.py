"""Pixels of a scene's views are found in the photos that the capture gave."""

import json

import numpy as np
import pytest
from support.written_captures import FOCAL, HEIGHT, WIDTH, write_colmap, write_transforms

from lexsplat.captures import load_capture
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.provenance import write_provenance
from lexsplat.runtime.errors import FileFormatError, QueryError
from lexsplat.scenes.folder import SceneFolder

NAMES = ["a.png", "b.png", "c.png"]
OPENCV = (FOCAL, 1.1 * FOCAL, 33.0, 23.0, -0.12, 0.03, 0.002, -0.001)
"""fx, fy, cx, cy, k1, k2, p1, p2 of a lens that distorts, for photos of WIDTH x HEIGHT."""


def by_opencv(rays: np.ndarray) -> np.ndarray:
    """Pixels ``[N, 2]`` of rays ``[N, 3]`` by the formula in OpenCV's documentation."""
    fx, fy, cx, cy, k1, k2, p1, p2 = OPENCV
    x, y = (rays[:, :2] / rays[:, 2:]).T
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([fx * u + cx, fy * v + cy], 1)


def stored(capture, folder) -> SceneFolder:
    """A scene folder with the views of a capture, read again from the disk."""
    write_provenance(SceneFolder(folder), capture, BuildConfig(clip="bundled", dino="bundled"), {})
    return SceneFolder.open(folder)


@pytest.mark.parametrize("downscale", [1.0, 2.7])
def test_a_world_point_is_at_the_pixel_where_the_lens_of_the_photo_shows_it(tmp_path, downscale):
    write_colmap(tmp_path / "capture", NAMES, model=4, params=OPENCV)
    capture = load_capture(tmp_path / "capture", downscale=downscale, test_every=0)
    rng = np.random.default_rng(0)
    for name, view in stored(capture, tmp_path / "scene").read_cameras().items():
        assert (view.camera.width, view.camera.height) != (WIDTH, HEIGHT), "it is cropped, and scaled"
        local = np.concatenate([rng.uniform(-0.3, 0.3, (20, 2)), np.ones((20, 1))], 1) * rng.uniform(
            1, 5, (20, 1)
        )
        seen = local @ view.camera.K.T  # by the pinhole camera of the view
        np.testing.assert_allclose(
            view.to_photo(seen[:, :2] / seen[:, 2:]), by_opencv(local), atol=1e-6, err_msg=name
        )


def test_photos_without_distortion_are_scaled_alone(tmp_path):
    write_transforms(tmp_path / "capture", NAMES)
    capture = load_capture(tmp_path / "capture", downscale=2, test_every=0)
    view = stored(capture, tmp_path / "scene").read_cameras()["b.png"]
    grid = np.array([[[0, 0], [WIDTH / 2, 0]], [[0.5, 0.5], [WIDTH / 2, HEIGHT / 2]]])
    np.testing.assert_allclose(view.to_photo(grid), 2 * grid, atol=1e-9)
    np.testing.assert_allclose(view.to_photo((3, 4)), (6, 8), atol=1e-9)
    assert view.photo is not None
    assert (view.photo.width, view.photo.height) == (WIDTH, HEIGHT)
    for wrong in (3, [1, 2, 3], [np.nan, 0]):
        with pytest.raises(ValueError, match=r"\[\.\.\., 2\]"):
            view.to_photo(wrong)


def test_a_scene_that_was_built_before_lenses_were_kept_says_to_build_again(tmp_path):
    write_transforms(tmp_path / "capture", NAMES)
    capture = load_capture(tmp_path / "capture", test_every=0)
    folder = stored(capture, tmp_path / "scene")
    folder.write_cameras({name: (view.camera, "train") for name, view in capture.views.items()})
    view = folder.read_cameras()["a.png"]
    with pytest.raises(QueryError, match=r"a\.png.*before lenses were kept.*build the scene again"):
        view.to_photo((1, 2))


def test_fields_that_earlier_versions_read_are_unchanged(tmp_path):
    write_transforms(tmp_path / "capture", NAMES)
    capture = load_capture(tmp_path / "capture", test_every=0)
    stored(capture, tmp_path / "scene")
    content = json.loads((tmp_path / "scene" / "cameras.json").read_text())
    assert content["format_version"] == 1
    for entry in content["views"]:
        assert list(entry) == ["name", "split", "width", "height", "K", "viewmat", "photo"]
        assert entry["photo"] == {
            "model": "PINHOLE",
            "width": WIDTH,
            "height": HEIGHT,
            "params": [60, 60, 32, 24],
        }


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 0},
        {"height": 1.5},
        {"model": 4},
        {"params": ["x"]},
        {"params": 3},
        {"params": [float("inf")]},
        "lens",
    ],
)
def test_a_damaged_lens_is_refused_when_the_views_are_read(tmp_path, wrong):
    write_transforms(tmp_path / "capture", NAMES)
    folder = stored(load_capture(tmp_path / "capture", test_every=0), tmp_path / "scene")
    file = tmp_path / "scene" / "cameras.json"
    content = json.loads(file.read_text())
    photo = content["views"][1]["photo"]
    content["views"][1]["photo"] = {**photo, **wrong} if isinstance(wrong, dict) else wrong
    file.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=r"cameras\.json.*build again"):
        folder.read_cameras()
