"""Where there is a GPU that gsplat cannot render on: "auto" takes the CPU and states it, "cuda" is refused."""

import sys
import types

import pytest
import torch
from support.command_line import fails_in_one_line

from lexsplat import cli, open_scene
from lexsplat.evaluation.demo import run_demo
from lexsplat.rendering import backends
from lexsplat.rendering.backends import choose_rasterizer
from lexsplat.runtime.errors import BackendError
from lexsplat.runtime.progress import NOTE
from lexsplat.scenes.library import Library


@pytest.fixture
def install_gsplat(monkeypatch):
    """A GPU, and gsplat without its extension; a function installs an extension."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    backend = types.ModuleType("gsplat.cuda._backend")
    backend._C = None
    monkeypatch.setitem(sys.modules, backend.__name__, backend)
    backends.missing_gsplat.cache_clear()
    yield lambda: setattr(backend, "_C", object())
    backends.missing_gsplat.cache_clear()


def test_auto_takes_the_gpu_where_gsplat_renders_on_it(install_gsplat):
    install_gsplat()
    assert choose_rasterizer("auto") == choose_rasterizer("cuda") == "cuda"
    assert choose_rasterizer("cpu") == "cpu"


def test_auto_takes_the_cpu_where_gsplat_cannot_render_and_states_it_once(install_gsplat, caplog):
    with caplog.at_level(NOTE, logger="lexsplat"):
        assert choose_rasterizer("auto") == choose_rasterizer("auto") == "cpu"
    assert caplog.messages == [
        "gsplat: expected its CUDA extension, found an installation without one; "
        "rendering on the CPU (--device cuda states how to use the GPU)"
    ]


def test_cuda_is_refused_with_options_that_every_command_has(install_gsplat):
    with pytest.raises(BackendError, match=r"nvcc .*, or rasterize on the CPU: --device cpu$"):
        choose_rasterizer("cuda")


def test_a_machine_without_a_gpu_does_not_load_gsplat(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(backends, "require_gsplat", lambda *_: pytest.fail("loaded"))
    assert choose_rasterizer("auto") == "cpu"


def test_scenes_and_libraries_open_on_the_cpu_where_gsplat_cannot_render(install_gsplat, tmp_path):
    assert open_scene("demo").gaussians.device.type == "cpu"
    library = Library.create(tmp_path / "library")
    library.add(open_scene("demo").folder.root)
    (record,) = library.records()
    assert library.scene(record.name).gaussians.device.type == "cpu"


def test_commands_answer_with_auto_and_refuse_cuda_in_one_line(install_gsplat, capsys):
    assert cli.main(["find", "demo", "red apple"]) == 0
    assert "red apple" in capsys.readouterr().out
    fails_in_one_line(capsys, ["find", "demo", "red apple", "--device", "cuda"], "gsplat", "--device cpu")


def test_the_demo_is_built_on_the_cpu_where_gsplat_cannot_render(install_gsplat, tmp_path, monkeypatch):
    class Begun(Exception):
        pass

    def begin(capture, output, config, **_):
        raise Begun(config.device)

    monkeypatch.setattr("lexsplat.evaluation.demo.build", begin)
    with pytest.raises(Begun, match="cpu"):
        run_demo(tmp_path / "demo")
    with pytest.raises(BackendError, match=r"--device cpu$"):
        run_demo(tmp_path / "demo", device="cuda")
