"""Connection of this process to Ray: a running cluster, or one of its own."""

from __future__ import annotations

import logging
import socket
import threading
from typing import Any

from lexsplat.runtime.errors import WorkersError

_WAIT_SECONDS = 5.0
_SETTINGS = b"\0\0\0\4\0\0\0\0\0"
"""An empty frame of settings (RFC 9113, sections 4.1 and 6.5)."""
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + _SETTINGS
_PORTS = "check the address (RAY_ADDRESS is HOST:6379, the --port of ray start; ray:// takes its client port, 10001)"
_TOKEN = "; if the cluster was started with a token, set RAY_AUTH_MODE=token and copy ~/.ray/auth_token from its head"


def connect(place: str, tries: int = 2) -> None:
    """Connect to Ray; once more where the server of ``ray://`` did not start in time.

    Args:
        place: "local" for a Ray of this process alone, an address of a cluster, or "ray://HOST:PORT".
        tries: Number of tries.

    Raises:
        WorkersError: If it is not reached.
    """
    import ray

    host, _, port = place.removeprefix("ray://").rpartition(":")
    named = bool(host) and port.isdigit()
    if named:  # Ray tries for a minute where nothing listens, and for hours where something else does
        _greet(place, host, int(port))
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    own: dict[str, Any] = {"include_dashboard": False} if place == "local" else {}
    try:
        ray.init(address=place, **quiet, **own)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError, OSError) as error:
        if tries > 1 and "Initialization failure" in str(error):
            connect(place, tries - 1)
            return
        raise _unreachable(place, error, answers=named) from error


def _greet(place: str, host: str, port: int) -> None:
    """Check that a server of gRPC listens, as Ray's are: it answers the preface of HTTP/2 with its settings."""
    try:
        with socket.create_connection((host, port), timeout=_WAIT_SECONDS) as server:
            server.sendall(_PREFACE)
            answer = server.recv(len(_SETTINGS), socket.MSG_WAITALL)
    except OSError as error:
        raise _unreachable(place, error) from error
    if answer[3:4] != _SETTINGS[3:4]:  # the kind of the frame, after three bytes of its length
        raise _unreachable(place, ConnectionError("a server that is not Ray's"))


class OwnRay:
    """A Ray of this process alone, which starts in a thread while the command goes on.

    The thread lives as long as the context: on Linux the processes of Ray end with the thread that starts them.
    """

    def __init__(self) -> None:
        self._ready, self._ended = threading.Event(), threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="Ray", daemon=True)

    def __enter__(self) -> OwnRay:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def wait(self) -> None:
        """Return when tasks can be sent.

        Raises:
            WorkersError: If Ray does not start.
        """
        self._ready.wait()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        import ray

        try:
            connect("local")
        except BaseException as error:
            self._error = error
        finally:
            self._ready.set()
        self._ended.wait()
        ray.shutdown()


def _unreachable(place: str, error: Exception, *, answers: bool = False) -> WorkersError:
    """The error to raise; ``answers`` if something listens at the address, so that a token may be missing."""
    reason = " ".join(str(error).split())[:200]
    if "ersion mismatch" in reason:
        remedy = "use the same versions of Ray and Python on every machine"
        return WorkersError(f"Ray at {place}", expected="the same version", found=reason, remedy=remedy)
    if "ray[client]" in reason:
        remedy = "pip install 'lexsplat[cluster]'"
        return WorkersError(place, expected="the client of Ray", found="no package grpcio", remedy=remedy)
    return WorkersError(
        f"Ray at {place}",
        expected="a running cluster",
        found=reason or type(error).__name__,
        remedy=f"{_PORTS} and: ray status" + (_TOKEN if answers else ""),
    )
