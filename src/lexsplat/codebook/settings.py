"""Settings of the quantization."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lexsplat.runtime.defaults import where_not_given

MAX_CODES = 256
"""Most codes of a codebook: an index map has one byte a pixel."""

PAPER_CODES = 128
"""Number of codes in the paper, except for two of its scenes."""


@dataclass(frozen=True)
class CodebookConfig:
    """Settings of the quantization.

    Args:
        num_codes: Size K of the discrete feature space, 1 to 256; `as_in_paper` takes 128. With 256, no index is left
            for a pixel without a meaning.
        lambda_dino: Weight of the DINO cosine in Eq. 4 and 5.
        lambda_cos: Weight of the cosine loss in Eq. 7.
        lambda_lb: Weight of the load-balancing loss in Eq. 7 (1 in the authors' code).
        use_dino: Off is the paper's ablation "w/o DINO".
        load_balancing: Off is the paper's ablation "w/o L_lb".
        temperature: Temperature of the softmax in supplement A; 1 in the paper.
        init: Start of the fit: "kmeans" is spherical k-means, "uniform" uniform(-1/K, 1/K) as in the authors' code.
        kmeans_iterations: Lloyd iterations of k-means.
        steps: Gradient steps on Eq. 7 after the start.
        learning_rate: Learning rate of AdamW in these steps.
        weight_decay: Weight decay of AdamW in these steps.
        batch_size: Feature vectors of a gradient step.
        sample_size: Most feature vectors in the sample, equally many from each training view.
    """

    num_codes: int = 255
    lambda_dino: float = 0.5
    lambda_cos: float = 1.0
    lambda_lb: float = 0.5
    use_dino: bool = True
    load_balancing: bool = True
    temperature: float = 1.0
    init: Literal["kmeans", "uniform"] = "kmeans"
    kmeans_iterations: int = 20
    steps: int = 100
    learning_rate: float = 1e-3
    weight_decay: float = 0.0
    batch_size: int = 4096
    sample_size: int = 50_000

    def __post_init__(self) -> None:
        if not 1 <= self.num_codes <= MAX_CODES:
            raise ValueError(
                f"num_codes must be 1 to {MAX_CODES} because an index map holds one byte a pixel, "
                f"got {self.num_codes}"
            )
        if self.init not in ("kmeans", "uniform"):
            raise ValueError(f'init must be "kmeans" or "uniform", got {self.init!r}')
        if self.temperature <= 0:
            raise ValueError(f"temperature must be positive, got {self.temperature:g}")
        if self.sample_size < 1 or self.batch_size < 1 or self.steps < 0 or self.kmeans_iterations < 0:
            raise ValueError(
                "sample_size and batch_size must be positive, steps and kmeans_iterations not negative"
            )

    def as_in_paper(self) -> CodebookConfig:
        """The paper's 128 codes, fitted as the authors' code fits them: gradient steps on Eq. 7 from a random start.

        The paper states the loss and the number of codes only. Settings that differ from their defaults are kept.
        """
        return where_not_given(
            self,
            num_codes=PAPER_CODES,
            init="uniform",
            steps=2000,
            learning_rate=1e-4,
            weight_decay=0.01,
            batch_size=16_384,
        )
