"""Feature extraction: the cache on disk, what it depends on, memory, and the settings."""

from __future__ import annotations

import dataclasses
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from support.counting_encoders import ColorEncoder, GridEncoder
from support.noise_photos import HEIGHT, WIDTH, FakeLens, FakeView, make_capture

from lexsplat.captures import Capture
from lexsplat.features import FeatureConfig, FeatureMap, FeatureMaps, extract_features
from lexsplat.features.cache import resize_grid
from lexsplat.features.pyramid import cut_crops, dense_map, grid_levels, mean_map, patch_map
from lexsplat.geometry.cameras import Camera
from lexsplat.runtime.errors import CaptureError, FileFormatError, MemoryBudgetError


@pytest.fixture(scope="module", autouse=True)
def two_threads():
    """Two workers run on every machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


CONFIG = FeatureConfig(
    crop_sizes=(0.25, 0.5), crop_strides=(0.5, 0.5), map_cells=8, dino_stride=2, dino_short_side=HEIGHT
)


@pytest.fixture
def capture(tmp_path) -> Capture:
    return make_capture(tmp_path / "images")


@pytest.mark.slow
def test_maps_equal_those_of_crops_encoded_one_by_one(capture, tmp_path):
    maps = extract_features(capture, ColorEncoder(), GridEncoder(), CONFIG, cache_dir=tmp_path / "cache")
    assert list(maps) == list(capture.views)
    for name, view in capture.views.items():
        image = view.load_image()
        levels = grid_levels(WIDTH, HEIGHT, CONFIG.crop_sizes, CONFIG.crop_strides)
        vectors = []
        for left, top, size in np.concatenate([level.boxes for level in levels]).tolist():
            patch = image[top : top + size, left : left + size]
            planes = [
                Image.fromarray(patch[..., c]).resize((8, 8), Image.Resampling.BICUBIC) for c in range(3)
            ]
            color = [np.clip(np.asarray(plane), 0, 1).mean() for plane in planes]
            vectors.append(np.array([*color, 1.0]) / np.linalg.norm([*color, 1.0]))
        expected = dense_map(levels, torch.tensor(np.array(vectors)).float(), WIDTH, HEIGHT, 12, 8)
        found = maps[name]
        assert found.clip.shape == (8, 12, 4)
        torch.testing.assert_close(found.clip, expected, atol=2e-3, rtol=0)  # half precision on disk
        blocks = image.reshape(16, 2, 24, 2, 3).mean((1, 3))  # the grid encoder's cells, 16 x 24
        assert found.dino.shape == (8, 12, 4)
        dense = np.concatenate([blocks, np.ones((16, 24, 1))], -1)
        dense = torch.from_numpy(dense / np.linalg.norm(dense, axis=-1, keepdims=True)).float()
        torch.testing.assert_close(found.dino, resize_grid(dense, 12, 8), atol=2e-3, rtol=0)


@pytest.mark.parametrize("tokens", ["patch", "both"])
def test_patch_embeddings_are_used_beside_or_instead_of_image_embeddings(tokens, capture, tmp_path):
    config = dataclasses.replace(CONFIG, crop_tokens=tokens)
    maps = extract_features(capture, ColorEncoder(), None, config, cache_dir=tmp_path / "cache")
    levels = grid_levels(WIDTH, HEIGHT, CONFIG.crop_sizes, CONFIG.crop_strides)
    boxes = np.concatenate([level.boxes for level in levels])
    for name, view in capture.views.items():
        image = torch.from_numpy(view.load_image()).permute(2, 0, 1)
        crops = torch.cat(list(cut_crops(image, boxes, 8, 64)))
        whole, patches = ColorEncoder().encode_patches(crops)
        expected = patch_map(levels, patches.flatten(1, 2), WIDTH, HEIGHT, 12, 8)
        if tokens == "both":
            expected = expected + mean_map(levels, whole, WIDTH, HEIGHT, 12, 8)
        torch.testing.assert_close(maps[name].clip, F.normalize(expected, dim=-1), atol=2e-3, rtol=0)


def test_patches_that_do_not_fit_are_refused_with_a_budget_that_does(capture, tmp_path):
    class Fine(ColorEncoder):
        patches = 100

    memory, patches = 4 << 20, dataclasses.replace(CONFIG, crop_tokens="both")
    with pytest.raises(MemoryBudgetError, match=r"features\.crop-tokens class"):
        extract_features(capture, Fine(), None, patches, cache_dir=tmp_path, memory=memory)
    assert len(extract_features(capture, Fine(), None, CONFIG, cache_dir=tmp_path, memory=memory)) == 5
    with pytest.raises(ValueError, match="memory"):
        extract_features(capture, Fine(), None, CONFIG, cache_dir=tmp_path, memory=0)


def test_patch_embeddings_are_stored_for_one_map_size(capture, tmp_path):
    config = dataclasses.replace(CONFIG, crop_tokens="both")
    assert _work(capture, tmp_path) == (True, 5)
    assert _work(capture, tmp_path, config) == (True, 0)
    assert _work(capture, tmp_path, dataclasses.replace(config, crop_tokens="patch")) == (False, 0)
    assert _work(capture, tmp_path, dataclasses.replace(config, map_cells=5)) == (True, 0)


def test_a_cached_patch_map_of_another_size_is_refused(capture, tmp_path):
    config = dataclasses.replace(CONFIG, crop_tokens="patch")
    maps = extract_features(capture, ColorEncoder(), None, config, cache_dir=tmp_path)
    path = sorted(tmp_path.glob("*.clip.safetensors"))[0]
    tensors = load_file(path)
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    for patches in (None, torch.zeros(3, 3, 4), torch.full((8, 12, 4), torch.nan), torch.zeros(8, 12)):
        changed = {name: value for name, value in tensors.items() if name != "patches"}
        save_file(changed if patches is None else {**changed, "patches": patches}, path, metadata)
        maps.forget()
        refused = []
        for name in maps:
            try:
                _ = maps[name]
            except FileFormatError as error:
                refused.append(str(error))
        assert len(refused) == 1
        assert "cached features" in refused[0]


def test_maps_are_unit_length_and_without_dino_have_none(capture, tmp_path):
    maps = extract_features(capture, ColorEncoder(), None, CONFIG, cache_dir=tmp_path)
    for found in maps.values():
        assert found.dino is None
        torch.testing.assert_close(found.clip.norm(dim=-1), torch.ones(8, 12))


@pytest.mark.parametrize("size", [(4000, 8), (8, 4000)])
def test_the_maps_of_long_images_have_a_bounded_number_of_cells(size, tmp_path):
    capture = make_capture(tmp_path, count=1)
    (view,) = capture.views.values()
    Image.new("RGB", size, (90, 20, 60)).save(view.image_path)
    seen = []

    class Asked(GridEncoder):
        def encode_dense(self, image, *, short_side=224, **rest):
            seen.append(short_side)
            return super().encode_dense(image, short_side=short_side, **rest)

    config = dataclasses.replace(
        CONFIG, crop_sizes=(0.5,), crop_strides=(1.0,), map_cells=20, dino_short_side=100
    )
    maps = extract_features(capture, ColorEncoder(), Asked(), config, cache_dir=tmp_path / "cache")
    rows, cols = maps[view.name].clip.shape[:2]
    assert rows * cols == pytest.approx(16 * 20**2, rel=0.2)
    assert max(rows, cols) / min(rows, cols) == pytest.approx(500, rel=0.2), "cells stay square"
    assert seen == [round(100 * (16 / 500) ** 0.5)]


def test_a_second_run_costs_nothing_and_gives_the_same(capture, tmp_path):
    first = extract_features(capture, ColorEncoder(), GridEncoder(), CONFIG, cache_dir=tmp_path)
    before = {name: first[name].clip for name in first}
    capture.loads.clear()
    clip, dino = ColorEncoder(), GridEncoder()
    events = []
    again = extract_features(capture, clip, dino, CONFIG, cache_dir=tmp_path, listener=events.append)
    assert (clip.crops, dino.images, capture.loads) == (0, 0, [])
    assert [(event.done, event.total) for event in events] == [(5, 5)]
    for name in again:
        assert torch.equal(again[name].clip, before[name])


@pytest.mark.parametrize("mode", ["grid", "random"])
def test_the_number_of_threads_changes_nothing(mode, capture, tmp_path):
    config = dataclasses.replace(CONFIG, mode=mode, random_crops=40, random_levels=3, random_sizes=(0.2, 0.6))
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        maps = extract_features(capture, ColorEncoder(), None, config, cache_dir=tmp_path / str(threads))
        assert torch.get_num_threads() == threads
        found.append({name: features.clip for name, features in maps.items()})
    torch.set_num_threads(2)
    for name in found[0]:
        torch.testing.assert_close(found[0][name], found[1][name], atol=1e-3, rtol=0)


def test_an_interrupted_run_resumes_with_the_missing_views(capture, tmp_path):
    torch.set_num_threads(1)
    try:
        whole = ColorEncoder()
        extract_features(capture, whole, None, CONFIG, cache_dir=tmp_path / "whole")
        cache, small = tmp_path / "cache", 4 * 24 * 12 * 64 * 8  # batches of eight crops
        broken = ColorEncoder(fail_after=whole.crops // 2)
        with pytest.raises(RuntimeError, match="stopped in the middle"):
            extract_features(capture, broken, None, CONFIG, cache_dir=cache, memory=small)
        assert not list((tmp_path / "cache").glob(".*"))  # no partial file remains
        stored = len(list((tmp_path / "cache").glob("*.safetensors")))
        assert 0 < stored < 5
        rest, events = ColorEncoder(), []
        extract_features(capture, rest, None, CONFIG, cache_dir=cache, memory=small, listener=events.append)
        assert rest.crops == whole.crops * (5 - stored) // 5
        assert [event.done for event in events] == list(range(stored, 6))
    finally:
        torch.set_num_threads(2)


def test_an_error_in_one_worker_stops_all_and_restores_the_threads(capture, tmp_path):
    with pytest.raises(RuntimeError, match="stopped in the middle"):
        extract_features(capture, ColorEncoder(fail_after=0), None, CONFIG, cache_dir=tmp_path)
    assert torch.get_num_threads() == 2
    assert threading.active_count() < 10


def test_an_unreadable_image_is_reported(capture, tmp_path):
    name = "left/3.png"

    class Broken(FakeView):
        def load_image(self, size=None):
            raise CaptureError(self.image_path, expected="an image", found="a truncated file")

    old = capture.views[name]
    capture.views[name] = Broken(old.name, old.image_path, old.camera, [])
    with pytest.raises(CaptureError, match="truncated"):
        extract_features(capture, ColorEncoder(), None, CONFIG, cache_dir=tmp_path)


def _work(capture, tmp_path, config=CONFIG, clip_hash="color"):
    clip, dino = ColorEncoder(clip_hash), GridEncoder()
    extract_features(capture, clip, dino, config, cache_dir=tmp_path)
    return clip.crops > 0, dino.images


def test_the_cache_follows_everything_that_changes_features_and_nothing_else(capture, tmp_path):
    assert _work(capture, tmp_path) == (True, 5)
    assert _work(capture, tmp_path) == (False, 0)
    assert _work(capture, tmp_path, dataclasses.replace(CONFIG, map_cells=5, seed=3)) == (
        False,
        0,
    )
    assert _work(capture, tmp_path, dataclasses.replace(CONFIG, crop_sizes=(0.3, 0.5))) == (True, 0)
    assert _work(capture, tmp_path, dataclasses.replace(CONFIG, dino_stride=4)) == (False, 5)
    assert _work(capture, tmp_path, dataclasses.replace(CONFIG, max_short_side=20)) == (True, 5)
    assert _work(capture, tmp_path, clip_hash="another") == (True, 0)
    path = capture.views["left/0.png"].image_path  # same name, same size, other content
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 7, np.uint8)).save(path)
    assert _work(capture, tmp_path) == (True, 1)
    view = capture.views["left/1.png"]
    capture.views["left/1.png"] = dataclasses.replace(view, lens=FakeLens((41.0, 24.0, 16.0)))
    assert _work(capture, tmp_path) == (True, 1)
    capture.views["left/1.png"] = dataclasses.replace(view, background=(1.0, 1.0, 1.0))
    assert _work(capture, tmp_path) == (True, 1)
    capture.views["left/1.png"] = dataclasses.replace(view, camera=view.camera.downscaled(2))
    assert _work(capture, tmp_path) == (False, 0)  # features do not depend on the working resolution


def test_a_damaged_cache_file_is_replaced(capture, tmp_path):
    extract_features(capture, ColorEncoder(), None, CONFIG, cache_dir=tmp_path)
    files = sorted(tmp_path.glob("*.clip.safetensors"))
    files[0].write_bytes(files[0].read_bytes()[:-10])
    files[1].write_bytes(b"")
    clip = ColorEncoder()
    maps = extract_features(capture, clip, None, CONFIG, cache_dir=tmp_path)
    assert clip.crops > 0
    assert len([maps[name] for name in maps]) == 5
    files[0].unlink()
    save_file({"other": torch.zeros(1)}, files[0], {"format_version": "1", "facts": "{}"})
    fresh = extract_features(capture, clip, None, CONFIG, cache_dir=tmp_path)
    with pytest.raises(FileFormatError, match="delete the file"):
        [fresh[name] for name in fresh]


def test_the_same_photo_under_two_names_is_encoded_once(capture, tmp_path):
    torch.set_num_threads(1)
    twin = dataclasses.replace(capture.views["left/0.png"], name="right/0.png")
    single = ColorEncoder()
    views = {"left/0.png": capture.views["left/0.png"]}
    one = SimpleNamespace(views=views)
    extract_features(one, single, None, CONFIG, cache_dir=tmp_path / "one")
    both = SimpleNamespace(views={**views, "right/0.png": twin})
    clip = ColorEncoder()
    maps = extract_features(both, clip, None, CONFIG, cache_dir=tmp_path / "both")
    torch.set_num_threads(2)
    assert clip.crops == single.crops
    assert torch.equal(maps["left/0.png"].clip, maps["right/0.png"].clip)


def test_cache_files_are_small_and_in_half_precision(capture, tmp_path):
    extract_features(capture, ColorEncoder(), GridEncoder(), CONFIG, cache_dir=tmp_path)
    for path in tmp_path.glob("*.safetensors"):
        tensors = load_file(path)
        large = tensors.get("embeddings", tensors.get("features"))
        assert large.dtype == torch.float16


def test_views_draw_different_random_crops_that_do_not_depend_on_each_other(capture, tmp_path):
    config = dataclasses.replace(CONFIG, mode="random", random_crops=20, random_levels=2)
    extract_features(capture, ColorEncoder(), None, config, cache_dir=tmp_path / "all")
    first = {"left/0.png": capture.views["left/0.png"]}
    alone = SimpleNamespace(views=first)
    extract_features(alone, ColorEncoder(), None, config, cache_dir=tmp_path / "alone")
    (path,) = (tmp_path / "alone").glob("*.safetensors")
    stored = {file.name: load_file(file)["lefts.0"] for file in (tmp_path / "all").glob("*.safetensors")}
    assert torch.equal(load_file(path)["lefts.0"], stored[path.name])
    assert len({tuple(lefts.tolist()) for lefts in stored.values()}) == 5


def test_maps_in_memory_never_exceed_their_bound_and_the_latest_are_kept():
    loads = []

    def load(name):
        loads.append(name)
        return FeatureMap(torch.zeros(10, 10, 4), torch.zeros(10, 10, 6))

    maps = FeatureMaps("abcd", load, cache_bytes=2 * 4000)
    for name in "abacad":
        _ = maps[name]
        assert maps.cached_bytes <= 8000
    assert loads == ["a", "b", "c", "d"]  # a was used recently enough to be kept
    _ = maps["b"]
    assert loads[-1] == "b"
    with pytest.raises(KeyError):
        maps["nothing"]
    tiny = FeatureMaps("a", load, cache_bytes=10)
    assert tiny["a"].nbytes == 4000
    assert tiny.cached_bytes == 0


def test_resizing_a_grid_keeps_cell_centers():
    """A linear ramp of angles sampled at cell centers must stay the same ramp at any size."""

    def ramp(rows, cols):
        angle = ((torch.arange(cols) + 0.5) / cols * 0.5).expand(rows, cols)
        return torch.stack([angle.cos(), angle.sin()], -1)

    for rows, cols in ((4, 20), (16, 80), (8, 30)):
        found = resize_grid(ramp(8, 40), cols, rows)
        inner = slice(cols // 20 + 1, -cols // 20 - 1)
        torch.testing.assert_close(found[:, inner], ramp(rows, cols)[:, inner], atol=2e-3, rtol=0)


@pytest.mark.parametrize(
    "bad",
    [
        {"mode": "spiral"}, {"crop_sizes": ()}, {"crop_sizes": (0.1,)}, {"map_cells": 0},
        {"dino_stride": 0}, {"crop_sizes": (0.0,) * 7}, {"random_sizes": (0.4, 0.2)}, {"random_crops": 0},
        {"dino_facet": "query"}, {"crop_tokens": "words"}, {"crop_tokens": "both", "mode": "random"},
    ],
)  # fmt: skip
def test_bad_settings_are_refused_at_once(bad):
    with pytest.raises(ValueError):
        FeatureConfig(**bad)


def test_the_sparse_settings_take_a_sixth_of_the_crops():
    def crops(config):
        return sum(map(len, grid_levels(1297, 840, config.crop_sizes, config.crop_strides)))

    assert crops(FeatureConfig.suited()) * 6 <= crops(FeatureConfig())
    photo = grid_levels(
        1440, 1080, FeatureConfig.suited(14).crop_sizes, FeatureConfig.suited(14).crop_strides
    )
    before = grid_levels(1440, 1080, FeatureConfig.suited().crop_sizes, FeatureConfig.suited().crop_strides)
    assert sum(map(len, photo)) * 5 <= sum(map(len, before)), "patches are read from a fifth of these at most"


@pytest.mark.slow
def test_a_cpu_finds_what_is_six_percent_of_the_photo(tmp_path):
    from lexsplat.captures import load_capture
    from lexsplat.evaluation.demo import demo_capture
    from lexsplat.features.encoders import load_clip

    clip, root = load_clip("bundled"), demo_capture("second")
    name = "view_002.jpg"
    masked = np.asarray(Image.open(root / "segmentations/view_002/bear_nose.png").convert("L")) > 127
    assert np.ptp(np.nonzero(masked)[0]) < 0.06 * len(masked)
    view = load_capture(root).views[name]
    settings = FeatureConfig.suited(clip.patches)
    maps = extract_features(SimpleNamespace(views={name: view}), clip, None, settings, cache_dir=tmp_path)
    relevancy = (maps[name].clip @ clip.encode_text(["bear nose"]).T)[..., 0]
    row, column = divmod(int(relevancy.argmax()), relevancy.shape[1])
    cell = np.array(masked.shape) / relevancy.shape
    peak = (np.array([row, column]) + 0.5) * cell
    inside = np.argwhere(masked) + 0.5
    assert np.abs(inside - peak).max(1).min() < cell.max(), "the peak lies on it, or in the next cell"


@pytest.mark.slow
def test_the_bundled_settings_and_encoders_find_the_red_half(tmp_path):
    """From photo to answer: the relevancy of a color is higher where the color is."""
    from lexsplat.features.encoders import load_clip, load_dino

    picture = np.zeros((240, 320, 3), np.uint8)
    picture[:, :160], picture[:, 160:] = (200, 30, 30), (30, 60, 200)
    path = tmp_path / "a.png"
    Image.fromarray(picture).save(path)
    view = FakeView("a.png", path, Camera(320, 240, np.diag([200.0, 200.0, 1.0]), np.eye(4)), [])
    clip = load_clip("bundled")
    capture = SimpleNamespace(views={"a.png": view})
    maps = extract_features(
        capture, clip, load_dino("bundled"), FeatureConfig.bundled(), cache_dir=tmp_path / "c"
    )
    found = maps["a.png"]
    assert found.clip.shape == (120, 160, 128)
    assert found.dino.shape == (120, 160, 128)
    red, blue = clip.encode_text(["something red", "something blue"])
    reddish = found.clip @ (red - blue)
    assert reddish[:, :72].min() > 0 > reddish[:, 88:].max()
