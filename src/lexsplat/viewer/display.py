"""The scene on the page: splats, camera frustums, camera jumps, and images rendered by the page."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lexsplat.geometry.cameras import Camera, look_at
from lexsplat.geometry.rotations import quaternion_from_matrix
from lexsplat.runtime.sampling import evenly
from lexsplat.scenes.folder import StoredView
from lexsplat.scenes.scene import Scene
from lexsplat.viewer.recording import orbit
from lexsplat.viewer.splats import BYTES_PER_SPLAT, SplatBlocks

if TYPE_CHECKING:
    import viser

TRAIN_COLOR, TEST_COLOR = (90, 110, 140), (232, 124, 3)
MAX_FRUSTUMS = 300
_FRAME_TIMEOUT = 60.0


class Display:
    """Draws a scene in viser."""

    def __init__(self, server: viser.ViserServer, scene: Scene, budget: int) -> None:
        self.server, self.scene = server, scene
        self.splats = SplatBlocks(scene.gaussians, budget)
        self._handles: list[Any] = []
        cameras = [view.camera for view in scene.views.values()]
        self.up = scene.world.up.direction
        self.center = np.median(scene.gaussians.means.detach().cpu().numpy(), axis=0).astype(np.float64)
        self._frustums: list[Any] = []
        server.scene.set_up_direction(self.up)
        self._start_at(cameras)

    # -- splats

    def draw(self, colors: NDArray[np.uint8]) -> int:
        """Draw the Gaussians in these colors ``[N, 3]``.

        Returns:
            Bytes queued for each page.
        """
        sent = 0
        with self.server.atomic():
            for number, own in self.splats.changes(colors):
                block = self.splats.blocks[number]
                if number < len(self._handles):
                    self._handles[number].rgbs = own
                else:
                    self._handles.append(
                        self.server.scene.add_gaussian_splats(
                            f"/scene/{number}",
                            centers=block.centers,
                            covariances=block.covariances,
                            rgbs=own,
                            opacities=block.opacities,
                            scale=1.0 / self.splats.unit,
                        )
                    )
                sent += len(own) * BYTES_PER_SPLAT
        self.server.flush()
        return sent

    # -- cameras

    def add_frustums(self, jump: Callable[[StoredView, Any], None], *, visible: bool) -> None:
        """Draw a frustum for each view, or for an even choice of at most `MAX_FRUSTUMS`.

        Args:
            jump: Called with the view and the page when a frustum is clicked.
            visible: Whether the frustums are shown at first.
        """
        views = evenly(list(self.scene.views.values()), MAX_FRUSTUMS)
        size = 0.25 * _spacing([view.camera for view in views])
        for number, view in enumerate(views):
            camera = view.camera
            handle = self.server.scene.add_camera_frustum(
                f"/cameras/{number}",
                fov=2 * math.atan(camera.height / (2 * camera.K[1, 1])),
                aspect=camera.width / camera.height,
                scale=size,
                thickness=1.5,
                thickness_units="screen",
                color=TEST_COLOR if view.split == "test" else TRAIN_COLOR,
                wxyz=quaternion_from_matrix(camera.viewmat[:3, :3].T),
                position=camera.position,
                visible=visible,
            )
            handle.on_click(_jumps_to(view, jump))
            self._frustums.append(handle)

    def show_frustums(self, visible: bool) -> None:
        """Show or hide the frustums."""
        with self.server.atomic():
            for handle in self._frustums:
                handle.visible = visible

    def jump(self, client: viser.ClientHandle, camera: Camera) -> None:
        """Move a page's camera to the pose of a view; the page then orbits what the view looks at."""
        with client.atomic():
            client.camera.position = camera.position
            client.camera.look_at = camera.position + camera.forward * self._distance(camera)
            client.camera.fov = 2 * math.atan(camera.height / (2 * camera.K[1, 1]))
        client.flush()

    def _start_at(self, cameras: list[Camera]) -> None:
        if not cameras:
            return
        first = cameras[0]
        start = self.server.initial_camera
        start.up = self.up
        start.position = first.position
        start.look_at = first.position + first.forward * self._distance(first)
        start.fov = 2 * math.atan(first.height / (2 * first.K[1, 1]))

    def _distance(self, camera: Camera) -> float:
        """Distance to the look-at point: the point on the optical axis that is closest to the scene's center."""
        along = float((self.center - camera.position) @ camera.forward)
        return along if along > 1e-3 else max(float(np.linalg.norm(self.center - camera.position)), 1e-3)

    # -- images

    def image(self, client: viser.ClientHandle, height: int, pose: Any = None) -> NDArray[np.uint8]:
        """What a page shows ``[height, W, 3]``, rendered by the page itself.

        Args:
            client: The page.
            height: Rows; the aspect ratio is that of the page.
            pose: ``(position, camera-to-world rotation)``; None takes the page's camera.
        """
        extra: dict[str, Any] = {}
        if pose is not None:
            place, rotation = pose
            extra = {
                "position": tuple(place),
                "wxyz": quaternion_from_matrix(rotation),
                "fov": client.camera.fov,
            }
        width = max(2, round(height * client.camera.aspect / 2) * 2)
        return client.get_render(
            height,
            width,
            transport_format="jpeg" if pose is not None else "png",
            timeout=_FRAME_TIMEOUT,
            **extra,
        )[..., :3]

    def orbit_frames(
        self, client: viser.ClientHandle, frames: int, height: int, listener: Callable[[int], None]
    ) -> list[NDArray[np.uint8]]:
        """Images of one orbit around the look-at point of a page, at the height of its camera."""
        camera = client.camera
        images = []
        seen_from = [view.camera.position for view in self.scene.views.values()]
        poses = orbit(camera.position, camera.look_at, self.up, frames, seen_from)
        for number, pose in enumerate(poses):
            images.append(self.image(client, height, pose))
            listener(number + 1)
        return images

    @contextlib.contextmanager
    def without_frustums(self) -> Iterator[None]:
        """A context in which the frustums are hidden."""
        visible = bool(self._frustums) and bool(self._frustums[0].visible)
        if visible:
            self.show_frustums(False)
            self.server.flush()
            time.sleep(0.2)  # until the page has drawn a frame without them
        try:
            yield
        finally:
            if visible:
                self.show_frustums(True)


def _jumps_to(view: StoredView, jump: Callable[[StoredView, Any], None]) -> Callable[[Any], None]:
    return lambda event: jump(view, event.client)


def page_camera(client: viser.ClientHandle) -> Camera:
    """The camera of a page; its size is that of the page's canvas in pixels."""
    camera = client.camera
    height, width = int(camera.image_height), int(camera.image_width)
    return look_at(camera.position, camera.look_at, camera.up_direction, width, height, camera.fov)


def _spacing(cameras: list[Camera]) -> float:
    """Median distance from a camera to its nearest neighbor; 1 for a single camera."""
    if len(cameras) < 2:
        return 1.0
    from scipy.spatial import cKDTree

    places = np.stack([camera.position for camera in cameras])
    apart = cKDTree(places).query(places, k=2)[0][:, 1]
    return float(np.median(apart)) or 1.0
