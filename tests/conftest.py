"""Fixtures shared by the tests.

Nothing heavy is imported here: with pytest-xdist the process that hands out the tests reads this file, too.
"""

import gc
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:
    # The processes share the cores; with all cores each, their threads would wait for one another.
    share = (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, share)))

import hypothesis
import pytest
from filelock import FileLock
from support.tiny_capture import QUICK_BUILD, write_capture

import lexsplat  # noqa: F401  (before torch: it sets how torch's threads wait)

# A loaded machine may take any time for an example.
hypothesis.settings.register_profile("lexsplat", deadline=None)
hypothesis.settings.load_profile("lexsplat")

gc.disable()  # until all tests are imported: nearly nothing of what is imported is ever freed

TEST_DATA = Path(os.environ.get("LEXSPLAT_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))


def pytest_collection_modifyitems(items):
    """Tests marked ``gpu`` are skipped without a CUDA device; tests of a scene built for them are slow.

    Files with slow tests come first, so that none of pytest-xdist's processes starts one when the others are done.
    """
    for item in items:
        if "built" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
    slow = {item.path for item in items if "slow" in item.keywords}
    items.sort(key=lambda item: item.path not in slow)
    import torch

    if torch.cuda.is_available():
        return
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


def pytest_collection_finish():
    gc.enable()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory) -> Iterator[None]:
    """A folder of the tests' own for what lexsplat keeps for the user."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def one_thread():
    """For tensors so small that threads would only wait for each other; also undoes what a test sets."""
    from lexsplat.runtime import device as threads

    with threads.one_thread():
        yield


@pytest.fixture(scope="session")
def made_once(tmp_path_factory) -> Callable[[str, Callable[[Path], object]], Path]:
    """Makes a folder once a run, whichever of pytest-xdist's processes asks first; the others wait for it."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(name: str, make: Callable[[Path], object]) -> Path:
        folder = shared / name
        with FileLock(shared / f"{name}.lock"):
            if not folder.exists():
                make(shared / f"{name}.unfinished")
                (shared / f"{name}.unfinished").rename(folder)
        return folder

    return made


@pytest.fixture(scope="session")
def tiny_capture(made_once) -> Path:
    """Twelve ray-traced views of two spheres with cameras, points and masks; read-only."""
    return made_once("tiny_capture", write_capture)


@pytest.fixture(scope="session")
def six_views(made_once) -> Path:
    """Six of the views, of which two have masks: for tests of what is built and not of how well; read-only."""
    return made_once("six_views", lambda folder: write_capture(folder, views=6))


@pytest.fixture(scope="session")
def built(tiny_capture, made_once, tmp_path_factory) -> Path:
    """A scene built from the tiny capture by the command line; its results must not be changed."""
    from lexsplat import cli

    def build(output: Path) -> None:
        assert cli.main(["build", str(tiny_capture), "--output", str(output), *QUICK_BUILD]) == 0

    # A copy for each process: commands write beside the results, such as metrics and embeddings of prompts.
    return shutil.copytree(made_once("tiny_scene", build), tmp_path_factory.mktemp("scene") / "tiny")


@pytest.fixture(scope="session")
def demo_library_made(made_once) -> Path:
    """The folder of a library of the bundled scene; to be copied."""
    from lexsplat.scenes.library import Library

    return made_once("demo_library", lambda folder: Library.create(folder).add("demo"))


@pytest.fixture
def demo_library_copy(demo_library_made, tmp_path) -> Path:
    """The same, which may be changed."""
    return shutil.copytree(demo_library_made, tmp_path / "demo_library")


@pytest.fixture(scope="session")
def built_trained(built, tiny_capture, made_once) -> Path:
    """The scene `built` with language by method "trained"; read-only."""
    from lexsplat import cli

    def build(output: Path) -> None:
        shutil.copytree(built, output)
        arguments = ["build", str(tiny_capture), "--output", str(output), *QUICK_BUILD, "--method", "trained"]
        assert cli.main(arguments) == 0

    return made_once("tiny_scene_trained", build)


@pytest.fixture(scope="module")
def color_encoders() -> Iterator[None]:
    """The color encoders in place of CLIP and DINO."""
    from support import color_encoder

    with pytest.MonkeyPatch.context() as patch:
        color_encoder.install(patch)
        yield


@pytest.fixture(scope="module")
def own_size_features() -> Iterator[None]:
    """SIFT that starts at the size of a photo instead of twice of it: a third of the time, enough for `rooms`.

    The stages under a memory limit (`limited_stages`) register the same photos with the features of the product.
    """
    import pycolmap

    make = pycolmap.FeatureExtractionOptions

    def options(**given):
        made = make(**given)
        made.sift.first_octave = 0
        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pycolmap, "FeatureExtractionOptions", options)
        yield


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory) -> Path:
    """A tiny CLIP with random weights, saved the way the Hub's are."""
    from support.encoder_folders import write_clip

    return write_clip(tmp_path_factory.mktemp("clip"))


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium (`page_browser`)."""
    pytest.importorskip("playwright.sync_api")
    from support.page_browser import chromium

    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def tab(browser, request):
    """A page for `page_browser.show`, one after another: it starts faster than new ones.

    A module's ``PIXEL_SCALE`` is its number of pixels of the screen for one of the page.
    """
    from support.page_browser import blank_page

    page = blank_page(browser, scale=getattr(request.module, "PIXEL_SCALE", 1.0))
    yield page
    page.close()


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
