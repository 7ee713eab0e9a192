"""The journal of an edit: a step is there whole or not at all, whatever happens to the disk."""

from __future__ import annotations

import json
import logging
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from lexsplat.runtime.errors import SceneFolderError
from lexsplat.scenes.journal import Journal, Step

resource = pytest.importorskip("resource", reason="no limit of file sizes on this system")

SCENE = SimpleNamespace(folder=None, gaussians=range(4))
"""All that a journal reads of a scene."""


def step(phrase: str, size: int = 0) -> dict:
    """A step as the journal keeps it, with so many characters more."""
    return {
        **Step("delete", torch.tensor([True, False, False, True]), {}, phrase).to_json(),
        "more": "x" * size,
    }


def phrases(path: Path) -> list[str]:
    """The steps that another program reads."""
    return [one.phrase for one in Journal(path, SCENE).read()[0]]


@pytest.fixture
def small_files():
    """Runs a function so that no file can become larger than so many bytes: a full disk without a mount."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    told = signal.signal(
        signal.SIGXFSZ, signal.SIG_IGN
    )  # a write beyond the limit is an error instead of the end

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
def test_a_step_that_a_full_disk_refuses_leaves_the_earlier_steps_as_they_were(
    tmp_path, small_files, size, room
):
    path = tmp_path / "edits.jsonl"
    journal = Journal(path, SCENE)
    journal.append(step("mug"))
    journal.append(step("apple"))
    before = path.read_bytes()
    with pytest.raises(OSError, match=r"edits\.jsonl"):
        small_files(len(before) + room, journal.append, step("lamp", size))
    assert path.read_bytes() == before
    assert phrases(path) == ["mug", "apple"]
    journal.append(step("pear"))  # there is room again
    assert phrases(path) == ["mug", "apple", "pear"]


def test_a_first_step_that_a_full_disk_refuses_leaves_no_file(tmp_path, small_files):
    path = tmp_path / "edits.jsonl"
    with pytest.raises(OSError, match=r"edits\.jsonl"):
        small_files(100, Journal(path, SCENE).append, step("mug", 3_000))
    assert not path.exists()


def test_each_step_is_a_line_of_json_below_a_header(tmp_path):
    path = tmp_path / "edits.jsonl"
    journal = Journal(path, SCENE)
    journal.append(step("mug"))
    journal.append({"undo": True})
    header, first, second = map(json.loads, path.read_text().splitlines())
    assert header == {"journal": 1, "gaussians": 4, "reconstruction": None}
    assert (first["step"], first["phrase"], second) == ("delete", "mug", {"undo": True})


def cut_off(path: Path) -> None:
    """A journal whose last step lacks its end, as a computer that stops leaves it."""
    journal = Journal(path, SCENE)
    journal.append(step("mug"))
    journal.append(step("apple"))
    path.write_bytes(path.read_bytes()[:-20])


def test_reading_a_journal_that_is_cut_off_does_not_write(tmp_path):
    path = tmp_path / "edits.jsonl"
    cut_off(path)
    before = path.read_bytes()
    assert phrases(path) == ["mug"]
    assert path.read_bytes() == before


def test_the_next_step_takes_the_place_of_a_line_that_is_cut_off(tmp_path):
    path = tmp_path / "edits.jsonl"
    cut_off(path)
    journal = Journal(path, SCENE)
    journal.read()
    assert journal.is_unchanged
    journal.append(step("lamp"))
    journal.append(step("pear"))
    assert phrases(path) == ["mug", "lamp", "pear"]


def test_of_two_programs_that_read_a_cut_off_journal_the_second_step_is_refused_and_the_first_stays(tmp_path):
    path = tmp_path / "edits.jsonl"
    cut_off(path)
    one, other = Journal(path, SCENE), Journal(path, SCENE)
    one.read(), other.read()
    one.append(step("lamp"))
    with pytest.raises(SceneFolderError, match="steps of another program"):
        other.append(step("pear"))
    assert phrases(path) == ["mug", "lamp"]


def test_a_step_that_another_program_appends_while_a_cut_off_journal_is_read_stays(tmp_path, monkeypatch):
    path = tmp_path / "edits.jsonl"
    cut_off(path)
    other = Journal(path, SCENE)
    other.read()
    # The warning is told between reading and returning: the moment at which the other program writes.
    log = logging.getLogger("lexsplat")
    monkeypatch.setattr(log, "warning", lambda *words: other.append(step("pear")))
    reader = Journal(path, SCENE)
    assert [one.phrase for one in reader.read()[0]] == ["mug"]
    monkeypatch.undo()
    assert phrases(path) == ["mug", "pear"]
    assert not reader.is_unchanged


def test_a_journal_of_which_only_a_part_of_the_header_was_written_begins_anew(tmp_path):
    path = tmp_path / "edits.jsonl"
    path.write_text('{"journal": 1, "gau')
    journal = Journal(path, SCENE)
    assert journal.read() == ([], [])
    journal.append(step("mug"))
    assert phrases(path) == ["mug"]


def test_a_full_disk_leaves_the_complete_lines_of_a_journal_that_is_cut_off(tmp_path, small_files):
    path = tmp_path / "edits.jsonl"
    cut_off(path)
    journal = Journal(path, SCENE)
    journal.read()
    with pytest.raises(OSError, match=r"edits\.jsonl"):
        small_files(path.stat().st_size + 50, journal.append, step("lamp", 3_000))
    assert phrases(path) == ["mug"]
    journal.append(step("pear"))
    assert phrases(path) == ["mug", "pear"]
