"""Fixtures shared by the tests."""

import os
from pathlib import Path

import pytest
from support.tiny_capture import write_capture

import lexsplat  # noqa: F401  (before torch: it sets how torch's threads wait)
from lexsplat.runtime import device as threads

TEST_DATA = Path(os.environ.get("LEXSPLAT_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))


def pytest_collection_modifyitems(items):
    """Tests marked ``gpu`` are skipped without a CUDA device; tests of a scene built for them are slow."""
    for item in items:
        if "built" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
    import torch

    if torch.cuda.is_available():
        return
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture
def one_thread():
    """For tensors so small that threads would only wait for each other; also undoes what a test sets."""
    with threads.one_thread():
        yield


@pytest.fixture(scope="session")
def tiny_capture(tmp_path_factory) -> Path:
    """Twelve ray-traced views of two spheres with cameras, points and masks; read-only."""
    return write_capture(tmp_path_factory.mktemp("capture") / "tiny")


QUICK_BUILD = [
    "--clip", "bundled", "--dino", "bundled", "--device", "cpu", "--iterations", "120",
    "--codebook.num-codes", "16", "--trained.iterations", "60",
]  # fmt: skip
"""Options of ``lexsplat build`` that make a small scene in seconds."""


@pytest.fixture(scope="session")
def built(tiny_capture, tmp_path_factory) -> Path:
    """A scene built from the tiny capture by the command line; its results must not be changed."""
    from lexsplat import cli

    output = tmp_path_factory.mktemp("scene") / "tiny"
    assert cli.main(["build", str(tiny_capture), "--output", str(output), *QUICK_BUILD]) == 0
    return output


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory) -> Path:
    """A tiny CLIP with random weights, saved the way the Hub's are."""
    from support.encoder_folders import write_clip

    return write_clip(tmp_path_factory.mktemp("clip"))


@pytest.fixture
def pretended_gpu(monkeypatch):
    """A pretended GPU with gsplat's kernels (`pretended_gpu`, `gsplat_kernels`); counts synchronizations."""
    from support import gsplat_kernels, pretended_gpu

    gsplat_kernels.install(monkeypatch)
    with pretended_gpu.pretending(monkeypatch) as waits:
        yield waits


@pytest.fixture
def real_captures() -> Path:
    """The folder of real photos, where there is one."""
    if not TEST_DATA.is_dir():
        pytest.skip(f"no real captures: set LEXSPLAT_TEST_DATA ({TEST_DATA} is absent)")
    return TEST_DATA
