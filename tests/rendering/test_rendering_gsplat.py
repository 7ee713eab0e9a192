"""The gsplat backend without a GPU: gsplat's own Python with a replacement of its CUDA extension (`gsplat_kernels`).

These tests check the arguments passed to gsplat, shapes and orders of its results, and the flow of gradients.
`test_rendering_gpu.py` checks the results of CUDA itself.
"""

import importlib.abc
import importlib.machinery
import sys
import types

import pytest
import torch
from support import gsplat_kernels
from support.rendering_reference import front_camera, random_gaussians

from lexsplat.rendering import (
    accumulate_weights,
    back_project,
    backends,
    gsplat_backend,
    prepare,
    render,
    weigh_cells,
)
from lexsplat.runtime.errors import BackendError

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
COUNT, WIDTH, HEIGHT = 60, 50, 37


@pytest.fixture
def on_gsplat(monkeypatch):
    """Selects the gsplat backend for tensors on the CPU."""
    gsplat_kernels.install(monkeypatch)

    def switch():
        monkeypatch.setattr(backends, "backend_for", lambda _: gsplat_backend)

    return switch


def results(antialiased, degree, viewmat=None):
    gaussians = random_gaussians(COUNT, 3, degree=degree, antialiased=antialiased)
    gaussians = gaussians.map(lambda t: t.detach().clone().requires_grad_())
    camera = front_camera(WIDTH, HEIGHT)
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(COUNT, 5, generator=generator).requires_grad_()
    pose = torch.from_numpy(camera.viewmat).float().requires_grad_() if viewmat else None
    found = render(
        gaussians,
        camera,
        features=features,
        background=torch.tensor([0.1, 0.4, 0.8]),
        depth=True,
        viewmat=pose,
    )
    weight = torch.randn(found.channels.shape, generator=generator)
    ((found.channels * weight).sum() + found.alpha.sum()).backward()
    values = torch.rand(HEIGHT, WIDTH, 40, generator=generator)
    made = {
        "image": found.image, "features": found.features, "alpha": found.alpha, "depth": found.depth,
        "means2d gradient": found.means2d.grad, "features gradient": features.grad,
        "back-projection": back_project(gaussians, camera, values),
        **{f"{name} gradient": getattr(gaussians, name).grad for name in FIELDS},
        **({"pose gradient": pose.grad} if viewmat else {}),
    }  # fmt: skip
    return {name: value.detach() for name, value in made.items() if value is not None and value.numel()}


@pytest.mark.parametrize(
    ("antialiased", "degree", "viewmat"), [(False, 0, False), (True, 3, False), (True, 2, True)]
)
def test_the_gsplat_backend_agrees_with_the_cpu(on_gsplat, antialiased, degree, viewmat):
    cpu = results(antialiased, degree, viewmat)
    on_gsplat()
    twin = results(antialiased, degree, viewmat)
    assert cpu.keys() == twin.keys()
    for name in ("image", "features", "alpha", "depth"):
        # Where alpha is within rounding of its threshold, only one of them may draw the contribution of 1/255.
        assert ((cpu[name] - twin[name]).abs() < 1e-4).float().mean() > 0.995, name
        assert (cpu[name] - twin[name]).abs().max() < 0.05, name
    for name in cpu.keys() - {"image", "features", "alpha", "depth"}:
        error = (cpu[name] - twin[name]).norm() / cpu[name].norm().clamp_min(1e-9)
        assert error < 5e-3, (name, float(error))


def test_cells_are_weighed_on_the_gsplat_backend_as_on_the_cpu(on_gsplat):
    gaussians, camera = random_gaussians(COUNT, 3), front_camera(WIDTH, HEIGHT)
    values = torch.randn(35, 70, generator=torch.Generator().manual_seed(0))
    counts = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))

    def found():
        weights = weigh_cells(gaussians, camera, (5, 7), counts, prepare(gaussians, camera))
        sums = torch.zeros(COUNT, 70)
        weights.add_to(sums, values)
        return torch.cat([sums, weights.totals()[:, None]], 1)

    cpu = found()
    on_gsplat()
    assert (cpu - found()).norm() < 5e-3 * cpu.norm()


def test_features_yield_no_gradient_of_the_geometry_on_the_gsplat_backend(on_gsplat):
    on_gsplat()
    gaussians = random_gaussians(COUNT, 3).map(lambda t: t.detach().clone().requires_grad_())
    features = torch.randn(COUNT, 3, requires_grad=True)
    render(gaussians, front_camera(WIDTH, HEIGHT), features=features).features.square().sum().backward()
    assert features.grad.abs().sum() > 0
    for name in FIELDS:
        gradient = getattr(gaussians, name).grad
        assert gradient is None or not gradient.any(), name


