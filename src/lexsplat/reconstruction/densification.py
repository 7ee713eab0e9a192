"""Adaptive density control: where Gaussians are added, moved and removed during reconstruction.

The rules are gsplat's strategy objects: "default" (3DGS: clone, split, prune, reset of opacities) and "mcmc"
(3D Gaussian Splatting as Markov Chain Monte Carlo). This module gives them what they lack: a cap for
"default", torch arithmetic where gsplat has only CUDA kernels, the opacity reset (gsplat 1.5.3 never reaches
its own, because ``step % n == 0 & step > 0`` is a chained comparison with ``0 & step``), a random generator
of their own, and a state that can be saved.
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

REFERENCE_ITERATIONS = 30_000
"""The length of training that all step numbers of 3DGS refer to."""
NEVER = 1 << 62
"""A step that no training reaches."""
MAX_COPIES = 51
"""More copies of one Gaussian than this are treated as this many (as gsplat does)."""

_operators_lock = threading.Lock()


@dataclass(frozen=True)
class DensitySchedule:
    """Steps at which density control acts.

    Args:
        start: First step after which Gaussians are added.
        stop: Step at which the number of Gaussians is final.
        every: Steps between two rounds.
        reset_every: Steps between two resets of the opacities ("default" only).
    """

    start: int
    stop: int
    every: int
    reset_every: int


def density_schedule(
    strategy: Literal["default", "mcmc"], iterations: int, *, every: int = 100, minimum_every: int = 1
) -> DensitySchedule:
    """The schedule of 3DGS (or of MCMC) for 30,000 iterations, stretched to ``iterations``.

    Args:
        strategy: Whose schedule.
        iterations: Length of the training.
        every: Steps between two rounds in a training of 30,000.
        minimum_every: Rounds of "default" are never closer than this, so that enough views vote. Nothing votes in
            "mcmc": it adds by chance, a twentieth a round, and with few rounds would never come to its cap.
    """
    scale = iterations / REFERENCE_ITERATIONS
    closest = minimum_every if strategy == "default" else 1
    return DensitySchedule(
        start=round(500 * scale),
        stop=round((15_000 if strategy == "default" else 25_000) * scale),
        every=max(1, closest, round(every * scale)),
        reset_every=max(1, round(3_000 * scale)),
    )


class DensityControl:
    """One of gsplat's strategies on any device, with a cap, its own random generator and a state.

    Parameters are passed under gsplat's names: means, quats, scales (logarithms), opacities (logits), and
    any other.

    Args:
        strategy: "default" or "mcmc".
        schedule: When it acts.
        extent: Radius of the scene; sizes are judged relative to it.
        max_gaussians: Never more than this many.
        grow_gradient: Mean gradient of the projected centers, in halves of the image, above which "default"
            adds.
        min_opacity: Gaussians fainter than this are removed ("default") or moved ("mcmc").
        reset_opacities: Whether "default" resets the opacities to twice ``min_opacity`` now and then, and
            from the first time on removes Gaussians larger than a tenth of the scene.
        noise: Strength of the noise of "mcmc", times the learning rate of the means.
        seed: Of the random generator.
        device: Where the parameters are.

    Raises:
        ValueError: If the strategy is unknown or the cap is not positive.
    """

    def __init__(
        self,
        strategy: Literal["default", "mcmc"],
        schedule: DensitySchedule,
        *,
        extent: float,
        max_gaussians: int,
        grow_gradient: float = 2e-4,
        min_opacity: float = 0.005,
        reset_opacities: bool = True,
        noise: float = 5e5,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        if max_gaussians < 1:
            raise ValueError(f"max_gaussians must be positive, got {max_gaussians}")
        from gsplat.strategy import DefaultStrategy, MCMCStrategy  # imported here: it takes seconds

        self.schedule = schedule
        self.max_gaussians = max_gaussians
        self.grow_gradient = grow_gradient
        self.reset_opacities = reset_opacities
        self._device = torch.device(device)
        self._random_state = _initial_random_state(self._device, seed)
        steps: dict[str, Any] = {
            "refine_start_iter": schedule.start,
            "refine_stop_iter": schedule.stop,
            "refine_every": schedule.every,
        }
        if strategy == "default":
            self._default = DefaultStrategy(
                prune_opa=min_opacity,
                grow_grad2d=grow_gradient,
                # gsplat also removes Gaussians larger than a tenth of the scene once opacities were reset. Without
                # resets that would only punch holes into a background that few Gaussians cover.
                reset_every=schedule.reset_every if reset_opacities else NEVER,
                **steps,
            )
            self._mcmc = None
            self._state = self._default.initialize_state(scene_scale=extent)
        elif strategy == "mcmc":
            self._default = None
            self._mcmc = MCMCStrategy(cap_max=max_gaussians, noise_lr=noise, min_opacity=min_opacity, **steps)
            self._state = self._mcmc.initialize_state()
        else:
            raise ValueError(f'strategy must be "default" or "mcmc", got {strategy!r}')

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
        """Act after the optimizers' step; entries of ``parameters`` may be replaced.

        Args:
            parameters: By gsplat's names.
            optimizers: One for each parameter, each with one group.
            step: Steps done before this one.
            means2d: Projected centers ``[N, 2]`` in pixels whose ``grad`` is filled.
            radii: Size on screen ``[N]`` in pixels; 0 where not drawn.
            image_size: Width and height of the image behind ``means2d``.
            means_learning_rate: Present learning rate of the means; scales the noise of "mcmc".

        Returns:
            Whether the set of Gaussians changed.
        """
        with self._own_randomness(), _operators_for(self._device):
            if self._mcmc is not None:
                self._mcmc.step_post_backward(
                    parameters, optimizers, self._state, step, {}, lr=means_learning_rate
                )
                return self._refines_at(step)
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

        if step >= self.schedule.stop or self._default is None:
            return False
        self._gather(means2d, radii, image_size)
        changed = self._refines_at(step)
        if changed:
            # gsplat gathers and refines in one call: nothing is visible to it here, so it only refines.
            self._default.grow_grad2d = self._threshold_within_cap(len(parameters["means"]))
            info = _nothing_visible(len(means2d), self._device)
            self._default.step_post_backward(parameters, optimizers, self._state, step, info)
        if self.reset_opacities and step > 0 and step % self.schedule.reset_every == 0:
            ops.reset_opa(parameters, optimizers, self._state, value=2.0 * self._default.prune_opa)
        return changed

    def _gather(self, means2d: Tensor, radii: Tensor, image_size: tuple[int, int]) -> None:
        """Add up gradients and visibility as gsplat does, without gathering indices: four passes over [N]."""
        if means2d.grad is None:
            raise ValueError("means2d has no gradient: density control runs after the backward pass")
        if self._state["grad2d"] is None:
            self._state["grad2d"] = torch.zeros(len(radii), device=self._device)
            self._state["count"] = torch.zeros(len(radii), device=self._device)
        visible = radii > 0
        x, y = (means2d.grad[:, axis] * (image_size[axis] / 2) for axis in (0, 1))
        self._state["grad2d"] += (x * x + y * y).sqrt_() * visible
        self._state["count"] += visible

    def _refines_at(self, step: int) -> bool:
        schedule = self.schedule
        return schedule.start < step < schedule.stop and step % schedule.every == 0

    def _threshold_within_cap(self, count: int) -> float:
        """The lowest threshold, not below the configured one, that keeps the number within the cap."""
        room = max(0, self.max_gaussians - count)
        gradients = self._state["grad2d"] / self._state["count"].clamp_min(1)
        if int((gradients > self.grow_gradient).sum()) <= room:
            return self.grow_gradient
        return float(torch.topk(gradients, room + 1).values[-1])

    def state_tensors(self) -> dict[str, Tensor]:
        """What `load_state_tensors` needs to go on bit for bit."""
        tensors = {"random_state": self._random_state.clone()}
        if self._default is not None:
            tensors.update(
                {k: self._state[k].clone() for k in ("grad2d", "count") if self._state[k] is not None}
            )
        return tensors

    def load_state_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Go on where `state_tensors` was called.

        Raises:
            ValueError: If the state of the generator is none.
        """
        state = tensors["random_state"]
        if state.dtype != self._random_state.dtype or state.shape != self._random_state.shape:
            raise ValueError("the state of the random numbers does not fit")
        self._random_state = tensors["random_state"].clone().cpu()
        if self._default is not None:
            for name in ("grad2d", "count"):
                self._state[name] = tensors[name].clone().to(self._device) if name in tensors else None

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        """gsplat draws from torch's global generator: lend it our stream, leave the global one as it was."""
        outside = _get_random_state(self._device)
        _set_random_state(self._device, self._random_state)
        try:
            yield
        finally:
            self._random_state = _get_random_state(self._device)
            _set_random_state(self._device, outside)


