"""Claims about averaged features of several levels of 2D segments: each level answers what it is for."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.language_scene import IGNORED, LanguageScene, make_scene
from torch.nn.functional import normalize

from lexsplat.codebook import CodebookConfig
from lexsplat.features import FeatureMap
from lexsplat.features.segments2d import pool
from lexsplat.language.fields import CodeField
from lexsplat.language.methods import METHODS
from lexsplat.language.methods.method import FitRun, TrainingViews
from lexsplat.pipeline.config import BuildConfig
from lexsplat.queries.relevancy import QueryConfig, Question, gaussian_relevancy
from lexsplat.queries.scoring import scores_in_form

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def balls() -> LanguageScene:
    return make_scene()


@pytest.fixture(scope="module")
def parts_and_things(balls) -> tuple[CodeField, CodeField]:
    """Balls 0 and 1 are parts of one thing: exact masks of parts and of things, kept apart and as one level."""
    rng = torch.Generator().manual_seed(0)
    maps, means = {}, {}
    for name, labels in balls.code_maps.items():
        parts = torch.from_numpy(np.where(labels == IGNORED, -1, labels.astype(int)))
        things = torch.where(parts == 1, 0, parts)
        features = torch.eye(6)[parts] + 0.3 * torch.randn(*parts.shape, 6, generator=rng)
        features = normalize(features, dim=-1) * (parts >= 0)[..., None]
        levels = torch.stack([parts, things])
        means[name] = FeatureMap(pool(features, levels))
        maps[name] = FeatureMap(
            means[name].clip, levels=tuple(FeatureMap(pool(features, level)) for level in levels.split(1))
        )
    views = {
        name: SimpleNamespace(camera=camera, load_valid=lambda size: None)
        for name, camera in balls.cameras.items()
    }
    config = BuildConfig(codebook=CodebookConfig(num_codes=20, use_dino=False))
    kept, mixed = (
        METHODS["averaged"].fit(balls.gaussians, TrainingViews(views, features=each), config, FitRun())
        for each in (maps, means)
    )
    return kept, mixed


@pytest.mark.parametrize("form", ["code", "segment"])
def test_a_part_is_answered_from_the_level_of_parts_and_a_thing_from_that_of_things(
    balls, parts_and_things, form
) -> None:
    kept, mixed = parts_and_things
    thing = normalize(torch.eye(6)[0] + torch.eye(6)[1], dim=0)
    query = QueryConfig(form=form, temperature=2.0)
    question = Question(torch.stack([torch.eye(6)[0], thing]), torch.eye(6)[5:], query)
    inside = torch.from_numpy(np.stack([balls.labels == 0, balls.labels <= 1]))
    own = gaussian_relevancy(kept, question)
    for prompt, level in enumerate(kept.levels):
        torch.testing.assert_close(own[prompt], gaussian_relevancy(level, question)[prompt])
    scores = scores_in_form(kept, query, own, ["yes", "yes"])
    for row, mask in zip(scores, inside):
        limit = 0.5 if form == "segment" else 0.75
        assert ((row >= limit) == mask).float().mean() > 0.95
    # One mean of both levels resembles neither the part nor the thing as much.
    worse = gaussian_relevancy(mixed, question)
    for row, other, mask in zip(own, worse, inside):
        assert float(row[mask].median()) > float(other[mask].median())


def test_levels_do_not_mix_where_part_and_thing_differ(balls, parts_and_things) -> None:
    kept, mixed = parts_and_things

    def of_the_other(field: CodeField) -> float:
        """Median cosine of the first ball's Gaussians with the second ball."""
        features = field.code_probabilities()[torch.from_numpy(balls.labels == 0)] @ field.codebook.clip
        return float(normalize(features, dim=-1)[:, 1].median())

    parts, things = kept.levels
    assert of_the_other(parts) < 0.1
    assert of_the_other(things) > 0.3
    assert 0.15 < of_the_other(mixed) < 0.3, "one mean lies between them"
