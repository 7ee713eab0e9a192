import numpy as np
import pycolmap
import pytest
from PIL import Image
from support.written_captures import picture, save

from lexsplat.captures.capture import View
from lexsplat.captures.images.bands import ArrayRows, resized
from lexsplat.captures.images.undistortion import Lens, pinhole_of, undistort
from lexsplat.geometry.cameras import Camera
from lexsplat.runtime.memory import BAND_BYTES

SIZE = (96, 72)
CENTER = (47.0, 37.0)
F = 80.0
LENSES = {
    "SIMPLE_PINHOLE": (F, *CENTER),
    "PINHOLE": (F, F + 2, *CENTER),
    "SIMPLE_RADIAL": (F, *CENTER, -0.1),
    "RADIAL": (F, *CENTER, -0.1, 0.05),
    "OPENCV": (F, F + 2, *CENTER, -0.1, 0.05, 0.002, -0.003),
    "FULL_OPENCV": (F, F + 2, *CENTER, -0.1, 0.05, 0.002, -0.003, 0.01, 0.02, 0.01, 0.0),
    "SIMPLE_RADIAL_FISHEYE": (F, *CENTER, 0.02),
    "RADIAL_FISHEYE": (F, *CENTER, 0.02, -0.01),
    "OPENCV_FISHEYE": (F, F + 2, *CENTER, 0.02, -0.01, 0.005, 0.0),
    "FOV": (F, F + 2, *CENTER, 0.5),
    "THIN_PRISM_FISHEYE": (F, F + 2, *CENTER, 0.02, -0.01, 0.001, 0.002, 0.0, 0.0, 0.001, 0.0),
}


