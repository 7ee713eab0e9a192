"""Starts the viewer: binds viser behind the guard, and puts scene and panels on the page."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from dataclasses import dataclass

from lexsplat.runtime.errors import BackendError
from lexsplat.scenes.scene import Scene
from lexsplat.viewer.guard import Guard, Limits
from lexsplat.viewer.history import Memory
from lexsplat.viewer.session import Session

logger = logging.getLogger("lexsplat")


@dataclass(frozen=True)
class ViewerConfig:
    """How the viewer is served.

    Args:
        host: Address to listen on; 127.0.0.1 is this machine alone.
        port: Port to listen on; the next free one is taken if it is in use, 0 takes any.
        names: Host names under which pages may reach it, besides addresses and ``localhost``.
        splats: How many Gaussians the browser draws at most.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    names: tuple[str, ...] = ()
    splats: int = 1_000_000

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port must be in 0..65535, got {self.port}")
        if self.splats < 1:
            raise ValueError(f"splats must be positive, got {self.splats}")


class ViewerServer:
    """A running viewer. It serves until `stop`.

    Args:
        scene: The scene to show.
        config: How it is served.
        limits: Bounds on what pages may send.

    Raises:
        BackendError: If viser is missing or cannot be guarded, or the address cannot be used.
    """

    def __init__(
        self, scene: Scene, config: ViewerConfig | None = None, limits: Limits | None = None
    ) -> None:
        self.config = config or ViewerConfig()
        _check_address(self.config.host)
        try:
            import viser
        except ImportError as error:
            raise BackendError(
                "viewer", expected="the package viser", found="none", remedy="pip install viser"
            ) from error
        from lexsplat.viewer.display import Display
        from lexsplat.viewer.panels import Panels

        guard = Guard(self.config.names, limits)
        # viser greets on standard output; the command line has its own words.
        with guard.before_viser(), contextlib.redirect_stdout(io.StringIO()):
            self.viser = viser.ViserServer(self.config.host, self.config.port, verbose=False)
        if not guard.in_place:
            self.viser.stop()
            raise BackendError(
                f"viser {viser.__version__}",
                expected="a server that starts through websockets, as version 1.1 does",
                found="another way",
                remedy="install the version of viser that constraints.txt names",
            )
        try:
            folder = scene.folder.root if scene.folder and not scene.folder.is_bundled else None
            self.session = Session(scene, Memory.load(folder, scene.clip))
            self.display = Display(self.viser, scene, self.config.splats)
            self.panels = Panels(self.viser, self.session, self.display)
        except BaseException:
            self.viser.stop()
            raise

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self.viser.get_port())

    @property
    def url(self) -> str:
        """What to open in a browser on this machine."""
        host = self.config.host
        shown = "127.0.0.1" if host in ("0.0.0.0", "") else "[::1]" if host == "::" else host
        return f"http://{f'[{shown}]' if ':' in shown and shown[0] != '[' else shown}:{self.port}"

    def stop(self) -> None:
        """Close all pages and free the port."""
        self.panels.stop()
        with contextlib.redirect_stdout(io.StringIO()):  # viser says farewell, too
            self.viser.stop()


def is_loopback(host: str) -> bool:
    """Whether an address to listen on can be reached from this machine alone."""
    import ipaddress

    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _check_address(host: str) -> None:
    """viser waits forever for an address that is not ours, so it is tried first."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise BackendError(
            f"--host {host}", expected="an address of this machine", found=str(error),
            remedy="use 127.0.0.1, or 0.0.0.0 for all networks of this machine",
        ) from error  # fmt: skip
