"""Fingerprints follow content, and nothing else."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from lexsplat.runtime.fingerprints import file_sample, fingerprint


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


@pytest.mark.parametrize("size", [0, 5, 70_000, 200_000])
def test_the_sample_of_a_file_is_that_of_its_copies_and_of_no_other_file(tmp_path, size):
    photo = tmp_path / "photo.jpg"
    content = bytes(range(256)) * 1000
    photo.write_bytes(content[:size])
    sample = file_sample(photo)
    assert file_sample(Path(shutil.copyfile(photo, tmp_path / "copy.jpg"))) == sample
    others = [content[: size + 1]]
    if size:
        others += [b"x" + content[1:size], content[: size - 1] + b"x"]
    for other in others:
        photo.write_bytes(other)
        assert file_sample(photo) != sample