def test_a_view_prepared_by_gsplat_renders_the_same(on_gsplat):
    on_gsplat()
    gaussians, camera = random_gaussians(COUNT, 4), front_camera(WIDTH, HEIGHT)
    view = prepare(gaussians, camera)
    assert view.nbytes > 0
    torch.testing.assert_close(
        render(gaussians, camera, prepared=view).image, render(gaussians, camera).image, atol=0, rtol=0
    )


def test_the_gsplat_backend_renders_zero_gaussians_as_an_empty_image(on_gsplat):
    on_gsplat()
    nothing = random_gaussians(COUNT, 3).select(torch.zeros(COUNT, dtype=torch.bool))
    nothing = nothing.map(lambda t: t.detach().clone().requires_grad_())
    camera, background = front_camera(WIDTH, HEIGHT), torch.tensor([0.1, 0.4, 0.8])
    found = render(nothing, camera, background=background, depth=True)
    assert torch.equal(found.image, background.expand(HEIGHT, WIDTH, 3))
    assert not found.alpha.any()
    assert not found.depth.any()
    (found.image.sum() + found.alpha.sum()).backward()
    assert back_project(nothing, camera, torch.zeros(HEIGHT, WIDTH, 3)).shape == (0, 3)


@pytest.mark.slow
def test_the_gsplat_backend_renders_any_number_of_channels(on_gsplat):
    on_gsplat()
    gaussians, camera = random_gaussians(COUNT, 3), front_camera(WIDTH, HEIGHT)
    features = torch.randn(COUNT, 600).requires_grad_()
    found = render(gaussians, camera, features=features)
    assert found.features.shape == (HEIGHT, WIDTH, 600)
    for columns in (slice(0, 3), slice(597, 600)):
        alone = render(gaussians, camera, features=features[:, columns]).features
        torch.testing.assert_close(found.features[..., columns], alone)
    found.features.sum().backward()
    weights = accumulate_weights(gaussians, camera)
    torch.testing.assert_close(features.grad, weights[:, None].expand(-1, 600))


@pytest.mark.parametrize("kind", [ImportError, RuntimeError])
def test_an_extension_that_fails_to_compile_is_reported_in_one_line(monkeypatch, kind):
    class Backend(types.ModuleType):
        @property
        def _C(self):
            raise kind("Error building extension 'gsplat_cuda'")

    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", Backend("gsplat.cuda._backend"))
    with pytest.raises(
        BackendError, match=r"expected its CUDA extension, found .*Error building extension.*nvcc"
    ):
        gsplat_backend.require_gsplat()


def test_of_a_compiler_that_fails_the_errors_are_reported_and_everything_is_logged(monkeypatch, caplog):
    output = "\n".join(
        [
            "Error building extension 'gsplat_cuda': [1/12] /usr/local/cuda/bin/nvcc -I include "
            + "-DX " * 90,
            "FAILED: ProjectionEWA.cuda.o",
            "nvcc --generate-dependencies " + "-DY " * 90,
            "/usr/include/glm/glm.hpp(12): fatal error: no such file or directory",
            "compilation terminated.",
            "ninja: build stopped: subcommand failed.",
        ]
    )

    class Backend(types.ModuleType):
        @property
        def _C(self):
            raise RuntimeError(output)

    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", Backend("gsplat.cuda._backend"))
    with caplog.at_level("DEBUG", "lexsplat"), pytest.raises(BackendError) as caught:
        gsplat_backend.require_gsplat()
    assert "glm.hpp(12): fatal error: no such file or directory; install a wheel" in str(caught.value)
    assert len(caught.value.found) < 400
    assert output in caplog.text


def test_gsplats_compiler_messages_are_not_printed(monkeypatch, capsys):
    class Talkative(importlib.abc.MetaPathFinder, importlib.abc.Loader):
        def find_spec(self, name, path=None, target=None):
            return importlib.machinery.ModuleSpec(name, self) if name == "gsplat.cuda._backend" else None

        def exec_module(self, module):
            print("gsplat: CUDA extension has been set up successfully")
            module._C = object()

    monkeypatch.delitem(sys.modules, "gsplat.cuda._backend", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Talkative(), *sys.meta_path])
    try:
        gsplat_backend.require_gsplat()
    finally:
        sys.modules.pop("gsplat.cuda._backend", None)
    said = capsys.readouterr()
    assert said.out == ""
    assert "set up successfully" in said.err


def test_an_installation_without_the_extension_is_reported_in_one_line(monkeypatch):
    backend = types.ModuleType("gsplat.cuda._backend")
    backend._C = None
    monkeypatch.setitem(sys.modules, backend.__name__, backend)
    with pytest.raises(BackendError, match="expected its CUDA extension, found an installation without one"):
        gsplat_backend.require_gsplat()


def test_a_missing_gsplat_is_reported_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(BackendError, match=r"gsplat: found .*; run: pip install gsplat==1\.5\.3"):
        gsplat_backend.require_gsplat()
