"""``lexsplat view``: the scene in a browser."""

from __future__ import annotations

import contextlib
import dataclasses

import tyro

from lexsplat.cli.options import Device, open_scene


@dataclasses.dataclass
class View:
    """Look at a scene in the browser, and search it there.

    Only this machine can connect unless --host says otherwise. Ctrl-C ends it.

    Args:
        scene: A scene folder.
        host: Address to listen on. 0.0.0.0 lets everyone who can reach this machine in: there is no password.
        port: Port to listen on; the next free one is taken if it is in use.
        name: Host name under which the page is opened, where that is neither an address nor localhost; may be
            given several times.
        splats: How many Gaussians the browser draws at most.
        clip: Text encoder, if it is not where the build found it.
        device: Where to compute.
    """

    scene: tyro.conf.Positional[str]
    host: str = "127.0.0.1"
    port: int = 8080
    name: tuple[str, ...] = ()
    splats: int = 1_000_000
    clip: str | None = None
    device: Device = "auto"

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port must be in 0..65535, got {self.port}")
        if self.splats < 1:
            raise ValueError(f"splats must be positive, got {self.splats}")

    def run(self) -> None:
        """Serve until Ctrl-C."""
        from lexsplat.viewer.server import ViewerConfig, ViewerServer

        scene = open_scene(self.scene, self.device, self.clip)
        viewer = ViewerServer(scene, ViewerConfig(self.host, self.port, self.name, self.splats))
        print(f"{self.scene} is shown at {viewer.url} (Ctrl-C ends it)", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            wait_for_interrupt()
        viewer.stop()


def wait_for_interrupt() -> None:
    """Sleep until Ctrl-C."""
    import threading

    threading.Event().wait()
