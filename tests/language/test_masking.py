"""Masked pixels do not affect images, features, codes, language or geometry, whatever their colors."""

import math
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from support.color_encoder import ColorClip, ColorDino
from support.language_scene import make_scene
from support.written_captures import write_colmap

from lexsplat.captures import initial_points, load_capture
from lexsplat.captures.images.bands import ArrayRows, FilledRows, whole
from lexsplat.codebook import CodebookConfig, assign_code_maps, fit_codebook
from lexsplat.features import FeatureConfig, FeatureMap, extract_features
from lexsplat.features.cache import without_masked_cells
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.language.code_maps import MASKED_CODE, MaskedCodeMaps, mark_masked_cells
from lexsplat.language.methods import METHODS, FitRun, TrainingViews
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.language.methods.trainer import FieldTrainer
from lexsplat.pipeline.config import BuildConfig
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor
from lexsplat.runtime.errors import CaptureError

DISTORTED = {"model": 4, "params": (60.0, 60.0, 32.0, 24.0, -0.12, 0.03, 0.001, -0.001)}  # OPENCV
PINHOLE = {}
HOLE = np.s_[10:31, 17:40]
"""Where photos of the small captures are masked."""


def masked_capture(folder, camera: dict, *, paint: int | None, mask: bool = True):
    """Three photos of noise, the same hole masked in all of them, and painted by chance with seed ``paint``."""
    write_colmap(folder, ["a.png", "b.png", "c.png"], images=False, **camera)
    for number, name in enumerate(("a", "b", "c")):
        image = np.random.default_rng(number).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        if paint is not None:
            image[HOLE] = np.random.default_rng(paint + number).integers(0, 256, image[HOLE].shape)
        (folder / "images").mkdir(exist_ok=True)
        Image.fromarray(image).save(folder / "images" / f"{name}.png")
        if mask:
            pixels = np.full((48, 64), 1 + number, np.uint8)  # dark, but not black: they count
            pixels[HOLE] = 0
            (folder / "masks").mkdir(exist_ok=True)
            Image.fromarray(pixels).save(folder / "masks" / f"{name}.png")
    return load_capture(folder, test_every=0)


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("size", [None, (64, 48), (32, 24), (23, 17), (96, 72)])
def test_masked_pixels_do_not_affect_images(tmp_path, camera, size):
    plain, painted, free = (
        masked_capture(tmp_path / name, camera, paint=paint, mask=mask).views["b.png"]
        for name, paint, mask in (("plain", None, True), ("painted", 7, True), ("free", None, False))
    )
    np.testing.assert_array_equal(plain.load_image(size), painted.load_image(size))
    valid = plain.load_valid(size)
    np.testing.assert_allclose(plain.load_image(size)[valid], free.load_image(size)[valid], atol=1e-6)
    assert free.load_valid(size) is None
    assert 0.5 < valid.mean() < 0.9
    assert not np.array_equal(free.load_image(size), plain.load_image(size))


def test_masked_pixels_have_the_mean_color_of_the_others():
    image = np.random.default_rng(0).random((6, 8, 3)).astype(np.float32)
    valid = np.random.default_rng(1).random((6, 8)) > 0.4
    result = whole(FilledRows(ArrayRows(image), valid))
    np.testing.assert_array_equal(result[valid], image[valid])
    np.testing.assert_allclose(result[~valid], np.tile(image[valid].mean(0), ((~valid).sum(), 1)), atol=1e-6)
    assert not whole(FilledRows(ArrayRows(image), np.zeros((6, 8), bool))).any()


@pytest.mark.slow
def test_features_codebook_and_codes_do_not_depend_on_masked_pixels(tmp_path):
    config = FeatureConfig(
        crop_sizes=(0.25,), crop_strides=(0.5,), map_cells=24, dino_short_side=48, dino_stride=4
    )
    found = []
    for name, paint in (("plain", None), ("painted", 7)):
        scene = masked_capture(tmp_path / name, PINHOLE, paint=paint)
        maps = extract_features(scene, ColorClip(), ColorDino(), config, cache_dir=tmp_path / f"{name} cache")
        maps = without_masked_cells(maps, scene)
        names = list(scene.views)
        codebook = fit_codebook(maps, names, CodebookConfig(num_codes=6, steps=20), seed=0)
        found.append((scene, maps, codebook, assign_code_maps(maps, codebook)))
    (scene, maps, codebook, codes), (_, other_maps, other_codebook, other_codes) = found
    for name in maps:
        assert torch.equal(maps[name].clip, other_maps[name].clip)
        assert torch.equal(maps[name].dino, other_maps[name].dino)
        np.testing.assert_array_equal(codes[name], other_codes[name])
        # 24x32 cells of two pixels each: those inside the hole are zero, all others have unit length.
        inside = np.zeros((24, 32), bool)
        inside[5:15, 9:20] = True
        np.testing.assert_array_equal((maps[name].clip.norm(dim=-1) == 0).numpy(), inside)
    assert torch.equal(codebook.clip, other_codebook.clip)
    stored = mark_masked_cells(codes["a.png"], scene.views["a.png"], 6)
    np.testing.assert_array_equal(stored == 255, inside)
    np.testing.assert_array_equal(stored[~inside], codes["a.png"][~inside])
    assert mark_masked_cells(codes["a.png"], scene.views["a.png"], 256) is codes["a.png"], (
        "255 is a code then"
    )


def test_index_maps_keep_the_codes_of_unmasked_pixels(tmp_path):
    views = masked_capture(tmp_path, PINHOLE, paint=None).views
    coarse = np.random.default_rng(0).integers(0, 200, (24, 32)).astype(np.uint8)
    maps = MaskedCodeMaps({"a.png": coarse, "elsewhere": coarse}, views)
    assert maps["elsewhere"] is coarse
    expected = coarse.repeat(2, 0).repeat(2, 1).astype(int)
    expected[HOLE] = MASKED_CODE
    np.testing.assert_array_equal(maps["a.png"], expected)
    assert list(maps) == ["a.png", "elsewhere"]


