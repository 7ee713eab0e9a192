"""Time estimate of a codebook and its index maps, measured on a few views and steps beforehand."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import torch

from lexsplat.codebook.fitting import check_sample, refine, sample_features, spherical_kmeans
from lexsplat.codebook.settings import CodebookConfig
from lexsplat.codebook.space import Codebook
from lexsplat.runtime import memory as budget
from lexsplat.runtime.device import one_thread
from lexsplat.runtime.errors import TrainingError
from lexsplat.runtime.progress import Listener, silent, tell, uncounted
from lexsplat.runtime.sampling import evenly

if TYPE_CHECKING:
    from lexsplat.features import FeatureMap

_VIEWS = 3
"""Views that are sampled, and as many others that get index maps."""
_STEPS = 4
"""Gradient steps, at most."""

T = TypeVar("T")


def tell_codebook(
    feature_maps: Mapping[str, FeatureMap],
    names: Sequence[str],
    config: CodebookConfig,
    *,
    memory: int = budget.DEFAULT_MEMORY,
    listener: Listener = silent,
) -> None:
    """Log the estimated time of the codebook (`forecast`); the listener receives events of stage "calibrate".

    Raises:
        MemoryBudgetError: If the sample does not fit into ``memory``, as in the fit.
    """
    check_sample(feature_maps[names[0]], len(names), config, memory)
    with contextlib.suppress(ValueError, TrainingError):  # features that the fit refuses
        with uncounted(listener, "calibrate", f"{len(names)} views"):
            seconds = forecast(feature_maps, names, config)
        tell("codebook", seconds, f"{len(names):,} views")


@one_thread()
def forecast(feature_maps: Mapping[str, FeatureMap], names: Sequence[str], config: CodebookConfig) -> float:
    """Seconds that `fit_codebook` and `assign_code_maps` will take for the named views.

    Args:
        feature_maps: Dense features by view name.
        names: Training views, at least one.
        config: Settings.
    """
    generator = torch.Generator().manual_seed(0)
    chosen = evenly(names, 2 * _VIEWS)
    sampled, assigned = chosen[::2], chosen[1::2] or chosen
    quota = -(-config.sample_size // len(names))
    few = replace(config, sample_size=quota * len(sampled), steps=min(_STEPS, config.steps))
    (clip, dino), reading = _timed(lambda: sample_features(feature_maps, sampled, few, generator=generator))
    size = len(clip) * len(names) / len(sampled)
    # A step takes a whole batch, which may be more than the few views give.
    rows = torch.arange(max(1, min(config.batch_size, int(size)))) % len(clip)
    clip, dino = clip[rows], None if dino is None else dino[rows]
    if config.init == "kmeans":
        (code_clip, code_dino), clusters = _timed(
            lambda: spherical_kmeans(
                clip,
                dino,
                config.num_codes,
                config.lambda_dino,
                iterations=config.kmeans_iterations,
                generator=generator,
            )
        )
    else:
        some = torch.arange(config.num_codes) % len(clip)
        code_clip, code_dino, clusters = clip[some], None if dino is None else dino[some], 0.0
    _, steps = _timed(lambda: refine(clip, dino, code_clip, code_dino, few, generator))
    codebook = Codebook(code_clip, code_dino, config.lambda_dino)
    _, maps = _timed(lambda: [codebook.assign(feature_maps[name]) for name in assigned])
    return (
        reading / len(sampled) * len(names)
        + clusters / len(rows) * size
        + steps / max(1, few.steps) * config.steps
        + maps / len(assigned) * len(names)
    )


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    """A result, and the seconds that it took."""
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start
