"""Files are whole or not there, and what is read is what was written."""

import errno
import json
import os
import stat

import pytest
import torch

from lexsplat.runtime import files
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import (
    atomic_path,
    naming,
    read_json,
    read_tensors,
    write_file,
    write_json,
    write_tensors,
)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    target = tmp_path / "a.json"
    write_json(target, {"old": 1})

    def cut_short() -> None:
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError):
        cut_short()
    assert read_json(target) == {"old": 1}
    assert os.listdir(tmp_path) == ["a.json"]


def test_an_error_of_the_system_names_the_file_and_not_its_temporary_name(tmp_path):
    target = tmp_path / "a.png"
    with pytest.raises(OSError, match="No space left") as caught, atomic_path(target) as temporary:
        raise OSError(28, "No space left on device", str(temporary))
    assert caught.value.filename == str(target)
    with pytest.raises(OSError, match="other") as caught, atomic_path(target):
        raise OSError(28, "No space left on device", "other")
    assert caught.value.filename == "other"


@pytest.mark.parametrize("name", [None, "x.json", ".x.json.1.2.tmp", ".x.json.work/page/codes.bin"])
def test_an_error_of_a_write_names_the_file_that_was_asked_for(tmp_path, name):
    found = None if name is None else tmp_path / name
    with pytest.raises(OSError, match="No space") as raised, naming(tmp_path / "x.json"):
        raise OSError(errno.ENOSPC, "No space left on device", found)
    assert str(raised.value.filename) == str(tmp_path / "x.json")


@pytest.mark.parametrize(
    "found", [OSError("no number"), FileNotFoundError(errno.ENOENT, "No such file", "y")]
)
def test_an_error_of_another_file_keeps_its_name(tmp_path, found):
    told = str(found)
    with pytest.raises(OSError) as raised, naming(tmp_path / "x.json"):
        raise found
    assert str(raised.value) == told


def test_a_file_in_a_file_system_that_is_read_only_is_named(tmp_path, monkeypatch):
    def refused(path, *_, **__):
        raise OSError(errno.EROFS, "Read-only file system", path)

    monkeypatch.setattr(os, "unlink", refused)  # as Linux refuses it, even of a file that is not there
    monkeypatch.setattr(os, "open", refused)
    with pytest.raises(OSError, match="Read-only") as raised, atomic_path(tmp_path / "x.json") as temporary:
        temporary.touch()
    assert raised.value.filename == str(tmp_path / "x.json")


def test_nan_never_reaches_a_json_file(tmp_path):
    with pytest.raises(ValueError):
        write_json(tmp_path / "a.json", {"psnr": float("nan")})
    assert not (tmp_path / "a.json").exists()


def test_tensors_and_metadata_survive(tmp_path):
    tensors = {"codes": torch.arange(6, dtype=torch.uint8).reshape(2, 3).T, "weights": torch.rand(3).half()}
    write_tensors(tmp_path / "t.safetensors", tensors, {"method": "trained"})
    back, metadata = read_tensors(tmp_path / "t.safetensors")
    assert metadata == {"method": "trained"}
    assert all(torch.equal(back[name], value) for name, value in tensors.items())


@pytest.mark.parametrize("content", [b"", b"\x80\x04pickle", b"\xff" * 64])
def test_files_other_than_safetensors_are_refused(tmp_path, content):
    (tmp_path / "t.safetensors").write_bytes(content)
    with pytest.raises(FileFormatError, match="safetensors"):
        read_tensors(tmp_path / "t.safetensors")


def test_a_truncated_safetensors_is_refused(tmp_path):
    path = tmp_path / "t.safetensors"
    write_tensors(path, {"a": torch.rand(10)}, {})
    data = path.read_bytes()
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(FileFormatError):
            read_tensors(path)


def test_a_file_gets_its_name_after_its_content_is_on_the_disk(tmp_path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        original = getattr(os, name)
        monkeypatch.setattr(
            files.os,
            name,
            lambda *given, name=name, original=original: calls.append(name) or original(*given),
        )
    write_json(tmp_path / "a.json", {})
    assert calls == ["fsync", "replace"]


def test_temporary_files_of_processes_of_other_users_stay(tmp_path, monkeypatch):
    def not_ours(process: int, signal: int) -> None:
        raise PermissionError

    left = tmp_path / ".a.json.123.1.tmp"
    left.write_text("half")
    monkeypatch.setattr(files.os, "kill", not_ours)
    files.remove_left_overs(tmp_path)
    assert left.exists()


def test_json_with_a_byte_order_mark_is_read(tmp_path):
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf" + json.dumps({"name": "Küche"}).encode())
    assert read_json(tmp_path / "a.json") == {"name": "Küche"}


def test_a_changed_bit_of_a_tensor_is_detected(tmp_path):
    path = tmp_path / "t.safetensors"
    write_tensors(path, {"a": torch.ones(4)}, {})
    content = bytearray(path.read_bytes())
    content[-2] ^= 1
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="hash differs"):
        read_tensors(path)


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


def test_the_free_space_of_a_folder_is_that_of_its_disk_and_of_the_limit_of_file_sizes(tmp_path):
    resource = pytest.importorskip("resource", reason="no limit of file sizes on this system")
    status = os.statvfs(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    free = files.free_bytes(tmp_path / "not" / "there" / "yet")
    assert free == pytest.approx(status.f_bavail * status.f_frsize, rel=0.1)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (12_345, before[1]))
        assert files.free_bytes(tmp_path) == 12_345
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_text_is_written_in_utf_8_and_bytes_as_they_are(tmp_path):
    write_file(tmp_path / "new" / "text", "ä\n")
    write_file(tmp_path / "new" / "bytes", b"\xff\r\n")
    assert (tmp_path / "new" / "text").read_bytes() == b"\xc3\xa4\n"
    assert (tmp_path / "new" / "bytes").read_bytes() == b"\xff\r\n"
    assert len(list((tmp_path / "new").iterdir())) == 2
