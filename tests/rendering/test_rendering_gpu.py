"""The CUDA backend against the CPU kernels, on the same scenes."""

from dataclasses import replace

import pytest
import torch
from support.rendering_reference import front_camera, random_gaussians

from lexsplat.rendering import back_project, prepare, render

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")


def results(device: str, antialiased: bool, degree: int) -> dict[str, torch.Tensor]:
    gaussians = random_gaussians(2000, 3, degree=degree, antialiased=antialiased, scale=0.06).to(device)
    gaussians = gaussians.map(lambda t: t.detach().clone().requires_grad_())
    camera = front_camera(165, 123)
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(2000, 9, generator=generator).to(device).requires_grad_()
    background = torch.tensor([0.1, 0.4, 0.8], device=device)
    rendering = render(gaussians, camera, features=features, background=background)
    weight = torch.randn(rendering.channels.shape, generator=generator).to(device)
    ((rendering.channels * weight).sum() + rendering.alpha.sum()).backward()
    values = torch.rand(123, 165, 40, generator=generator).to(device)
    found = {
        "image": rendering.image, "features": rendering.features, "alpha": rendering.alpha,
        "means2d gradient": rendering.means2d.grad, "features gradient": features.grad,
        "back-projection": back_project(gaussians, camera, values),
        **{f"{name} gradient": getattr(gaussians, name).grad for name in FIELDS},
    }  # fmt: skip
    return {name: value.detach().cpu() for name, value in found.items()}


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("antialiased", [False, True])
def test_cuda_agrees_with_the_cpu(antialiased, degree):
    cpu, cuda = results("cpu", antialiased, degree), results("cuda", antialiased, degree)
    for name in ("image", "features", "alpha"):
        # Where alpha is within rounding of its threshold, only one of them may draw the contribution of 1/255.
        assert ((cpu[name] - cuda[name]).abs() < 1e-4).float().mean() > 0.999, name
        assert (cpu[name] - cuda[name]).abs().max() < 0.05, name
    for name in cpu.keys() - {"image", "features", "alpha"}:
        error = (cpu[name] - cuda[name]).norm() / cpu[name].norm().clamp_min(1e-9)
        assert error < 5e-3, (name, float(error))


def test_the_pose_gradient_on_cuda_agrees_with_the_cpu():
    camera, gradients = front_camera(165, 123), []
    for device in ("cpu", "cuda"):
        gaussians = random_gaussians(2000, 3, antialiased=True, scale=0.06).to(device)
        viewmat = torch.from_numpy(camera.viewmat).float().to(device).requires_grad_()
        rendering = render(gaussians, camera, viewmat=viewmat)
        weight = torch.randn(rendering.channels.shape, generator=torch.Generator().manual_seed(0)).to(device)
        (rendering.channels * weight).sum().backward()
        gradients.append(viewmat.grad.cpu())
    assert (gradients[0] - gradients[1]).norm() < 5e-3 * gradients[0].norm()


def test_features_leave_the_gradients_of_the_geometry_unchanged_on_cuda():
    gaussians = random_gaussians(500, 3).to("cuda").map(lambda t: t.detach().clone().requires_grad_())
    features = torch.randn(500, 9, device="cuda", requires_grad=True)
    rendering = render(gaussians, front_camera(), features=features)
    rendering.features.square().sum().backward()
    assert features.grad.abs().sum() > 0
    for name in FIELDS:
        gradient = getattr(gaussians, name).grad
        assert gradient is None or not gradient.any(), name


def test_radii_and_prepared_views_on_cuda():
    gaussians, camera = random_gaussians(500, 3).to("cuda"), front_camera()
    prepared = prepare(gaussians, camera)
    straight, again = (
        render(gaussians, camera, depth=True),
        render(gaussians, camera, depth=True, prepared=prepared),
    )
    assert torch.equal(straight.channels, again.channels)
    on_cpu = render(gaussians.to("cpu"), camera, depth=True)
    assert ((straight.radii.cpu() > 0) == (on_cpu.radii > 0)).float().mean() > 0.99
    seen = on_cpu.alpha > 0.1
    assert (straight.depth.cpu() - on_cpu.depth)[seen].abs().max() < 1e-2


def test_an_empty_view_on_cuda():
    gaussians, camera = random_gaussians(20, 3).to("cuda"), front_camera()
    behind = replace(
        gaussians, means=gaussians.means + 3 * torch.tensor(camera.position, device="cuda").float()
    )
    background = torch.tensor([0.2, 0.3, 0.4], device="cuda")
    rendering = render(behind, camera, background=background)
    assert torch.allclose(rendering.image, background.expand_as(rendering.image))
    assert not rendering.radii.any()
