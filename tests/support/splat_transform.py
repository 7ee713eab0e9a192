"""splat-transform in one process for all of its runs: a start takes it longer than most of them.

Its command line is a function that ends with the process; here the process goes on to the next run. Each run is
otherwise that of the command.
"""

from __future__ import annotations

import contextlib
import functools
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

_RUNS = """
import { syncBuiltinESMExports } from "node:module";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

let status;
process.exit = (code) => {
  status ??= code ?? 0;
  throw new Error("its end");
};
syncBuiltinESMExports();
const { main } = await import(pathToFileURL(process.argv[2]).href);
for await (const line of createInterface({ input: process.stdin })) {
  process.argv = [...process.argv.slice(0, 2), ...JSON.parse(line)];
  status = undefined;
  await main().catch((error) => console.error(error));
  console.log(`status ${status ?? 1}`);
}
"""


@functools.cache
def program() -> str | None:
    """splat-transform, if it is there and runs."""
    found = shutil.which("splat-transform")
    runs = found and subprocess.run([found, "--version"], capture_output=True).returncode == 0
    return found if runs else None


@contextlib.contextmanager
def running() -> Iterator[Callable[..., None]]:
    """A function that runs splat-transform with some words, and fails with what it has written if it fails."""
    lines = Path(str(program())).resolve().parents[1] / "dist" / "cli.mjs"
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as told:
        script = Path(folder, "runs.mjs")
        script.write_text(_RUNS)
        process = subprocess.Popen(
            ["node", str(script), str(lines)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=told, text=True,
        )  # fmt: skip

        def run(*words: object) -> None:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(json.dumps([*map(str, words)]) + "\n")
            process.stdin.flush()
            status = next((line for line in process.stdout if line.startswith("status ")), "no status")
            told.seek(0)
            assert status == "status 0\n", told.read()[-2000:]

        try:
            yield run
        finally:
            process.communicate()
