"""Files that are written completely or not at all: the atomic rename, JSON and named tensors."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from threading import get_ident
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lexsplat.runtime.errors import FileFormatError

_TEMPORARY = re.compile(r"\..*\.(\d+)\.\d+\.tmp")
"""Names of temporary files: .NAME.PROCESS.THREAD.tmp"""


@contextlib.contextmanager
def atomic_path(path: Path, lasting: bool = True) -> Iterator[Path]:
    """A temporary path beside ``path`` that replaces it when the block ends without an error.

    Readers see the old file or the new one, never a part. The data reach the disk before the name changes. Missing
    folders are created. Threads and processes may write the same file at once; the last one wins. Errors of the
    system name ``path``.

    Args:
        path: The file.
        lasting: Whether the data must outlast a loss of power, which takes milliseconds; a cache that is checked when
            it is read need not.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{get_ident()}.tmp")
    try:
        with naming(path):
            yield temporary
            if lasting:
                with open(temporary, "rb") as file:
                    os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):  # a read-only file system refuses it even where there is no file
            temporary.unlink(missing_ok=True)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file as `atomic_path` does; a text in UTF-8."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of the system in the block name ``path``, not nothing and not a temporary ``.NAME.*`` beside it."""
    try:
        yield
    except OSError as error:
        beside = str(path.with_name(f".{path.name}."))
        if error.errno is not None and str(error.filename or beside).startswith(beside):
            error.filename = str(path)
        raise


def require_writable(folder: Path) -> None:
    """Refuse a folder that takes no file, before something is computed that would be lost.

    Raises:
        OSError: As the system gives it; names the folder.
    """
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        error.filename = str(folder)
        raise


def free_bytes(folder: Path) -> int:
    """Bytes that a new file in a folder may have: of its disk, and of the limit of file sizes, if there is one.

    Args:
        folder: It, or a part of what is above it, exists.
    """
    free = shutil.disk_usage(next(path for path in (folder, *folder.parents) if path.exists())).free
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return free
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return free if limit == resource.RLIM_INFINITY else min(free, limit)


def link_or_copy(source: Path, target: Path) -> None:
    """A second name of a file; a copy on another file system, or one without hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def remove_left_overs(root: Path) -> None:
    """Delete the temporary files below ``root`` that killed processes left behind.

    Files of running processes stay: a query may be writing while a build starts.
    """
    for path in root.rglob(".*.tmp"):
        match = _TEMPORARY.fullmatch(path.name)
        if match and not _is_running(int(match[1])):
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(root: Path, refusal: Callable[[str], Exception]) -> Iterator[None]:
    """Lock a folder for one writer, and remove what killed ones left; the lock ends with the process.

    Args:
        root: The folder; created if missing.
        refusal: The error where another process holds the lock, from the number of that process.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no flock: two writers there are not detected
        yield
        return
    root.mkdir(parents=True, exist_ok=True)
    with open(root / ".lock", "a+", encoding="ascii") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            raise refusal(file.read(20).strip() or "another process") from error
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        remove_left_overs(root)
        yield


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it runs as another user
        return True
    return True


_MAX_JSON_BYTES = 256 << 20


