"""The kernels of a training are compiled once, in a process of its own, and in the training where that fails."""

import subprocess
import sys
from collections.abc import Callable
from contextlib import contextmanager

import pytest
from support.tiny_capture import write_capture
from support.warm_starts import Program, Stage, run_warm

from lexsplat.reconstruction import first_run
from lexsplat.rendering.kernels import jit
from lexsplat.runtime.progress import Event

TRAINING = """
import sys
import torch
from lexsplat.captures import load_capture
from lexsplat.captures.sfm.triangulation import initial_points
from lexsplat.language.fields.smoothing import mlp
from lexsplat.reconstruction import ReconstructionConfig, Reconstructor, first_run
from lexsplat.rendering.kernels import jit

def used():
    return {(kernel.__name__, signature) for kernel in jit._dispatchers for signature in kernel.signatures}

first_run.compile_kernels("cpu")
first_run._train_a_little()
before = used()
capture = load_capture(sys.argv[1])
trainer = Reconstructor(capture, ReconstructionConfig(iterations=4, warm_up=0.5), initial_points(capture))
for _ in range(4):
    trainer.step()
print(len(before), sorted(used() - before))
mlp((3, 4, 2), None)
print([name for name in ("torch._dynamo", "sympy") if name in sys.modules])
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory) -> list[str]:
    """The lines that a training prints in a new process."""
    capture = write_capture(tmp_path_factory.mktemp("first") / "capture", views=4, width=64, height=48)
    (run,) = run_warm(Stage(["torch"], [[Program(TRAINING, [str(capture)])]]))
    assert run.status == 0, run.err
    return run.out.splitlines()


@pytest.mark.slow
def test_a_training_needs_no_kernel_that_was_not_compiled_before_it(told):
    assert told[0].split(maxsplit=1)[1] == "[]"


@pytest.mark.slow
def test_the_bar_of_the_compilation_has_a_unit_for_each_kernel_that_python_calls(told):
    assert int(told[0].split()[0]) == first_run.KERNELS


@pytest.mark.slow
def test_a_training_does_not_import_the_compiler_of_torch(told):
    """It takes as long to import as torch."""
    assert told[1] == "[]"


class Started(list):
    """Stands in for `subprocess.Popen`: a process that writes a line for each kernel and ends with a status."""

    stdout = [b"\n"] * 3

    def __init__(self, status: int = 0) -> None:
        super().__init__()
        self.returncode, self.killed = status, False

    def __call__(self, command: list[str], **options: object) -> "Started":
        self.append(command)
        if self.returncode < 0:
            raise PermissionError(command[0])
        return self

    def kill(self) -> None:
        self.killed = True

    def __enter__(self) -> "Started":
        return self

    def __exit__(self, *error: object) -> None:
        pass


@pytest.fixture
def nothing_compiled(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(jit, "_cache_folder", lambda: str(tmp_path))


@pytest.mark.parametrize(
    ("status", "here"), [(0, False), (1, True), (-1, True)], ids=["works", "fails", "refused"]
)
def test_kernels_are_compiled_once_by_another_process_or_here_where_it_fails(
    nothing_compiled, monkeypatch, status, here
):
    started, trained = Started(status), []
    monkeypatch.setattr(subprocess, "Popen", started)
    monkeypatch.setattr(first_run, "_train_a_little", lambda: trained.append(True))
    for _ in range(2):
        first_run.compile_kernels("cpu")
    assert started == [[sys.executable, "-m", "lexsplat.reconstruction.first_run"]]
    assert trained == [True] * here


@pytest.mark.parametrize(
    ("status", "elsewhere"), [(0, 3), (1, 3), (-1, 0)], ids=["works", "fails", "refused"]
)
def test_each_kernel_moves_the_bar_wherever_it_is_compiled(nothing_compiled, monkeypatch, status, elsewhere):
    monkeypatch.setattr(subprocess, "Popen", Started(status))
    compiled: list[Callable[[], None]] = []

    @contextmanager
    def each_compiled(told):
        yield compiled.append(told)

    monkeypatch.setattr(jit, "each_compiled", each_compiled)
    monkeypatch.setattr(first_run, "_train_a_little", lambda: [compiled[0]() for _ in range(2)])
    events: list[Event] = []
    first_run.compile_kernels("cpu", events.append)
    kernels, moved = first_run.KERNELS, elsewhere + (2 if status else 0)
    assert events == [Event("kernels", done, kernels) for done in (*range(moved + 1), kernels)]


def test_the_other_process_ends_when_this_one_is_interrupted(nothing_compiled, monkeypatch):
    started = Started()
    monkeypatch.setattr(subprocess, "Popen", started)

    def interrupt(event: Event) -> None:
        if event.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first_run.compile_kernels("cpu", interrupt)
    assert started.killed
    assert not jit.marker_of("training").exists()


def test_a_training_on_a_gpu_compiles_no_kernels_of_the_cpu(nothing_compiled, monkeypatch):
    started, events = Started(), []
    monkeypatch.setattr(subprocess, "Popen", started)
    first_run.compile_kernels("cuda", events.append)
    assert (started, events) == ([], [])
