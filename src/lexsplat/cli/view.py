"""``lexsplat view``: the scene in a browser."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import TYPE_CHECKING

from lexsplat.cli.options import Device, SceneArgument, open_scene, work_on
from lexsplat.cli.waiting import starting
from lexsplat.runtime.progress import uncounted

if TYPE_CHECKING:
    from lexsplat.viewer.server import ViewerConfig


@dataclasses.dataclass
class View:
    """Show, search and edit a scene in the browser.

    Only this machine can connect unless --host allows others. Edits are steps of lexsplat edit. Ctrl-C stops the
    server.

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        host: Address to listen on. On others than 127.0.0.1, visitors need the token of the printed address.
        port: Port to listen on. The next free port is used if it is taken.
        name: Host names under which the page may be opened, in addition to localhost and addresses.
        splats: Maximum number of Gaussians that the browser draws.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
    """

    scene: SceneArgument
    host: str = "127.0.0.1"
    port: int = 8080
    name: tuple[str, ...] = ()
    splats: int = 1_000_000
    clip: str | None = None
    device: Device = "auto"

    def check(self) -> None:
        """Refuse invalid options."""
        self._config()

    def _config(self) -> ViewerConfig:
        from lexsplat.viewer.server import ViewerConfig

        return ViewerConfig(self.host, self.port, self.name, self.splats)

    def run(self) -> None:
        """Serve until Ctrl-C."""
        with starting():
            from lexsplat.viewer.server import ViewerServer

        scene = open_scene(self.scene, self.device, self.clip, shows_steps=True)
        with uncounted(scene.listener, "page", work_on(self.scene)):
            viewer = ViewerServer(scene, self._config())
        print(f"{self.scene} is shown at {viewer.url} (Ctrl-C stops the server)", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            wait_for_interrupt()
        viewer.stop()


def wait_for_interrupt() -> None:
    """Sleep until Ctrl-C."""
    import threading

    threading.Event().wait()
