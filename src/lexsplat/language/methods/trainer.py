"""Training of the paper's field in single steps, with everything that an exact continuation needs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lexsplat.codebook import Codebook
from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.language.code_maps import MASKED_CODE, codes_at_pixels
from lexsplat.language.fields import TrainedField
from lexsplat.language.losses import (
    cross_entropy_loss,
    mean_in_blocks,
    smoothing_loss,
    uncertainty_loss,
)
from lexsplat.language.methods.trained_settings import TrainedConfig
from lexsplat.reconstruction.optimizers import below_prefix, check_moments, with_prefix
from lexsplat.rendering import PreparedView
from lexsplat.runtime.adam import AdamW
from lexsplat.runtime.errors import TrainingError


class FieldTrainer:
    """Training of the language field in single steps, alone or together with a reconstruction.

    Args:
        gaussians: The geometry, which is not changed.
        codebook: The discrete feature space S.
        config: Settings.
        seed: Seed of the initial field and of all samples.
    """

    parameter_prefixes: tuple[str, ...] = ("field.",)

    def __init__(
        self,
        gaussians: Gaussians,
        codebook: Codebook,
        config: TrainedConfig,
        *,
        seed: int = 0,
    ) -> None:
        self.config = config
        self.seed = seed
        self._bfloat16 = config.mlp_precision == "bfloat16"
        self.iteration = 0
        self.rate_factor = 1.0
        """Factor of all learning rates: halved whenever the training diverges (`lexsplat.runtime.training`)."""
        self._first_loss = math.nan
        self.generator = torch.Generator().manual_seed(seed)
        self.gaussians = gaussians.detach()
        self.field = TrainedField.initial(
            gaussians,
            codebook,
            generator=self.generator,
            num_frequencies=config.num_frequencies,
            normalize_rendering=config.normalize_rendering,
        )
        self.optimizer = self._make_optimizer()

    def _make_optimizer(self) -> torch.optim.Optimizer:
        config, field = self.config, self.field
        rates: list[tuple[Any, float, float]] = [
            ([field.semantics], config.semantics_lr, 0.0),
            ([field.uncertainty_logits], config.uncertainty_lr, 0.0),
            (list(field.decoder.parameters()), config.decoder_lr, config.decoder_weight_decay),
            (list(field.smoother.parameters()), config.smoothing_lr, 0.0),
        ]
        groups = [
            {"params": parameters, "lr": rate, "base_lr": rate, "weight_decay": decay}
            for parameters, rate, decay in rates
        ]
        # AdamW without weight decay is Adam, the paper's optimizer.
        return AdamW(groups, betas=(0.9, 0.999))

    def step(
        self, camera: Camera, code_map: NDArray[np.integer] | Tensor, *, prepared: PreparedView | None = None
    ) -> dict[str, Tensor]:
        """One step on one view.

        Args:
            camera: The view, at the resolution to render.
            code_map: Its index map ``[h, w]``. Cells with an index of K or above are ignored by the cross-entropy,
                those with `MASKED_CODE` by all losses.
            prepared: The projection of the view, if the geometry has not changed since.

        Returns:
            Losses by name, without gradient history.
        """
        config, field = self.config, self.field
        for group in self.optimizer.param_groups:
            progress = self.iteration / max(config.iterations, 1)
            group["lr"] = group["base_lr"] * config.final_lr_factor ** min(progress, 1.0) * self.rate_factor
        self.optimizer.zero_grad(set_to_none=True)
        semantics, uncertainty = field.render_semantics(self.gaussians, camera, prepared=prepared)
        losses = self._semantic_terms(semantics, uncertainty, code_map)
        smoothing = semantics.new_zeros(())
        if config.use_smoothing and self.iteration % config.smoothing_every == 0:
            smoothing = losses["smoothing"] = self._smoothing_term()
        loss = losses["loss"] = config.lambda_s * losses["semantic"] + config.lambda_smo * smoothing  # Eq. 15
        loss.backward()
        if config.clip_decoder_grad is not None:
            nn.utils.clip_grad_norm_(field.decoder.parameters(), config.clip_decoder_grad)
        self.optimizer.step()
        self.iteration += 1
        return {name: value.detach() for name, value in losses.items()}

    def _semantic_terms(self, semantics: Tensor, uncertainty: Tensor, code_map: Any) -> dict[str, Tensor]:
        """Eq. 8 to 12 for rendered maps ``[H, W, 8]`` and ``[H, W]``."""
        config, field = self.config, self.field
        pixels, codes = self._sample_pixels(semantics.shape[0], semantics.shape[1], code_map)
        if len(pixels) == 0:  # all cells of the view are ignored
            nothing = semantics.sum() * 0
            return {"cross_entropy": nothing, "semantic": nothing}
        # Not [pixels], whose gradient sums repeated rows in an order that depends on the threads.
        rows = [semantics.flatten(0, 1).index_select(0, pixels), codes]
        if config.use_uncertainty:
            rows.append(uncertainty.flatten().index_select(0, pixels))
        cross_entropy = mean_in_blocks(
            lambda s, *rest: cross_entropy_loss(field.decode(s, bfloat16=self._bfloat16), *rest),
            rows,
            list(field.decoder.parameters()),
        )
        if not config.use_uncertainty:
            return {"cross_entropy": cross_entropy, "semantic": config.lambda_ce * cross_entropy}
        regularizer = uncertainty_loss(self._not_masked(uncertainty, code_map), config.uncertainty_form)
        semantic = config.lambda_ce * cross_entropy + config.lambda_u * regularizer  # Eq. 12
        return {"cross_entropy": cross_entropy, "uncertainty": regularizer, "semantic": semantic}

    def _not_masked(self, uncertainty: Tensor, code_map: Any) -> Tensor:
        """Rendered values ``[H, W]`` of the pixels that are not masked ``[M]``; unchanged if no pixel is masked."""
        codes = torch.as_tensor(code_map).cpu()
        if int(codes.max()) < MASKED_CODE:
            return uncertainty
        height, width = uncertainty.shape
        codes = codes_at_pixels(codes, height, width, torch.arange(height * width))
        return uncertainty.flatten()[(codes != MASKED_CODE).to(uncertainty.device)]

    def _sample_pixels(self, height: int, width: int, code_map: Any) -> tuple[Tensor, Tensor]:
        """Indices of pixels and their codes, both ``[M]``, without pixels of ignored cells."""
        count = height * width
        if self.config.pixel_sample and self.config.pixel_sample < count:
            pixels = torch.randint(count, (self.config.pixel_sample,), generator=self.generator)
        else:
            pixels = torch.arange(count)
        codes = codes_at_pixels(torch.as_tensor(code_map).cpu(), height, width, pixels)
        known = codes < self.field.codebook.num_codes
        device = self.gaussians.device
        return _sent(pixels[known], device), _sent(codes[known], device)

    def _smoothing_term(self) -> Tensor:
        """Eq. 13 and 14 for all Gaussians or a random sample."""
        config, field = self.config, self.field
        count = len(field.semantics)
        means: Tensor = self.gaussians.means
        semantics: Tensor = field.semantics
        logits: Tensor = field.uncertainty_logits
        if config.smoothing_sample and config.smoothing_sample < count:
            rows = _sent(
                torch.randint(count, (config.smoothing_sample,), generator=self.generator), means.device
            )
            means, semantics, logits = (t.index_select(0, rows) for t in (means, semantics, logits))
        uncertainties = logits.detach().sigmoid() if config.use_uncertainty else torch.zeros_like(logits)

        def smoothing(means: Tensor, semantics: Tensor, uncertainties: Tensor) -> Tensor:
            return smoothing_loss(
                field.smoother(means, bfloat16=self._bfloat16),
                semantics,
                uncertainties,
                config.min_smoothing_weight,
                weight=config.smoothing_weight,
                squared=config.smoothing_squared,
            )

        return mean_in_blocks(
            smoothing, (means.detach(), semantics, uncertainties), list(field.smoother.parameters())
        )

    def replace_gaussians(self, gaussians: Gaussians, parents: Tensor) -> None:
        """Follow density control: Gaussian n of the new geometry takes over the language of ``parents[n]``.

        Args:
            gaussians: The new geometry with M Gaussians.
            parents: Indices ``[M]`` of the old Gaussians.
        """
        if len(parents) != len(gaussians):
            raise ValueError(f"{len(gaussians)} Gaussians, but {len(parents)} parents")
        self.gaussians = gaussians.detach()
        for name, group in zip(("semantics", "uncertainty_logits"), self.optimizer.param_groups):
            old = getattr(self.field, name)
            new = nn.Parameter(old.detach()[parents].clone())
            moments = self.optimizer.state.pop(old, {})
            self.optimizer.state[new] = {
                key: value[parents].clone() if value.ndim else value for key, value in moments.items()
            }
            group["params"] = [new]
            setattr(self.field, name, new)

    def view_of_step(self, names: list[str]) -> str:
        """The view of the next step: random permutations of all views, one after the other."""
        epoch, place = divmod(self.iteration, len(names))
        order = torch.Generator().manual_seed(self.seed * 1_000_003 + epoch)
        return names[int(torch.randperm(len(names), generator=order)[place])]

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that an exact continuation needs, as named tensors."""
        state = with_prefix("field.", self.field.state_dict())
        for name, parameter in self.field.named_parameters():
            state |= with_prefix(f"optimizer.{name}.", self.optimizer.state.get(parameter, {}))
        state["generator"] = self.generator.get_state()
        state["iteration"] = torch.tensor(self.iteration)
        state["rate_factor"] = torch.tensor(self.rate_factor, dtype=torch.float64)
        state["first_loss"] = torch.tensor(self._first_loss, dtype=torch.float64)
        return {name: value.detach().clone() for name, value in state.items()}

    def find_invalid(self) -> str:
        """The first invalid parameter; empty if there is none."""
        broken = [n for n, p in self.field.named_parameters() if not bool(torch.isfinite(p).all())]
        return f"NaN or Inf in {broken[0]}" if broken else ""

    def check_loss(self, loss: float) -> None:
        """Compare a loss with the first one.

        Raises:
            TrainingError: If it is NaN, or about ten times as large as the first.
        """
        if math.isnan(self._first_loss):
            self._first_loss = loss
        if not loss <= 10 * self._first_loss + 10:
            raise TrainingError(
                "language field",
                expected="a loss that falls",
                found=f"a loss of {loss:.3g} at step {self.iteration}",
                remedy="lower the learning rates or set clip_decoder_grad",
            )

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """The inverse of `state_dict`, for a trainer with the same geometry and settings.

        Raises:
            ValueError: If the state belongs to another scene or is incomplete.
        """
        try:
            self.field.load_state_dict(below_prefix("field.", state))
            self.generator.set_state(state["generator"].cpu())
            self.iteration = int(state["iteration"])
            self.rate_factor = float(state.get("rate_factor", 1.0))
            self._first_loss = float(state.get("first_loss", math.nan))
            if not (0 <= self.iteration <= self.config.iterations and 0 < self.rate_factor <= 1):
                raise ValueError(f"iteration {self.iteration}, learning rates times {self.rate_factor:g}")
        except (KeyError, RuntimeError, TypeError) as error:
            raise ValueError(f"the training state does not fit: {error}") from error
        self.optimizer.state.clear()
        for name, parameter in self.field.named_parameters():
            moments = below_prefix(f"optimizer.{name}.", state)
            check_moments(moments, parameter)
            if moments:
                self.optimizer.state[parameter] = {
                    key: value.clone() if key == "step" else value.to(parameter.device, copy=True)
                    for key, value in moments.items()
                }


def _sent(sample: Tensor, device: torch.device) -> Tensor:
    """A sample on the device. For a GPU it is copied from pinned memory, without waiting for earlier steps."""
    if device.type != "cuda":
        return sample.to(device)
    return sample.pin_memory().to(device, non_blocking=True)
