"""A scene with known query results for tests of the viewer: colored balls, "ball 0" to "ball 4", one code each."""

import colorsys

import numpy as np
import torch

from lexsplat.codebook import Codebook
from lexsplat.language.fields import CodeField
from lexsplat.queries.relevancy import CANONICAL_PHRASES
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.views import StoredView
from support.language_scene import LanguageScene, make_scene

WORDS = [f"ball {number}" for number in range(5)]


class BallScene(Scene):
    """Text embeddings without a model: "ball k" is axis k, canonical phrases are axis 31, other text lies between."""

    def encode_text(self, texts: list[str]) -> torch.Tensor:
        rows = torch.zeros(len(texts), 32)
        for row, text in zip(rows, texts):
            if text in WORDS:
                row[WORDS.index(text)] = 1
            else:
                row[31 if text in CANONICAL_PHRASES else 5 + sum(text.encode()) % 26] = 1
        return rows

    def preload(self) -> "BallScene":
        return self


def ball_scene(per_ball: int = 300) -> tuple[BallScene, LanguageScene]:
    """The scene and its ground truth."""
    ground_truth = make_scene(per_ball=per_ball, views=6, width=96, height=72)
    gaussians = ground_truth.gaussians
    colors = np.array([colorsys.hsv_to_rgb(k / 5, 0.5, 0.75) for k in range(5)])[ground_truth.labels]
    gaussians.sh0 = ((torch.from_numpy(colors).float() - 0.5) / 0.28209479177387814)[:, None]
    words = 0.8 * torch.eye(5, 32)
    words[:, 31] = 0.6
    codebook = Codebook(words, torch.eye(5, 8))
    count = len(ground_truth.labels)
    field = CodeField(
        codebook,
        torch.from_numpy(ground_truth.labels.astype(np.uint8))[:, None],
        torch.ones(count, 1),
        torch.linspace(0, 0.5, count),
    )
    views = {
        name: StoredView(name, camera, "test" if number % 3 == 2 else "train")
        for number, (name, camera) in enumerate(ground_truth.cameras.items())
    }
    return BallScene(gaussians, field, views, "none"), ground_truth
