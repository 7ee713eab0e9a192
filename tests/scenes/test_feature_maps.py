"""The feature map F of a view and its picture."""

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file
from support.viewer_scene import BallScene, ball_scene

from lexsplat.codebook import Codebook
from lexsplat.language.fields import CodeField
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.feature_maps import code_colors, feature_map, feature_picture, write_features


@pytest.fixture(scope="module")
def scene() -> BallScene:
    return ball_scene(per_ball=80)[0]


def test_the_feature_map_is_the_blend_of_the_codewords_at_unit_length(scene):
    view = next(iter(scene.views))
    probabilities = (
        scene.field.render_code_probabilities(scene.gaussians, scene.camera(view)).double().numpy()
    )
    expected = probabilities @ scene.field.codebook.clip.double().numpy()
    lengths = np.linalg.norm(expected, axis=-1, keepdims=True)
    seen = lengths[..., 0] > 1e-3
    assert seen.any()
    found = feature_map(scene, view).numpy()
    np.testing.assert_allclose(found[seen], (expected / np.maximum(lengths, 1e-12))[seen], atol=1e-4)
    assert not np.abs(found[lengths[..., 0] == 0]).any()


def test_colors_are_the_principal_components_of_the_codewords_of_the_gaussians():
    random = torch.Generator().manual_seed(0)
    codewords = torch.nn.functional.normalize(torch.randn(9, 12, generator=random), dim=-1)
    codes = torch.randint(9, (200, 2), generator=random).to(torch.uint8)
    field = CodeField(Codebook(codewords), codes, torch.full((200, 2), 0.5), torch.zeros(200))
    codewords = field.codebook.clip.double().numpy()
    weights = np.bincount(codes.numpy().ravel(), minlength=9)
    covariance = np.cov(codewords.T, aweights=weights, ddof=0)
    values, vectors = np.linalg.eigh(covariance)
    centered = codewords - np.average(codewords, axis=0, weights=weights)
    colors = code_colors(field).double().numpy()
    for place in range(3):
        expected = 0.5 * centered @ vectors[:, -1 - place] / (2 * values[-1 - place] ** 0.5)
        inside = np.abs(expected) < 0.49
        assert np.isclose(np.abs(colors[inside, place] - 0.5), np.abs(expected[inside]), atol=1e-5).all()


def test_the_picture_and_the_map_are_written_for_each_view(scene, tmp_path):
    view = next(iter(scene.views))
    written = write_features(scene, [view], tmp_path)
    stored = load_file(written[view]["map"])["features"]
    assert torch.equal(stored, feature_map(scene, view).half())
    pixels = np.asarray(Image.open(written[view]["picture"])) / 255
    np.testing.assert_allclose(pixels, feature_picture(scene, view), atol=0.5 / 255 + 1e-6)
    colors = code_colors(scene.field)
    assert torch.equal(feature_picture(scene, view, colors), feature_picture(scene, view))
    with pytest.raises(QueryError, match="name of a view"):
        write_features(scene, ["nothing"], tmp_path)
