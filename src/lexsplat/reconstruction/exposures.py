"""Exposure compensation: an affine color map per photo, optimized together with the scene."""

from __future__ import annotations

import torch
from torch import Tensor

from lexsplat.reconstruction.optimizers import (
    adam,
    below_prefix,
    load_optimizer_tensors,
    optimizer_tensors,
    with_prefix,
)


class Exposures:
    """An affine color map ``[3, 4]`` per training photo, initially the identity.

    Photos of one capture can differ in exposure and white balance. Without compensation, the difference turns into
    view-dependent color or haze.

    Args:
        count: Number of training photos.
        rate: Learning rate.
        device: Device of the rendered images.
    """

    def __init__(self, count: int, rate: float, device: torch.device | str) -> None:
        self.matrices = torch.nn.Parameter(torch.eye(3, 4, device=device).repeat(count, 1, 1))
        self._optimizer = adam(self.matrices, rate)

    def apply(self, image: Tensor, index: int) -> Tensor:
        """A rendered image ``[H, W, 3]`` with the colors of photo ``index``."""
        matrix = self.matrices[index]
        return image @ matrix[:, :3].T + matrix[:, 3]

    def optimize(self) -> None:
        """Step, then remove the mean change, so that the scene keeps the average exposure of all photos."""
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            identity = torch.eye(3, 4, device=self.matrices.device)
            self.matrices.add_(identity - self.matrices.mean(0))

    def state_tensors(self) -> dict[str, Tensor]:
        """Everything `load_state_tensors` needs to continue bit for bit."""
        state = with_prefix("optimizer/", optimizer_tensors(self._optimizer))
        return {"matrices": self.matrices.detach().clone(), **state}

    def load_state_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Continue where `state_tensors` was called.

        Raises:
            ValueError: If the state belongs to another number of photos.
        """
        if "matrices" not in tensors or tensors["matrices"].shape != self.matrices.shape:
            raise ValueError("the state of the exposures does not fit")
        with torch.no_grad():
            self.matrices.copy_(tensors["matrices"])
        self.matrices.grad = None
        load_optimizer_tensors(self._optimizer, below_prefix("optimizer/", tensors))
