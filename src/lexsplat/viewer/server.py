"""Starts the viewer: the application behind its guard, on a socket of this machine."""

from __future__ import annotations

import secrets
import socket
import threading
import time
from dataclasses import dataclass

import uvicorn

from lexsplat.runtime.listening import listen
from lexsplat.scenes.scene import Scene
from lexsplat.viewer.app import make_app
from lexsplat.viewer.guard import Guard
from lexsplat.viewer.history import History
from lexsplat.viewer.session import Session

MOST_CONNECTIONS = 64
"""Open connections, at most; a browser opens up to six for a page."""
_PORTS = 50
"""Number of ports that are tried."""
_ANYWHERE = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}


@dataclass(frozen=True)
class ViewerConfig:
    """Where and how the viewer is served.

    Args:
        host: Address to listen on; 127.0.0.1 is reachable from this machine only.
        port: Port to listen on; the next free one if it is in use, any free one for 0.
        names: Host names under which pages may open the viewer, besides addresses and ``localhost``.
        splats: Maximum number of Gaussians that the browser draws.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    names: tuple[str, ...] = ()
    splats: int = 1_000_000

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port must be in 0..65535, got {self.port}")
        if self.splats < 2:
            raise ValueError(f"splats must be at least 2, got {self.splats}")


class ViewerServer:
    """A running viewer. It serves until `stop`.

    Args:
        scene: The scene to show.
        config: Settings of the server; None takes the defaults.

    Raises:
        BackendError: If the address cannot be used.
        QueryError: If the scene has fewer than two Gaussians, or invalid ones.
    """

    def __init__(self, scene: Scene, config: ViewerConfig | None = None) -> None:
        self.config = config or ViewerConfig()
        self.socket = listen(self.config.host, self.config.port, _PORTS)
        try:
            folder = scene.folder.root if scene.folder and not scene.folder.is_bundled else None
            self.session = Session(scene, self.config.splats, History.load(folder, scene.clip))
        except BaseException:
            self.socket.close()
            raise
        self.token = "" if _is_loopback(self.socket) else secrets.token_urlsafe(18)
        guard = Guard(make_app(self.session), self.config.names, self.token)
        settings = uvicorn.Config(
            guard, log_config=None, access_log=False, server_header=False, lifespan="off", ws="none",
            limit_concurrency=MOST_CONNECTIONS, timeout_keep_alive=20, timeout_graceful_shutdown=2,
        )  # fmt: skip
        self._server = uvicorn.Server(settings)
        self._thread = threading.Thread(target=self._server.run, args=([self.socket],), daemon=True)
        self._thread.start()
        while not self._server.started and self._thread.is_alive():
            time.sleep(0.005)
        self._warming = threading.Thread(target=self.session.warm_up, daemon=True)
        self._warming.start()

    @property
    def port(self) -> int:
        """The port it listens on."""
        return int(self.socket.getsockname()[1])

    @property
    def url(self) -> str:
        """The address to open in a browser on this machine."""
        host = _ANYWHERE.get(self.config.host, self.config.host)
        token = f"/?token={self.token}" if self.token else ""
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}{token}"

    def stop(self) -> None:
        """Close all connections and free the port."""
        self._server.should_exit = self.session.closed = True
        self._thread.join(timeout=10)
        self._warming.join(timeout=10)
        self.socket.close()


def _is_loopback(listening: socket.socket) -> bool:
    import ipaddress

    return ipaddress.ip_address(listening.getsockname()[0].partition("%")[0]).is_loopback