def photo_through(lens: Lens) -> np.ndarray:
    """The analytic image through the lens: the color of every photo pixel from its ray."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.to_pycolmap().cam_from_img(np.stack([x.ravel(), y.ravel()], 1))
    return picture(*rays.T).reshape(lens.height, lens.width, 3).astype(np.float32)


def pinhole_picture(lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """The analytic image through a pinhole camera: the mean over 4x4 samples of each pixel."""
    width, height, K = pinhole_of(lens)
    fine = (np.arange(4) + 0.5) / 4
    u = (np.arange(size[0])[:, None] + fine).ravel() * width / size[0]
    v = (np.arange(size[1])[:, None] + fine).ravel() * height / size[1]
    x, y = np.meshgrid((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])
    return picture(x, y).reshape(size[1], 4, size[0], 4, 3).mean((1, 3))


@pytest.mark.parametrize("model", LENSES)
def test_undistorted_photos_show_what_a_pinhole_camera_sees(model):
    lens = Lens(model, *SIZE, LENSES[model])
    width, height, _ = pinhole_of(lens)
    seen = undistort(ArrayRows(photo_through(lens)), lens, (width, height))
    assert np.abs(seen - pinhole_picture(lens, (width, height))).max() < 0.012
    assert np.abs(seen - pinhole_picture(lens, (width, height))).mean() < 0.001


@pytest.mark.parametrize("divisor", [1.5, 4, 7])
def test_smaller_undistorted_photos_average_the_area(divisor):
    lens = Lens("OPENCV", *SIZE, LENSES["OPENCV"])
    width, height, _ = pinhole_of(lens)
    size = (round(width / divisor), round(height / divisor))
    rng = np.random.default_rng(0)
    noisy = photo_through(lens) + rng.normal(0, 0.1, (SIZE[1], SIZE[0], 3)).astype(np.float32)
    seen = undistort(ArrayRows(np.clip(noisy, 0, 1)), lens, size)
    error = (seen - pinhole_picture(lens, size)).std()
    # The mean over divisor^2 independent pixels; skipping pixels would leave the noise at 0.1.
    assert error < 1.6 * 0.1 / divisor


def test_every_perspective_model_of_pycolmap_is_supported():
    for name, model in pycolmap.CameraModelId.__members__.items():
        if name == "INVALID":
            continue
        camera = pycolmap.Camera.create_from_model_id(1, model, 500.0, 640, 480)
        if camera.is_perspective():
            width, height, K = pinhole_of(Lens(name, 640, 480, tuple(camera.params)))
            assert (width, height) == pytest.approx((640, 480), abs=110)
            assert K[0, 0] == pytest.approx(500)


def test_panoramas_are_refused_because_they_have_no_pinhole_equivalent():
    with pytest.raises(ValueError, match="EQUIRECTANGULAR"):
        Lens("EQUIRECTANGULAR", 640, 320, (640.0, 320.0))


def test_no_pixel_of_the_result_lies_outside_the_photo():
    for model, params in LENSES.items():
        lens = Lens(model, *SIZE, params)
        width, height, K = pinhole_of(lens)
        border = np.array([(u, v, 1.0) for u in (0.5, width - 0.5) for v in (0.5, height - 0.5)])
        border[:, :2] = (border[:, :2] - K[:2, 2]) / np.diag(K)[:2]
        where = lens.to_pycolmap().img_from_cam(border)
        assert (where > -0.75).all(), model
        assert (where < np.array(SIZE) + 0.75).all(), model


def test_without_distortion_the_camera_is_unchanged():
    width, height, K = pinhole_of(Lens("RADIAL", *SIZE, (F, *CENTER, 0.0, 0.0)))
    assert (width, height) == SIZE
    np.testing.assert_array_equal(K, [[F, 0, 47], [0, F, 37], [0, 0, 1]])


@pytest.mark.parametrize(
    ("model", "size", "params", "message"),
    [
        ("PINHOLE", (0, 4), (1.0, 1, 1, 1), "image size"),
        ("PINHOLE", (10**9, 4), (1.0, 1, 1, 1), "image size"),
        ("PINHOLE", SIZE, (F, F, 1.0), "parameters"),
        ("PINHOLE", SIZE, (F, np.nan, 1.0, 1.0), "finite"),
        ("PINHOLE", SIZE, (-F, F, 1.0, 1.0), "focal"),
        ("PINHOLE", SIZE, (1e-9, F, 1.0, 1.0), "focal"),
        ("WIDE", SIZE, (F, F, 1.0, 1.0), "model"),
    ],
)
def test_impossible_lenses_are_refused(model, size, params, message):
    with pytest.raises(ValueError, match=message):
        Lens(model, *size, params)


def test_shrinking_is_the_mean_of_the_covered_area():
    image = np.random.default_rng(0).random((12, 18, 3)).astype(np.float32)
    small = resized(ArrayRows(image), (6, 4))
    np.testing.assert_allclose(small, image.reshape(4, 3, 6, 3, 3).mean((1, 3)), atol=1e-6)


def test_shrinking_by_a_fraction_keeps_the_mean():
    image = np.random.default_rng(0).random((11, 17, 3)).astype(np.float32)
    assert resized(ArrayRows(image), (7, 5)).mean() == pytest.approx(image.mean(), abs=1e-3)


# -- large photos, in bands


def view_of(folder, lens: Lens, mask: np.ndarray | None) -> View:
    save(folder / "a.png", photo_through(lens))
    ignored = None if mask is None else folder / "mask.png"
    if ignored is not None:
        save(ignored, mask)
    width, height, K = pinhole_of(lens)
    camera = Camera(width, height, K, np.eye(4))
    return View(
        "a.png",
        folder / "a.png",
        camera,
        (width, height),
        lens,
        ignore_path=mask if mask is None else folder / "mask.png",
    )


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL"])
@pytest.mark.parametrize("masked", [None, "photo", "half", "undistorted"])
def test_large_photos_and_masks_processed_in_bands_equal_those_processed_whole(
    tmp_path, monkeypatch, model, masked
):
    lens = Lens(model, *SIZE, LENSES[model])
    width, height, _ = pinhole_of(lens)
    shape = {None: None, "photo": SIZE, "half": (SIZE[0] // 2, SIZE[1] // 2), "undistorted": (width, height)}[
        masked
    ]
    mask = None if shape is None else np.ones(shape[::-1])
    if mask is not None:
        mask[len(mask) // 3 : len(mask) // 2, 5:30] = 0
    view = view_of(tmp_path, lens, mask)
    sizes = [
        (width, height),
        (width // 2, height // 2),
        (width // 5, height // 5),
        (width - 7, height // 3),
        (width + 9, height + 4),
    ]
    at_once = [(view.load_image(size), view.valid_share(size)) for size in sizes]
    monkeypatch.setattr("lexsplat.captures.images.bands.LARGE_PIXELS", 0)
    monkeypatch.setattr("lexsplat.captures.images.bands.BAND_PIXELS", 5 * width)
    for size, (image, share) in zip(sizes, at_once):
        np.testing.assert_allclose(view.load_image(size), image, atol=2e-5)
        if share is not None:
            np.testing.assert_allclose(view.valid_share(size), share, atol=2e-5)


@pytest.mark.slow
def test_undistorting_a_large_photo_takes_a_fraction_of_its_size_in_floats(tmp_path):
    """Traced by Python, which excludes Pillow's decoded image of four bytes per pixel."""
    import tracemalloc

    lens = Lens("SIMPLE_RADIAL", 3000, 2400, (2600.0, 1500.0, 1200.0, -0.05))
    Image.new("RGB", (3000, 2400), (90, 120, 30)).save(tmp_path / "a.jpg")
    width, height, K = pinhole_of(lens)
    view = View("a.jpg", tmp_path / "a.jpg", Camera(width, height, K, np.eye(4)), (width, height), lens)
    for size in ((width // 2, height // 2), (width // 8, height // 8)):
        tracemalloc.start()
        view.load_image(size)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 24 * size[0] * size[1] + BAND_BYTES
