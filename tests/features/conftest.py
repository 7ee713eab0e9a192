"""Fixtures of the encoders' tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.encoder_folders import save_model, seeded, tiny_vit


@pytest.fixture
def clip_copy(clip_folder, tmp_path) -> Path:
    """A copy of the tiny CLIP to damage."""
    return shutil.copytree(clip_folder, tmp_path / "copy")


@pytest.fixture(scope="module")
def vit_folder(tmp_path_factory) -> Path:
    return save_model(seeded(tiny_vit), tmp_path_factory.mktemp("vit"))
