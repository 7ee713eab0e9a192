"""Named tensors on disk: safetensors, written whole or not at all, and read only as they were written."""

from __future__ import annotations

import errno
import hashlib
import os
import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from lexsplat.atomic import atomic_path
from lexsplat.errors import FileFormatError

PICKLES = (".pt", ".pth", ".pkl", ".pickle", ".ckpt")
"""Endings of files that may hold pickles. Loading one runs whatever its author put into it: we never do."""

_DIGEST = "content"
"""Metadata entry with a hash of the tensors; files without it, of other programs, are read as they are."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write named tensors and string metadata as safetensors, with a hash of the tensors.

    Raises:
        OSError: If they cannot be written, as on a full disk; what was there stays.
    """
    contiguous = {name: tensor.detach().to("cpu").contiguous() for name, tensor in tensors.items()}
    with atomic_path(path) as temporary:
        save_tensors(contiguous, temporary, {**metadata, _DIGEST: _digest(contiguous)})


def save_tensors(tensors: Mapping[str, Tensor], path: Path, metadata: Mapping[str, str]) -> None:
    """``safetensors.torch.save_file`` that fails as every other way of writing a file does.

    Raises:
        OSError: If the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    try:
        save_file(dict(tensors), path, metadata=dict(metadata))
    except SafetensorError as error:
        found = re.search(r"os error (\d+)", str(error))
        code = int(found[1]) if found else errno.EIO
        raise OSError(code, os.strerror(code), str(path)) from error


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors and the metadata of a safetensors file.

    Raises:
        FileFormatError: If it is missing, truncated, not safetensors, or not what `write_tensors` wrote.
    """
    from safetensors import SafetensorError, safe_open

    refuse_pickle(path)
    try:
        with safe_open(path, framework="pt") as file:
            # Copies: tensors inside the file start anywhere, and where a vector starts decides how it is summed.
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
            expected="the numbers that were written",
            found="others: the file is damaged",
            remedy="run the build again",
        )
    return tensors, metadata


def refuse_pickle(path: Path) -> None:
    """Refuse files that are pickles by their names, and say what to do instead.

    Raises:
        FileFormatError: If it is one.
    """
    if path.suffix.lower() in PICKLES:
        raise FileFormatError(
            path,
            expected="safetensors, .npy, or for splats .ply",
            found="a pickle, which can run any program when it is loaded",
            remedy="open it where you trust it and save it with safetensors.torch.save_file, or export a .ply there",
        )


def _digest(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {list(tensor.shape)};".encode("utf-8", "surrogatepass"))
        if tensor.numel():
            digest.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
