"""Fingerprints follow content, and nothing else."""

import dataclasses
from pathlib import Path

from lexsplat.runtime.fingerprints import fingerprint


@dataclasses.dataclass(frozen=True)
class Settings:
    rate: float = 0.1
    sizes: tuple[int, ...] = (1, 2)
    folder: Path = Path("x")


def test_fingerprints_change_with_any_field_and_with_nothing_else():
    same = fingerprint(Settings(), {"b": 1, "a": 2})
    assert same == fingerprint(Settings(), {"a": 2, "b": 1})
    assert same != fingerprint(Settings(rate=0.2), {"b": 1, "a": 2})
    assert same != fingerprint(Settings(sizes=(1, 3)), {"b": 1, "a": 2})
    assert same != fingerprint({"b": 1, "a": 2}, Settings())
