"""A Ray of two nodes on this machine, and tasks to run on it."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

import numpy as np

from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.progress import NOTE

STORE_BYTES = 100 << 20


class TwoNodes:
    """A head without cores, and nodes of one core each that can be killed and replaced.

    Args:
        nodes: Number of nodes beside the head.
        client_port: Port for ``ray://``; 0 leaves it closed.
    """

    def __init__(self, nodes: int = 2, client_port: int = 0) -> None:
        from ray.cluster_utils import Cluster

        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112 - workers would wait for all else on this machine
        paths = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))  # workers read the tasks of this file
        head = {"num_cpus": 0, "object_store_memory": STORE_BYTES, "include_dashboard": False}
        if client_port:
            head["ray_client_server_port"] = client_port
        self.client_port = client_port
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        self.nodes = [self.add() for _ in range(nodes)]

    @property
    def address(self) -> str:
        """Address for ``RAY_ADDRESS``."""
        return self.cluster.address

    def add(self):
        """Start one more node."""
        return self.cluster.add_node(num_cpus=1, object_store_memory=STORE_BYTES)

    def replace(self, index: int) -> None:
        """Kill a node with everything that runs on it, and start another."""
        self.cluster.remove_node(self.nodes[index], allow_graceful=False)
        self.nodes[index] = self.add()

    def stop(self) -> None:
        """Stop all nodes."""
        self.cluster.shutdown()


def noisy_sum(shared: np.ndarray, seed: int) -> np.ndarray:
    """Numbers whose sum depends on the order of addition."""
    return shared * np.random.default_rng(seed).normal(size=shared.shape).astype(np.float32)


def slow_sum(shared: np.ndarray, seed: int) -> np.ndarray:
    """`noisy_sum` that takes a while, so that it can be interrupted."""
    time.sleep(0.3)
    return noisy_sum(shared, seed)


def late_first(shared: None, item: int) -> int:
    """Returns the item; the first one takes longest."""
    time.sleep(0.5 if item == 0 else 0.0)
    return item


def one_broken(shared: None, item: int) -> int:
    """Fails for its own reason at 2."""
    if item == 2:
        raise CaptureError("photo 2", expected="a photo", found="a torn file", remedy="replace it")
    return item


def raises_second(error: BaseException, item: int) -> int:
    """Raises the error at 1."""
    if item == 1:
        raise error
    return item


def warns(shared: None, item: int) -> int:
    """Tells a note, a warning, and what nobody asked for."""
    log = logging.getLogger("lexsplat")
    log.info("unasked")
    log.log(NOTE, "about %s s", item)
    log.warning("%s photos are few", item)
    return item


def waits_for_the_others(marks: Path, item: int) -> int:
    """The first task ends when ten others have ended."""
    (marks / str(item)).touch()
    end = time.monotonic() + 60
    while item == 0 and len(list(marks.iterdir())) < 11:
        if time.monotonic() > end:
            raise TimeoutError(f"{len(list(marks.iterdir()))} tasks began")
        time.sleep(0.1)
    return item


def dies_once(marks: Path, item: int) -> int:
    """Kills its process the first time it is run."""
    mark = marks / str(item)
    if not mark.exists():
        mark.touch()
        os._exit(1)
    return item


def always_dies(shared: None, item: int) -> int:
    """Kills its process whenever it is run."""
    if item == 1:
        os._exit(1)
    return item
