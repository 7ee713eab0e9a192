"""The gsplat backend without a GPU: gsplat's own torch twins stand in for its CUDA functions.

This shows that our calls fit gsplat's signatures, that shapes and orders are understood, and that gradients go
where they should; what CUDA itself computes is for `test_rendering_gpu.py`. gsplat's twin of the last step needs
CUDA, so that one is written out here.
"""

import inspect

import numpy as np
import pytest
import torch
from rendering_reference import front_camera, random_gaussians

from lexsplat import rendering
from lexsplat.rendering import accumulate_codes, prepare, render

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
COUNT, WIDTH, HEIGHT = 60, 50, 37


def rasterize(means2d, conics, colors, opacities, width, height, tile, offsets, members, backgrounds=None):
    """What `gsplat.rasterize_to_pixels` documents, pixel by pixel over the list of its tile, for one image."""
    assert means2d.shape == (1, COUNT, 2)
    assert conics.shape == (1, COUNT, 3)
    assert opacities.shape == (1, COUNT)
    assert colors.shape[:2] == (1, COUNT)
    rows, columns = offsets.shape[1:]
    starts = [*offsets.flatten().tolist(), len(members)]
    ys, xs = torch.meshgrid(torch.arange(tile) + 0.5, torch.arange(tile) + 0.5, indexing="ij")
    strips = []
    for row in range(rows):
        tiles = []
        for column in range(columns):
            place = row * columns + column
            x, y = xs + column * tile, ys + row * tile
            left = torch.ones_like(x)
            done = torch.zeros_like(x, dtype=torch.bool)
            image = torch.zeros(tile, tile, colors.shape[-1])
            for k in members[starts[place] : starts[place + 1]].tolist():
                dx, dy = means2d[0, k, 0] - x, means2d[0, k, 1] - y
                a, b, c = conics[0, k]
                sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
                alpha = (opacities[0, k] * torch.exp(-sigma)).clamp_max(0.999)
                alpha = torch.where((sigma >= 0) & (alpha >= 1 / 255), alpha, torch.zeros_like(alpha))
                after = left * (1 - alpha)
                done = done | (after <= 1e-4)
                weight = torch.where(done, torch.zeros_like(alpha), alpha * left)
                left = torch.where(done, left, after)
                image = image + weight[..., None] * colors[0, k]
            if backgrounds is not None:
                image = image + left[..., None] * backgrounds[0]
            tiles.append(torch.cat([image, 1 - left[..., None]], -1))
        strips.append(torch.cat(tiles, 1))
    whole = torch.cat(strips, 0)[:height, :width]
    return whole[None, ..., :-1], whole[None, ..., -1:]


def project(means, covars, quats, scales, viewmats, Ks, width, height, **options):
    """gsplat's twin takes covariances, and does not narrow the radii by the opacities."""
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    assert covars is None
    options.pop("opacities")
    covariances, _ = _quat_scale_to_covar_preci(quats, scales, True, False, False)
    return _fully_fused_projection(means, covariances, viewmats, Ks, width, height, **options)


@pytest.fixture
def on_gsplat(monkeypatch):
    """Makes rendering take the gsplat backend, with stand-ins that insist on gsplat's signatures."""
    from gsplat.cuda import _torch_impl, _wrapper

    from lexsplat.rendering import gsplat_backend

    stand_ins = {
        "fully_fused_projection": project,
        "isect_tiles": _torch_impl._isect_tiles,
        "isect_offset_encode": _torch_impl._isect_offset_encode,
        "spherical_harmonics": lambda degree, dirs, coeffs, masks: _torch_impl._spherical_harmonics(
            degree, dirs, coeffs
        ),
        "rasterize_to_pixels": rasterize,
    }
    for name, stand_in in stand_ins.items():
        signature = inspect.signature(getattr(_wrapper, name))

        def call(*args, _signature=signature, _stand_in=stand_in, **kwargs):
            _signature.bind(*args, **kwargs)
            return _stand_in(*args, **kwargs)

        monkeypatch.setattr(_wrapper, name, call)
    monkeypatch.setattr(gsplat_backend, "_require_gsplat", lambda: None)

    def switch():
        monkeypatch.setattr(rendering, "_module", lambda *_: gsplat_backend)

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
    codes = np.random.default_rng(0).integers(0, 40, (HEIGHT, WIDTH))
    made = {
        "image": found.image, "features": found.features, "alpha": found.alpha, "depth": found.depth,
        "means2d gradient": found.means2d.grad, "features gradient": features.grad,
        "codes": accumulate_codes(gaussians, camera, codes, 40),
        **{f"{name} gradient": getattr(gaussians, name).grad for name in FIELDS},
        **({"pose gradient": pose.grad} if viewmat else {}),
    }  # fmt: skip
    return {name: value.detach() for name, value in made.items() if value is not None and value.numel()}


@pytest.mark.parametrize(
    ("antialiased", "degree", "viewmat"), [(False, 0, False), (True, 3, False), (True, 2, True)]
)
def test_the_gsplat_backend_renders_what_the_cpu_renders(on_gsplat, antialiased, degree, viewmat):
    cpu = results(antialiased, degree, viewmat)
    on_gsplat()
    twin = results(antialiased, degree, viewmat)
    assert cpu.keys() == twin.keys()
    for name in ("image", "features", "alpha", "depth"):
        # Where alpha is within rounding of its threshold, one of them draws 1/255 that the other does not.
        assert ((cpu[name] - twin[name]).abs() < 1e-4).float().mean() > 0.995, name
        assert (cpu[name] - twin[name]).abs().max() < 0.05, name
    for name in cpu.keys() - {"image", "features", "alpha", "depth"}:
        error = (cpu[name] - twin[name]).norm() / cpu[name].norm().clamp_min(1e-9)
        assert error < 5e-3, (name, float(error))


def test_on_the_gsplat_backend_too_features_leave_geometry_alone(on_gsplat):
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
