"""Gaussians of another program: the file is checked before any work (agreement: test_early_checks)."""

import pytest
from support.sog_files import write_streamed

from lexsplat.pipeline.splats import existing_splats, splats_hash
from lexsplat.runtime.errors import FileFormatError


@pytest.mark.parametrize(
    ("name", "found"),
    [
        (None, "no such file"),
        ("absent.ply", "no such file"),
        (".", "a folder without meta.json and lod-meta.json"),
    ],
)
def test_only_an_existing_file_is_taken(tmp_path, name, found):
    with pytest.raises(FileFormatError, match=f"found {found}"):
        existing_splats(None if name is None else tmp_path / name)
    (tmp_path / "there.ply").write_bytes(b"")
    assert existing_splats(tmp_path / "there.ply") == tmp_path / "there.ply"


def test_the_hash_of_a_sog_in_a_folder_depends_on_each_of_its_parts(tmp_path):
    tree = {"lods": {"0": {"file": 0, "offset": 0, "count": 10}}}
    write_streamed(tmp_path, {"0_0": 10}, tree)
    found = {splats_hash(tmp_path)}
    for part in ("0_0/meta.json", "0_0/quats.webp", "lod-meta.json"):
        (tmp_path / part).write_bytes((tmp_path / part).read_bytes() + b" ")
        found.add(splats_hash(tmp_path))
    assert len(found) == 4
    assert splats_hash(tmp_path) == splats_hash(tmp_path / "lod-meta.json") in found
