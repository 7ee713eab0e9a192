"""The training photos, loaded on first use and cached as bytes within a memory budget.

The cache never evicts: views are visited in random order, in which a least-recently-used cache would almost always
miss. A photo has the same values (8 bits per channel) whether it comes from the cache or from its file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.cameras import Camera
from lexsplat.reconstruction.image_losses import SSIMTarget, ssim_target

if TYPE_CHECKING:
    from lexsplat.captures import View

Window = tuple[float, float, float, float]
"""Part of an image: left, top, right and lower end, as shares of its width and height in 0..1."""
WHOLE: Window = (0.0, 0.0, 1.0, 1.0)


class TrainingImages:
    """Photos and their SSIM moments by view name, for one image size at a time.

    Args:
        views: All training views.
        memory: Budget of the cache in bytes of host or device memory. Photos and their masks have priority; SSIM
            moments, which are eight times as large and quick to recompute, take the rest.
        shrink: Factor by which images are smaller than the views' cameras.
        device: Device of the targets.
        windows: Parts of views that are trained on; views that are not named are trained on as a whole.
    """

    def __init__(
        self,
        views: Iterable[View],
        *,
        memory: int,
        shrink: float = 1.0,
        device: torch.device | str = "cpu",
        windows: Mapping[str, Window] | None = None,
    ) -> None:
        self._views = {view.name: view for view in views}
        self._device = torch.device(device)
        self._whole = {
            name: view.camera if shrink == 1.0 else view.camera.downscaled(shrink)
            for name, view in self._views.items()
        }
        self._windows = {name: (windows or {}).get(name, WHOLE) for name in self._views}
        self._cameras = {name: cropped(self._whole[name], part) for name, part in self._windows.items()}
        pixels = sum(camera.width * camera.height for camera in self._cameras.values())
        self._photo_room = memory
        self._moment_room = max(0, memory - 3 * pixels)
        self._photos: dict[str, Tensor] = {}
        self._valid: dict[str, Tensor | None] = {}
        self._moments: dict[str, tuple[Tensor, Tensor]] = {}

    def camera(self, name: str) -> Camera:
        """Camera of the view, with the size of its training image."""
        return self._cameras[name]

    def share(self, name: str) -> float:
        """Share of the view's pixels that its training image has, in 0..1."""
        part, whole = self._cameras[name], self._whole[name]
        return part.width * part.height / (whole.width * whole.height)

    def whole_size(self, name: str) -> tuple[int, int]:
        """Width and height of the view of which the training image is a part."""
        return self._whole[name].width, self._whole[name].height

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
            mask = self._views[name].load_valid(self.whole_size(name))
            valid = None if mask is None else torch.from_numpy(self._part(name, mask)).to(self._device)
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
        image = self._part(name, self._views[name].load_image(self.whole_size(name)))
        photo = torch.from_numpy(np.round(image * 255.0).astype(np.uint8)).to(self._device)
        if photo.nbytes <= self._photo_room:
            self._photo_room -= photo.nbytes
            self._photos[name] = photo
        return photo

    def _part(self, name: str, image: NDArray) -> NDArray:
        """The window of a view's image ``[H, W, ...]``."""
        left, top, right, bottom = _pixels(self._whole[name], self._windows[name])
        return np.ascontiguousarray(image[top:bottom, left:right])


def cropped(camera: Camera, window: Window) -> Camera:
    """The camera of a part of the image, rounded to whole pixels."""
    left, top, right, bottom = _pixels(camera, window)
    K = camera.K.copy()
    K[:2, 2] -= left, top
    return replace(camera, width=right - left, height=bottom - top, K=K)


def _pixels(camera: Camera, window: Window) -> tuple[int, int, int, int]:
    left, top, right, bottom = np.round(np.multiply(window, (camera.width, camera.height) * 2)).astype(int)
    return int(left), int(top), int(max(right, left + 1)), int(max(bottom, top + 1))