def relocate(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale of ``ratios`` equal Gaussians at one place that look like the one they replace.

    Equation 9 of the MCMC paper: ``o' = 1 - (1 - o)^(1/n)``, and the scale keeps the integral of the blended
    profile along a line. Its double sum over i <= n and k < i collapses, because ``sum_i C(i-1, k) = C(n,
    k+1)``.

    Args:
        opacities: ``[N]`` in 0..1.
        scales: Standard deviations ``[N, 3]``.
        ratios: How many copies there will be ``[N]``, integer; held within 1..51.
        binoms: Ignored; gsplat passes its table here.

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


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Covariances ``[N, 3, 3]`` of Gaussians with rotations ``[N, 4]`` (wxyz) and scales ``[N, 3]``."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    axes = torch.stack(rows, -1).reshape(-1, 3, 3) * scales[:, None, :]
    return axes @ axes.transpose(1, 2)


def _signed_binomials() -> Tensor:
    """``[n, k-1] = (-1)^(k-1) C(n, k)`` for n in 0..51, k in 1..51, float64."""
    table = [
        [(-1) ** (k - 1) * math.comb(n, k) for k in range(1, MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)
    ]
    return torch.tensor(table, dtype=torch.float64)


@contextmanager
def _operators_for(device: torch.device) -> Iterator[None]:
    """Where gsplat has only CUDA kernels, its strategies use our arithmetic: the one seam between the two."""
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
    """What gsplat's rasterizer reports for a camera that sees no Gaussian."""
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
