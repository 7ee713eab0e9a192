"""Claims about the language fields; references are float64 layers and the renderer by definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from support.language_scene import LanguageScene, make_codebook, make_scene
from support.rendering_reference import blend, project, to_float64
from torch import nn

from lexsplat.language.fields import (
    INITIAL_UNCERTAINTY,
    CodeField,
    LanguageField,
    SmoothingMLP,
    TrainedField,
    field_from_tensors,
    positional_encoding,
    scene_box,
)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene(per_ball=8, views=2, width=16, height=12, num_codes=70)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make_trained(balls, **options) -> TrainedField:
    field = TrainedField.initial(balls.gaussians, balls.codebook, generator=generator(), **options)
    with torch.no_grad():
        field.uncertainty_logits.copy_(torch.randn(len(balls.gaussians), generator=generator(1)))
    return field


def make_coded(balls, columns: int = 4) -> CodeField:
    rng = np.random.default_rng(0)
    count = len(balls.gaussians)
    codes = np.stack([rng.permutation(balls.codebook.num_codes)[:columns] for _ in range(count)]).astype(
        np.uint8
    )
    weights = rng.random((count, columns))
    weights /= weights.sum(1, keepdims=True)
    weights[3] = 0
    return CodeField(
        balls.codebook, torch.tensor(codes), torch.tensor(weights), torch.tensor(rng.random(count))
    )


def layers_by_hand(network: nn.Sequential, values: np.ndarray) -> np.ndarray:
    for layer in network:
        if isinstance(layer, nn.Linear):
            values = values @ layer.weight.detach().double().numpy().T + layer.bias.detach().double().numpy()
        else:
            values = np.maximum(values, 0)
    return values


def softmax(values: np.ndarray) -> np.ndarray:
    exponentials = np.exp(values - values.max(-1, keepdims=True))
    return exponentials / exponentials.sum(-1, keepdims=True)


def rendered_by_definition(balls, name: str, values: np.ndarray) -> np.ndarray:
    projected = project(to_float64(balls.gaussians), balls.cameras[name], balls.gaussians.antialiased)
    return blend(projected, torch.from_numpy(values), balls.cameras[name])[0].detach().numpy()


def test_layers_are_those_of_the_papers_tables(balls) -> None:
    field = make_trained(balls)
    decoder = [
        (layer.in_features, layer.out_features) for layer in field.decoder if isinstance(layer, nn.Linear)
    ]
    smoother = [
        (layer.in_features, layer.out_features)
        for layer in field.smoother.layers
        if isinstance(layer, nn.Linear)
    ]
    assert decoder == [(8, 128), (128, 256), (256, 70)]
    assert smoother == [(3, 128), (128, 128), (128, 128), (128, 8)]
    for network in (field.decoder, field.smoother.layers):
        kinds = [nn.Linear if isinstance(layer, nn.Linear) else type(layer) for layer in network]
        assert kinds[:-1] == [nn.Linear, nn.ReLU] * (len(kinds) // 2)
        assert kinds[-1] is nn.Linear


def test_training_starts_from_normal_semantics_and_almost_no_uncertainty(balls) -> None:
    field = TrainedField.initial(balls.gaussians, balls.codebook, generator=generator())
    assert abs(float(field.semantics.detach().mean())) < 0.2
    assert float(field.semantics.detach().std()) == pytest.approx(1, abs=0.1)
    np.testing.assert_allclose(field.uncertainties, INITIAL_UNCERTAINTY, rtol=1e-5)


def test_the_start_depends_on_its_generator_only(balls) -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = make_trained(balls).tensors()
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    second = make_trained(balls).tensors()
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("num_frequencies", [0, 1, 3])
def test_positional_encoding_is_nerfs(num_frequencies: int) -> None:
    positions = np.random.default_rng(0).uniform(-1, 1, (4, 3))
    encoded = positional_encoding(torch.tensor(positions), num_frequencies).numpy()
    for row, position in zip(encoded, positions):
        angles = [2.0**octave * np.pi * value for octave in range(num_frequencies) for value in position]
        np.testing.assert_allclose(row, [*position, *np.sin(angles), *np.cos(angles)], atol=1e-6)


@pytest.mark.parametrize("num_frequencies", [0, 2])
def test_smoothing_mlp_is_equation_13_on_the_normalized_scene(num_frequencies: int) -> None:
    center, extent = torch.tensor([1.0, -2.0, 0.5]), torch.tensor(2.0)
    network = SmoothingMLP(center, extent, num_frequencies, generator=generator())
    means = torch.randn(6, 3, generator=generator(2)) * 3
    unit = np.clip((means.double().numpy() - center.numpy()) / 2.0, -2, 2)
    encoded = positional_encoding(torch.tensor(unit), num_frequencies).numpy()
    np.testing.assert_allclose(network(means).detach(), layers_by_hand(network.layers, encoded), atol=1e-5)


def test_scene_box_holds_the_scene_and_not_its_floaters() -> None:
    points = torch.rand(1000, 3, generator=generator()) * torch.tensor([2.0, 4.0, 1.0])
    points[:5] = 1e4
    center, extent = scene_box(points)
    np.testing.assert_allclose(center, [1, 2, 0.5], atol=0.1)
    assert float(extent) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("normalize", [False, True])
def test_trained_field_renders_equation_8(balls, normalize: bool) -> None:
    field = make_trained(balls, normalize_rendering=normalize)
    semantics = rendered_by_definition(balls, "view1", field.semantics.detach().double().numpy())
    if normalize:
        semantics = semantics / np.maximum(np.linalg.norm(semantics, axis=-1, keepdims=True), 1e-12)
    expected = softmax(layers_by_hand(field.decoder, semantics))
    found = field.render_code_probabilities(balls.gaussians, balls.cameras["view1"])
    assert found.shape == (12, 16, 70)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    own = field.semantics.detach().double().numpy()
    own = own / np.linalg.norm(own, axis=1, keepdims=True) if normalize else own
    np.testing.assert_allclose(
        field.code_probabilities(), softmax(layers_by_hand(field.decoder, own)), atol=1e-5
    )


def test_semantics_and_uncertainty_are_rendered_together(balls) -> None:
    field = make_trained(balls)
    semantics, uncertainty = field.render_semantics(balls.gaussians, balls.cameras["view0"])
    expected = rendered_by_definition(balls, "view0", field.uncertainties.double().numpy()[:, None])[..., 0]
    np.testing.assert_allclose(uncertainty.detach(), expected, atol=1e-5)
    assert semantics.shape == (12, 16, 8)
    assert uncertainty.min() >= 0
    assert uncertainty.max() <= 1


def test_language_gradients_never_reach_geometry(balls) -> None:
    gaussians = balls.gaussians.map(lambda tensor: tensor.clone().requires_grad_())
    field = make_trained(balls)
    semantics, uncertainty = field.render_semantics(gaussians, balls.cameras["view0"])
    (field.decode(semantics).square().sum() + uncertainty.sum()).backward()
    assert all(tensor.grad is None for tensor in gaussians.tensors().values())
    assert field.semantics.grad.abs().sum() > 0
    assert field.uncertainty_logits.grad.abs().sum() > 0


def test_smoothing_gradients_never_reach_the_places(balls) -> None:
    means = balls.gaussians.means.clone().requires_grad_()
    smoother = make_trained(balls).smoother
    smoother(means).square().sum().backward()
    assert means.grad is None
    assert smoother.layers[0].weight.grad.abs().sum() > 0


def test_a_code_field_renders_its_distributions(balls) -> None:
    field = make_coded(balls)
    dense = np.zeros((len(balls.gaussians), 70))
    for n in range(len(dense)):
        for code, weight in zip(field.codes[n].tolist(), field.weights[n].tolist()):
            dense[n, code] += weight
    np.testing.assert_allclose(field.code_probabilities(), dense, atol=1e-7)
    found = field.render_code_probabilities(balls.gaussians, balls.cameras["view1"])
    np.testing.assert_allclose(found, rendered_by_definition(balls, "view1", dense), atol=1e-5)


@pytest.mark.parametrize("make", [make_trained, make_coded])
def test_rendered_scores_are_the_table_applied_to_the_probabilities(balls, make) -> None:
    field, camera = make(balls), balls.cameras["view0"]
    table = torch.rand(70, 3, generator=generator(3))
    probabilities = field.render_code_probabilities(balls.gaussians, camera)
    scores = field.render_scores(balls.gaussians, camera, table)
    torch.testing.assert_close(scores, probabilities @ table, rtol=0, atol=1e-5)


def test_scores_of_a_code_field_render_as_its_3d_scores(balls) -> None:
    field = make_coded(balls)
    table = torch.rand(70, 40, generator=generator(3))
    in_space = (field.code_probabilities() @ table).double().numpy()
    found = field.render_scores(balls.gaussians, balls.cameras["view0"], table)
    np.testing.assert_allclose(found, rendered_by_definition(balls, "view0", in_space), atol=1e-5)


@pytest.mark.parametrize("make", [make_trained, make_coded])
def test_scores_are_the_table_applied_to_the_probabilities_of_each_gaussian(balls, make) -> None:
    field, table = make(balls), torch.rand(70, 3, generator=generator(3))
    torch.testing.assert_close(field.scores(table), field.code_probabilities() @ table, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match=r"table must be \[70, P\]"):
        field.scores(torch.ones(3, 1))


@pytest.mark.parametrize("method", ["lifted", "averaged", "lifted+tuned", "trained"])
def test_stored_fields_of_earlier_versions_open(balls, method) -> None:
    field = make_trained(balls) if method in ("lifted+tuned", "trained") else make_coded(balls)
    kind = "trained" if isinstance(field, TrainedField) else "lifted"
    metadata = {"kind": kind, "method": method, "dropped": "0.0312"}
    tensors = field.tensors()
    if isinstance(field, CodeField):  # they hold floats
        tensors |= {"weights": field.weights, "uncertainties": field.uncertainties}
    again = field_from_tensors(tensors, metadata)
    assert type(again) is type(field)
    assert again.method == method
    assert torch.equal(again.uncertainties, field.uncertainties)


@pytest.mark.parametrize("make", [make_trained, make_coded])
def test_sums_and_likeliest_codes_are_those_of_the_dense_distributions(balls, make) -> None:
    field, count = make(balls), len(balls.gaussians)
    rng = np.random.default_rng(2)
    places, shares, dense = rng.integers(0, 3, count), rng.random(count), field.code_probabilities().numpy()
    expected = np.stack([shares[places == place] @ dense[places == place] for place in range(4)])
    found = field.sums(torch.from_numpy(places), torch.from_numpy(shares), 4)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
    codes, known = (each.numpy() for each in field.likeliest_codes())
    assert np.array_equal(known, dense.sum(1) > 0)
    assert np.array_equal(codes[known], dense.argmax(1)[known])


def test_codes_weights_and_u_take_nine_bytes_a_gaussian_and_keep_the_sum_of_the_weights(balls) -> None:
    field = make_coded(balls)
    stored = field.tensors()
    sizes = [stored[name].nbytes for name in ("codes", "weights", "uncertainties")]
    assert sum(sizes) == 9 * len(balls.gaussians)
    again = field_from_tensors(stored, field.metadata())
    assert isinstance(again, CodeField)
    sums = torch.ones(len(field.codes)).index_fill(0, torch.tensor([3]), 0)
    torch.testing.assert_close(again.weights.sum(1), sums, rtol=0, atol=1e-6)
    assert float((again.weights - field.weights).abs().max()) < 1 / 255
    assert float((again.uncertainties - field.uncertainties).abs().max()) <= 0.5 / 255 + 1e-6
    assert all(torch.equal(value, again.tensors()[name]) for name, value in stored.items()), "stored again"


def make_leveled(balls) -> tuple[CodeField, list[CodeField]]:
    """A field of two levels, and the field of each alone."""
    first = make_coded(balls)
    codes, weights = first.codes.flip(0), first.weights.flip(0).index_fill(0, torch.tensor([3]), 0)
    weights[-4] = weights[0]  # the same Gaussian has no language at both levels
    alone = [first, CodeField(balls.codebook, codes, weights, first.uncertainties)]
    both = torch.cat([first.codes, codes], 1), torch.cat([first.weights, weights], 1) / 2
    return CodeField(balls.codebook, *both, first.uncertainties, num_levels=2), alone


def test_levels_are_kept_apart_also_on_disk_and_their_mean_is_the_field(balls) -> None:
    field, alone = make_leveled(balls)
    table = torch.rand(balls.codebook.num_codes, 3, generator=generator())
    mean = sum(level.code_probabilities().double() @ table.double() for level in alone).numpy() / 2
    np.testing.assert_allclose(field.scores(table), mean, atol=1e-6)
    stored = field.tensors()
    assert sum(stored[name].nbytes for name in ("codes", "weights", "uncertainties")) == 17 * len(mean)
    again = field_from_tensors(stored, field.metadata())
    index = torch.tensor([7, 3, 0])
    for kept, steps in ((field, 1e-6), (again, 2.5 / 255)):
        assert len(kept.levels) == 2
        for level, part, known in zip(kept.levels, kept.select(index).levels, alone):
            assert torch.equal(level.codes, known.codes)
            assert torch.equal(part.codes, known.codes[index])
            assert part.levels == level.levels == (), "a level has none"
            torch.testing.assert_close(level.weights, known.weights, rtol=0, atol=steps)
            torch.testing.assert_close(level.weights.sum(1), known.weights.sum(1))
    assert field.facts()["levels"] == 2


def test_a_field_of_one_level_is_stored_as_before(balls) -> None:
    field = make_coded(balls)
    assert field.metadata() == {"kind": "codes", "method": "averaged"}
    assert list(field.facts()) == ["codes", "codes_used", "perplexity", "unseen"]
    assert field.levels == make_trained(balls).levels == ()


@pytest.mark.parametrize("levels", ["3", "0", "two"])
def test_levels_that_do_not_fit_the_codes_are_refused(balls, levels) -> None:
    field, _ = make_leveled(balls)
    with pytest.raises(ValueError, match=levels):
        field_from_tensors(field.tensors(), {**field.metadata(), "levels": levels})


@pytest.mark.parametrize("make", [make_trained, make_coded])
def test_a_field_survives_a_safetensors_file(balls, make, tmp_path) -> None:
    field = make(balls)
    field.method = "renamed"
    save_file(field.tensors(), tmp_path / "language.safetensors", field.metadata())
    with safe_open(tmp_path / "language.safetensors", "pt") as file:
        again = field_from_tensors({name: file.get_tensor(name) for name in file.keys()}, file.metadata())  # noqa: SIM118
    assert type(again) is type(field)
    assert isinstance(again, LanguageField)
    assert again.method == "renamed"
    assert again.codebook.lambda_dino == field.codebook.lambda_dino
    camera = balls.cameras["view0"]
    steps = 1 / 255 if isinstance(field, CodeField) else 0
    for found, wanted in (
        (f.render_code_probabilities(balls.gaussians, camera) for f in (again, field)),
        (f.uncertainties for f in (again, field)),
    ):
        torch.testing.assert_close(found, wanted, rtol=0, atol=steps)


def test_settings_of_a_trained_field_are_stored(balls) -> None:
    field = make_trained(balls, normalize_rendering=True, num_frequencies=2)
    again = TrainedField.from_tensors(field.tensors(), field.metadata())
    assert again.normalize_rendering
    assert again.smoother.num_frequencies == 2


def test_bad_input_is_refused(balls) -> None:
    book = make_codebook(3)
    with pytest.raises(ValueError, match="code 3 is not in a codebook of 3"):
        CodeField(book, torch.tensor([[3]], dtype=torch.uint8), torch.ones(1, 1), torch.zeros(1))
    with pytest.raises(ValueError, match="uint8"):
        CodeField(book, torch.tensor([[1]]), torch.ones(1, 1), torch.zeros(1))
    with pytest.raises(ValueError, match="neither semantics"):
        field_from_tensors({})
    tensors = make_trained(balls).tensors()
    del tensors["decoder.0.weight"]
    with pytest.raises(ValueError, match="does not fit"):
        field_from_tensors(tensors)
