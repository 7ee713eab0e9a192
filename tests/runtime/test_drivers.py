"""Commands that use a real Ray from outside, and commands that are killed while their workers are at work."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
from support import two_nodes
from support.tiny_capture import QUICK_BUILD

from lexsplat.runtime import ray_connection
from lexsplat.runtime.errors import WorkersError
from lexsplat.runtime.workers import open_workers

SUMS = """
import numpy as np
from support import two_nodes
from lexsplat.runtime.workers import IN_PROCESS, open_workers, results
ones, items = np.ones(1000, np.float32), {f"part {seed}": seed for seed in range(12)}
def total(workers):
    return sum(results(workers.map(two_nodes.noisy_sum, ones, items)), np.zeros_like(ones))
with open_workers("ray://127.0.0.1:PORT") as workers:
    found = total(workers)
    failed = list(workers.map(two_nodes.one_broken, None, {str(i): i for i in range(4)}))[2].error
print(found.tobytes() == total(IN_PROCESS).tobytes(), failed)
"""


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.fixture(scope="module")
def nodes() -> Iterator[two_nodes.TwoNodes]:
    pytest.importorskip("ray", reason="needs Ray: pip install 'lexsplat[cluster]'")
    pytest.importorskip("grpc", reason="needs Ray's client: pip install 'lexsplat[cluster]'")
    started = two_nodes.TwoNodes(client_port=free_port())
    yield started
    started.stop()


@pytest.mark.slow
def test_a_cluster_used_from_outside_gives_the_bits_of_this_process_and_names_what_fails(nodes):
    command = [sys.executable, "-c", SUMS.replace("PORT", str(nodes.client_port))]
    environment = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.strip() == "True photo 2: expected a photo, found a torn file; replace it"


def test_without_the_client_of_ray_the_remedy_is_reported(monkeypatch):
    pytest.importorskip("ray", reason="needs Ray: pip install 'lexsplat[cluster]'")
    monkeypatch.setitem(sys.modules, "grpc", None)
    for name in [name for name in sys.modules if name.startswith("ray.util.client")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(ray_connection, "_greet", lambda *_: None)
    with (
        pytest.raises(WorkersError, match=r"the client of Ray, .*pip install 'lexsplat\[cluster\]'"),
        open_workers("ray://127.0.0.1:10001"),
    ):
        pass


@pytest.mark.slow
def test_a_command_that_is_killed_goes_on_when_it_is_run_again_and_builds_the_same_scene(
    nodes, built, tiny_capture, tmp_path
):
    output = tmp_path / "scene"
    arguments = ["build", str(tiny_capture), "--output", str(output), *QUICK_BUILD, "--workers", "ray"]
    command = [sys.executable, "-m", "lexsplat", *arguments]
    environment = {**os.environ, "RAY_ADDRESS": nodes.address}
    driver = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    cache = output / "checkpoints" / "features"
    end = time.monotonic() + 300
    while not (before := features_in(cache)) and driver.poll() is None and time.monotonic() < end:
        time.sleep(0.02)
    os.kill(driver.pid, signal.SIGKILL)
    assert driver.wait() == -signal.SIGKILL, "killed while the workers were at work"
    again = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert again.returncode == 0, again.stderr
    after = features_in(cache)
    assert 0 < len(before) < len(after)
    assert before.items() <= after.items(), "finished features are kept"
    for name in ("gaussians.ply", "language.safetensors"):
        assert (output / name).read_bytes() == (built / name).read_bytes(), name


def features_in(cache):
    return {path.name: path.stat().st_mtime_ns for path in cache.glob("*.safetensors")}


@pytest.mark.slow
def test_nodes_killed_while_blocks_are_trained_change_no_byte_of_the_gaussians(nodes, tiny_capture, tmp_path):
    command = [
        sys.executable,
        "-m",
        "lexsplat",
        "reconstruct",
        str(tiny_capture),
        *QUICK_BUILD,
        "--blocks",
        "3",
    ]
    here, there = tmp_path / "here", tmp_path / "there"
    subprocess.run([*command, "--output", str(here)], check=True, capture_output=True, timeout=300)
    environment = {**os.environ, "RAY_ADDRESS": nodes.address}
    command += ["--output", str(there), "--workers", "ray", "--progress", "json"]
    errors, kills = tmp_path / "errors.txt", 0  # a file: of a node that dies Ray tells more than a pipe holds
    with (
        errors.open("w") as log,
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=log, text=True) as driver,
    ):
        for line in driver.stdout:
            event = json.loads(line)
            if event["stage"] == "blocks" and event["done"] in (1, 4, 7) and event["done"] < event["total"]:
                for node in range(2):  # the next visit is on one of them
                    nodes.replace(node)
                    kills += 1
    assert driver.returncode == 0, errors.read_text()
    assert kills == 6
    assert (there / "gaussians.ply").read_bytes() == (here / "gaussians.ply").read_bytes()
