"""Adaptive density control: which Gaussians are added, moved and removed during reconstruction.

The rules are gsplat's strategies: "default" (3DGS: clone, split, prune, reset of opacities) and "mcmc" (3D Gaussian
Splatting as Markov Chain Monte Carlo). This module adds what they lack: a cap for "default", torch arithmetic where
gsplat has only CUDA kernels, a working opacity reset (that of gsplat 1.5.3 never runs, because
``step % n == 0 & step > 0`` is a chained comparison with ``0 & step``), a random generator of their own, and a state
that can be saved.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal

import torch
from torch import Tensor

from lexsplat.geometry.rotations import covariances

REFERENCE_ITERATIONS = 30_000
"""Number of iterations to which all step numbers of 3DGS refer."""
NEVER = 1 << 62
"""A step that no training reaches."""
MAX_COPIES = 51
"""Upper limit of the copies of one Gaussian; larger numbers are clamped to it, as in gsplat."""

_operators_lock = threading.Lock()


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


def density_schedule(
    strategy: Literal["default", "mcmc"], iterations: int, *, every: int = 100, minimum_every: int = 1
) -> DensitySchedule:
    """The schedule of 3DGS (or of MCMC) for 30,000 iterations, scaled to ``iterations``.

    Args:
        strategy: "default" or "mcmc".
        iterations: Number of iterations of the training.
        every: Steps between two rounds in a training of 30,000.
        minimum_every: Lower limit of the actual steps between two rounds of "default", so that enough views
            contribute to each decision. For "mcmc" it is 2: "mcmc" adds a twentieth per round at random and would
            never reach its cap in few rounds, and rounds after every step leave no step in which the moved
            Gaussians regain opacity.
    """
    scale = iterations / REFERENCE_ITERATIONS
    closest = minimum_every if strategy == "default" else 2
    return DensitySchedule(
        start=round(500 * scale),
        stop=round((15_000 if strategy == "default" else 25_000) * scale),
        every=max(1, closest, round(every * scale)),
        reset_every=max(1, round(3_000 * scale)),
    )


@dataclass(frozen=True)
class DensityConfig:
    """Rules of density control.

    Args:
        strategy: "default" or "mcmc".
        schedule: Steps at which it acts.
        extent: Radius of the scene in world units; sizes are relative to it.
        max_gaussians: Upper limit of the number of Gaussians.
        grow_gradient: Mean gradient of the projected centers, in halves of the image, above which "default" adds
            Gaussians.
        min_opacity: Gaussians below this opacity are removed ("default") or moved ("mcmc").
        reset_opacities: Whether "default" regularly lowers the opacities to twice ``min_opacity``, and after the
            first reset removes Gaussians larger than a tenth of the scene.
        noise: Strength of the noise of "mcmc", times the learning rate of the means.

    Raises:
        ValueError: If the strategy is unknown or the cap is not positive.
    """

    strategy: Literal["default", "mcmc"]
    schedule: DensitySchedule
    extent: float
    max_gaussians: int
    grow_gradient: float = 2e-4
    min_opacity: float = 0.005
    reset_opacities: bool = True
    noise: float = 5e5

    def __post_init__(self) -> None:
        if self.max_gaussians < 1:
            raise ValueError(f"max_gaussians must be positive, got {self.max_gaussians}")
        if self.strategy not in ("default", "mcmc"):
            raise ValueError(f'strategy must be "default" or "mcmc", got {self.strategy!r}')


class DensityControl:
    """One of gsplat's strategies on any device, with a cap, a random generator of its own, and a state.

    Parameters have gsplat's names: means, quats, scales (logarithms), opacities (logits), and any other.

    Args:
        config: The rules.
        seed: Seed of the random generator.
        device: Device of the parameters.
    """

    def __init__(self, config: DensityConfig, *, seed: int = 0, device: torch.device | str = "cpu") -> None:
        from gsplat.strategy import DefaultStrategy, MCMCStrategy  # imported here: it takes seconds

        self.config = config
        self._device = torch.device(device)
        self._random_state = _initial_random_state(self._device, seed)
        schedule = config.schedule
        steps: dict[str, Any] = {
            "refine_start_iter": schedule.start,
            "refine_stop_iter": schedule.stop,
            "refine_every": schedule.every,
        }
        self._default = self._mcmc = None
        if config.strategy == "default":
            self._default = DefaultStrategy(
                prune_opa=config.min_opacity,
                grow_grad2d=config.grow_gradient,
                # After the first reset gsplat also removes Gaussians larger than a tenth of the scene. Without
                # resets this would only punch holes into a background covered by few Gaussians.
                reset_every=schedule.reset_every if config.reset_opacities else NEVER,
                **steps,
            )
            self._state = self._default.initialize_state(scene_scale=config.extent)
        else:
            self._mcmc = MCMCStrategy(
                cap_max=config.max_gaussians, noise_lr=config.noise, min_opacity=config.min_opacity, **steps
            )
            self._state = self._mcmc.initialize_state()

    def step(
        self,
        parameters: dict[str, torch.nn.Parameter],
        optimizers: dict[str, torch.optim.Optimizer],
        step: int,
        *,
        means2d: Tensor,
        radii: Tensor,
        image_size: tuple[int, int],
        means_learning_rate: float,
    ) -> bool:
        """Add, move and remove Gaussians after the optimizers' step; replaces entries of ``parameters``.

        Args:
            parameters: The parameters by gsplat's names.
            optimizers: One optimizer per parameter, each with one group.
            step: Number of steps before this one.
            means2d: Projected centers ``[N, 2]`` in pixels with their ``grad``.
            radii: Size on screen ``[N]`` in pixels; 0 where not drawn.
            image_size: Width and height of the rendered image.
            means_learning_rate: Present learning rate of the means; scales the noise of "mcmc".

        Returns:
            Whether the set of Gaussians changed.
        """
        with self._own_randomness(), _operators_for(self._device):
            if self._mcmc is not None:
                # gsplat moves faint Gaussians to others and fails if there are none: such a round is left out.
                opacities = parameters["opacities"].sigmoid()
                changes = self.refines_at(step) and bool((opacities > self.config.min_opacity).any())
                self._mcmc.step_post_backward(
                    parameters, optimizers, self._state, step if changes else 0, {}, lr=means_learning_rate
                )
                return changes
            return self._default_step(parameters, optimizers, step, means2d, radii, image_size)

    def _default_step(
        self,
        parameters: dict[str, torch.nn.Parameter],
        optimizers: dict[str, torch.optim.Optimizer],
        step: int,
        means2d: Tensor,
        radii: Tensor,
        image_size: tuple[int, int],
    ) -> bool:
        from gsplat.strategy import ops

        if step >= self.config.schedule.stop or self._default is None:
            return False
        self._accumulate(means2d, radii, image_size)
        changed = self.refines_at(step)
        if changed:
            # gsplat accumulates and refines in one call; shown no visible Gaussian, it only refines.
            self._default.grow_grad2d = self._threshold_within_cap(len(parameters["means"]))
            info = _nothing_visible(len(means2d), self._device)
            self._default.step_post_backward(parameters, optimizers, self._state, step, info)
        if self.config.reset_opacities and step > 0 and step % self.config.schedule.reset_every == 0:
            ops.reset_opa(parameters, optimizers, self._state, value=2.0 * self._default.prune_opa)
        return changed

    def _accumulate(self, means2d: Tensor, radii: Tensor, image_size: tuple[int, int]) -> None:
        """Accumulate gradients and visibility as gsplat does, but without index gathers: four passes over ``[N]``."""
        if means2d.grad is None:
            raise ValueError("means2d must have a gradient: run density control after the backward pass")
        if self._state["grad2d"] is None:
            self._state["grad2d"] = torch.zeros(len(radii), device=self._device)
            self._state["count"] = torch.zeros(len(radii), device=self._device)
        visible = radii > 0
        x, y = (means2d.grad[:, axis] * (image_size[axis] / 2) for axis in (0, 1))
        self._state["grad2d"] += (x * x + y * y).sqrt_() * visible
        self._state["count"] += visible

    def refines_at(self, step: int) -> bool:
        """Whether `step` changes the set of Gaussians after ``step`` finished steps."""
        schedule = self.config.schedule
        return schedule.start < step < schedule.stop and step % schedule.every == 0

    def _threshold_within_cap(self, count: int) -> float:
        """The lowest threshold, not below the configured one, that keeps the number within the cap."""
        grow_gradient = self.config.grow_gradient
        room = max(0, self.config.max_gaussians - count)
        gradients = self._state["grad2d"] / self._state["count"].clamp_min(1)
        if int((gradients > grow_gradient).sum()) <= room:
            return grow_gradient
        return float(torch.topk(gradients, room + 1).values[-1])

    def state_tensors(self) -> dict[str, Tensor]:
        """Everything `load_state_tensors` needs to continue bit for bit."""
        tensors = {"random_state": self._random_state.clone()}
        if self._default is not None:
            tensors.update(
                {k: self._state[k].clone() for k in ("grad2d", "count") if self._state[k] is not None}
            )
        return tensors

    def load_state_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Continue where `state_tensors` was called.

        Raises:
            ValueError: If the state of the random generator is invalid.
        """
        state = tensors["random_state"]
        if state.dtype != self._random_state.dtype or state.shape != self._random_state.shape:
            raise ValueError("the state of the random generator is invalid")
        self._random_state = tensors["random_state"].clone().cpu()
        if self._default is not None:
            for name in ("grad2d", "count"):
                self._state[name] = tensors[name].clone().to(self._device) if name in tensors else None

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        """Lend our random stream to gsplat, which draws from torch's global generator; restore the global one."""
        outside = _get_random_state(self._device)
        _set_random_state(self._device, self._random_state)
        try:
            yield
        finally:
            self._random_state = _get_random_state(self._device)
            _set_random_state(self._device, outside)


