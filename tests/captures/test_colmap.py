import resource
import struct
import time

import numpy as np
import pycolmap
import pytest
from support.refusals import assert_reports, fails
from support.written_captures import (
    HEIGHT,
    WIDTH,
    cameras_around,
    colmap_bytes,
    shared_data,
    write_colmap,
    write_images,
)

from lexsplat.captures import load_annotations, load_capture
from lexsplat.captures.readers.colmap import read_colmap
from lexsplat.runtime.errors import CaptureError, FileFormatError, LexsplatError

NAMES = [f"sub/{index}.png" for index in range(6)]
FILES = ("cameras.bin", "images.bin", "points3D.bin")


def synthesized(**options: int) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(3)
    return pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(options))


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    "options",
    [
        {"num_rigs": 1, "num_cameras_per_rig": 1, "num_frames_per_rig": 5},
        {"num_rigs": 2, "num_cameras_per_rig": 2, "num_frames_per_rig": 3},
    ],
)
def test_models_are_read_as_pycolmap_reads_them(tmp_path, binary, options):
    model = synthesized(num_points3D=40, **options)
    folder = tmp_path / "sparse"
    folder.mkdir()
    (model.write_binary if binary else model.write_text)(folder)
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        write_images(tmp_path / "images", [image.name], (camera.width // 16, camera.height // 16))
    capture = read_colmap(tmp_path, folder)
    assert len(capture.photos) == len(model.images)
    for photo in capture.photos:
        image = model.find_image_with_name(photo.name)
        camera = model.cameras[image.camera_id]
        assert (photo.lens.model, photo.lens.width, photo.lens.height) == (
            camera.model_name,
            camera.width,
            camera.height,
        )
        np.testing.assert_allclose(photo.lens.params, camera.params)
        np.testing.assert_allclose(photo.viewmat[:3], image.cam_from_world().matrix(), atol=1e-12)
    ours = sorted(zip(capture.points.tolist(), (capture.point_colors * 255).round().tolist()))
    theirs = sorted((p.xyz.astype(np.float32).tolist(), p.color.tolist()) for p in model.points3D.values())
    assert len(ours) == 40
    np.testing.assert_allclose([p for p, _ in ours], [p for p, _ in theirs], rtol=1e-6)
    assert [c for _, c in ours] == [c for _, c in theirs]


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_models_are_found_in_the_folders_of_common_tools(tmp_path, place):
    folder = tmp_path / place
    folder.mkdir(parents=True, exist_ok=True)
    for file, content in colmap_bytes(NAMES).items():
        (folder / file).write_bytes(content)
    write_images(tmp_path / "images", NAMES)
    capture = load_capture(tmp_path)
    assert list(capture.views) == NAMES
    for view, camera in zip(capture.views.values(), cameras_around(len(NAMES))):
        np.testing.assert_allclose(view.camera.viewmat, camera.viewmat, atol=1e-9)
    np.testing.assert_allclose(capture.points[1], [0.1, 0.2, -0.3], rtol=1e-6)
    np.testing.assert_allclose(capture.point_colors[1], [1, 128 / 255, 0], rtol=1e-6)


def test_distorted_cameras_of_mixed_sizes_become_pinholes(tmp_path):
    write_colmap(tmp_path, NAMES, model=2, params=(60.0, 32.0, 24.0, -0.1))
    write_images(tmp_path / "images", NAMES[:2], (2 * WIDTH, 2 * HEIGHT))
    views = list(load_capture(tmp_path).views.values())
    big, small = views[0].camera, views[5].camera
    assert big.K[0, 0] == pytest.approx(120)
    assert small.K[0, 0] == pytest.approx(60)
    assert abs(big.width - 2 * small.width) <= 2
    assert views[0].load_image().shape == (big.height, big.width, 3)


def test_images_are_found_in_the_folder_that_has_most_of_them(tmp_path):
    write_colmap(tmp_path, NAMES, images=False)
    (tmp_path / "images").mkdir()
    write_images(tmp_path / "images_4", NAMES, (16, 12))
    assert load_capture(tmp_path).views[NAMES[0]].camera.K[0, 0] == pytest.approx(15)


def test_a_model_without_points_has_none(tmp_path):
    (write_colmap(tmp_path, NAMES) / "points3D.bin").unlink()
    assert load_capture(tmp_path).points.shape == (0, 3)


def test_points_that_are_not_finite_are_dropped_with_a_warning(tmp_path):
    file = write_colmap(tmp_path, NAMES) / "points3D.bin"
    content = bytearray(file.read_bytes())
    struct.pack_into("<d", content, 16, np.nan)
    file.write_bytes(content)
    capture = load_capture(tmp_path)
    assert len(capture.points) == 2
    assert "1 points" in capture.warnings[0]


def test_nan_in_a_pose_names_the_image(tmp_path):
    file = write_colmap(tmp_path, NAMES) / "images.bin"
    content = bytearray(file.read_bytes())
    struct.pack_into("<d", content, 12, np.nan)
    file.write_bytes(content)
    fails(tmp_path, "images.bin", NAMES[0], "NaN")
    struct.pack_into("<4d", content, 12, 0, 0, 0, 0)  # no rotation at all
    file.write_bytes(content)
    fails(tmp_path, "images.bin", NAMES[0])


@pytest.mark.parametrize("name", ["../0.png", "/0.png", "..\\0.png"])
def test_names_that_leave_the_capture(tmp_path, name):
    write_colmap(tmp_path, [name, "b.png"], images=False)
    fails(tmp_path, "images.bin", "inside the capture")


def test_the_same_name_twice(tmp_path):
    write_colmap(tmp_path, ["a.png", "a.png"])
    fails(tmp_path, "a.png twice")


def test_a_missing_images_file_and_an_unknown_camera(tmp_path):
    model = write_colmap(tmp_path, NAMES)
    cameras = bytearray((model / "cameras.bin").read_bytes())
    struct.pack_into("<I", cameras, 8, 7)
    (model / "cameras.bin").write_bytes(cameras)
    fails(tmp_path, "images.bin", "camera 1", "[7]", kind=FileFormatError)
    (model / "images.bin").unlink()
    fails(tmp_path, "images.bin", "no such file", kind=FileFormatError)


@pytest.mark.parametrize("file", FILES)
def test_a_binary_file_truncated_anywhere_is_refused(tmp_path, file):
    model = write_colmap(tmp_path, NAMES[:2])
    whole = (model / file).read_bytes()
    for size in range(len(whole)):
        (model / file).write_bytes(whole[:size])
        with pytest.raises(FileFormatError) as caught:
            load_capture(tmp_path)
        assert_reports(caught.value, file)
    (model / file).write_bytes(whole + b"\0")
    fails(tmp_path, file, "1 more bytes", kind=FileFormatError)


@pytest.mark.parametrize("file", FILES)
def test_absurd_counts_neither_allocate_nor_hang(tmp_path, file):
    model = write_colmap(tmp_path, NAMES[:2])
    whole = (model / file).read_bytes()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    for count in (12, 2**31, 2**62, 2**64 - 1):
        for offset in {0, len(whole) - 16} if file == "points3D.bin" else {0}:
            content = bytearray(whole)
            struct.pack_into("<Q", content, offset, count)
            (model / file).write_bytes(content)
            fails(tmp_path, file, "bytes left", kind=FileFormatError)
    assert time.perf_counter() - start < 5
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB


def text_model(root):
    model = synthesized(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=3, num_points3D=10)
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    model.write_text(folder)
    camera = next(iter(model.cameras.values()))
    write_images(
        root / "images", [i.name for i in model.images.values()], (camera.width // 16, camera.height // 16)
    )
    return folder


@pytest.mark.parametrize(
    ("file", "cut"), [("cameras.txt", 0.7), ("images.txt", 0.5), ("images.txt", 0.7), ("points3D.txt", 0.6)]
)
def test_a_truncated_text_file_is_refused(tmp_path, file, cut):
    folder = text_model(tmp_path)
    load_capture(tmp_path)
    whole = (folder / file).read_text()
    (folder / file).write_text(whole[: int(cut * len(whole))])
    fails(tmp_path, file, kind=FileFormatError)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"1 PINHOLE\n", b"one PINHOLE 4 4 1 1 1 1\n", b"\0"])
def test_text_that_is_no_model(tmp_path, content):
    folder = text_model(tmp_path)
    (folder / "cameras.txt").write_bytes(content)
    fails(tmp_path, "cameras.txt", kind=FileFormatError)


def test_a_text_model_may_leave_out_observations_and_the_last_empty_line(tmp_path):
    folder = tmp_path / "sparse"
    folder.mkdir()
    (folder / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 0 1 my photo.png\n\n2 1 0 0 0 1 0 0 1 b.png\n")
    write_images(tmp_path / "images", ["my photo.png", "b.png"])
    capture = load_capture(tmp_path)
    assert list(capture.views) == ["b.png", "my photo.png"]
    np.testing.assert_allclose(capture.views["b.png"].camera.position, [-1, 0, 0])


@pytest.mark.parametrize("observations", ["", "1.5 2.5 -1 3 4 7"])
def test_missing_observation_lines_are_reported(tmp_path, observations):
    folder = text_model(tmp_path)
    poses = [f"{number} 1 0 0 0 {number} 0 3 1 {number}.png" for number in range(1, 5)]
    write_images(tmp_path / "images", [f"{number}.png" for number in range(1, 5)])
    (folder / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    (folder / "images.txt").write_text("".join(f"{line}\n{observations}\n" for line in poses))
    assert len(load_capture(tmp_path).views) == 4
    (folder / "images.txt").write_text("".join(f"{line}\n" for line in poses))
    fails(tmp_path, "images.txt", "observations", "2.png", kind=FileFormatError)


@pytest.mark.parametrize("binary", [True, False])
def test_a_duplicate_camera_is_refused(tmp_path, binary):
    """The camera of its images is ambiguous."""
    if binary:
        model = write_colmap(tmp_path, ["a.png", "b.png"])
        content = (model / "cameras.bin").read_bytes()
        (model / "cameras.bin").write_bytes(struct.pack("<Q", 2) + content[8:] * 2)
    else:
        model = text_model(tmp_path)
        (model / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n1 PINHOLE 64 48 99 99 32 24\n")
    fails(tmp_path, "cameras.", "camera 1 twice", kind=FileFormatError)


def test_a_principal_point_far_outside_the_image_is_refused(tmp_path):
    write_colmap(tmp_path, ["a.png"], params=(60.0, 60.0, 1e6, 24.0))
    fails(tmp_path, "cameras.bin", "principal point")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_mutated_models_yield_a_capture_or_a_typed_error(tmp_path, suffix):
    rng = np.random.default_rng(0)
    if suffix == "bin":
        model = write_colmap(tmp_path, NAMES[:3], model=2, params=(60.0, 32.0, 24.0, -0.1))
    else:
        model = text_model(tmp_path)
    files = {name: (model / f"{name}.{suffix}").read_bytes() for name in ("cameras", "images", "points3D")}
    failed = 0
    for _ in range(300):
        name = rng.choice(list(files))
        content = bytearray(files[name])
        for position in rng.integers(0, len(content), rng.integers(1, 4)):
            content[position] ^= 1 << rng.integers(0, 8)
        (model / f"{name}.{suffix}").write_bytes(content)
        try:
            capture = load_capture(tmp_path)
        except LexsplatError as error:
            failed += 1
            assert_reports(error)
        else:
            assert np.isfinite(capture.points).all()
            for view in capture.views.values():
                rotation = view.camera.viewmat[:3, :3]
                np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        (model / f"{name}.{suffix}").write_bytes(files[name])
    assert 30 < failed < 300


def test_panoramas_are_refused_with_a_remedy(tmp_path):
    write_colmap(tmp_path, NAMES, model=17, params=(64.0, 48.0))
    fails(tmp_path, "cameras.bin", "EQUIRECTANGULAR", kind=CaptureError)


@pytest.mark.slow
def test_bonsai_is_loaded_with_points_and_masks():
    capture = load_capture(shared_data("bonsai"), downscale=4)
    assert len(capture.views) == 292
    assert capture.points.shape == (68290, 3)
    assert capture.test_names == ("DSCF5653.JPG", "DSCF5805.JPG")
    assert capture.warnings == ()
    masks = load_annotations(capture).masks
    assert sorted(masks) == sorted(capture.test_names)
    assert "plastic box" in masks["DSCF5805.JPG"]
    assert capture.views["DSCF5805.JPG"].load_image().shape == (133, 200, 3)


@pytest.mark.slow
def test_points_of_bonsai_fall_on_pixels_of_their_color():
    capture = load_capture(shared_data("bonsai"))
    view = capture.views["DSCF5600.JPG"]
    local = capture.points @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
    uv = local[:, :2] / local[:, 2:] * np.diag(view.camera.K)[:2] + view.camera.K[:2, 2]
    size = np.array([view.camera.width, view.camera.height])
    nearest: dict[tuple, int] = {}  # a point hides those behind it in a cell of 16 pixels
    for index in np.flatnonzero((local[:, 2] > 0) & (uv >= 10).all(1) & (uv < size - 10).all(1)):
        cell = tuple((uv[index] // 16).astype(int))
        if cell not in nearest or local[index, 2] < local[nearest[cell], 2]:
            nearest[cell] = index
    seen = np.array(list(nearest.values()))
    image = view.load_image()
    column, row = uv[seen].astype(int).T
    shifts = [(0, 0), (-2, 0), (2, 0), (0, -2), (0, 2)]
    errors = [np.abs(image[row + dy, column + dx] - capture.point_colors[seen]).mean() for dx, dy in shifts]
    assert len(seen) > 1000
    # Right to the pixel: two pixels aside in any direction the colors agree less.
    assert errors[0] < 0.9 * min(errors[1:])
