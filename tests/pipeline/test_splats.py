"""Gaussians of another program: the file is checked before any work (agreement: test_early_checks)."""

import pytest

from lexsplat.pipeline.splats import existing_splats
from lexsplat.runtime.errors import FileFormatError


@pytest.mark.parametrize("name", [None, "absent.ply", "."])
def test_only_an_existing_file_is_taken(tmp_path, name):
    with pytest.raises(FileFormatError, match="no such file"):
        existing_splats(None if name is None else tmp_path / name)
    (tmp_path / "there.ply").write_bytes(b"")
    assert existing_splats(tmp_path / "there.ply") == tmp_path / "there.ply"
