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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from lexsplat.geometry.rotations import covariances
from lexsplat.reconstruction.settings import ReconstructionConfig

NEVER = 1 << 62
"""A step that no training reaches."""
MAX_COPIES = 51
"""Upper limit of the copies of one Gaussian; larger numbers are clamped to it, as in gsplat."""

RENEWAL_START = 0.2
"""Share of the iterations after which rounds make room for others: before it, all Gaussians are still growing."""

GSPLAT_NAMES = {"log_scales": "scales", "opacity_logits": "opacities"}
"""Parameters that gsplat's strategies expect under another name."""

STATISTICS = ("grad2d", "count")
"""State of "default": sums of gradients, and numbers of views that drew each Gaussian."""

_operators_lock = threading.Lock()


class DensityControl:
    """One of gsplat's strategies on any device, with a cap, a random generator of its own, and a state.

    Args:
        config: Strategy, schedule and rules.
        extent: Radius of the scene in world units; sizes are relative to it.
        seed: Seed of the random generator.
        device: Device of the parameters.
    """

    def __init__(
        self,
        config: ReconstructionConfig,
        extent: float,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        from gsplat.strategy import DefaultStrategy, MCMCStrategy  # imported here: it takes seconds

        self.config, self.schedule = config, config.density_schedule
        self._device = torch.device(device)
        self._cap = config.cap(self._device)
        self._random_state = torch.Generator(device=self._device).manual_seed(seed).get_state()
        steps: dict[str, Any] = {
            "refine_start_iter": self.schedule.start,
            "refine_stop_iter": self.schedule.stop,
            "refine_every": self.schedule.every,
        }
        self._strategy: Any
        if config.strategy == "mcmc":
            self._strategy = MCMCStrategy(
                cap_max=self._cap, noise_lr=config.noise, min_opacity=config.min_opacity, **steps
            )
            self._state = self._strategy.initialize_state()
        else:
            self._strategy = DefaultStrategy(
                prune_opa=config.min_opacity,
                grow_grad2d=config.grow_gradient,
                # After the first reset gsplat also removes Gaussians larger than a tenth of the scene. Without
                # resets this would only punch holes into a background covered by few Gaussians.
                reset_every=self.schedule.reset_every if config.resets_opacities else NEVER,
                **steps,
            )
            self._state = self._strategy.initialize_state(scene_scale=extent)

    # What a rule may read of a step, and what it changes.
    def step(
        self,
        parameters: dict[str, torch.nn.Parameter],
        optimizers: Mapping[str, torch.optim.Optimizer],
        step: int,
        *,
        means2d: Tensor,
        radii: Tensor,
        image_size: tuple[int, int],
        means_learning_rate: float,
        idle: Tensor | None = None,
    ) -> bool:
        """Add, move and remove Gaussians after the optimizers' step; replaces entries of ``parameters``.

        Args:
            parameters: The parameters by the names of `Gaussians`, and any other of the same length.
            optimizers: One optimizer per parameter, each with one group.
            step: Number of steps before this one.
            means2d: Projected centers ``[N, 2]`` or, of C views, ``[C, N, 2]`` in pixels with their ``grad``.
            radii: Size on screen ``[N]`` or ``[C, N]`` in pixels; 0 where not drawn.
            image_size: Width and height of the rendered image.
            means_learning_rate: Present learning rate of the means; scales the noise of "mcmc".
            idle: Mask ``[N]`` of Gaussians that a round of "default" removes before it adds others.

        Returns:
            Whether the set of Gaussians changed.
        """
        changed = self.refines_at(step)
        theirs = {GSPLAT_NAMES.get(name, name): value for name, value in parameters.items()}
        subjects = theirs, {GSPLAT_NAMES.get(name, name): value for name, value in optimizers.items()}
        with self._own_randomness(), _operators_for(self._device):
            if self.config.strategy == "mcmc":
                # gsplat moves faint Gaussians to others and fails if there are none: such a round is skipped.
                changed = changed and bool((theirs["opacities"].sigmoid() > self.config.min_opacity).any())
                self._strategy.step_post_backward(
                    *subjects, self._state, step if changed else 0, {}, lr=means_learning_rate
                )
            elif step < self.schedule.stop:
                self._accumulate(means2d, radii, image_size)
                if changed:
                    if idle is not None:
                        self._remove(subjects, idle)
                    self._refine(subjects, step)
                if self.config.resets_opacities and step > 0 and step % self.schedule.reset_every == 0:
                    self._reset_opacities(subjects)
        parameters.update({name: theirs[GSPLAT_NAMES.get(name, name)] for name in parameters})
        return changed

    def refine(
        self,
        parameters: dict[str, torch.nn.Parameter],
        optimizers: Mapping[str, torch.optim.Optimizer],
        step: int,
        steps: int,
    ) -> bool:
        """Change the set of Gaussians now, with the statistics so far; replaces entries of ``parameters``.

        Args:
            parameters: As in `step`.
            optimizers: As in `step`.
            step: Number of finished steps.
            steps: Number of steps since the last call; opacities are reset if one of them would have done it.

        Returns:
            Whether it was done: from the first round of the schedule to its end.
        """
        schedule = self.schedule
        due = step // schedule.every * schedule.every
        if not schedule.start < due < schedule.stop or step >= schedule.stop:
            return False
        theirs = {GSPLAT_NAMES.get(name, name): value for name, value in parameters.items()}
        subjects = theirs, {GSPLAT_NAMES.get(name, name): value for name, value in optimizers.items()}
        with self._own_randomness(), _operators_for(self._device):
            if self.config.strategy == "mcmc":
                if not bool((theirs["opacities"].sigmoid() > self.config.min_opacity).any()):
                    return False
                self._strategy.step_post_backward(*subjects, self._state, due, {}, lr=0.0)
            else:
                self._refine(subjects, due)
                every = schedule.reset_every
                if self.config.resets_opacities and step // every > (step - steps) // every:
                    self._reset_opacities(subjects)
        parameters.update({name: theirs[GSPLAT_NAMES.get(name, name)] for name in parameters})
        return True

    def _refine(self, subjects: tuple[dict[str, Any], dict[str, Any]], step: int) -> None:
        # gsplat accumulates and refines in one call; shown no visible Gaussian, it only refines.
        count = len(subjects[0]["means"])
        self._strategy.grow_grad2d = self._threshold_within_cap(count)
        nothing = _nothing_visible(count, self._device)
        self._strategy.step_post_backward(*subjects, self._state, step, nothing)

    def _remove(self, subjects: tuple[dict[str, Any], dict[str, Any]], mask: Tensor) -> None:
        from gsplat.strategy import ops

        ops.remove(*subjects, self._state, mask)

    def _reset_opacities(self, subjects: tuple[dict[str, Any], dict[str, Any]]) -> None:
        from gsplat.strategy import ops

        ops.reset_opa(*subjects, self._state, value=2.0 * self.config.min_opacity)

    def _accumulate(self, means2d: Tensor, radii: Tensor, image_size: tuple[int, int]) -> None:
        """Accumulate gradients and visibility as gsplat does, but without index gathers: four passes over ``[N]``."""
        if means2d.grad is None:
            raise ValueError("means2d must have a gradient: run density control after the backward pass")
        if self._state["grad2d"] is None:
            self._state["grad2d"] = torch.zeros(radii.shape[-1], device=self._device)
            self._state["count"] = torch.zeros(radii.shape[-1], device=self._device)
        for gradients, visible in zip(
            means2d.grad.view(-1, *means2d.shape[-2:]), radii.view(-1, radii.shape[-1]) > 0
        ):
            x, y = (gradients[:, axis] * (image_size[axis] / 2) for axis in (0, 1))
            self._state["grad2d"] += (x * x + y * y).sqrt_() * visible
            self._state["count"] += visible

    def refines_at(self, step: int) -> bool:
        """Whether `step` changes the set of Gaussians after ``step`` finished steps."""
        return self.schedule.start < step < self.schedule.stop and step % self.schedule.every == 0

    def number_to_renew(self, step: int) -> int:
        """Number of Gaussians that a round after ``step`` finished steps removes to make room below the cap."""
        share, sums = self.config.renewed_share, self._state.get("grad2d")
        if sums is None or not self.refines_at(step) or step < RENEWAL_START * self.config.iterations:
            return 0
        gradients = sums / self._state["count"].clamp_min(1)
        wanted = int((gradients > self.config.grow_gradient).sum())
        return max(0, min(int(share * len(sums)), wanted - (self._cap - len(sums))))

    def _threshold_within_cap(self, count: int) -> float:
        """The lowest threshold, not below the configured one, that keeps the number within the cap."""
        grow_gradient = self.config.grow_gradient
        room = max(0, self._cap - count)
        gradients = self._state["grad2d"] / self._state["count"].clamp_min(1)
        if int((gradients > grow_gradient).sum()) <= room:
            return grow_gradient
        return float(torch.topk(gradients, room + 1).values[-1])

    def state_tensors(self) -> dict[str, Tensor]:
        """Everything `load_state_tensors` needs to continue bit for bit."""
        statistics = {name: self._state.get(name) for name in STATISTICS}
        known = {"random_state": self._random_state, **statistics}
        return {name: tensor.clone() for name, tensor in known.items() if tensor is not None}

    def load_state_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Continue where `state_tensors` was called.

        Raises:
            ValueError: If the state of the random generator is invalid.
        """
        state = tensors["random_state"]
        if state.dtype != self._random_state.dtype or state.shape != self._random_state.shape:
            raise ValueError("the state of the random generator is invalid")
        self._random_state = state.clone().cpu()
        if self.config.strategy == "default":
            for name in STATISTICS:
                self._state[name] = tensors[name].clone().to(self._device) if name in tensors else None

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        """Lend our random stream to gsplat, which draws from torch's global generator; restore the global one."""
        cuda = self._device.type == "cuda"
        place = (self._device,) if cuda else ()
        current, change = (
            (torch.cuda.get_rng_state, torch.cuda.set_rng_state)
            if cuda
            else (torch.get_rng_state, torch.set_rng_state)
        )
        outside = current(*place)
        change(self._random_state, *place)
        try:
            yield
        finally:
            self._random_state = current(*place)
            change(outside, *place)


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
