"""A slice of the mutated splat files, in this process; `test_hostile_inputs` reads all of them."""

from __future__ import annotations

import logging
import signal
from pathlib import Path

import pytest
from support.hostile import READERS
from support.hostile.running import interrupt, run_reader

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the memory limit needs Linux"),
]

SLOW = ("compressed_ply", "ksplat")  # each input starts a process
NAMES = [name for name, make in READERS.items() if make.__module__.endswith(".splats") and name not in SLOW]


def test_every_format_that_is_read_has_mutations():
    formats = {"splat_ply", "splat_text_ply", "splat", "spz_2", "spz", "spz_4", "glb", "gltf"}
    formats |= {"sog", "sog_folder", "sog_version_1", "sog_streamed"}
    assert set(NAMES) == formats


@pytest.mark.parametrize("name", NAMES)
def test_damaged_splats_are_read_correctly_or_refused_with_one_line(tmp_path, name, caplog, recwarn):
    caplog.set_level(logging.CRITICAL, "lexsplat")
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        report = run_reader(name, tmp_path / "work", tmp_path / "current", every=29)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert not report.failures, "\n".join(report.failures)
    assert report.inputs > 20
    assert report.right
    assert sum(report.errors.values())
