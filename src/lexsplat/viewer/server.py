"""Starts the viewer: viser behind the request guard, with the scene and the panels on its page."""

from __future__ import annotations

import contextlib
import io
import socket
from dataclasses import dataclass

from lexsplat.runtime.errors import BackendError
from lexsplat.scenes.scene import Scene
from lexsplat.viewer.guard import RequestGuard, restrict_messages
from lexsplat.viewer.history import History
from lexsplat.viewer.session import Session


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
        if self.splats < 1:
            raise ValueError(f"splats must be positive, got {self.splats}")


class ViewerServer:
    """A running viewer. It serves until `stop`.

    Args:
        scene: The scene to show.
        config: Where and how it is served; None takes the defaults.

    Raises:
        BackendError: If viser is missing or cannot be guarded, or if the address cannot be used.
    """

    def __init__(self, scene: Scene, config: ViewerConfig | None = None) -> None:
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

        guard = RequestGuard(self.config.names)
        # viser prints a banner; the command line prints its own line.
        with guard.wrap_server(), contextlib.redirect_stdout(io.StringIO()):
            self.viser = viser.ViserServer(self.config.host, self.config.port, verbose=False)
        try:
            if not guard.in_place:
                raise _unguarded(viser.__version__)
            try:
                restrict_messages(self.viser)
            except (ImportError, AttributeError, AssertionError, KeyError) as error:
                raise _unguarded(viser.__version__) from error
            folder = scene.folder.root if scene.folder and not scene.folder.is_bundled else None
            self.session = Session(scene, History.load(folder, scene.clip))
            self.display = Display(self.viser, scene, self.config.splats)
            self.panels = Panels(self.viser, self.session, self.display)
        except BaseException:
            self.viser.stop()
            raise

    @property
    def port(self) -> int:
        """The port it listens on."""
        return int(self.viser.get_port())

    @property
    def url(self) -> str:
        """The address to open in a browser on this machine."""
        host = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.config.host, self.config.host)
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}"

    def stop(self) -> None:
        """Close all pages and free the port."""
        self.panels.stop()
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints here, too
            self.viser.stop()


def _check_address(host: str) -> None:
    """Fail at once for a foreign address, for which viser would wait forever."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise BackendError(
            f"--host {host}", expected="an address of this machine", found=str(error),
            remedy="use 127.0.0.1, or 0.0.0.0 for all networks of this machine",
        ) from error  # fmt: skip


def _unguarded(version: str) -> BackendError:
    return BackendError(
        f"viser {version}",
        expected="a server that can be guarded, as in version 1.1",
        found="a different way to start or to handle messages",
        remedy="install the version of viser that constraints.txt names",
    )
