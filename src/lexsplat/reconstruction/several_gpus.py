"""One reconstruction on several GPUs under ``torchrun``, with gsplat's distributed rasterizer. Untried on real GPUs.

As in Grendel (On Scaling Up 3D Gaussian Splatting Training), each process keeps a part of the Gaussians with their
optimizers and density control. In a step each process renders a view of its own: it gets the projections of all
Gaussians from the others and returns their gradients.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import distributed

from lexsplat.geometry.cameras import Camera
from lexsplat.geometry.gaussians import Gaussians
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.reconstruction.trainer import Reconstructor
from lexsplat.runtime.errors import TrainingError

if TYPE_CHECKING:
    from lexsplat.captures import Capture
    from lexsplat.captures.sfm.triangulation import InitialPoints
    from lexsplat.rendering import Rendering


class PartReconstructor(Reconstructor):
    """The part of a reconstruction that one process of a group trains; see `Reconstructor`.

    The process group of `torch.distributed` must be open. A step of all processes takes as many views as there are
    processes, so each runs that share of the iterations.

    Args:
        capture: Views of one size, and split.
        config: Settings of the whole.
        points: Initial points of the whole.
        device: Device of this process.
        seed: Seed of the whole.

    Raises:
        TrainingError: If the views differ in size, or a process would have no point or no view.
    """

    def __init__(
        self,
        capture: Capture,
        config: ReconstructionConfig,
        points: InitialPoints,
        *,
        device: torch.device | str = "cuda",
        seed: int = 0,
    ) -> None:
        self._rank, self._ranks = distributed.get_rank(), distributed.get_world_size()
        sizes = {(view.camera.width, view.camera.height) for view in capture.train_views}
        if len(sizes) > 1:
            raise TrainingError(
                "reconstruction on several GPUs",
                expected="photos of one size",
                found=f"{len(sizes)} sizes",
                remedy="crop or scale the photos to one size, or use one GPU",
            )
        if len(capture.train_names) < self._ranks:
            raise TrainingError(
                "reconstruction on several GPUs",
                expected=f"at least {self._ranks} training views",
                found=str(len(capture.train_names)),
                remedy="start fewer processes",
            )
        own = replace(
            points,
            points=points.points[self._rank :: self._ranks],
            colors=points.colors[self._rank :: self._ranks],
        )
        part = replace(
            config,
            iterations=math.ceil(config.iterations / self._ranks),
            max_gaussians=math.ceil(config.cap(torch.device(device)) / self._ranks),
            # The weights of a part alone would not know what the other parts hide.
            renewal=config.renewal if self._ranks == 1 else 0.0,
        )
        if self._ranks > 1 and config.rate_scale is None:
            # The higher rates of a training with a cool-down were measured with one process.
            part = replace(part, rate_scale=replace(part, cool_down=0.0).scale_of_rates)
        super().__init__(capture, part, own, device=device, seed=seed + self._rank)
        self._generator = torch.Generator().manual_seed(seed)  # one order of views in all processes

    def _next_view(self) -> int:
        """Index of the next view of this process; the processes follow one permutation."""
        place = self.steps_done % (len(self._names) // self._ranks)
        if place == 0:
            self._order = torch.randperm(len(self._names), generator=self._generator)
        return int(self._order[place * self._ranks + self._rank])

    def _render(self, gaussians: Gaussians, camera: Camera) -> Rendering:
        from lexsplat.rendering.gsplat_backend import render_distributed

        return render_distributed(gaussians, camera, self._active_sh_degree(), self._background)
