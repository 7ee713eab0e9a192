"""``lexsplat mcp``: tools for language models."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from lexsplat.cli.options import Device, named
from lexsplat.cli.waiting import LateProgress, starting
from lexsplat.runtime.errors import BackendError, LibraryError
from lexsplat.runtime.progress import uncounted

if TYPE_CHECKING:
    import socket

    from lexsplat.scenes.library import Library
    from lexsplat.scenes.serving import OpenScene

Scenes = Annotated[tuple[str, ...], tyro.conf.Positional, named("SCENE ...")]


@dataclasses.dataclass
class Mcp:
    """Serve scenes to language models over the Model Context Protocol (docs/mcp.md).

    Clients such as Claude Desktop start this command themselves and talk over standard input and output. With --http
    it listens at http://127.0.0.1:8765/mcp.

    Args:
        scenes: Scene folders, a library of scenes, or the word "demo" for the bundled scene.
        http: Serve over HTTP instead of standard input and output.
        host: Address to listen on. Other addresses than this machine's need --token.
        port: Port to listen on.
        token: Token that clients must send as "Authorization: Bearer TOKEN".
        allow_write: Offer the tools export and edit, which write new files into --output.
        output: Folder of the files that export and edit write.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
    """

    scenes: Scenes
    http: bool = False
    host: str = "127.0.0.1"
    port: int = 8765
    token: Annotated[str | None, tyro.conf.arg(metavar="TOKEN")] = None
    allow_write: bool = False
    output: Path = Path("lexsplat-output")
    clip: str | None = None
    device: Device = "auto"

    defaults: ClassVar[dict[str, str]] = {"clip": "the encoder of the build", "token": "none"}

    def check(self) -> None:
        """Refuse invalid options."""
        if not self.scenes:
            raise ValueError("at least one SCENE is needed, such as demo")
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        given = [name for name in ("host", "port", "token") if getattr(self, name) != defaults[name]]
        if given and not self.http:
            raise ValueError(
                f"--{given[0]} needs --http: without it, clients talk over standard input and output"
            )
        if not 0 < self.port < 65536:
            raise ValueError(f"port must be in 1..65535, got {self.port}")
        if self.token is not None and len(self.token) < 16:
            raise ValueError("token must have at least 16 characters")
        if self.http and self.token is None and self.host not in ("127.0.0.1", "localhost", "::1"):
            raise ValueError(f"host {self.host} can be reached by others: give --token")

    def run(self) -> None:
        """Serve until the client ends or Ctrl-C."""
        if importlib.util.find_spec("mcp") is None:
            raise BackendError(
                "lexsplat mcp", expected="the package mcp", found="none", remedy='pip install "lexsplat[mcp]"'
            )
        if not self.http:
            self._serve(None)
            return
        from lexsplat.runtime.listening import listen

        # First: a taken port is refused before anything is loaded.
        with listen(self.host, self.port) as listening:
            self._serve(listening)

    def _serve(self, listening: socket.socket | None) -> None:
        with starting():
            from lexsplat.mcp.server import make_server, serve_http
            from lexsplat.mcp.writing import check_output

        if self.allow_write:
            check_output(self.output.resolve())
        scenes, library = self._open()
        server = make_server(scenes, self.output.resolve() if self.allow_write else None, library)
        warming = [threading.Thread(target=served.warm) for served in scenes.values()]
        for thread in warming:  # meanwhile the client connects
            thread.start()
        # An exception might be raised within an import of the thread above, which would never end then; and nothing
        # else ends the thread that waits for the client's next line.
        before = signal.signal(signal.SIGINT, lambda *_: os._exit(0))
        try:
            if listening is None:
                server.run()
                return
            host = f"[{self.host}]" if ":" in self.host else self.host
            address = f"http://{host}:{listening.getsockname()[1]}/mcp"
            print(f"{', '.join(self.scenes)} served at {address} (Ctrl-C stops the server)", flush=True)
            serve_http(server, listening, self.host, self.token)
        finally:
            for thread in warming:
                thread.join()
            signal.signal(signal.SIGINT, before)

    def _open(self) -> tuple[dict[str, OpenScene], Library | None]:
        """The scenes by name, and the library; both show progress on standard error, never on standard output."""
        from lexsplat.scenes.library import open_library
        from lexsplat.scenes.serving import open_scenes

        libraries = [path for path in self.scenes if (Path(path) / "library.json").is_file()]
        if len(libraries) > 1:
            raise LibraryError(libraries[1], expected="one library", found=str(len(libraries)))
        listener, library = LateProgress(), None
        if libraries:
            with uncounted(listener, "library", Path(libraries[0]).resolve()):
                library = open_library(libraries[0], device=self.device)
            library.listener = listener
        alone = [path for path in self.scenes if path not in libraries]
        taken: dict[str, Path | None] = {}
        if library is not None:
            taken.update(dict.fromkeys(library.names()))
            taken.update({record.name: library.folder(record).resolve() for record in library.records()})
        return open_scenes(alone, self.device, self.clip, listener, taken), library
