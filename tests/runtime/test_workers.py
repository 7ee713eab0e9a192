"""Workers: one map with results in order, in this process and on a real Ray whose nodes are killed."""

import contextlib
import os
import random
import socket
import subprocess
import sys
import threading
import time
import types
from collections.abc import Iterator

import numpy as np
import pytest
from support import two_nodes

from lexsplat.runtime import ray_connection, ray_tasks, ray_workers
from lexsplat.runtime.errors import CaptureError, TaskError, WorkersError
from lexsplat.runtime.progress import NOTE
from lexsplat.runtime.workers import IN_PROCESS, Needs, SharedFolder, check_spec, open_workers, results

ONES = np.ones(1000, np.float32)
SEEDS = {f"part {seed}": seed for seed in range(12)}


def total(workers, work=two_nodes.noisy_sum, items=SEEDS) -> np.ndarray:
    found = np.zeros_like(ONES)
    for part in results(workers.map(work, ONES, items)):
        found += part
    return found


@pytest.fixture(scope="module")
def nodes() -> Iterator[two_nodes.TwoNodes]:
    pytest.importorskip("ray", reason="needs Ray: pip install 'lexsplat[cluster]'")
    started = two_nodes.TwoNodes()
    yield started
    started.stop()


@pytest.fixture(scope="module")
def on_ray(nodes):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_ADDRESS", nodes.address)
        with open_workers("ray") as workers:
            yield workers


def test_the_order_of_this_sum_matters():
    backwards = dict(reversed(SEEDS.items()))
    assert not np.array_equal(total(IN_PROCESS), total(IN_PROCESS, items=backwards))


def test_one_failure_is_raised_after_the_others_are_done():
    found = results(IN_PROCESS.map(two_nodes.one_broken, None, {str(i): i for i in range(5)}))
    assert [next(found) for _ in range(4)] == [0, 1, 3, 4]
    with pytest.raises(CaptureError, match="photo 2: expected a photo, found a torn file"):
        next(found)


def test_several_failures_are_one_error_that_names_them():
    with pytest.raises(CaptureError) as caught:
        list(results(IN_PROCESS.map(two_nodes.one_broken, None, {"a": 2, "b": 1, "c": 2, "d": 2})))
    assert str(caught.value).endswith("found a torn file (and 2 more failed: c, d); replace it")


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (
            OSError(28, "No space left on device", "/x/y"),
            "found No space left on device: /x/y; fix this and run",
        ),
        (MemoryError(), "found no memory left; give a smaller --memory"),
        (ValueError("no such axis"), "found ValueError: no such axis; fix this and run"),
        (RuntimeError("bad shape"), "found RuntimeError: bad shape; fix this and run"),
    ],
)
def test_any_error_of_a_task_is_reported_with_its_name_and_the_rest_is_kept(error, told):
    outcomes = list(IN_PROCESS.map(two_nodes.raises_second, error, {f"part {i}": i for i in range(4)}))
    assert [o.result for o in outcomes] == [0, None, 2, 3]
    assert str(outcomes[1].error).startswith(f"part 1: expected a result, {told}")
    with pytest.raises(TaskError) as caught:
        list(results(iter(outcomes)))
    assert caught.value.__cause__ is error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(3)])
def test_what_ends_the_program_ends_the_tasks_at_once(error):
    with pytest.raises(type(error)):
        list(IN_PROCESS.map(two_nodes.raises_second, error, {str(i): i for i in range(4)}))


def test_notes_and_warnings_of_a_task_travel_with_its_outcome():
    outcome, said = ray_tasks.run(two_nodes.warns, None, "bath", 3)
    assert (outcome.name, outcome.result) == ("bath", 3)
    assert said == [(NOTE, "about 3 s"), (30, "3 photos are few")]


def test_other_versions_of_packages_on_a_node_are_a_warning(caplog):
    own = ray_workers.versions()
    ray_workers._compare("node a", own)
    assert not caplog.records
    ray_workers._compare("node a", {**own, "torch": "1.0", "transformers": "0.1"})
    assert f"torch 1.0 (here {own['torch']})" in caplog.text
    assert "transformers" not in caplog.text


