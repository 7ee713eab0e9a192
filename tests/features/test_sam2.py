"""SAM 2 on a grid of points: a small one with random weights, and exact masks in place of its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.noise_photos import make_capture
from support.refusals import assert_reports
from support.sam2_folder import SIDE, write_sam2

from lexsplat.features import sam2
from lexsplat.features.sam2 import Sam2Segmenter, paint
from lexsplat.features.segments2d import load_segmenter
from lexsplat.runtime.errors import ModelError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_sam2(tmp_path_factory.mktemp("sam2"))


@pytest.fixture(scope="module")
def photo():
    return torch.rand(3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))


@pytest.mark.slow
def test_masks_of_the_grid_equal_those_of_transformers_point_by_point(folder, photo):
    from transformers import Sam2Model

    found, scores = Sam2Segmenter(folder, "small", points=9).masks(photo, (16, 16))
    assert found.shape == (81, 3, 16, 16)
    assert scores.shape == (81, 3)
    model = Sam2Model.from_pretrained(folder).eval()
    pixels = (photo - torch.tensor([0.1, 0.2, 0.3])[:, None, None]) / torch.tensor([0.5, 0.6, 0.7])[
        :, None, None
    ]
    for row, column in ((0, 0), (3, 7), (8, 8)):
        point = torch.tensor([(column + 0.5) * SIDE / 9, (row + 0.5) * SIDE / 9])
        with torch.inference_mode():
            one = model(pixel_values=pixels[None], input_points=point.reshape(1, 1, 1, 2))
        torch.testing.assert_close(found[9 * row + column], one.pred_masks[0, 0], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(scores[9 * row + column], one.iou_scores[0, 0], atol=1e-5, rtol=1e-4)


@pytest.mark.slow
def test_a_photo_has_three_levels_of_segments_the_same_each_time(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(sam2, "CONFIDENT", -np.inf)  # random weights are confident of nothing
    monkeypatch.setattr(sam2, "STABLE", 0.0)
    view = next(iter(make_capture(tmp_path, count=1).views.values()))
    segmenter = load_segmenter(str(folder))
    found = segmenter.labels(view, (12, 8))
    assert found.shape == (3, 8, 12)
    assert found.dtype == np.int32
    assert (found >= 0).any()
    np.testing.assert_array_equal(segmenter.labels(view, (12, 8)), found)


@pytest.mark.slow
def test_the_published_class_for_videos_gives_the_masks_of_its_photo_part(folder, photo, tmp_path):
    video = Sam2Segmenter(write_sam2(tmp_path / "video", video=True), "video", points=3)
    expected, scores = Sam2Segmenter(folder, "photo", points=3).masks(photo, (16, 16))
    found, found_scores = video.masks(photo, (16, 16))
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(found_scores, scores)


@pytest.mark.gpu
def test_masks_on_a_gpu_are_those_of_the_cpu(folder, photo):
    expected = Sam2Segmenter(folder, "small", "cpu", points=4).masks(photo, (16, 16))[0]
    found = Sam2Segmenter(folder, "small", "cuda", points=4).masks(photo, (16, 16))[0]
    assert ((found > 0) == (expected > 0)).float().mean() > 0.97  # half precision


def as_logits(*masks: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.where(np.stack(masks), 10.0, -10.0)).float()


def box(top: int, left: int, bottom: int, right: int) -> np.ndarray:
    mask = np.zeros((20, 30), bool)
    mask[top:bottom, left:right] = True
    return mask


def test_exact_masks_give_exact_segments_with_parts_on_top_of_things():
    thing, part, other = box(2, 2, 14, 16), box(4, 4, 8, 8), box(2, 18, 14, 28)
    found = paint(as_logits(part, thing, other), torch.tensor([0.9, 0.95, 0.99]))
    expected = np.full((20, 30), -1)
    for number, mask in enumerate((thing, other, part)):
        expected[mask] = number
    np.testing.assert_array_equal(found, expected)


def test_of_masks_that_nearly_coincide_the_most_confident_is_kept():
    wide, narrow = box(2, 2, 14, 16), box(2, 2, 14, 15)  # IoU 13/14
    found = paint(as_logits(wide, narrow), torch.tensor([0.85, 0.9]))
    np.testing.assert_array_equal(found, np.where(narrow, 0, -1))


def test_masks_that_are_unsure_unstable_or_empty_are_left_out():
    good = as_logits(box(0, 0, 4, 4))
    unsure = as_logits(box(10, 10, 14, 14))
    unstable = as_logits(box(10, 10, 14, 14))
    unstable[0, 10] = 0.5  # a quarter of it: IoU .75 between logits of 1 and of -1
    logits = torch.cat([good, unsure, unstable, as_logits(box(0, 0, 0, 0))])
    found = paint(logits, torch.tensor([0.9, 0.79, 0.9, 0.9]))
    np.testing.assert_array_equal(found, np.where(box(0, 0, 4, 4), 0, -1))
    assert (paint(as_logits(box(0, 0, 0, 0)), torch.ones(1)) == -1).all(), "a photo without masks"


@pytest.mark.slow
def test_a_model_of_another_kind_is_refused(clip_folder):
    with pytest.raises(ModelError) as caught:
        load_segmenter(str(clip_folder))
    assert_reports(caught.value, "a SAM 2 model", "'clip'", "--features.segments slic")


def test_a_folder_without_weights_is_refused(folder, tmp_path):
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    with pytest.raises(ModelError) as caught:
        load_segmenter(str(tmp_path))
    assert_reports(caught.value, str(tmp_path), "model.safetensors", "--features.segments slic")


def test_a_model_that_cannot_be_downloaded_is_refused(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(ModelError) as caught:
        load_segmenter("nobody/no-such-sam2")
    assert_reports(caught.value, "nobody/no-such-sam2", "--features.segments slic")
