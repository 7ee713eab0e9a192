"""The training photos, loaded on first use and cached as bytes within a memory budget.

The cache never evicts: views are visited in random order, in which a least-recently-used cache would almost always
miss. A photo has the same values (8 bits per channel) whether it comes from the cache or from its file. Blocks load
their photos anew in each visit; reduced photos are small and slow to make, so that they are kept on disk as well.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.reconstruction.image_losses import SSIMTarget, ssim_target
from lexsplat.runtime.files import atomic_path
from lexsplat.runtime.fingerprints import fingerprint

if TYPE_CHECKING:
    from lexsplat.captures import View


class TrainingImages:
    """Photos and their SSIM moments by view name, for one image size at a time.

    Args:
        views: All training views.
        memory: Budget of the cache in bytes of host or device memory. Photos and their masks have priority; SSIM
            moments, which are eight times as large and quick to recompute, take the rest.
        shrink: Factor by which images are smaller than the views' cameras.
        device: Device of the targets.
        folder: Folder that keeps photos of at most a quarter of the pixels of their files; None keeps none.
    """

    def __init__(
        self,
        views: Iterable[View],
        *,
        memory: int,
        shrink: float = 1.0,
        device: torch.device | str = "cpu",
        folder: Path | None = None,
    ) -> None:
        self._folder = folder
        self._views = {view.name: view for view in views}
        self._device = torch.device(device)
        self._cameras = {
            name: view.camera if shrink == 1.0 else view.camera.downscaled(shrink)
            for name, view in self._views.items()
        }
        pixels = sum(camera.width * camera.height for camera in self._cameras.values())
        self._photo_room = memory
        self._moment_room = max(0, memory - 3 * pixels)
        self._photos: dict[str, Tensor] = {}
        self._valid: dict[str, Tensor | None] = {}
        self._moments: dict[str, tuple[Tensor, Tensor]] = {}

    def camera(self, name: str) -> Camera:
        """Camera of the view, with the size of its training image."""
        return self._cameras[name]

    def target(self, name: str) -> SSIMTarget:
        """The photo of a view with its SSIM moments.

        Raises:
            CaptureError: If the image file cannot be read.
        """
        image = self._photo(name).to(torch.float32).div_(255.0)
        if name in self._moments:
            return SSIMTarget(image, *self._moments[name])
        target = ssim_target(image)
        size = target.mean.nbytes + target.variance.nbytes
        if size <= self._moment_room:
            self._moment_room -= size
            self._moments[name] = (target.mean, target.variance)
        return target

    def valid(self, name: str) -> Tensor | None:
        """Pixels of a view that contribute to the loss, ``[H, W]`` bool; None for all."""
        if name not in self._valid:
            camera = self._cameras[name]
            mask = self._views[name].load_valid((camera.width, camera.height))
            valid = None if mask is None else torch.from_numpy(mask).to(self._device)
            size = 0 if valid is None else valid.nbytes
            if size > self._photo_room:
                return valid
            self._photo_room -= size
            self._moment_room = max(0, self._moment_room - size)
            self._valid[name] = valid
        return self._valid[name]

    @property
    def cached_bytes(self) -> int:
        """Present size of the cache in bytes."""
        moments = sum(mean.nbytes + variance.nbytes for mean, variance in self._moments.values())
        masks = sum(valid.nbytes for valid in self._valid.values() if valid is not None)
        return moments + masks + sum(photo.nbytes for photo in self._photos.values())

    def _photo(self, name: str) -> Tensor:
        if name in self._photos:
            return self._photos[name]
        view, camera = self._views[name], self._cameras[name]
        photo = torch.from_numpy(self._pixels(view, (camera.width, camera.height))).to(self._device)
        if photo.nbytes <= self._photo_room:
            self._photo_room -= photo.nbytes
            self._photos[name] = photo
        return photo

    def _pixels(self, view: View, size: tuple[int, int]) -> NDArray[np.uint8]:
        """A photo ``[H, W, 3]`` in 8 bits, from the folder if it is there."""
        kept = None
        if self._folder is not None and 4 * size[0] * size[1] <= view.capture_size[0] * view.capture_size[1]:
            kept = self._folder / f"{fingerprint(view.name, size)}.npy"
            with contextlib.suppress(OSError, ValueError, EOFError):  # not there, or damaged
                pixels = np.load(kept, allow_pickle=False)
                if pixels.shape == (size[1], size[0], 3) and pixels.dtype == np.uint8:
                    return pixels
        pixels = np.round(view.load_image(size) * 255.0).astype(np.uint8)
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(kept) as path, open(path, "wb") as file:
                np.save(file, pixels)
        return pixels
