"""Dense encoders: real architectures with tiny random weights, against direct calls of transformers."""

from __future__ import annotations

import json
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from support.encoder_folders import normalized, save_model, seeded, tiny_vit, unit

from lexsplat.features.dino import _ramp, _window_starts
from lexsplat.features.encoders import DinoEncoder

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(autouse=True)
def full_precision(monkeypatch) -> None:
    monkeypatch.setattr("lexsplat.features.pretrained.bfloat16_is_faster", lambda: False)


def _dinov2(registers: int):
    import transformers

    sizes = {"hidden_size": 24, "num_hidden_layers": 3, "num_attention_heads": 2}
    options = {**sizes, "image_size": 28, "patch_size": 14}
    if not registers:
        return transformers.Dinov2Model(transformers.Dinov2Config(**options))
    config = transformers.Dinov2WithRegistersConfig(**options, num_register_tokens=registers)
    return transformers.Dinov2WithRegistersModel(config)


def _dinov3(registers: int):
    transformers = pytest.importorskip("transformers")
    if not hasattr(transformers, "DINOv3ViTModel"):
        pytest.skip("this transformers has no DINOv3")
    config = transformers.DINOv3ViTConfig(
        hidden_size=24, intermediate_size=40, num_hidden_layers=3, num_attention_heads=2, image_size=32,
        patch_size=16, num_register_tokens=registers,
    )  # fmt: skip
    return transformers.DINOv3ViTModel(config)


@pytest.mark.parametrize(("build", "registers"), [(tiny_vit, 0), (_dinov2, 0), (_dinov2, 4), (_dinov3, 3)])
def test_dense_tokens_and_keys_equal_transformers_own_without_special_tokens(build, registers, tmp_path):
    model = seeded(lambda: build(registers))
    encoder = DinoEncoder(save_model(model, tmp_path), "tiny")
    patch = encoder.patch_size
    rows, cols = 3, 5
    image = torch.rand(3, rows * patch, cols * patch, generator=torch.Generator().manual_seed(3))
    options = {"interpolate_pos_encoding": True} if build is tiny_vit else {}
    with torch.no_grad():
        output = model(normalized(image[None]), output_hidden_states=True, **options)
    expected = output.last_hidden_state[0, 1 + registers :].reshape(rows, cols, 24)
    found = encoder.encode_dense(image, short_side=rows * patch, facet="token")
    assert encoder.num_layers == 3
    torch.testing.assert_close(found, unit(expected), atol=1e-5, rtol=0)

    # Keys of layer 1 by hand: its input, through its first normalization and its key projection.
    layers = [(n, m) for n, m in model.named_modules() if n.endswith("layer.1") or n.endswith("layers.1")]
    layer = layers[0][1]
    norm = next(m for n, m in layer.named_modules() if n in ("norm1", "layernorm_before"))
    key = next(m for n, m in layer.named_modules() if n.endswith(("k_proj", ".key")))
    with torch.no_grad():
        expected = key(norm(output.hidden_states[1]))[0, 1 + registers :].reshape(rows, cols, 24)
    found = encoder.encode_dense(image, short_side=rows * patch, facet="key", layer=1)
    torch.testing.assert_close(found, unit(expected), atol=1e-5, rtol=0)


@pytest.fixture(scope="module")
def dino(tmp_path_factory) -> DinoEncoder:
    return DinoEncoder(save_model(seeded(tiny_vit), tmp_path_factory.mktemp("vit")), "tiny")


def test_a_smaller_stride_evaluates_the_model_on_shifted_images(dino):
    image = torch.rand(3, 32, 48, generator=torch.Generator().manual_seed(4))
    fine = dino.encode_dense(image, short_side=32, stride=2, facet="token")
    assert fine.shape == (16, 24, 24)
    # Cell 4 k + 2 of the fine grid has its center at 8 k + 5: the patch that starts at 8 k + 1.
    padded = torch.nn.functional.pad(image[None], (3, 3, 3, 3), mode="replicate")[0]
    shifted = padded[:, 3 + 1 : 3 + 1 + 32, 3 - 1 : 3 - 1 + 48]
    expected = dino.encode_dense(shifted, short_side=32, facet="token")
    torch.testing.assert_close(fine[2::4, 1::4], expected, atol=1e-5, rtol=0)