@pytest.fixture(scope="module")
def language():
    """Balls of one code each, the left half of every view masked, and the same with wrong codes in that half."""
    scene = make_scene(per_ball=30, views=5)
    masked, wrong = {}, {}
    rng = np.random.default_rng(0)
    for name, codes in scene.code_maps.items():
        masked[name] = codes.astype(np.int16)
        masked[name][:, : codes.shape[1] // 2] = MASKED_CODE
        wrong[name] = codes.copy()
        wrong[name][:, : codes.shape[1] // 2] = rng.integers(
            0, 5, wrong[name][:, : codes.shape[1] // 2].shape
        )
    return scene, masked, wrong


def test_language_losses_have_no_gradient_at_masked_pixels(language):
    """Gradients of what is rendered, by torch itself: exactly zero where a pixel is masked, and not elsewhere."""
    scene, masked, _ = language
    trainer = FieldTrainer(scene.gaussians, scene.codebook, TrainedConfig(pixel_sample=0))
    name, camera = next(iter(scene.cameras.items()))
    generator = torch.Generator().manual_seed(0)
    semantics = torch.randn(camera.height, camera.width, 8, generator=generator).requires_grad_()
    uncertainty = torch.rand(camera.height, camera.width, generator=generator).requires_grad_()
    trainer._semantic_terms(semantics, uncertainty, masked[name])["semantic"].backward()
    half = camera.width // 2
    assert not semantics.grad[:, :half].any()
    assert not uncertainty.grad[:, :half].any()
    assert semantics.grad[:, half:].any()
    assert uncertainty.grad[:, half:].any()


@pytest.fixture(scope="module")
def halves(tiny_capture, tmp_path_factory):
    """The tiny capture with the left half of every photo masked, as it is and painted; and wholly masked."""
    scenes = {}
    for name in ("plain", "painted", "nothing"):
        folder = shutil.copytree(tiny_capture, tmp_path_factory.mktemp("masks") / name)
        (folder / "masks").mkdir()
        for number, file in enumerate(sorted((folder / "images").iterdir())):
            image = np.array(Image.open(file))
            mask = np.full(image.shape[:2], 255, np.uint8)
            mask[:, :48] = 0
            Image.fromarray(mask).save(folder / "masks" / f"{file.name}.png")
            if name == "painted":
                hole = image[:, :48]
                hole[:] = np.random.default_rng(number).integers(0, 256, hole.shape)
                Image.fromarray(image).save(file)
        scenes[name] = load_capture(folder)
    for file in (folder / "masks").iterdir():  # a capture whose photos are all wholly masked is refused
        Image.fromarray(np.zeros_like(np.array(Image.open(file)))).save(file)
    return scenes


@pytest.mark.slow
def test_geometry_does_not_depend_on_masked_pixels(halves):
    points = initial_points(halves["plain"])
    config = ReconstructionConfig(
        iterations=10,
        sh_degree=1,
        max_gaussians=1300,
        densify_min_every=5,
        warm_up=0.4,
        opacity_weight=0.0,  # the default for few photos, which needs no pixel
        scale_weight=0.0,
    )
    results = {}
    for name, scene in halves.items():
        trainer = Reconstructor(scene, config, points)
        start = {key: value.clone() for key, value in trainer.gaussians().tensors().items()}
        for _ in range(2 if name == "nothing" else 8):
            trainer.step()
        results[name] = trainer.gaussians().tensors()
    for key, value in results["plain"].items():
        assert torch.equal(value, results["painted"][key]), key
        assert torch.equal(start[key], results["nothing"][key]), (
            f"{key}: a photo without pixels teaches nothing"
        )


def test_masks_without_a_photo_are_reported(tmp_path, caplog):
    masked_capture(tmp_path, PINHOLE, paint=None)
    Image.new("L", (64, 48)).save(tmp_path / "masks" / "nobody.png")
    Image.new("L", (64, 48)).save(tmp_path / "masks" / "nowhere.jpg")
    scene = load_capture(tmp_path)
    assert len([warning for warning in scene.warnings if "masks" in warning]) == 1
    assert "2 masks" in scene.warnings[-1]
    assert "nobody.png" in scene.warnings[-1]
    Image.new("L", (48, 64)).save(tmp_path / "masks" / "b.png")
    with pytest.raises(CaptureError, match=r"b\.png.*48x64"):
        load_capture(tmp_path)


def test_a_gaussian_seen_in_masked_pixels_only_has_no_language(tmp_path):
    """Every cell has a feature, those of the hole too; behind its middle lies a small Gaussian."""
    view = masked_capture(tmp_path, PINHOLE, paint=None).views["a.png"]
    camera, points = view.camera, []
    for x, y in ((28.0, 20.0), (5.0, 40.0)):  # behind the hole, and beside it
        ray = np.linalg.inv(camera.K) @ [x, y, 1.0]
        points.append(np.linalg.inv(camera.viewmat)[:3] @ [*(2.0 * ray), 1.0])
    gaussians = gaussians_from_points(np.array(points), np.full((2, 3), 0.5), sh_degree=0, opacity=0.9)
    gaussians.log_scales.fill_(math.log(0.02))
    maps = {"a.png": FeatureMap(torch.eye(4)[:1].expand(12, 16, 4))}
    views = TrainingViews({"a.png": view}, features=maps)
    field = METHODS["averaged"].fit(gaussians, views, BuildConfig(), FitRun())
    assert field.weights.sum(1).tolist() == pytest.approx([0.0, 1.0])
