"""The socket that a server listens on. It is bound first, so that a port in use ends in one line."""

from __future__ import annotations

import errno
import socket

from lexsplat.runtime.errors import BackendError


def listen(host: str, port: int, ports: int = 1) -> socket.socket:
    """A socket that listens on a port.

    Args:
        host: Address to listen on.
        port: The port; any free one for 0.
        ports: Number of ports that are tried, from the first on.

    Raises:
        BackendError: If the address is not of this machine, or all ports are taken.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        for number in range(port, min(port + ports, 65536)) if port else [0]:
            listening = socket.socket(family, kind, protocol)
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listening.bind((address[0], number, *address[2:]))
                listening.listen()
                return listening
            except OSError as error:
                listening.close()
                if error.errno != errno.EADDRINUSE:
                    raise
    except (OSError, UnicodeError) as error:
        raise BackendError(
            f"--host {host}", expected="an address of this machine", found=str(error),
            remedy="use 127.0.0.1, or 0.0.0.0 for all networks of this machine",
        ) from error  # fmt: skip
    raise BackendError(
        f"--port {port}",
        expected="a free port",
        found=f"{port} is taken" if ports == 1 else f"{port} and the next ones are taken",
        remedy="give another --port" if ports == 1 else "--port 0 takes any",
    )