def to_json(value: Any) -> Any:
    """Plain JSON data from dataclasses, paths, tuples and numpy values.

    Raises:
        TypeError: If a value has no JSON form.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [to_json(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"no JSON form for {type(value).__name__}")


def write_json(path: Path, data: Any) -> None:
    """Write ``data`` as indented JSON.

    Raises:
        ValueError: If it holds NaN or infinity, which are not JSON.
    """
    text = json.dumps(to_json(data), indent=2, allow_nan=False, ensure_ascii=False)
    write_file(path, text + "\n")


def read_json(path: Path, *, remedy: str = "") -> Any:
    """Read a JSON file in UTF-8, with or without a byte order mark. NaN and infinity are read.

    Args:
        path: The file.
        remedy: Advice to the user if the file is not valid.

    Raises:
        FileFormatError: If it cannot be read, is not JSON, or is larger than 256 MiB.
    """
    try:
        size = path.stat().st_size
        if size <= _MAX_JSON_BYTES:
            return json.loads(path.read_bytes().decode("utf-8-sig"))
        found = f"{size} bytes"
    except OSError as error:
        found = str(error.strerror)
    except UnicodeDecodeError as error:
        found = f"invalid UTF-8 at byte {error.start}"
    except RecursionError:
        found = "brackets nested too deeply"
    except ValueError as error:
        found = str(error)
    raise FileFormatError(path, expected="JSON", found=found, remedy=remedy)


PICKLES = (".pt", ".pth", ".pkl", ".pickle", ".ckpt")
"""Suffixes of files that may hold pickles. Unpickling runs arbitrary code, so lexsplat never does it."""

_DIGEST = "content"
"""Metadata entry with a hash of the tensors; files of other programs lack it and are not checked."""


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str], lasting: bool = True
) -> None:
    """Write named tensors and string metadata as safetensors, with a hash of the tensors (`atomic_path`).

    Raises:
        OSError: If they cannot be written, for example on a full disk; an existing file stays.
    """
    contiguous = {name: tensor.detach().to("cpu").contiguous() for name, tensor in tensors.items()}
    with atomic_path(path, lasting) as temporary:
        save_tensors(contiguous, temporary, {**metadata, _DIGEST: _digest(contiguous)})


def save_tensors(tensors: Mapping[str, Tensor], path: Path, metadata: Mapping[str, str]) -> None:
    """``safetensors.torch.save_file`` with equal bytes for equal arguments, and with ``OSError`` for failed writes.

    safetensors writes the metadata in random order; here they are sorted. It also creates files that only their owner
    can read; here the permissions follow the umask.

    Raises:
        OSError: If the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    path.touch()
    permissions = stat.S_IMODE(path.stat().st_mode)  # reading the umask itself would mean setting it
    try:
        save_file(dict(tensors), path, metadata=dict(metadata))
    except SafetensorError as error:
        found = re.search(r"os error (\d+)", str(error))
        code = int(found[1]) if found else errno.EIO
        raise OSError(code, os.strerror(code), str(path)) from error
    path.chmod(permissions)
    _sort_metadata(path)


def _sort_metadata(path: Path) -> None:
    """Rewrite the header of a safetensors file in place, with sorted metadata.

    The file starts with the length of the header as a 64-bit little-endian integer, followed by the header as JSON,
    padded with spaces. Sorting does not change its length.
    """
    with open(path, "r+b") as file:
        length = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(length))
        if "__metadata__" not in header:
            return
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        content = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode("utf-8")
        if len(content) > length:
            raise FileFormatError(path, expected=f"a header of {length} bytes", found=f"{len(content)} bytes")
        file.seek(8)
        file.write(content.ljust(length))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors and the metadata of a safetensors file.

    Raises:
        FileFormatError: If it is missing, truncated, not safetensors, or differs from what `write_tensors` wrote.
    """
    from safetensors import SafetensorError, safe_open

    refuse_pickle(path)
    try:
        with safe_open(path, framework="pt") as file:
            # Copies, because tensors in the file are not aligned, and alignment affects the rounding of sums.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
            metadata = dict(file.metadata() or {})
    except (OSError, SafetensorError, ValueError, RuntimeError, OverflowError) as error:
        raise FileFormatError(
            path, expected="a safetensors file", found=str(error)[:200], remedy="run the build again"
        ) from error
    written = metadata.pop(_DIGEST, None)
    if written is not None and written != _digest(tensors):
        raise FileFormatError(
            path,
            expected="the tensors that were written",
            found="damaged content (the hash differs)",
            remedy="run the build again",
        )
    return tensors, metadata


def refuse_pickle(path: Path) -> None:
    """Refuse files whose suffix is that of a pickle.

    Raises:
        FileFormatError: If it is a pickle; the message names the alternative.
    """
    if path.suffix.lower() in PICKLES:
        raise FileFormatError(
            path,
            expected="safetensors, .npy, or for splats .ply",
            found="a pickle, which can run arbitrary code when loaded",
            remedy="open it where you trust it and save it with safetensors.torch.save_file, or export a .ply",
        )


def _digest(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {list(tensor.shape)};".encode("utf-8", "surrogatepass"))
        if tensor.numel():
            digest.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
