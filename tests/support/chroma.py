"""A real Chroma server in a process of its own, from the wheel of the package chromadb."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

_RUN = "import sys, chromadb_rust_bindings as server; server.cli(['chroma', 'run', *sys.argv[1:]])"


class Chroma:
    """A server that keeps its data in a folder, so that it may be killed and started again."""

    def __init__(self, folder: Path) -> None:
        pytest.importorskip("chromadb_rust_bindings", reason="the package chromadb is missing")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.folder, self.url = folder, f"http://127.0.0.1:{self.port}"
        self.process: subprocess.Popen | None = None
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-c", _RUN, "--path", str(self.folder), "--port", str(self.port)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(600):
            try:
                with urllib.request.urlopen(f"{self.url}/api/v2/heartbeat", timeout=1):
                    return
            except OSError:
                time.sleep(0.1)
        pytest.fail("Chroma did not start")

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
