"""The journal of an edit: a step is there whole or not at all, whatever happens to the disk."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from lexsplat.scenes.journal import Journal, Step

resource = pytest.importorskip("resource", reason="no limit of file sizes on this system")

SCENE = SimpleNamespace(folder=None, gaussians=range(4))
"""All that a journal reads of a scene."""


def step(phrase: str, size: int = 0) -> dict:
    """A step as the journal keeps it, with so many characters more."""
    return {**Step("delete", torch.tensor([True, False, False, True]), {}, phrase).to_json(), "more": "x" * size}


def phrases(path: Path) -> list[str]:
    """The steps that another program reads."""
    return [one.phrase for one in Journal(path, SCENE).read()[0]]


@pytest.fixture
def limited():
    """Runs a function so that no file can become larger than so many bytes: a full disk without a mount."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    told = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write beyond the limit is an error instead of the end

    def run(size: int, function, *arguments) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            function(*arguments)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    yield run
    signal.signal(signal.SIGXFSZ, told)


@pytest.mark.parametrize("size", [0, 3_000, 100_000])
@pytest.mark.parametrize("room", [0, 1, 60])
def test_a_step_that_a_full_disk_refuses_leaves_the_earlier_steps_as_they_were(tmp_path, limited, size, room):
    path = tmp_path / "edits.jsonl"
    journal = Journal(path, SCENE)
    journal.append(step("mug"))
    journal.append(step("apple"))
    before = path.read_bytes()
    with pytest.raises(OSError, match=r"edits\.jsonl"):
        limited(len(before) + room, journal.append, step("lamp", size))
    assert path.read_bytes() == before
    assert phrases(path) == ["mug", "apple"]
    journal.append(step("pear"))  # there is room again
    assert phrases(path) == ["mug", "apple", "pear"]


def test_a_first_step_that_a_full_disk_refuses_leaves_no_file(tmp_path, limited):
    path = tmp_path / "edits.jsonl"
    with pytest.raises(OSError, match=r"edits\.jsonl"):
        limited(100, Journal(path, SCENE).append, step("mug", 3_000))
    assert not path.exists()


def test_each_step_is_a_line_of_json_below_a_header(tmp_path):
    path = tmp_path / "edits.jsonl"
    journal = Journal(path, SCENE)
    journal.append(step("mug"))
    journal.append({"undo": True})
    header, first, second = map(json.loads, path.read_text().splitlines())
    assert header == {"journal": 1, "gaussians": 4, "reconstruction": None}
    assert (first["step"], first["phrase"], second) == ("delete", "mug", {"undo": True})
