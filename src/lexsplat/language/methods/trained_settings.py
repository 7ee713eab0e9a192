"""Settings of method "trained", with those of the paper and of the authors' code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lexsplat.language.losses import SmoothingWeight, UncertaintyForm
from lexsplat.runtime.defaults import where_not_given

MLPPrecision = Literal["float32", "bfloat16"]


@dataclass(frozen=True)
class TrainedConfig:
    """Settings of method "trained". The defaults suit a CPU; see also `as_in_paper`.

    Args:
        iterations: Steps, one view each (paper: 30,000).
        pixel_sample: Random pixels of a step that enter the cross-entropy; 0 takes the full map (paper).
        render_downscale: Views are rendered this many times smaller than their cameras.
        semantics_lr: Learning rate of s_G (paper: 0.001).
        uncertainty_lr: Learning rate of the logits of u (paper: 0.001; authors' code: 0.05).
        decoder_lr: Learning rate of D_MLP (paper: 0.001).
        smoothing_lr: Learning rate of the smoothing MLP (paper: 0.001).
        decoder_weight_decay: Weight decay of D_MLP (paper: 0; authors' code: 1e-5).
        final_lr_factor: Learning rates decay exponentially to this share (paper: 1, constant).
        lambda_ce: Weight of the cross-entropy in Eq. 12.
        lambda_u: Weight of the uncertainty loss in Eq. 12.
        lambda_s: Weight of the semantic loss in Eq. 15.
        lambda_smo: Weight of the smoothing loss in Eq. 15.
        min_smoothing_weight: w_s in Eq. 14.
        use_uncertainty: Off is the paper's ablation "w/o u_G": Eq. 9 in place of Eq. 10 to 12.
        use_smoothing: Off is the paper's ablation "w/o MLP".
        uncertainty_form: "linear" is Eq. 11, "log" the form of the authors' code.
        smoothing_weight: "max" is Eq. 14, "linear" the form of the authors' code.
        smoothing_squared: Squared norms in Eq. 14, as in the authors' code.
        smoothing_every: Steps between two smoothing steps (paper: 1; authors' code: 10).
        smoothing_sample: Random Gaussians of a step that enter Eq. 14; 0 takes all (paper).
        num_frequencies: Frequencies of the positional encoding in Eq. 13 (paper's table: 0).
        normalize_rendering: Scale the rendered s to unit length before decoding (authors' code).
        clip_decoder_grad: Largest norm of the gradient of D_MLP; None does not clip (paper).
        mlp_precision: Numbers that both MLPs multiply in training, but for their first layers. "bfloat16" halves the
            time of full maps on processors and GPUs that multiply it; weights, sums and losses stay in float32.
    """

    iterations: int = 1000
    pixel_sample: int = 2048
    render_downscale: float = 1.0
    semantics_lr: float = 0.05
    uncertainty_lr: float = 0.02
    decoder_lr: float = 2e-3
    smoothing_lr: float = 1e-3
    decoder_weight_decay: float = 0.0
    final_lr_factor: float = 0.1
    lambda_ce: float = 1.0
    lambda_u: float = 1.0
    lambda_s: float = 1.0
    lambda_smo: float = 1.0
    min_smoothing_weight: float = 0.1
    use_uncertainty: bool = True
    use_smoothing: bool = True
    uncertainty_form: UncertaintyForm = "linear"
    smoothing_weight: SmoothingWeight = "max"
    smoothing_squared: bool = False
    smoothing_every: int = 1
    smoothing_sample: int = 2048
    num_frequencies: int = 0
    normalize_rendering: bool = False
    clip_decoder_grad: float | None = 1.0
    mlp_precision: MLPPrecision = "float32"

    def __post_init__(self) -> None:
        if min(self.iterations, self.pixel_sample, self.smoothing_sample) < 0 or self.smoothing_every < 1:
            raise ValueError("iterations and samples must not be negative, smoothing_every must be positive")
        if not self.render_downscale > 0 or not self.final_lr_factor > 0:
            raise ValueError("render_downscale and final_lr_factor must be positive")

    def as_in_paper(self) -> TrainedConfig:
        """30,000 iterations over full maps with a constant learning rate of 0.001.

        Settings that differ from their defaults are kept.
        """
        return where_not_given(
            self,
            iterations=30_000,
            pixel_sample=0,
            render_downscale=1.0,
            semantics_lr=1e-3,
            uncertainty_lr=1e-3,
            decoder_lr=1e-3,
            smoothing_lr=1e-3,
            decoder_weight_decay=0.0,
            final_lr_factor=1.0,
            smoothing_every=1,
            smoothing_sample=0,
            clip_decoder_grad=None,
        )
