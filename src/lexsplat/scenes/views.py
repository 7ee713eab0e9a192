"""The views of a scene as its folder stores them, and their names."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lexsplat.captures.capture import stem_of
from lexsplat.captures.images.undistortion import MAX_SIDE
from lexsplat.captures.readers.camera_files import MAX_COORDINATE, checked_name
from lexsplat.captures.splits import match_stem
from lexsplat.geometry.cameras import Camera
from lexsplat.runtime.errors import QueryError

if TYPE_CHECKING:
    from lexsplat.captures.images.undistortion import Lens


@dataclasses.dataclass(frozen=True)
class PhotoLens:
    """The lens of a view's photo, as the capture gives it: a `Lens` that is not checked before it is used.

    Args:
        model: Name of the camera model in COLMAP, such as ``"OPENCV"``.
        width: Width of the photo in pixels.
        height: Its height in pixels.
        params: The model's parameters in COLMAP's order; lengths in pixels of the photo, pixel centers at +0.5.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @classmethod
    def of(cls, lens: Lens) -> PhotoLens:
        """A lens of a capture."""
        return cls(lens.model, lens.width, lens.height, lens.params)

    def pixels(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels of the photo ``[N, 2]`` of rays ``[N, 3]`` in the axes of the camera, with the lens's distortion.

        Raises:
            ValueError: If the parameters are not those of a camera.
        """
        from lexsplat.captures.images.undistortion import Lens

        lens = Lens(self.model, self.width, self.height, self.params)
        return np.asarray(lens.to_pycolmap().img_from_cam(rays), np.float64).reshape(-1, 2)


@dataclasses.dataclass(frozen=True)
class StoredView:
    """A view as the scene folder stores it: enough to render, without the photo.

    Args:
        name: Name of the photo, relative to the image folder.
        camera: The pinhole camera of the view: that of the photo after undistortion, at the size of the scene.
        split: "train" or "test".
        photo: The lens of the photo; None in scenes that were built before lenses were kept.
    """

    name: str
    camera: Camera
    split: str
    photo: PhotoLens | None = None

    def to_photo(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """The pixels of the photo that pixels of the view show.

        The photo is the file that the cameras belong to, with the distortion of its lens, at full size. A photo that
        is stored rotated, and whose cameras are estimated, is meant upright.

        Args:
            pixels: Pixels of the view ``[..., 2]``, x from the left and y from the top; the first center is at 0.5.

        Returns:
            Pixels of the photo ``[..., 2]``, with the same convention.

        Raises:
            QueryError: If the scene does not keep the lens of the photo.
            ValueError: If ``pixels`` is not ``[..., 2]``, or not finite.
        """
        given = np.asarray(pixels, dtype=np.float64)
        if given.ndim < 1 or given.shape[-1] != 2 or not np.isfinite(given).all():
            raise ValueError(f"pixels must be finite numbers [..., 2], got {list(given.shape)}")
        if self.photo is None:
            raise QueryError(
                f"view {self.name[:60]!r}",
                expected="the lens of its photo",
                found="none: the scene was built before lenses were kept",
                remedy="build the scene again (finished stages are kept), and ask that one",
            )
        rays = np.ones((given.size // 2, 3))
        K = self.camera.K
        rays[:, :2] = (given.reshape(-1, 2) - K[:2, 2]) / (K[0, 0], K[1, 1])
        return self.photo.pixels(rays).reshape(given.shape)


def view_named(views: Mapping[str, StoredView], name: str) -> StoredView:
    """The view called ``name``, with or without its folder and its suffix.

    Raises:
        QueryError: If there is none, or several match.
    """
    if not isinstance(name, str):
        expected = "the name of a view, a StoredView or a Camera"
        raise QueryError("view", expected=expected, found=repr(name)[:60])
    # A suffix may be given where the views are stored without theirs.
    matches = match_stem(name, views) or match_stem(
        stem_of(name), (each for each in views if stem_of(each) == each)
    )
    if len(matches) != 1:
        known = ", ".join(list(views)[:5])
        raise QueryError(
            f"view {name[:60]!r}",
            expected="the name of a view",
            found="no match" if not matches else f"{len(matches)} matches",
            remedy=f"the scene has {len(views)} views, such as {known}",
        )
    return views[matches[0]]


def stored_view(entry: Any, path: Path) -> StoredView:
    """A view of ``cameras.json``.

    Raises:
        CaptureError: If its name leads out of the folder.
        KeyError, TypeError, ValueError, OverflowError: If an entry is missing or invalid.
    """
    name, split, width, height = entry["name"], entry["split"], entry["width"], entry["height"]
    if not isinstance(name, str) or split not in ("train", "test"):
        raise ValueError(f"view {name!r} of split {split!r}"[:100])
    if not all(isinstance(side, int) and 1 <= side <= MAX_SIDE for side in (width, height)):
        raise ValueError(f"size {width!r} x {height!r}"[:100])
    camera = Camera(width, height, np.array(entry["K"], float), np.array(entry["viewmat"], float))
    if np.abs(camera.viewmat).max() > MAX_COORDINATE:
        raise ValueError(f"the pose of {name!r} is too far from the origin"[:100])
    return StoredView(checked_name(name, path), camera, split, _stored_photo(entry.get("photo")))


def _stored_photo(entry: Any) -> PhotoLens | None:
    """The lens of a photo of ``cameras.json``; None where the scene has none.

    Raises:
        KeyError, TypeError, ValueError: If it is invalid.
    """
    if entry is None:
        return None
    model, width, height = entry["model"], entry["width"], entry["height"]
    params = tuple(float(number) for number in entry["params"])
    sides = all(isinstance(side, int) and 1 <= side <= MAX_SIDE for side in (width, height))
    if not isinstance(model, str) or not sides or not np.isfinite(params).all():
        raise ValueError(f"photo {entry!r}"[:100])
    return PhotoLens(model, width, height, params)


def training_cameras(views: Mapping[str, StoredView]) -> list[Camera]:
    """The cameras of the views that a scene was made from."""
    return [view.camera for view in views.values() if view.split == "train"]
