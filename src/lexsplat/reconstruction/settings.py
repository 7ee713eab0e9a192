"""Settings of the reconstruction.

Learning rates, schedules and density control are those of 3DGS. Every step number refers to a training of 30,000
iterations and is scaled to the actual number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch

REFERENCE_ITERATIONS = 30_000
"""Number of iterations to which all step numbers of 3DGS refer."""

LONG_TRAINING = 15_000
"""Trainings of this length reset opacities and run entirely at full resolution, unless a setting overrides it."""


COOLEST = 0.05
"""Factor of all learning rates at the end of the cool-down."""

COOLED_RATES = 1.6
"""Factor of the learning rates, but that of the opacities, of a "default" training that has a cool-down."""


@dataclass(frozen=True)
class DensitySchedule:
    """Steps at which density control acts.

    Args:
        start: Step after which Gaussians are added.
        stop: Step at which the number of Gaussians becomes final.
        every: Steps between two rounds.
        reset_every: Steps between two opacity resets ("default" only).
    """

    start: int
    stop: int
    every: int
    reset_every: int


@dataclass(frozen=True)
class ReconstructionConfig:
    """Settings of the reconstruction; numbers of steps refer to a training of 30,000.

    Args:
        iterations: Optimization steps, one view each; the command line sets it with ``--iterations``.
        ssim_weight: Weight of 1 - SSIM against L1, in 0..1.
        sh_degree: Highest degree of spherical harmonics, 0..3 (4 where the backend can).
        sh_degree_every: Steps after which the next degree is added.
        strategy: Density control: "default" (3DGS) or "mcmc".
        max_gaussians: Upper limit of the number of Gaussians; None is 3,000,000 on CUDA and 40,000 on a CPU.
        densify_every: Steps between two rounds of density control.
        densify_min_every: Lower limit of the actual steps between two rounds of "default", so that enough views
            contribute to each decision.
        grow_gradient: Mean gradient of projected centers, in halves of the image, above which "default" adds
            Gaussians.
        renewal: Most Gaussians that a round of "default" replaces at the upper limit, as a share of all: those of the
            least blending weight over the training views go where others ask for more room, from a fifth of the
            iterations on. None is 0.15 in trainings shorter than 15,000, else 0.
        min_opacity: Gaussians below this opacity are removed ("default") or moved ("mcmc").
        reset_opacities: Whether "default" lowers all opacities every 3,000 steps to twice ``min_opacity``, and after
            the first reset removes Gaussians larger than a tenth of the scene; None enables it from 15,000
            iterations on, where the training has time to recover.
        noise: Strength of the noise of "mcmc", times the learning rate of the means.
        opacity_weight: Weight of the mean opacity in the loss; None is 0.01 with "mcmc", and for at most 25 training
            photos in trainings shorter than 15,000, else 0.
        scale_weight: Weight of the mean standard deviation (relative to the scene) in the loss; None as above.
        antialiased: Train and render with the mip filter; --reconstruction.no-antialiased leaves it out.
        initial_opacity: Opacity of the initial Gaussians.
        warm_up: Share of the iterations, at the start, that run at half resolution; None is 0.3 in trainings
            shorter than 15,000, else 0.
        cool_down: Share of the iterations, at the end, over which all learning rates fall linearly to a twentieth, so
            that the last views do not count for more than the others; None is 0.25 in trainings shorter than 15,000,
            else 0.
        exposure: Fit an affine color change per training photo, for captures whose exposure varies; None does so for
            at most 25 training photos in trainings shorter than 15,000.
        rate_scale: Factor of all learning rates but that of the opacities; None is the cube root of
            30,000 / iterations, between 1 and 3, so that a short training takes larger steps, and 1.6 times that
            where "default" has a cool-down to settle them.
        means_rate: Learning rate of the centers at the start, relative to the extent of the scene.
        means_rate_final: The same at the end; it decays exponentially.
        scales_rate: Learning rate of the logarithms of the scales.
        quats_rate: Learning rate of the rotations.
        opacities_rate: Learning rate of the opacity logits.
        sh0_rate: Learning rate of the constant color.
        shN_rate: Learning rate of the other color coefficients.
        exposure_rate: Learning rate of the color change.
    """

    iterations: int = 30_000
    ssim_weight: float = 0.2
    sh_degree: int = 3
    sh_degree_every: int = 1_000
    strategy: Literal["default", "mcmc"] = "default"
    max_gaussians: int | None = None
    densify_every: int = 100
    densify_min_every: int = 100
    grow_gradient: float = 2e-4
    renewal: float | None = None
    min_opacity: float = 0.005
    reset_opacities: bool | None = None
    noise: float = 5e5
    opacity_weight: float | None = None
    scale_weight: float | None = None
    antialiased: bool = True
    initial_opacity: float = 0.1
    warm_up: float | None = None
    cool_down: float | None = None
    exposure: bool | None = None
    rate_scale: float | None = None
    means_rate: float = 1.6e-4
    means_rate_final: float = 1.6e-6
    scales_rate: float = 5e-3
    quats_rate: float = 1e-3
    opacities_rate: float = 5e-2
    sh0_rate: float = 2.5e-3
    shN_rate: float = 1.25e-4
    exposure_rate: float = 1e-3

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"iterations must be positive, got {self.iterations}")
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise ValueError(f"max_gaussians must be positive, got {self.max_gaussians}")
        if self.strategy not in ("default", "mcmc"):
            raise ValueError(f'strategy must be "default" or "mcmc", got {self.strategy!r}')
        if not 0 <= self.ssim_weight <= 1:
            raise ValueError(f"ssim_weight must be in 0..1, got {self.ssim_weight:g}")
        if not 0 <= self.sh_degree <= 4:
            raise ValueError(f"sh_degree must be in 0..4, got {self.sh_degree}")
        if self.warm_up is not None and not 0 <= self.warm_up <= 1:
            raise ValueError(f"warm_up must be in 0..1, got {self.warm_up:g}")
        if self.cool_down is not None and not 0 <= self.cool_down <= 1:
            raise ValueError(f"cool_down must be in 0..1, got {self.cool_down:g}")
        if self.renewal is not None and not 0 <= self.renewal < 1:
            raise ValueError(f"renewal must be in [0, 1), got {self.renewal:g}")
        if not 0 < self.initial_opacity < 1:
            raise ValueError(f"initial_opacity must be between 0 and 1, got {self.initial_opacity:g}")

    def cap(self, device: torch.device) -> int:
        """`max_gaussians`, with the default of the device."""
        if self.max_gaussians is not None:
            return self.max_gaussians
        return 3_000_000 if device.type == "cuda" else 40_000

    @property
    def is_long(self) -> bool:
        """Whether the defaults reset opacities and skip the warm-up."""
        return self.iterations >= LONG_TRAINING

    @property
    def resets_opacities(self) -> bool:
        """Whether "default" resets opacities."""
        return self.is_long if self.reset_opacities is None else self.reset_opacities

    @property
    def density_schedule(self) -> DensitySchedule:
        """The schedule of 3DGS (or of MCMC) for 30,000 iterations, scaled to ``iterations``."""
        scale = self.iterations / REFERENCE_ITERATIONS
        # "mcmc" adds a twentieth per round at random and would never reach its cap in few rounds. Rounds after every
        # step would leave no step in which the moved Gaussians regain opacity.
        least, stop = (self.densify_min_every, 15_000) if self.strategy == "default" else (2, 25_000)
        return DensitySchedule(
            start=round(500 * scale),
            stop=round(stop * scale),
            every=max(1, least, round(self.densify_every * scale)),
            reset_every=max(1, round(3_000 * scale)),
        )

    @property
    def warm_up_iterations(self) -> int:
        """Number of iterations at half resolution."""
        share = (0.0 if self.is_long else 0.3) if self.warm_up is None else self.warm_up
        return round(share * self.iterations)

    def cooling(self, step: int) -> float:
        """Factor of all learning rates after ``step`` finished steps: 1, and below it in the cool-down."""
        if self.cooled_share == 0:
            return 1.0
        return min(1.0, max(COOLEST, (self.iterations - step) / (self.cooled_share * self.iterations)))

    @property
    def cooled_share(self) -> float:
        """`cool_down`, with its default."""
        return (0.0 if self.is_long else 0.25) if self.cool_down is None else self.cool_down

    @property
    def renewed_share(self) -> float:
        """`renewal`, with its default."""
        if self.strategy != "default":
            return 0.0
        return (0.0 if self.is_long else 0.15) if self.renewal is None else self.renewal

    def for_photos(self, few: bool) -> ReconstructionConfig:
        """The same settings with what depends on the number of training photos filled in.

        Few photos leave much open: lower opacities and scales, and a color change per photo, gain on new views
        (docs/captures.md).
        """
        helps = few and not self.is_long
        weight = 0.01 if helps or self.strategy == "mcmc" else 0.0
        return replace(
            self,
            opacity_weight=weight if self.opacity_weight is None else self.opacity_weight,
            scale_weight=weight if self.scale_weight is None else self.scale_weight,
            exposure=helps if self.exposure is None else self.exposure,
        )

    @property
    def scale_of_rates(self) -> float:
        """`rate_scale`, with its default."""
        if self.rate_scale is not None:
            return self.rate_scale
        scale = min(3.0, max(1.0, (REFERENCE_ITERATIONS / self.iterations) ** (1 / 3)))
        return COOLED_RATES * scale if self.cooled_share and self.strategy == "default" else scale

    def rates(self, extent: float) -> dict[str, float]:
        """Initial learning rates by parameter (our names)."""
        scale = self.scale_of_rates
        return {
            "means": scale * self.means_rate * extent,
            "quats": scale * self.quats_rate,
            "log_scales": scale * self.scales_rate,
            "opacity_logits": self.opacities_rate,
            "sh0": scale * self.sh0_rate,
            "shN": scale * self.shN_rate,
        }
