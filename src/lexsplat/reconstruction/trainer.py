"""The training of the Gaussians (section 3.1), step by step; it can be saved and resumed bit for bit."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from lexsplat.geometry.gaussians import TENSORS, Gaussians, gaussians_from_points
from lexsplat.reconstruction.densification import STATISTICS, DensityControl
from lexsplat.reconstruction.exposures import Exposures
from lexsplat.reconstruction.few_photos import has_few_photos
from lexsplat.reconstruction.optimizers import (
    adam,
    below_prefix,
    load_optimizer_tensors,
    optimizer_tensors,
    with_prefix,
)
from lexsplat.reconstruction.settings import REFERENCE_ITERATIONS, ReconstructionConfig
from lexsplat.runtime.errors import TrainingError
from lexsplat.runtime.memory import DEFAULT_MEMORY
from lexsplat.runtime.progress import Listener, silent
from lexsplat.runtime.sampling import evenly
from lexsplat.runtime.training import run_training

if TYPE_CHECKING:
    from pathlib import Path

    from lexsplat.captures import Capture
    from lexsplat.captures.sfm.triangulation import InitialPoints
    from lexsplat.geometry.cameras import Camera
    from lexsplat.reconstruction.photos import TrainingImages
    from lexsplat.rendering import Rendering
    from lexsplat.runtime.training import Checkpoint

STAGE = "reconstruct"
"""Name of the stage in events."""
WEIGHED_VIEWS = 24
"""Training views, evenly chosen, that decide which Gaussians are renewed."""
EVENT_EVERY = 10
"""Iterations between two events."""
PHOTO_BYTES_MAX = 1 << 30
"""Upper limit of the memory for cached photos, whatever the budget."""


class Reconstructor:
    """A reconstruction that can be stepped, saved and resumed bit for bit.

    Args:
        capture: Views and split.
        config: Settings.
        points: Initial points, from `lexsplat.captures.sfm.triangulation.initial_points`.
        device: Device of the training.
        seed: Seed of the view order and of density control.
        memory: Total budget in bytes. Cached photos take a quarter of it, at most 1 GiB; the budget does not
            affect the result.
        extent: Scene scale, if it is not that of the capture's training views.

    Raises:
        TrainingError: If there is no training view or no point.
    """

    parameter_prefixes: tuple[str, ...] = ("parameters/", "exposures/")

    def __init__(
        self,
        capture: Capture,
        config: ReconstructionConfig,
        points: InitialPoints,
        *,
        device: torch.device | str = "cpu",
        seed: int = 0,
        memory: int = DEFAULT_MEMORY,
        extent: float | None = None,
    ) -> None:
        from lexsplat.reconstruction.image_losses import SMALLEST_SIDE

        config = self.config = config.for_photos(has_few_photos(capture))
        self.device = torch.device(device)
        self.steps_done = 0
        self._photo_bytes = min(PHOTO_BYTES_MAX, memory // 4)
        self._photo_folder: Path | None = None
        self._views = {view.name: view for view in capture.train_views}
        self._names = sorted(self._views)
        halves = [view.camera.downscaled(2.0) for view in self._views.values()]
        self._can_shrink = all(min(half.width, half.height) >= SMALLEST_SIDE for half in halves)
        if not self._names:
            raise TrainingError(
                capture.root,
                expected="at least one training view",
                found="none",
                remedy="hold out fewer views",
            )
        self._extent = capture.extent if extent is None else extent
        self._background = torch.tensor(capture.background, dtype=torch.float32, device=self.device)
        self._generator = torch.Generator().manual_seed(seed)
        self._order = torch.empty(0, dtype=torch.int64)
        self._recent_error = self._background_error = float("nan")
        self._rate_factor = 1.0
        self._parameters = self._initial_parameters(points)
        self._optimizers = self._new_optimizers()
        self._exposures = None
        if config.exposure:
            self._exposures = Exposures(len(self._names), config.exposure_rate, self.device)
        self._density = DensityControl(config, self._extent, seed=seed, device=self.device)
        self._images: TrainingImages | None = None
        self._images_shrink = 0.0
        self._background_errors: dict[str, float] = {}
        self.last_view = ""
        """Name of the view of the last step."""
        self.tracks_origins = False
        """Whether `origins` is filled; joint training turns it on."""
        self.origins: Tensor | None = None
        """If the last step changed the set of Gaussians: the previous index ``[N]`` of each one, or of its parent."""

    @property
    def done(self) -> bool:
        """Whether all iterations have run."""
        return self.steps_done >= self.config.iterations

    @property
    def total_steps(self) -> int:
        """Number of iterations."""
        return self.config.iterations

    @property
    def rate_factor(self) -> float:
        """Factor of all learning rates; halved whenever the training diverges (`lexsplat.runtime.training`)."""
        return self._rate_factor

    @rate_factor.setter
    def rate_factor(self, factor: float) -> None:
        self._rate_factor = factor
        for name, rate in self._rates().items():
            self._optimizers[name].param_groups[0]["lr"] = rate

    @property
    def metrics(self) -> dict[str, float]:
        """PSNR of recent training views in dB, and the number of Gaussians."""
        psnr = -10.0 * math.log10(max(self._recent_error, 1e-12)) if self.steps_done else float("nan")
        return {"psnr": psnr, "gaussians": float(len(self._parameters["means"]))}

    def run(self, listener: Listener = silent, checkpoint: Checkpoint | None = None) -> None:
        """Run the remaining iterations; ``checkpoint`` resumes the training and saves it between iterations."""
        run_training(
            self,
            stage=STAGE,
            name="reconstruction",
            every=EVENT_EVERY,
            checkpoint=checkpoint,
            listener=listener,
        )

    def gaussians(self) -> Gaussians:
        """The present Gaussians without gradient history; they share memory with the training."""
        return self._as_gaussians().detach()

    def step(self) -> float:
        """Run one iteration on one view.

        Returns:
            The loss; 0 where it was not read from the GPU (`reads_loss`).

        Raises:
            TrainingError: If the loss is not finite, the images diverge, or no Gaussian is left.
        """
        from lexsplat.reconstruction.image_losses import photometric_loss

        index = self._next_view()
        images = self._training_images()
        name = self._names[index]
        camera, target = images.camera(name), images.target(name)
        rendering = self._render(self._as_gaussians(), camera)
        image = rendering.image
        if self._exposures is not None:
            image = self._exposures.apply(image, index)
        valid = images.valid(name)
        if valid is not None:
            image = torch.where(valid[..., None], image, target.image)
        loss = photometric_loss(image, target, self.config.ssim_weight)
        loss = loss + self._regularization()
        loss.backward()
        value = loss.item() if self.reads_loss(self.steps_done + 1) else 0.0
        if not math.isfinite(value):
            raise TrainingError(
                "reconstruction",
                expected="a finite loss",
                found=f"{value} at iteration {self.steps_done + 1}",
                remedy="check the cameras, or lower the learning rates",
            )
        self._update_errors(name, image, target.image, valid)
        self._optimize()
        self._control_density(rendering.means2d, rendering.radii, (camera.width, camera.height))
        self.last_view = name
        if len(self._parameters["means"]) == 0:
            raise TrainingError(
                "reconstruction",
                expected="Gaussians",
                found=f"none left at iteration {self.steps_done + 1}",
                remedy="check the cameras and points, or lower min_opacity",
            )
        self.steps_done += 1
        return value

    def _render(self, gaussians: Gaussians, camera: Camera) -> Rendering:
        from lexsplat.rendering import render

        return render(gaussians, camera, sh_degree=self._active_sh_degree(), background=self._background)

    def _control_density(self, means2d: Tensor, radii: Tensor, image_size: tuple[int, int]) -> None:
        """Run density control and record the origins of the Gaussians if they are tracked.

        To track them, an index that is never trained is copied, split and removed along with the parameters.
        Indices are exact in float32 up to 16 million.
        """
        number = self._density.number_to_renew(self.steps_done)
        idle = self._of_least_weight(number) if number else None
        tracked = self.tracks_origins and self._density.refines_at(self.steps_done)
        if tracked:
            indices = torch.arange(len(self._parameters["means"]), dtype=torch.float32, device=self.device)
            self._parameters["origins"] = torch.nn.Parameter(indices, requires_grad=False)
            self._optimizers["origins"] = adam(self._parameters["origins"], 0.0)
        self._density.step(
            self._parameters,
            self._optimizers,
            self.steps_done,
            means2d=means2d,
            radii=radii,
            image_size=image_size,
            means_learning_rate=self._means_rate(),
            idle=idle,
        )
        self.origins = None
        if tracked:
            del self._optimizers["origins"]
            self.origins = self._parameters.pop("origins").detach().long()

    def _of_least_weight(self, number: int) -> Tensor:
        """Mask of the ``number`` Gaussians of the least blending weight, summed over evenly chosen views."""
        from lexsplat.rendering import accumulate_weights

        gaussians = self.gaussians()
        weights = torch.zeros(len(gaussians), device=self.device)
        for name in evenly(self._names, WEIGHED_VIEWS):
            weights += accumulate_weights(gaussians, self._views[name].camera)
        mask = torch.zeros(len(weights), dtype=torch.bool, device=self.device)
        mask[torch.argsort(weights, stable=True)[:number]] = True
        return mask

    def state_dict(self) -> dict[str, Tensor]:
        """Everything needed to continue bit for bit, as named tensors."""
        tensors = {
            "steps_done": torch.tensor(self.steps_done),
            "recent_error": torch.tensor(self._recent_error, dtype=torch.float64),
            "nothing_error": torch.tensor(self._background_error, dtype=torch.float64),
            "rate_factor": torch.tensor(self.rate_factor, dtype=torch.float64),
            "views/order": self._order.clone(),
            "views/generator": self._generator.get_state(),
        }
        for name, parameter in self._parameters.items():
            tensors[f"parameters/{name}"] = parameter.detach().clone()
            tensors.update(with_prefix(f"optimizers/{name}/", optimizer_tensors(self._optimizers[name])))
        tensors.update(with_prefix("density/", self._density.state_tensors()))
        if self._exposures is not None:
            tensors.update(with_prefix("exposures/", self._exposures.state_tensors()))
        return tensors

    def find_invalid(self) -> str:
        """The first defect of the parameters, such as "NaN or Inf in means"; empty if there is none."""
        finite = self._exposures is None or bool(self._exposures.matrices.isfinite().all())
        return self.gaussians().find_invalid() or ("" if finite else "NaN or Inf in the exposures")

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Continue where `state_dict` was called; capture, settings and device must be the same.

        Raises:
            ValueError: If an entry is missing or does not fit the others.
        """
        parameters = check_state(tensors, len(self._names), self.config.iterations)
        self.steps_done = int(tensors["steps_done"])
        self._recent_error = float(tensors["recent_error"])
        self._background_error = float(tensors.get("nothing_error", math.nan))
        self._rate_factor = float(tensors.get("rate_factor", 1.0))
        self._order = tensors["views/order"].clone()
        self._generator.set_state(tensors["views/generator"])
        for name in TENSORS:
            self._parameters[name] = torch.nn.Parameter(parameters[name].to(self.device, copy=True))
        self._optimizers = self._new_optimizers()
        for name, optimizer in self._optimizers.items():
            load_optimizer_tensors(optimizer, below_prefix(f"optimizers/{name}/", tensors))
        self._density.load_state_tensors(below_prefix("density/", tensors))
        if self._exposures is not None:
            self._exposures.load_state_tensors(below_prefix("exposures/", tensors))

    def _initial_parameters(self, start: InitialPoints) -> dict[str, torch.nn.Parameter]:
        gaussians = initial_gaussians(self.config, start, self.device, self._generator)
        return {name: torch.nn.Parameter(value) for name, value in gaussians.tensors().items()}

    def _new_optimizers(self) -> dict[str, torch.optim.Adam]:
        return {name: adam(self._parameters[name], rate) for name, rate in self._rates().items()}

    def _rates(self) -> dict[str, float]:
        factor = self._rate_factor * self.config.cooling(self.steps_done)
        return {name: rate * factor for name, rate in self.config.rates(self._extent).items()}

    def _as_gaussians(self) -> Gaussians:
        return Gaussians(**self._parameters, antialiased=self.config.antialiased)

    def _active_sh_degree(self) -> int:
        every = self.config.sh_degree_every * self.config.iterations / REFERENCE_ITERATIONS
        return min(self.config.sh_degree, int(self.steps_done / every))

    def _means_rate(self) -> float:
        config = self.config
        decay = (config.means_rate_final / config.means_rate) ** (self.steps_done / config.iterations)
        return self._rates()["means"] * decay

    def _next_view(self) -> int:
        """Index of the next view; views follow random permutations, so each is visited equally often."""
        place = self.steps_done % len(self._names)
        if place == 0:
            self._order = torch.randperm(len(self._names), generator=self._generator)
        return int(self._order[place])

    def _training_images(self) -> TrainingImages:
        """The photos at the present resolution; those of the warm-up are freed after it."""
        from lexsplat.reconstruction.photos import TrainingImages

        shrink = 2.0 if self.steps_done < self.config.warm_up_iterations and self._can_shrink else 1.0
        if self._images is None or shrink != self._images_shrink:
            self._images = TrainingImages(
                self._views.values(),
                memory=self._photo_bytes,
                shrink=shrink,
                device=self.device,
                folder=self._photo_folder,
            )
            self._images_shrink = shrink
            self._background_errors.clear()
        return self._images

    def _regularization(self) -> Tensor | float:
        total: Tensor | float = 0.0
        if weight := self.config.opacity_weight:
            total = total + weight * self._parameters["opacity_logits"].sigmoid().mean()
        if weight := self.config.scale_weight:
            total = total + weight * self._parameters["log_scales"].exp().mean() / self._extent
        return total

    def reads_loss(self, done: int) -> bool:
        """Whether step ``done`` reads its loss: always on a CPU, every few steps on CUDA, where reading waits."""
        return self.device.type == "cpu" or done % EVENT_EVERY == 0 or done == self.config.iterations

    def _update_errors(self, name: str, image: Tensor, target: Tensor, valid: Tensor | None) -> None:
        """Update the running mean squared errors of the renderings and of the bare background, at unmasked pixels.

        Raises:
            TrainingError: If the renderings are much worse than the background, which means divergence.
        """
        if not self.reads_loss(self.steps_done + 1) or (valid is not None and not valid.any()):
            return
        if name not in self._background_errors:
            self._background_errors[name] = _mean_square(self._background - target, valid)
        errors = _mean_square(image.detach() - target, valid), self._background_errors[name]
        olds = self._recent_error, self._background_error
        self._recent_error, self._background_error = (
            error if math.isnan(old) else 0.95 * old + 0.05 * error for old, error in zip(olds, errors)
        )
        if self._recent_error > 4 * self._background_error + 0.5:
            raise TrainingError(
                "reconstruction",
                expected="renderings that approach the photos",
                found=f"a mean squared error of {self._recent_error:.3g} at iteration {self.steps_done + 1}",
                remedy="check the cameras, or lower the learning rates",
            )

    def _optimize(self) -> None:
        for name, rate in (self._rates() | {"means": self._means_rate()}).items():
            self._optimizers[name].param_groups[0]["lr"] = rate
        if self._active_sh_degree() == 0:
            self._parameters["shN"].grad = None
        for optimizer in self._optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if self._exposures is not None:
            self._exposures.optimize()


