"""The training of the Gaussians, step by step; it can be saved and resumed bit for bit."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians, gaussians_from_points
from lexsplat.reconstruction.adam import (
    Adam,
    below_prefix,
    load_optimizer_tensors,
    optimizer_tensors,
    with_prefix,
)
from lexsplat.reconstruction.densification import REFERENCE_ITERATIONS, DensityControl, density_schedule
from lexsplat.reconstruction.exposures import Exposures
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.runtime.divergence import KEEP_EVERY, Guard
from lexsplat.runtime.errors import TrainingError
from lexsplat.runtime.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.captures import Capture
    from lexsplat.captures.sfm.triangulation import InitialPoints
    from lexsplat.runtime.checkpoints import Checkpoint

STAGE = "reconstruct"
"""Name of the stage in events."""
EVENT_EVERY = 10
"""Iterations between two events."""
GSPLAT_NAMES = {
    "means": "means",
    "quats": "quats",
    "log_scales": "scales",
    "opacity_logits": "opacities",
    "sh0": "sh0",
    "shN": "shN",
}
"""Our names of the parameters, and those gsplat's strategies look for."""


class Reconstructor:
    """A training that can be stepped, saved and resumed bit for bit.

    Args:
        scene: Views and split.
        config: Settings.
        points: Where Gaussians start, from `lexsplat.captures.sfm.triangulation.initial_points`.
        device: Where to train.
        seed: Of the order of views and of density control.

    Raises:
        TrainingError: If there is no training view or no point.
    """

    def __init__(
        self,
        scene: Capture,
        config: ReconstructionConfig,
        points: InitialPoints,
        *,
        device: torch.device | str = "cpu",
        seed: int = 0,
        memory: int | None = None,
    ) -> None:
        from lexsplat.reconstruction.image_losses import SMALLEST_SIDE

        if memory is not None:
            config = replace(config, image_memory=min(config.image_memory, memory // 4))
        self.config = config
        self.device = torch.device(device)
        self.steps_done = 0
        self._views = {view.name: view for view in scene.train_views}
        self._names = sorted(self._views)
        halves = [view.camera.downscaled(2.0) for view in self._views.values()]
        self._can_shrink = all(min(half.width, half.height) >= SMALLEST_SIDE for half in halves)
        if not self._names:
            raise TrainingError(
                scene.root, expected="at least one training view", found="none", remedy="hold out fewer views"
            )
        self._extent = scene.extent
        self._background = torch.tensor(scene.background, dtype=torch.float32, device=self.device)
        self._generator = torch.Generator().manual_seed(seed)
        self._order = torch.empty(0, dtype=torch.int64)
        self._recent_error = self._nothing_error = float("nan")
        self._rate_factor = 1.0
        self._parameters = self._initial_parameters(points)
        self._optimizers = self._new_optimizers()
        self._exposures = None
        if config.exposure:
            self._exposures = Exposures(len(self._names), config.exposure_rate, self.device)
        self._density = DensityControl(
            config.strategy,
            density_schedule(
                config.strategy,
                config.iterations,
                every=config.densify_every,
                minimum_every=config.densify_min_every,
            ),
            extent=self._extent,
            max_gaussians=config.cap(self.device),
            grow_gradient=config.grow_gradient,
            min_opacity=config.min_opacity,
            reset_opacities=config.is_long if config.reset_opacities is None else config.reset_opacities,
            noise=config.noise,
            seed=seed,
            device=self.device,
        )
        self._images: Any = None
        self._images_shrink = 0.0
        self.last_view = ""
        """Name of the view of the last step."""
        self.origins: Tensor | None = None
        """If the last step changed the set of Gaussians: which Gaussian before it each one comes from ``[N]``."""

    @property
    def done(self) -> bool:
        """Whether all iterations have run."""
        return self.steps_done >= self.config.iterations

    @property
    def rate_factor(self) -> float:
        """Factor of all learning rates: halved whenever the training diverges (`lexsplat.runtime.divergence`)."""
        return self._rate_factor

    @rate_factor.setter
    def rate_factor(self, factor: float) -> None:
        self._rate_factor = factor
        for name, rate in self._rates().items():
            self._optimizers[GSPLAT_NAMES[name]].param_groups[0]["lr"] = rate

    @property
    def metrics(self) -> dict[str, float]:
        """Numbers for progress: PSNR of recent training views and the count of Gaussians."""
        psnr = -10.0 * math.log10(max(self._recent_error, 1e-12)) if self.steps_done else float("nan")
        return {"psnr": psnr, "gaussians": float(len(self._parameters["means"]))}

    def run(self, listener: Listener = silent, checkpoint: Checkpoint | None = None) -> None:
        """Run the iterations that are left; ``checkpoint`` saves the training between them."""
        total = self.config.iterations
        guard = Guard(self, "reconstruction", every=KEEP_EVERY[self.device.type])
        with nullcontext() if checkpoint is None else checkpoint.guarding():
            while not self.done:
                with guard:
                    self.step()
                    guard.after_step(self.done)
                    if checkpoint is not None:
                        checkpoint.after_step(self)
                if self.steps_done % EVENT_EVERY == 0 or self.done:
                    listener(Event(STAGE, self.steps_done, total, self.metrics))

    def gaussians(self) -> Gaussians:
        """The present Gaussians, without gradient history; they share memory with the training."""
        return self._as_gaussians().detach()

    def step(self) -> float:
        """One iteration on one view; returns its loss.

        Raises:
            TrainingError: If the loss is no longer finite.
        """
        from lexsplat.reconstruction.image_losses import photometric_loss
        from lexsplat.rendering import render

        index = self._next_view()
        images = self._training_images()
        camera = images.camera(self._names[index])
        target = images.target(self._names[index])
        rendering = render(
            self._as_gaussians(), camera, sh_degree=self._active_sh_degree(), background=self._background
        )
        image = rendering.image
        if self._exposures is not None:
            image = self._exposures.apply(image, index)
        valid = images.valid(self._names[index])
        if valid is not None:
            image = torch.where(valid[..., None], image, target.image)
        loss = photometric_loss(image, target, self.config.ssim_weight) + self._regularization()
        loss.backward()
        value = loss.item() if self._checks_now() else 0.0
        if not math.isfinite(value):
            raise TrainingError(
                "reconstruction",
                expected="a finite loss",
                found=f"{value} at iteration {self.steps_done + 1}",
                remedy="check the cameras, or lower the learning rates",
            )
        self._follow(image, target.image)
        self._optimize()
        self._control_density(rendering.means2d, rendering.radii, (camera.width, camera.height))
        self.last_view = self._names[index]
        if len(self._parameters["means"]) == 0:
            raise TrainingError(
                "reconstruction",
                expected="Gaussians",
                found=f"none left at iteration {self.steps_done + 1}",
                remedy="check the cameras and points, or lower min_opacity",
            )
        self.steps_done += 1
        return value

    def _control_density(self, means2d: Tensor, radii: Tensor, image_size: tuple[int, int]) -> None:
        """Density control, and where it leaves each Gaussian: a number that is copied along with its parameters.

        Numbers are exact in float32 up to 16 million, more Gaussians than fit anywhere else.
        """
        numbers = torch.arange(len(self._parameters["means"]), dtype=torch.float32, device=self.device)
        self._parameters["origins"] = torch.nn.Parameter(numbers, requires_grad=False)
        self._optimizers["origins"] = Adam(self._parameters["origins"], 0.0)
        changed = self._density.step(
            self._parameters,
            self._optimizers,  # type: ignore[arg-type]
            self.steps_done,
            means2d=means2d,
            radii=radii,
            image_size=image_size,
            means_learning_rate=self._means_rate(),
        )
        del self._optimizers["origins"]
        origins = self._parameters.pop("origins").detach().long()
        self.origins = origins if changed else None

    def state_dict(self) -> dict[str, Tensor]:
        """Everything needed to go on bit for bit, as named tensors."""
        tensors = {
            "steps_done": torch.tensor(self.steps_done),
            "recent_error": torch.tensor(self._recent_error, dtype=torch.float64),
            "nothing_error": torch.tensor(self._nothing_error, dtype=torch.float64),
            "rate_factor": torch.tensor(self.rate_factor, dtype=torch.float64),
            "views/order": self._order.clone(),
            "views/generator": self._generator.get_state(),
        }
        for ours, theirs in GSPLAT_NAMES.items():
            tensors[f"parameters/{ours}"] = self._parameters[theirs].detach().clone()
            tensors.update(with_prefix(f"optimizers/{ours}/", optimizer_tensors(self._optimizers[theirs])))
        tensors.update(with_prefix("density/", self._density.state_tensors()))
        if self._exposures is not None:
            tensors.update(with_prefix("exposures/", self._exposures.state_tensors()))
        return tensors

    def damage(self) -> str:
        """What is wrong with the parameters, such as "NaN or Inf in means"; nothing where all is well."""
        damage = self.gaussians().damage()
        if not damage and self._exposures is not None and not bool(self._exposures.matrices.isfinite().all()):
            return "NaN or Inf in the exposures"
        return damage

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Go on where `state_dict` was called; scene, config and device must be the same.

        Raises:
            ValueError: If an entry is missing or does not fit the others.
        """
        parameters = check_state(tensors, len(self._names), self.config.iterations)
        self.steps_done = int(tensors["steps_done"])
        self._recent_error = float(tensors["recent_error"])
        self._nothing_error = float(tensors.get("nothing_error", math.nan))
        self._rate_factor = float(tensors.get("rate_factor", 1.0))
        self._order = tensors["views/order"].clone()
        self._generator.set_state(tensors["views/generator"])
        for ours, theirs in GSPLAT_NAMES.items():
            value = parameters[ours].to(self.device, copy=True)
            self._parameters[theirs] = torch.nn.Parameter(value)
        self._optimizers = self._new_optimizers()
        for ours, theirs in GSPLAT_NAMES.items():
            state = below_prefix(f"optimizers/{ours}/", tensors)
            load_optimizer_tensors(self._optimizers[theirs], state)
        self._density.load_state_tensors(below_prefix("density/", tensors))
        if self._exposures is not None:
            self._exposures.load_state_tensors(below_prefix("exposures/", tensors))

    def _initial_parameters(self, start: InitialPoints) -> dict[str, torch.nn.Parameter]:
        points, colors = start.points, start.colors
        if len(points) == 0:
            raise TrainingError(
                "reconstruction", expected="points to start from", found="none", remedy="check the cameras"
            )
        cap = self.config.cap(self.device)
        if len(points) > cap:
            chosen = torch.randperm(len(points), generator=self._generator)[:cap]
            points, colors = points[chosen.numpy()], colors[chosen.numpy()]
        gaussians = gaussians_from_points(
            points,
            colors,
            sh_degree=self.config.sh_degree,
            opacity=self.config.initial_opacity,
            device=self.device,
        )
        tensors = gaussians.tensors()
        return {theirs: torch.nn.Parameter(tensors[ours]) for ours, theirs in GSPLAT_NAMES.items()}

    def _new_optimizers(self) -> dict[str, Adam]:
        rates = self._rates()
        return {theirs: Adam(self._parameters[theirs], rates[ours]) for ours, theirs in GSPLAT_NAMES.items()}

    def _rates(self) -> dict[str, float]:
        return {name: rate * self._rate_factor for name, rate in self.config.rates(self._extent).items()}

    def _as_gaussians(self) -> Gaussians:
        tensors = {ours: self._parameters[theirs] for ours, theirs in GSPLAT_NAMES.items()}
        return Gaussians(**tensors, antialiased=self.config.antialiased)

    def _active_sh_degree(self) -> int:
        every = self.config.sh_degree_every * self.config.iterations / REFERENCE_ITERATIONS
        return min(self.config.sh_degree, int(self.steps_done / every))

    def _means_rate(self) -> float:
        config = self.config
        decay = (config.means_rate_final / config.means_rate) ** (self.steps_done / config.iterations)
        return self._rates()["means"] * decay

    def _next_view(self) -> int:
        """Views come in random permutations, so each is seen equally often."""
        place = self.steps_done % len(self._names)
        if place == 0:
            self._order = torch.randperm(len(self._names), generator=self._generator)
        return int(self._order[place])

    def _training_images(self) -> Any:
        """The photos at the present resolution; those of the warm-up are dropped after it."""
        from lexsplat.reconstruction.photos import TrainingImages

        shrink = 2.0 if self.steps_done < self.config.warm_up_iterations and self._can_shrink else 1.0
        if shrink != self._images_shrink:
            self._images = TrainingImages(
                self._views.values(), memory=self.config.image_memory, shrink=shrink, device=self.device
            )
            self._images_shrink = shrink
        return self._images

    def _regularization(self) -> Tensor | float:
        opacity_weight, scale_weight = self.config.regularizers
        total: Tensor | float = 0.0
        if opacity_weight > 0:
            total = total + opacity_weight * self._parameters["opacities"].sigmoid().mean()
        if scale_weight > 0:
            total = total + scale_weight * self._parameters["scales"].exp().mean() / self._extent
        return total

    def _checks_now(self) -> bool:
        """Reading the loss is free on a CPU; on CUDA it waits for the device: now and then, and at the end."""
        done = self.steps_done + 1
        return self.device.type == "cpu" or done % EVENT_EVERY == 0 or done == self.config.iterations

    def _follow(self, image: Tensor, target: Tensor) -> None:
        """Mean squared errors of recent views, and those that a picture of nothing but background would have.

        Raises:
            TrainingError: If the pictures are much worse than that, which no healthy training is.
        """
        if not self._checks_now():
            return
        errors = torch.mean((image.detach() - target) ** 2), torch.mean((self._background - target) ** 2)
        olds = self._recent_error, self._nothing_error
        self._recent_error, self._nothing_error = (
            float(error) if math.isnan(old) else 0.95 * old + 0.05 * float(error)
            for old, error in zip(olds, errors)
        )
        if self._recent_error > 4 * self._nothing_error + 0.5:
            raise TrainingError(
                "reconstruction",
                expected="pictures that come closer to the photos",
                found=f"a mean squared error of {self._recent_error:.3g} at iteration {self.steps_done + 1}",
                remedy="check the cameras, or lower the learning rates",
            )

    def _optimize(self) -> None:
        self._optimizers["means"].param_groups[0]["lr"] = self._means_rate()
        if self._active_sh_degree() == 0:
            self._parameters["shN"].grad = None
        for optimizer in self._optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if self._exposures is not None:
            self._exposures.optimize()


def check_state(tensors: dict[str, Tensor], views: int, iterations: int) -> dict[str, Tensor]:
    """The parameters (our names) of a `Reconstructor.state_dict`, if all of it fits together.

    Args:
        tensors: What was saved.
        views: Number of training views.
        iterations: Of the whole training.

    Raises:
        ValueError: If an entry is missing or does not fit the others.
    """
    expected = {"steps_done", "recent_error", "views/order", "views/generator", "density/random_state"}
    missing = (expected | {f"parameters/{name}" for name in GSPLAT_NAMES}) - tensors.keys()
    if missing:
        raise ValueError(f"checkpoint lacks {', '.join(sorted(missing))}")
    parameters = {name: tensors[f"parameters/{name}"] for name in GSPLAT_NAMES}
    Gaussians(**parameters, antialiased=False)  # raises if the shapes do not belong together
    if sorted(tensors["views/order"].tolist()) not in ([], list(range(views))):
        raise ValueError("the order of views is of another capture")
    if any(value.dtype != torch.float32 for value in parameters.values()):
        raise ValueError("parameters must be float32")
    statistics = [tensors[name] for name in ("density/grad2d", "density/count") if name in tensors]
    if any(value.shape != parameters["opacity_logits"].shape for value in statistics):
        raise ValueError("the statistics of density control are of other Gaussians")
    if not 0 <= int(tensors["steps_done"]) <= iterations:
        raise ValueError(f"{int(tensors['steps_done'])} of {iterations} iterations")
    if not 0 < float(tensors.get("rate_factor", 1.0)) <= 1:
        raise ValueError(f"learning rates times {float(tensors['rate_factor']):g}")
    return parameters
