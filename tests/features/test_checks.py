"""The images by which encoders are checked."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from PIL import Image

from lexsplat.captures import load_capture
from lexsplat.features.checks import CAPTURE, ENOUGH, PLACES, WORDS, bundled_images, check_words, rank_words
from lexsplat.features.encoders import load_clip
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.encoding import Encoders, check_given
from lexsplat.runtime.errors import ModelError


@pytest.mark.parametrize("word", WORDS)
def test_the_image_of_a_word_is_where_its_mask_is_widest(word):
    widest = 0
    for path in sorted(CAPTURE.glob(f"segmentations/*/{word.replace(' ', '_')}.png")):
        with Image.open(path) as mask:
            columns, rows = (np.asarray(mask.convert("L")).any(axis) for axis in (0, 1))
        left, right = np.flatnonzero(columns)[[0, -1]]
        if right + 1 - left > widest:
            widest, found = right + 1 - left, (path.parent.name, rows, left, right)
    name, (x0, y0, x1, y1) = PLACES[word]
    view, rows, left, right = found
    top, bottom = np.flatnonzero(rows)[[0, -1]]
    assert x1 - x0 == widest
    assert (name, (x0, y0, x1, y1)) == (view, (left, top, right + 1, bottom + 1))


def test_an_image_of_one_word_is_that_among_all():
    images = bundled_images(48)
    assert images.shape == (len(WORDS), 3, 48, 48)
    assert bundled_images(48, WORDS[3:5]).equal(images[3:5])


def rotation(size: int) -> torch.Tensor:
    return torch.linalg.qr(torch.randn(size, size, generator=torch.Generator().manual_seed(1)))[0]


def test_patches_without_content_are_found_where_class_tokens_are_right(monkeypatch):
    clip = load_clip("bundled")
    assert rank_words(clip, patches=True) > ENOUGH
    whole = clip.encode_patches
    monkeypatch.setattr(clip, "encode_patches", lambda images: (None, whole(images)[1] @ rotation(clip.dim)))
    check_words(clip)
    with pytest.raises(
        ModelError, match=r"at their patches .* or read class tokens: `--features.crop-tokens class`"
    ):
        check_words(clip, patches=True)


@pytest.mark.parametrize("change", ["none", "another encoder", "reversed channels", "mirrored"])
def test_features_that_do_not_match_the_photos_are_told_though_they_have_the_depth(tmp_path, caplog, change):
    capture, encoders = load_capture(CAPTURE), Encoders("bundled", "none", "cpu")
    turned = rotation(encoders.clip.dim) if change == "another encoder" else torch.eye(encoders.clip.dim)
    for view in capture.views.values():
        photo = torch.from_numpy(view.load_image((160, 120))).permute(2, 0, 1)
        tiles = photo.unfold(1, 40, 40).unfold(2, 40, 40).permute(1, 2, 0, 3, 4)  # 3 rows of 4
        tokens = encoders.clip.encode_images(tiles.flatten(0, 1)) @ turned
        tokens = tokens.reshape(3, 4, -1)
        flipped = {"reversed channels": tokens.flip(2), "mirrored": tokens.flip(1)}.get(change, tokens)
        np.save(tmp_path / f"{view.stem}.npy", flipped.numpy())
    config = BuildConfig(clip="bundled", dino="none", features_from=tmp_path)
    with caplog.at_level(logging.WARNING, logger="lexsplat"):
        check_given(config, capture, encoders)
    assert ("of another encoder, which --clip has to name" in caplog.text) is (change != "none")


@pytest.mark.parametrize(("right", "told"), [(0.77, True), (0.83, False)])
def test_maps_that_match_as_well_as_permuted_channels_are_told(tmp_path, caplog, monkeypatch, right, told):
    capture, encoders = load_capture(CAPTURE), Encoders("bundled", "none", "cpu")
    for view in capture.views.values():
        np.save(tmp_path / f"{view.stem}.npy", np.ones((3, 4, encoders.clip.dim), np.float32))
    monkeypatch.setattr("lexsplat.pipeline.encoding.rank_tiles", lambda *_: right)
    with caplog.at_level(logging.WARNING, logger="lexsplat"):
        check_given(BuildConfig(clip="bundled", dino="none", features_from=tmp_path), capture, encoders)
    assert (f"by {right:.2f} only (expected 0.80" in caplog.text) is told
