"""Claims about what averaging tells: the time beforehand, and features that do not agree."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from support.language_scene import make_scene
from torch.nn.functional import normalize

from lexsplat.codebook import CodebookConfig
from lexsplat.features import FeatureMap
from lexsplat.language.methods import METHODS, averaged
from lexsplat.language.methods.averaged import features_of_codes
from lexsplat.language.methods.method import FitRun, TrainingViews
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.progress import NOTE

pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_time_is_that_of_a_few_views_and_gaussians_and_they_leave_no_trace(monkeypatch, caplog) -> None:
    """The clock counts views and Gaussians; whatever runs first loads kernels."""
    balls = make_scene()
    clock, seen, count = [0.0], set(), len(balls.gaussians)

    def timed(name, seconds):
        work = getattr(averaged, name)

        def slow(*inputs, **options):
            clock[0] += seconds(*inputs) + (0.0 if name in seen else 1000.0)
            seen.add(name)
            return work(*inputs, **options)

        monkeypatch.setattr(averaged, name, slow)

    views = TrainingViews(
        {
            name: SimpleNamespace(camera=camera, load_valid=lambda size: None)
            for name, camera in balls.cameras.items()
        },
        features=features_of_codes(balls.code_maps, balls.codebook),
    )
    config = BuildConfig(codebook=CodebookConfig(num_codes=5, use_dino=False))
    silent = METHODS["averaged"].fit(balls.gaussians, views, config, FitRun())
    timed("average_features", lambda gaussians, cameras, *_: 5.0 * len(cameras))
    timed("field_from_means", lambda found, *_: 0.03 * len(found.means))
    timed("make_segments", lambda gaussians, *_: 0.01 * len(gaussians))
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    monkeypatch.setattr(averaged, "_TOLD_FROM", 1)
    monkeypatch.setattr(averaged, "_SAMPLE", 50)
    with caplog.at_level(NOTE, "lexsplat"):
        told = METHODS["averaged"].fit(balls.gaussians, views, config, FitRun())
    seconds = round(5.0 * len(views.views) + 0.04 * count)
    length = f"{seconds // 60}:{seconds % 60:02} min"
    assert caplog.messages == [
        f"language: about {length} for {len(views.views)} views and {count:,} Gaussians"
    ]
    for name, tensor in silent.tensors().items():
        assert torch.equal(tensor, told.tensors()[name]), name


@pytest.mark.parametrize(("spoiled", "told"), [("nothing", 0), ("sides", 1), ("all", 1)])
def test_features_that_disagree_about_the_scene_are_doubted(spoiled, told, caplog) -> None:
    balls = make_scene()
    maps = features_of_codes(balls.code_maps, balls.codebook)
    if spoiled == "sides":
        maps = {name: FeatureMap(maps[name].clip.flip(0, 1)) for name in balls.cameras}
    elif spoiled == "all":
        noise = torch.Generator().manual_seed(0)
        maps = {
            name: FeatureMap(normalize(torch.randn(camera.height, camera.width, 7, generator=noise), dim=-1))
            for name, camera in balls.cameras.items()
        }
    views = {
        name: SimpleNamespace(camera=camera, load_valid=lambda size: None)
        for name, camera in balls.cameras.items()
    }
    config = BuildConfig(codebook=CodebookConfig(num_codes=5, use_dino=False))
    METHODS["averaged"].fit(balls.gaussians, TrainingViews(views, features=maps), config, FitRun())
    assert sum("disagree about the language" in message for message in caplog.messages) == told