def _mean_square(difference: Tensor, valid: Tensor | None) -> float:
    values = (difference if valid is None else difference[valid]).flatten()
    return float(values.dot(values)) / len(values)


def initial_gaussians(
    config: ReconstructionConfig, start: InitialPoints, device: torch.device, generator: torch.Generator
) -> Gaussians:
    """The Gaussians that a training begins with: one a point, of a random choice within the cap.

    Raises:
        TrainingError: If there are no points.
    """
    points, colors = start.points, start.colors
    if len(points) == 0:
        raise TrainingError(
            "reconstruction", expected="initial points", found="none", remedy="check the cameras"
        )
    if len(points) > (cap := config.cap(device)):
        chosen = torch.randperm(len(points), generator=generator)[:cap]
        points, colors = points[chosen.numpy()], colors[chosen.numpy()]
    return gaussians_from_points(
        points, colors, sh_degree=config.sh_degree, opacity=config.initial_opacity, device=device
    )


def check_state(tensors: dict[str, Tensor], views: int, iterations: int) -> dict[str, Tensor]:
    """Validate a `Reconstructor.state_dict` and return its parameters by our names.

    Args:
        tensors: The saved state.
        views: Number of training views.
        iterations: Number of iterations of the whole training.

    Raises:
        ValueError: If an entry is missing or does not fit the others.
    """
    expected = {"steps_done", "recent_error", "views/order", "views/generator", "density/random_state"}
    missing = (expected | {f"parameters/{name}" for name in TENSORS}) - tensors.keys()
    if missing:
        raise ValueError(f"checkpoint lacks {', '.join(sorted(missing))}")
    parameters = {name: tensors[f"parameters/{name}"] for name in TENSORS}
    Gaussians(**parameters, antialiased=False)  # raises if the shapes are inconsistent
    if sorted(tensors["views/order"].tolist()) not in ([], list(range(views))):
        raise ValueError("the view order belongs to another capture")
    if any(value.dtype != torch.float32 for value in parameters.values()):
        raise ValueError("parameters must be float32")
    statistics = [tensors[name] for name in (f"density/{name}" for name in STATISTICS) if name in tensors]
    if any(value.shape != parameters["opacity_logits"].shape for value in statistics):
        raise ValueError("the statistics of density control belong to other Gaussians")
    if not 0 <= int(tensors["steps_done"]) <= iterations:
        raise ValueError(f"steps_done must be in 0..{iterations}, got {int(tensors['steps_done'])}")
    if not 0 < float(tensors.get("rate_factor", 1.0)) <= 1:
        raise ValueError(f"rate_factor must be in (0, 1], got {float(tensors['rate_factor']):g}")
    return parameters
