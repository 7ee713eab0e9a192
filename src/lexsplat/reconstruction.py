"""Reconstruction (section 3.1): 3D Gaussians from photos with cameras, by gradient descent on the
photometric loss.

Learning rates, schedules and density control are those of 3DGS; every step number refers to a training of
30,000 iterations and is stretched to the number that is run.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from lexsplat import budget
from lexsplat.densification import REFERENCE_ITERATIONS, DensityControl, density_schedule
from lexsplat.divergence import KEEP_EVERY, Guard
from lexsplat.errors import TrainingError
from lexsplat.exposures import Exposures
from lexsplat.gaussians import Gaussians, gaussians_from_points
from lexsplat.optimizers import (
    Adam,
    below_prefix,
    load_optimizer_tensors,
    optimizer_tensors,
    with_prefix,
)
from lexsplat.progress import Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.checkpoints import Checkpoint
    from lexsplat.scenes import Scene, View
    from lexsplat.scenes.triangulation import InitialPoints

STAGE = "reconstruct"
"""Name of the stage in events."""
EVENT_EVERY = 10
"""Iterations between two events."""
LONG_TRAINING = 15_000
"""From here on opacities are reset and all iterations run at full resolution, unless a setting says otherwise."""
GSPLAT_NAMES = {
    "means": "means",
    "quats": "quats",
    "log_scales": "scales",
    "opacity_logits": "opacities",
    "sh0": "sh0",
    "shN": "shN",
}
"""Our names of the parameters, and those gsplat's strategies look for."""


