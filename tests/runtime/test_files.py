import os
import stat

import pytest
import torch

from lexsplat.runtime.files import atomic_path, read_tensors, write_json, write_tensors


def test_tensors_that_are_read_are_aligned(tmp_path):
    # 1 and 3 bytes shift everything behind them in the file.
    tensors = {f"{n}": torch.arange(n, dtype=torch.uint8) for n in (1, 3)}
    tensors |= {f"t{n}": torch.rand(n, 5) for n in (1, 2, 7)}
    write_tensors(tmp_path / "t.safetensors", tensors, {"who": "me"})
    found, metadata = read_tensors(tmp_path / "t.safetensors")
    assert metadata == {"who": "me"}
    assert set(found) == set(tensors)
    for name, tensor in found.items():
        assert torch.equal(tensor, tensors[name])
        assert tensor.data_ptr() % 64 == 0, (
            "sums over it have the bits of sums over a tensor that was never stored"
        )


def test_equal_tensors_and_metadata_give_equal_bytes(tmp_path):
    tensors = {"a": torch.rand(3, 2), "b": torch.arange(5)}
    metadata = {f"key {i}": 'väl"ue\\ \n\t\x01 \U0001f34e' * i for i in range(12)}
    contents = set()
    for i in range(20):
        path = tmp_path / f"{i}.safetensors"
        write_tensors(path, tensors, dict(sorted(metadata.items(), reverse=i % 2 == 1)))
        contents.add(path.read_bytes())
    assert len(contents) == 1
    found, read = read_tensors(path)
    assert read == metadata
    assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items())


@pytest.mark.parametrize(("umask", "expected"), [(0o022, 0o644), (0o002, 0o664), (0o077, 0o600)])
def test_written_files_have_the_permissions_of_the_umask(tmp_path, umask, expected):
    before = os.umask(umask)
    try:
        write_tensors(tmp_path / "tensors", {"a": torch.zeros(1)}, {})
        write_json(tmp_path / "json", {})
        with atomic_path(tmp_path / "text") as path:
            path.write_text("text")
    finally:
        os.umask(before)
    for name in ("tensors", "json", "text"):
        assert stat.S_IMODE((tmp_path / name).stat().st_mode) == expected