def test_an_object_store_that_is_too_small_is_reported_with_the_room_that_all_results_need():
    found = str(ray_tasks.store_full(30 << 20, 4, 76 << 20))
    assert found.startswith("object store of Ray: expected room for 4 results of 30MB, found 76MB; start")


def test_the_memory_to_give_leaves_out_what_no_budget_makes_smaller(monkeypatch):
    most = [2670 << 20]
    monkeypatch.setattr(ray_tasks, "_most_memory", lambda: most[0])
    needs = Needs(memory=5632 << 20, libraries=1536 << 20)
    assert str(ray_tasks.no_node(needs)).endswith(
        "found at most 2670MB; use --memory 567MB, or use larger nodes; finished work is kept"
    )
    assert 567 + 1536 < 2670
    most[0] = 1600 << 20
    assert str(ray_tasks.no_node(needs)).endswith(
        "found at most 1600MB; use larger nodes; finished work is kept"
    )


@pytest.mark.parametrize("answer", [b"", b"SSH-2.0-OpenSSH_9.2\r\n", b"HTTP/1.1 400 Bad Request\r\n\r\n"])
def test_an_address_where_another_server_answers_is_refused_at_once_with_the_ports_of_ray(answer):
    def reply():
        connected, _ = listening.accept()
        with connected, contextlib.suppress(OSError):  # the other side may close first
            connected.sendall(answer)
            connected.shutdown(socket.SHUT_WR)
            while connected.recv(100):
                pass

    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=reply, daemon=True).start()
        with pytest.raises(WorkersError, match=r"found a server that is not Ray's; .*HOST:6379, .*10001"):
            ray_connection._greet("127.0.0.1:1", "127.0.0.1", listening.getsockname()[1])


def test_a_server_of_the_client_that_did_not_start_in_time_is_asked_once_more(monkeypatch):
    tried = []

    def init(**_):
        tried.append(1)
        if len(tried) < 2:
            raise ConnectionAbortedError(
                "Initialization failure from server: Starting Ray client server failed"
            )

    monkeypatch.setitem(sys.modules, "ray", types.SimpleNamespace(init=init))
    monkeypatch.setattr(ray_connection, "_greet", lambda *_: None)
    ray_connection.connect("ray://head:10001")
    assert len(tried) == 2


def test_a_ray_that_does_not_start_is_reported_when_its_first_task_is_sent_and_its_thread_ends(monkeypatch):
    def init(**_):
        raise RuntimeError("no room for sockets")

    ended = []
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    stand_in = types.SimpleNamespace(
        init=init, shutdown=lambda: ended.append(threading.current_thread().name)
    )
    monkeypatch.setitem(sys.modules, "ray", stand_in)
    with open_workers("ray") as workers:
        workers.require(())
        with pytest.raises(
            WorkersError, match="Ray at local: expected a running cluster, found no room for sock"
        ):
            list(workers.map(two_nodes.one_broken, None, {"0": 0}))
    assert ended == ["Ray"]


@pytest.mark.parametrize("spec", ["slurm", "ray://", "ray://host", "ray://host:port", "ray:", ""])
def test_unknown_engines_are_refused(spec):
    with pytest.raises(ValueError, match="workers must be none, ray or ray://HOST:PORT"):
        check_spec(spec)


def test_a_folder_is_recognized_by_its_content_and_not_by_its_name(tmp_path):
    with SharedFolder.offered(tmp_path / "there") as folder:
        assert folder.is_visible
        assert not SharedFolder(folder.path, "another token").is_visible
    assert list((tmp_path / "there").iterdir()) == []