def relocate(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale of ``ratios`` equal Gaussians at one place that together replace one Gaussian.

    Equation 9 of the MCMC paper: ``o' = 1 - (1 - o)^(1/n)``, and the scale preserves the integral of the blended
    profile along a line. The double sum over i <= n and k < i collapses by ``sum_i C(i-1, k) = C(n, k+1)``.

    Args:
        opacities: ``[N]`` in 0..1.
        scales: Standard deviations ``[N, 3]``.
        ratios: Numbers of copies ``[N]``, integer; clamped to 1..51.
        binoms: Ignored; gsplat passes its own table here.

    Returns:
        New opacities ``[N]`` and scales ``[N, 3]``.
    """
    copies = ratios.clamp(1, MAX_COPIES).long()
    old = opacities.double()
    new = 1.0 - (1.0 - old) ** copies.double().reciprocal()
    k = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64, device=opacities.device)
    coefficients = _signed_binomials().to(opacities.device)[copies] / k.sqrt()
    integral = (coefficients * new[:, None] ** k).sum(1)
    return new.to(opacities.dtype), (old / integral)[:, None].to(scales.dtype) * scales


def _signed_binomials() -> Tensor:
    """``[n, k-1] = (-1)^(k-1) C(n, k)`` for n in 0..51, k in 1..51, float64."""
    table = [
        [(-1) ** (k - 1) * math.comb(n, k) for k in range(1, MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)
    ]
    return torch.tensor(table, dtype=torch.float64)


@contextmanager
def _operators_for(device: torch.device) -> Iterator[None]:
    """Replace the operators of gsplat's strategies that exist only as CUDA kernels."""
    if device.type == "cuda":
        yield
        return
    from gsplat.strategy import ops

    def covariance_only(quats: Tensor, scales: Tensor, **_: bool) -> tuple[Tensor, None]:
        return covariances(quats, scales), None

    with _operators_lock:
        original = ops.compute_relocation, ops.quat_scale_to_covar_preci
        ops.compute_relocation, ops.quat_scale_to_covar_preci = relocate, covariance_only
        try:
            yield
        finally:
            ops.compute_relocation, ops.quat_scale_to_covar_preci = original


def _nothing_visible(count: int, device: torch.device) -> dict[str, Any]:
    """The output of gsplat's rasterizer for a camera that sees no Gaussian."""
    return {
        "means2d": SimpleNamespace(grad=torch.zeros(1, count, 2, device=device)),
        "radii": torch.zeros(1, count, 2, device=device),
        **{"width": 1, "height": 1, "n_cameras": 1, "gaussian_ids": None},
    }


def _initial_random_state(device: torch.device, seed: int) -> Tensor:
    return torch.Generator(device=device).manual_seed(seed).get_state()


def _get_random_state(device: torch.device) -> Tensor:
    return torch.cuda.get_rng_state(device) if device.type == "cuda" else torch.get_rng_state()


def _set_random_state(device: torch.device, state: Tensor) -> None:
    if device.type == "cuda":
        torch.cuda.set_rng_state(state, device)
    else:
        torch.set_rng_state(state)