@dataclass(frozen=True)
class ReconstructionConfig:
    """Settings of the reconstruction; numbers of steps refer to a training of 30,000.

    Args:
        iterations: Optimisation steps, one view each.
        ssim_weight: Weight of 1 - SSIM against L1, in 0..1.
        sh_degree: Highest degree of spherical harmonics, 0..3 (4 where the backend can).
        sh_degree_every: Steps after which the next degree joins.
        strategy: Density control: "default" (3DGS) or "mcmc".
        max_gaussians: Never more than this many; None is 3,000,000 on CUDA and 40,000 on a CPU.
        densify_every: Steps between two rounds of density control.
        densify_min_every: Rounds are never closer than this many actual steps.
        grow_gradient: Mean gradient of projected centres above which "default" adds Gaussians.
        min_opacity: Fainter Gaussians are removed ("default") or moved ("mcmc").
        reset_opacities: Whether "default" lowers all opacities every 3,000 steps; None does so in trainings of at
            least 15,000, which have the time to recover.
        noise: Strength of the noise of "mcmc".
        opacity_weight: Weight of the mean opacity in the loss; None is 0.01 with "mcmc", else 0.
        scale_weight: Weight of the mean standard deviation (relative to the scene) in the loss; None as
            above.
        antialiased: Train and render with the mip filter.
        initial_opacity: Opacity of the first Gaussians.
        warm_up: Share of the iterations that run at half resolution, at the start; None is 0.3 in trainings
            shorter than 15,000, else 0.
        exposure: Fit an affine colour change per training photo, for captures whose exposure varies.
        rate_scale: Factor of all learning rates but that of the opacities; None is the cube root of
            30,000 / iterations, between 1 and 3: a short training takes longer strides.
        means_rate: Learning rate of the centres at the start, relative to the extent of the scene.
        means_rate_final: The same at the end; it decays exponentially.
        scales_rate: Learning rate of the logarithms of the scales.
        quats_rate: Learning rate of the rotations.
        opacities_rate: Learning rate of the opacity logits.
        sh0_rate: Learning rate of the constant colour.
        shN_rate: Learning rate of the other colour coefficients.
        exposure_rate: Learning rate of the colour change.
        image_memory: Bytes for photos kept in memory.
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
    min_opacity: float = 0.005
    reset_opacities: bool | None = None
    noise: float = 5e5
    opacity_weight: float | None = None
    scale_weight: float | None = None
    antialiased: bool = True
    initial_opacity: float = 0.1
    warm_up: float | None = None
    exposure: bool = False
    rate_scale: float | None = None
    means_rate: float = 1.6e-4
    means_rate_final: float = 1.6e-6
    scales_rate: float = 5e-3
    quats_rate: float = 1e-3
    opacities_rate: float = 5e-2
    sh0_rate: float = 2.5e-3
    shN_rate: float = 1.25e-4
    exposure_rate: float = 1e-3
    image_memory: int = 1 << 30

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"iterations must be positive, got {self.iterations}")
        if not 0 <= self.ssim_weight <= 1:
            raise ValueError(f"ssim_weight must be in 0..1, got {self.ssim_weight:g}")
        if not 0 <= self.sh_degree <= 4:
            raise ValueError(f"sh_degree must be in 0..4, got {self.sh_degree}")
        if self.warm_up is not None and not 0 <= self.warm_up <= 1:
            raise ValueError(f"warm_up must be in 0..1, got {self.warm_up:g}")
        if not 0 < self.initial_opacity < 1:
            raise ValueError(f"initial_opacity must be between 0 and 1, got {self.initial_opacity:g}")

    def cap(self, device: torch.device) -> int:
        """`max_gaussians` with nothing left open."""
        if self.max_gaussians is not None:
            return self.max_gaussians
        return 3_000_000 if device.type == "cuda" else 40_000

    @property
    def is_long(self) -> bool:
        """Whether opacities are reset and there is no warm-up, where the settings do not say."""
        return self.iterations >= LONG_TRAINING

    @property
    def warm_up_iterations(self) -> int:
        """Iterations that run at half resolution."""
        share = (0.0 if self.is_long else 0.3) if self.warm_up is None else self.warm_up
        return round(share * self.iterations)

    @property
    def regularisers(self) -> tuple[float, float]:
        """Weights of opacity and scale in the loss."""
        default = 0.01 if self.strategy == "mcmc" else 0.0
        given = (self.opacity_weight, self.scale_weight)
        return tuple(default if weight is None else weight for weight in given)  # type: ignore[return-value]

    def rates(self, extent: float) -> dict[str, float]:
        """Learning rates at the start by parameter (our names)."""
        scale = self.rate_scale
        if scale is None:
            scale = min(3.0, max(1.0, (REFERENCE_ITERATIONS / self.iterations) ** (1 / 3)))
        return {
            "means": scale * self.means_rate * extent,
            "quats": scale * self.quats_rate,
            "log_scales": scale * self.scales_rate,
            "opacity_logits": self.opacities_rate,
            "sh0": scale * self.sh0_rate,
            "shN": scale * self.shN_rate,
        }


def reconstruct(
    scene: Scene,
    config: ReconstructionConfig,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    cache_dir: Path | None = None,
    memory: int = budget.DEFAULT_MEMORY,
    checkpoint: Checkpoint | None = None,
    listener: Listener = silent,
) -> Gaussians:
    """Train Gaussians on the training views of a scene.

    Args:
        scene: Views, split, and the points to start from; where it has none they are triangulated.
        config: Settings.
        device: Where to train.
        seed: Of the order of views, of density control and of what replaces missing points.
        cache_dir: Where triangulated points are kept for the next call; None keeps nothing.
        memory: Bytes of host memory that the triangulation, and then the Gaussians, may take.
        checkpoint: Where the training is saved on the way, and goes on from.
        listener: Hears an event of stage "reconstruct" every ten iterations, with "psnr" (recent training
            views) and "gaussians".

    Raises:
        TrainingError: If there is nothing to train on or the optimisation diverges.
        CaptureError: If a photo cannot be read.
        MemoryBudgetError: If the Gaussians, or the photos while they are triangulated, do not fit into ``memory``.
    """
    from lexsplat.scenes.triangulation import initial_points

    check_gaussians(config, device, memory)
    points = initial_points(scene, seed=seed, cache_dir=cache_dir, memory=memory, listener=listener)
    trainer = Reconstructor(scene, config, points, device=device, seed=seed)
    if checkpoint is not None:
        checkpoint.resume(trainer)
    trainer.run(listener, checkpoint)
    return trainer.gaussians()


def check_gaussians(config: ReconstructionConfig, device: torch.device | str, memory: int) -> None:
    """Refuse to train more Gaussians on the host than half of the budget holds: the rest is for photos.

    Raises:
        MemoryBudgetError: With the number that it holds.
    """
    cap = config.cap(torch.device(device))
    if torch.device(device).type != "cpu":
        return
    room = memory // 2 // budget.GAUSSIAN_BYTES
    need = 2 * budget.gaussian_bytes(cap)
    what, remedy = f"{cap:,} Gaussians beside the photos", f"reconstruction.max-gaussians {room}"
    budget.require("reconstruct", need, memory, what, remedy)


class Reconstructor:
    """A training that can be stepped, saved and resumed bit for bit.

    Args:
        scene: Views and split.
        config: Settings.
        points: Where Gaussians start, from `lexsplat.scenes.triangulation.initial_points`.
        device: Where to train.
        seed: Of the order of views and of density control.

    Raises:
        TrainingError: If there is no training view or no point.
    """

    def __init__(
        self,
        scene: Scene,
        config: ReconstructionConfig,
        points: InitialPoints,
        *,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        self.config = config
        self.device = torch.device(device)
        self.steps_done = 0
        self._views = {view.name: view for view in scene.train_views}
        self._names = sorted(self._views)
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
        """Factor of all learning rates: halved whenever the training diverges (`lexsplat.divergence`)."""
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
        from lexsplat.image_losses import photometric_loss
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
        loss = photometric_loss(image, target, self.config.ssim_weight) + self._regularisation()
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

    @torch.no_grad()
    def evaluate(self, views: Iterable[View]) -> float:
        """Mean PSNR in dB over views, at the size of their cameras.

        Raises:
            ValueError: If there is no view.
        """
        from lexsplat.metrics import psnr
        from lexsplat.rendering import render

        scores = []
        gaussians = self.gaussians()
        for view in views:
            image = render(gaussians, view.camera, background=self._background).image
            photo = torch.from_numpy(view.load_image()).to(self.device)
            valid = view.load_valid()
            if valid is not None:
                image, photo = image[valid], photo[valid]
            scores.append(psnr(image.clamp(0, 1).cpu().numpy(), photo.cpu().numpy()))
        if not scores:
            raise ValueError("no views to evaluate on")
        return sum(scores) / len(scores)

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
        expected = {"steps_done", "recent_error", "views/order", "views/generator", "density/random_state"}
        missing = (expected | {f"parameters/{name}" for name in GSPLAT_NAMES}) - tensors.keys()
        if missing:
            raise ValueError(f"checkpoint lacks {', '.join(sorted(missing))}")
        parameters = {name: tensors[f"parameters/{name}"] for name in GSPLAT_NAMES}
        Gaussians(**parameters, antialiased=False)  # raises if the shapes do not belong together
        if sorted(tensors["views/order"].tolist()) not in ([], list(range(len(self._names)))):
            raise ValueError("the order of views is of another capture")
        if any(value.dtype != torch.float32 for value in parameters.values()):
            raise ValueError("parameters must be float32")
        statistics = [tensors[name] for name in ("density/grad2d", "density/count") if name in tensors]
        if any(value.shape != parameters["opacity_logits"].shape for value in statistics):
            raise ValueError("the statistics of density control are of other Gaussians")
        if not 0 <= int(tensors["steps_done"]) <= self.config.iterations:
            raise ValueError(f"{int(tensors['steps_done'])} of {self.config.iterations} iterations")
        if not 0 < float(tensors.get("rate_factor", 1.0)) <= 1:
            raise ValueError(f"learning rates times {float(tensors['rate_factor']):g}")
        self.steps_done = int(tensors["steps_done"])
        self._recent_error = float(tensors["recent_error"])
        self._nothing_error = float(tensors.get("nothing_error", math.nan))
        self._rate_factor = float(tensors.get("rate_factor", 1.0))
        self._order = tensors["views/order"].clone()
        self._generator.set_state(tensors["views/generator"])
        for ours, theirs in GSPLAT_NAMES.items():
            value = tensors[f"parameters/{ours}"].to(self.device, copy=True)
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
        from lexsplat.training_images import TrainingImages

        shrink = 2.0 if self.steps_done < self.config.warm_up_iterations else 1.0
        if shrink != self._images_shrink:
            self._images = TrainingImages(
                self._views.values(), memory=self.config.image_memory, shrink=shrink, device=self.device
            )
            self._images_shrink = shrink
        return self._images

    def _regularisation(self) -> Tensor | float:
        opacity_weight, scale_weight = self.config.regularisers
        total: Tensor | float = 0.0
        if opacity_weight > 0:
            total = total + opacity_weight * self._parameters["opacities"].sigmoid().mean()
        if scale_weight > 0:
            total = total + scale_weight * self._parameters["scales"].exp().mean() / self._extent
        return total

    def _checks_now(self) -> bool:
        """Reading the loss is free on a CPU; on CUDA it waits for the device, so only now and then."""
        return self.device.type == "cpu" or self.steps_done % EVENT_EVERY == EVENT_EVERY - 1

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