def test_fine_features_are_aligned_with_the_image(tmp_path):
    """With a model that only averages color, features of a ramp must be the ramp at the cells' centers."""
    model = tiny_vit(hidden_size=4, intermediate_size=4, num_hidden_layers=1, num_attention_heads=1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
        # Channels (mean red, its negative, 1, -1): zero mean, so that normalizing keeps the ratio.
        weight = model.embeddings.patch_embeddings.projection.weight
        weight[0, 0], weight[1, 0] = 1 / 64, -1 / 64
        model.embeddings.patch_embeddings.projection.bias[:] = torch.tensor([0.0, 0.0, 1.0, -1.0])
        for module in model.modules():
            if isinstance(module, torch.nn.LayerNorm):
                module.weight.fill_(1.0)
    folder = save_model(model, tmp_path)
    (folder / "preprocessor_config.json").write_text(
        json.dumps({"image_mean": [0] * 3, "image_std": [1] * 3})
    )
    encoder = DinoEncoder(folder, "color")
    ramp = (torch.arange(64) + 0.5) / 64
    image = ramp.expand(3, 32, 64)
    for stride, tolerance in ((8, 1e-4), (2, 1e-4), (4, 1e-4)):
        found = encoder.encode_dense(image, short_side=32, stride=stride, facet="token")
        red = found[..., 0] / found[..., 2]
        centers = (torch.arange(64 // stride) + 0.5) * stride / 64
        inner = slice(4 // stride + 1, -4 // stride - 1)  # border patches see replicated pixels
        assert (red[:, inner] - centers[inner]).abs().max() < tolerance


def test_windows_of_a_large_image_agree_with_one_pass_for_a_local_model(dino, tmp_path):
    image = torch.rand(3, 64, 120, generator=torch.Generator().manual_seed(5))
    whole = dino.encode_dense(image, short_side=64, facet="token")
    windowed = dino.encode_dense(image, short_side=64, facet="token", max_tokens=20)
    assert windowed.shape == whole.shape
    torch.testing.assert_close(windowed.norm(dim=-1), torch.ones(8, 15), atol=1e-5, rtol=0)
    # Without attention and positions a token depends on its patch alone, so windows change nothing.
    model = seeded(tiny_vit)
    with torch.no_grad():
        model.embeddings.position_embeddings.zero_()
        for name, parameter in model.named_parameters():
            if "v_proj" in name or "attention.value" in name:
                parameter.zero_()
    local = DinoEncoder(save_model(model, tmp_path), "local")
    whole = local.encode_dense(image, short_side=64, facet="token")
    windowed = local.encode_dense(image, short_side=64, facet="token", max_tokens=20)
    torch.testing.assert_close(windowed, whole, atol=1e-5, rtol=0)


def test_attention_never_sees_more_patches_than_allowed(dino, monkeypatch):
    seen = []

    def counted(pixels, facet, layer):
        rows, cols = pixels.shape[-2] // 8, pixels.shape[-1] // 8
        seen.append(rows * cols)
        return torch.ones(rows, cols, 24)

    monkeypatch.setattr(dino, "_forward", counted)
    for height, width, limit in ((64, 120, 20), (32, 400, 7), (400, 32, 7), (64, 64, 1)):
        seen.clear()
        dino.encode_dense(torch.rand(3, height, width), short_side=min(height, width), max_tokens=limit)
        assert seen
        assert max(seen) <= limit


@pytest.mark.parametrize(("total", "window"), [(5, 9), (9, 9), (10, 9), (100, 7), (13, 1), (64, 16)])
def test_windows_cover_everything_and_overlap(total, window):
    starts = _window_starts(total, window)
    covered = np.zeros(total, dtype=int)
    for start in starts:
        assert 0 <= start <= max(0, total - window)
        covered[start : start + window] += 1
    assert covered.min() >= 1
    assert (_ramp(window) > 0).all()
    if window >= 4:
        assert max(np.diff(starts), default=0) <= window - window // 4 + 1


def test_each_thread_gets_its_own_keys(dino):
    images = [torch.rand(3, 32, 32, generator=torch.Generator().manual_seed(seed)) for seed in range(6)]
    expected = [dino.encode_dense(image, short_side=32) for image in images]
    barrier = threading.Barrier(3)

    def work(index: int) -> list[torch.Tensor]:
        barrier.wait()
        return [dino.encode_dense(images[i], short_side=32) for i in range(index, 6, 3)]

    with ThreadPoolExecutor(3) as pool:
        for index, found in enumerate(pool.map(work, range(3))):
            for tensor, reference in zip(found, expected[index::3]):
                torch.testing.assert_close(tensor, reference, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    "options", [{"stride": 0}, {"facet": "value"}, {"layer": 3}, {"layer": -4}]
)  # the tiny model has three layers
def test_bad_dense_options_are_refused(dino, options):
    with pytest.raises(ValueError):
        dino.encode_dense(torch.rand(3, 32, 32), **options)
