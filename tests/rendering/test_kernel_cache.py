"""Compiled kernels are kept in a folder that can be written, and compilation is announced once."""

import logging
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
from numba.core.caching import NullCache
from support.warm_starts import Ended, Program, Stage, run_warm

pytestmark = pytest.mark.slow


PROBE = """
import logging, sys
from numba.core import config
config.reload_config()
logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
from lexsplat.rendering.kernels import binning, jit
import numpy as np
binning.offsets_of(np.ones((2, 3), np.int64), np.zeros(4, np.int64))
print("hits", sum(binning.offsets_of.stats.cache_hits.values()))
print("at", binning.offsets_of.stats.cache_path)
"""


USED = (
    "torch", "numba", "numba.core.cpu", "numba.cpython.unicode", "numba.experimental.jitclass.base",
    "numba.np.arraymath", "numba.np.linalg", "numba.np.npyimpl", "numba.np.polynomial.polynomial_functions",
    "numba.np.random.generator_methods", "numba.np.ufunc_db", "numba.typed",
)  # fmt: skip
"""What a compilation imports; the processor and the folder are asked for later."""

OTHER_PROCESSOR = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}


@pytest.fixture(scope="module")
def kernels(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("kernels")


@pytest.fixture(scope="module")
def runs(kernels) -> dict[str, Ended]:
    """Processes that call a kernel one after the other; the last three, of which two run at once, share a folder."""
    here, shared = ({"NUMBA_CACHE_DIR": str(kernels / name)} for name in ("one", "shared"))
    groups = {
        ("first",): here, ("again",): here, ("elsewhere",): here | OTHER_PROCESSOR, ("back",): here,
        ("left", "right"): shared, ("after both",): shared,
    }  # fmt: skip
    programs = [[Program(PROBE, environment=where)] * len(names) for names, where in groups.items()]
    found = run_warm(Stage(USED, programs))
    return dict(zip((name for names in groups for name in names), found, strict=True))


def test_compiled_kernels_are_reused_from_numba_cache_dir(runs, kernels):
    assert "compiling CPU kernels, once" in runs["first"].out
    assert "hits 0" in runs["first"].out
    assert "hits 1" in runs["again"].out
    assert str(kernels / "one") in runs["again"].out


def test_kernels_cached_for_another_processor_are_recompiled(runs):
    # As with a home folder on a network, or a disk moved to another machine.
    assert "compiling CPU kernels, once" in runs["elsewhere"].out
    assert "hits 0" in runs["elsewhere"].out
    assert "hits 1" in runs["back"].out


def test_kernels_that_are_not_compiled_are_not_announced(runs):
    # A viewer never compiles the kernels of gradients.
    assert "hits 1" in runs["again"].out
    assert "compiling" not in runs["again"].out


def test_two_processes_can_compile_at_the_same_time(runs):
    for name in ("left", "right"):
        assert (runs[name].status, runs[name].err) == (0, "")
    assert "hits 1" in runs["after both"].out


def test_only_compilation_of_this_packages_kernels_is_announced_once(monkeypatch, caplog):
    from lexsplat.reconstruction import image_loss_kernels
    from lexsplat.rendering.kernels import jit

    monkeypatch.setattr(jit, "_announced", False)
    monkeypatch.setattr(jit, "_dispatchers", set(jit._dispatchers))
    image, products = np.ones((2, 3), np.float32), np.ones((3, 2, 3), np.float32)
    with caplog.at_level(logging.INFO, logger="lexsplat"):
        numba.njit(lambda x: x + 1)(3)
        assert not caplog.records
        for _ in range(2):
            fresh = jit.kernel(image_loss_kernels._multiply.py_func)
            fresh._cache = NullCache()
            fresh(0, 2, image, image, products)
    assert [record.message for record in caplog.records] == ["compiling CPU kernels, once for this machine"]


def test_a_read_only_installation_caches_kernels_in_the_home_folder(tmp_path, monkeypatch):
    from lexsplat.rendering.kernels import jit

    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    real = Path.mkdir

    def mkdir(self, *args, **options):
        if "__pycache__" in self.parts:
            raise PermissionError(self)
        return real(self, *args, **options)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    folder = jit._cache_folder.__wrapped__()
    assert folder.startswith(str(tmp_path / "home" / "lexsplat" / "kernels-"))


@pytest.mark.parametrize("homeless", [False, True])
def test_without_a_writable_folder_kernels_go_to_a_temporary_folder(tmp_path, monkeypatch, homeless):
    # Homeless: a container whose user has neither an entry in /etc/passwd nor HOME.
    from lexsplat.rendering.kernels import jit

    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(jit.tempfile, "mkdtemp", lambda prefix: str(tmp_path / prefix))

    def refused(self, *args, **options):
        raise PermissionError(self)

    def no_home(self):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "mkdir", refused)
    if homeless:
        monkeypatch.setattr(Path, "expanduser", no_home)
    folder = jit._cache_folder.__wrapped__()
    assert folder == str(tmp_path / "lexsplat-kernels-")


def test_a_kernel_is_told_once_all_that_it_calls_itself_are_compiled():
    from lexsplat.rendering.kernels import binning, jit

    outer, inner = binning.find_boxes, binning.list_pairs
    of_others = object()
    told: list[str] = []
    listener = jit._Compiled(lambda: told.append("compiled"))

    def event(dispatcher: object) -> SimpleNamespace:
        return SimpleNamespace(data={"dispatcher": dispatcher})

    for dispatcher in (of_others, outer, inner):
        listener.on_start(event(dispatcher))
    for dispatcher, expected in ((inner, 0), (outer, 1), (of_others, 1)):
        listener.on_end(event(dispatcher))
        assert len(told) == expected