def test_without_the_package_the_remedy_is_reported(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with (
        pytest.raises(WorkersError, match=r"found none installed; pip install 'lexsplat\[cluster\]'"),
        open_workers("ray"),
    ):
        pass


def test_nodes_with_another_version_or_none_or_without_the_capture_are_refused():
    own, code = ray_workers.version_of_lexsplat(), ray_workers.code_identity()
    ray_workers._check_probe("a", own, code, [])
    for answer, message in (
        (("", "", []), "node a: expected lexsplat .*, found no lexsplat; install the same"),
        (("0.0.9", "x", []), "found 0.0.9; install"),
        ((own, "x", []), "found .* with other code; install"),
        ((own, code, ["/data/room"]), "found no such file or folder; put capture and scene on a file system"),
    ):
        with pytest.raises(WorkersError, match=message):
            ray_workers._check_probe("a", *answer)


def test_another_version_of_ray_is_reported_with_the_remedy():
    found = RuntimeError("Version mismatch: The cluster was started with:\n Ray: 2.9.0 Python: 3.11.7")
    assert str(ray_connection._unreachable("head:6379", found)) == (
        "Ray at head:6379: expected the same version, found Version mismatch: The cluster was started with: "
        "Ray: 2.9.0 Python: 3.11.7; use the same versions of Ray and Python on every machine"
    )


def test_a_cluster_that_answers_and_lets_nobody_in_may_want_a_token():
    found = RuntimeError("Failed to connect to Ray cluster at head:6379")
    assert "RAY_AUTH_MODE=token" in str(ray_connection._unreachable("head:6379", found, answers=True))
    assert "RAY_AUTH_MODE" not in str(ray_connection._unreachable("head:6379", found))


@pytest.mark.slow
def test_two_nodes_give_the_bits_of_this_process_in_order(on_ray):
    np.testing.assert_array_equal(total(on_ray), total(IN_PROCESS))
    found = [o.result for o in on_ray.map(two_nodes.late_first, None, {str(i): i for i in range(6)})]
    assert found == list(range(6))


@pytest.mark.slow
def test_a_task_that_fails_on_a_node_is_reported_with_its_name_and_the_rest_is_kept(on_ray):
    outcomes = list(on_ray.map(two_nodes.one_broken, None, {str(i): i for i in range(5)}))
    assert [o.result for o in outcomes] == [0, 1, None, 3, 4]
    assert isinstance(outcomes[2].error, CaptureError)
    assert str(outcomes[2].error).startswith("photo 2: expected a photo")


@pytest.mark.slow
@pytest.mark.parametrize("error", [OSError(28, "No space left", "/x"), MemoryError(), ValueError("axis")])
def test_any_error_of_a_task_on_a_node_is_reported_as_in_this_process(on_ray, error):
    items = {f"part {i}": i for i in range(4)}
    here, there = (
        [(o.name, o.result, str(o.error)) for o in each.map(two_nodes.raises_second, error, items)]
        for each in (IN_PROCESS, on_ray)
    )
    assert there == here


@pytest.mark.slow
def test_warnings_on_a_node_are_reported_with_the_name_of_the_task(on_ray, caplog):
    list(on_ray.map(two_nodes.warns, None, {"bath": 8}))
    assert "bath: 8 photos are few" in caplog.messages


@pytest.mark.slow
def test_a_slow_first_task_does_not_idle_the_other_worker(on_ray, tmp_path):
    (tmp_path / "marks").mkdir()
    items = {str(i): i for i in range(12)}
    found = [o.result for o in on_ray.map(two_nodes.waits_for_the_others, tmp_path / "marks", items)]
    assert found == list(range(12))


@pytest.mark.slow
def test_nodes_report_whether_they_see_a_folder_itself(on_ray, tmp_path):
    with SharedFolder.offered(tmp_path / "there") as folder:
        assert on_ray.see(folder)
        assert not on_ray.see(SharedFolder(folder.path, "that of another machine"))


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(on_ray, tmp_path):
    found = [o.result for o in on_ray.map(two_nodes.dies_once, tmp_path, {"a": 0, "b": 1})]
    assert found == [0, 1]


@pytest.mark.slow
def test_a_task_that_kills_every_worker_is_reported_and_the_rest_is_kept(on_ray, monkeypatch):
    monkeypatch.setattr(ray_tasks, "RETRIES", 1)
    outcomes = list(on_ray.map(two_nodes.always_dies, None, {str(i): i for i in range(3)}))
    assert [o.result for o in outcomes] == [0, None, 2]
    assert "its worker died 2 times" in str(outcomes[1].error)


@pytest.mark.slow
def test_tasks_that_no_node_can_hold_are_refused(on_ray):
    with pytest.raises(WorkersError, match="a node with 1048576MB of memory for a task, found at most"):
        list(on_ray.map(two_nodes.late_first, None, {"a": 1}, Needs(memory=1 << 40)))
    with pytest.raises(WorkersError, match=r"object store of Ray: .*--object-store-memory"):
        list(on_ray.map(two_nodes.late_first, None, {"a": 1}, Needs(result=1 << 40)))


@pytest.mark.slow
def test_tasks_whose_only_node_is_gone_end_in_one_line_and_finished_ones_are_kept(nodes, on_ray, monkeypatch):
    monkeypatch.setattr(ray_tasks, "_WITHOUT_NODES_SECONDS", 5.0)
    large = nodes.cluster.add_node(num_cpus=1, memory=1 << 40, object_store_memory=two_nodes.STORE_BYTES)
    items = {str(i): i for i in range(200)}
    found = on_ray.map(two_nodes.slow_sum, ONES, items, Needs(memory=1 << 39))
    kept = [next(found) for _ in range(2)]
    nodes.cluster.remove_node(large, allow_graceful=False)
    with pytest.raises(WorkersError, match=r"a node with 524288MB of memory for a task, found .* is kept"):
        kept.extend(found)
    assert all(outcome.error is None for outcome in kept)
    assert 2 <= len(kept) < len(items)


@pytest.mark.slow
def test_nodes_killed_at_twenty_random_moments_change_no_bit(nodes, on_ray):
    expected, kills, rng = total(IN_PROCESS), 0, random.Random(7)
    while kills < 20:
        found = np.zeros_like(ONES)
        for part in results(on_ray.map(two_nodes.slow_sum, ONES, SEEDS)):
            found += part
            if (
                kills < 20 and rng.random() < 0.7
            ):  # tasks run on, here only the next result is not yet asked for
                time.sleep(rng.uniform(0.0, 0.4))
                nodes.replace(rng.randrange(2))
                kills += 1
        np.testing.assert_array_equal(found, expected)


def test_a_cluster_that_is_not_there_is_reported_in_one_line(monkeypatch):
    pytest.importorskip("ray", reason="needs Ray: pip install 'lexsplat[cluster]'")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with (
        pytest.raises(WorkersError, match=r"Ray at 127\.0\.0\.1:1: expected a running cluster"),
        open_workers("ray"),
    ):
        pass


@pytest.mark.slow
def test_a_cluster_that_disappears_ends_in_one_line(tmp_path):
    pytest.importorskip("ray", reason="needs Ray: pip install 'lexsplat[cluster]'")
    started = two_nodes.TwoNodes(1)
    try:
        script = (
            "from support import two_nodes; from lexsplat.runtime.workers import open_workers\n"
            "from lexsplat import cli\n"
            "def run(words):\n"
            "    with open_workers('ray') as workers:\n"
            "        print('connected', flush=True)\n"
            "        list(workers.map(two_nodes.late_first, None, {'a': 1}))\n"
            "        ones, items = __import__('numpy').ones(9), {str(i): i for i in range(999)}\n"
            "        list(workers.map(two_nodes.slow_sum, ones, items))\n"
            "cli._run = run\n"
            "raise SystemExit(cli.main([]))\n"
        )
        environment = {**os.environ, "RAY_ADDRESS": started.address}
        driver = subprocess.Popen(
            [sys.executable, "-c", script],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        while driver.stdout.readline() != "connected\n":
            assert driver.poll() is None
        time.sleep(2)
        started.cluster.head_node.kill_all_processes(check_alive=False, allow_graceful=False)
        assert "finished work is kept; run the same command again" in driver.communicate(timeout=120)[0]
        assert driver.returncode == 1, "no crash in what is left of Ray"
    finally:
        started.stop()
