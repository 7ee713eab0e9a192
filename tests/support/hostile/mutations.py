"""Mutations of valid files: each is a pair of kind and bytes, and all are seeded. Independent of lexsplat.

The kind "truncated" cuts the file after every byte, or at evenly chosen places of a longer file. The kind "recounted"
has counts that disagree with the data, or data after the end: the file fails or yields what it did before. The other
kinds are random, or enumerate the structure of the format.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

Mutation = tuple[str, bytes]

WORDS = (
    b"\xff\xff\xff\xff\xff\xff\xff\xff",  # the largest count
    b"\xff\xff\xff\xff\xff\xff\xff\x7f",  # the largest signed count
    b"\x00\x00\x00\x00\x01\x00\x00\x00",  # 4 billion
    b"\x00\x00\x00\x00\x00\x00\x00\x00",
    struct.pack("<d", float("nan")),
    struct.pack("<d", float("inf")),
    struct.pack("<d", -1e300),
    struct.pack("<ff", float("nan"), float("-inf")),
    struct.pack("<ff", 3e38, -3e38),
)
"""Eight bytes that are invalid as a count or as a number."""

NAMES = (
    "../../../../etc/passwd", "/etc/passwd", "C:\\windows\\win.ini", "..\\..\\secret.png", "a/../../b.png",
    "~/.ssh/id", "", ".", "..", "/", "a\0b.png", "con\n.png", "x" * 5000, "фото/вид 1.png", "写真/景色.png",
    "صورة.png",
    "é.png", "e\u0301.png", "\u202egnp.png", "\ud83d.png", "%2e%2e/%2e%2e/x.png", "images", "sparse/0/cameras.bin",
)  # fmt: skip
"""Names that point outside the folder, are special to an operating system, or are in other alphabets."""

VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1e308, -1e308, float("nan"), float("inf"), 10**400, 2**31, 2**63, "", "x", "../../x",
    "日本語.png", "1e999", [], {}, [[]], [None], [1e400], {"a": 1}, "A" * 2000,
)  # fmt: skip
"""JSON values of unexpected types and sizes."""

TOKENS = ("nan", "inf", "-inf", "1e400", "-1", "0", "99999999999999999999999", "18446744073709551615", "", "x", "1.5",
          "0x10", "١٢", "1_000", "../../../x.png", "写真.png", "\0", "1 2 3 4 5 6 7 8 9")  # fmt: skip
"""Words that replace a number or name in text."""


def truncated(content: bytes, limit: int = 400) -> Iterator[Mutation]:
    """The file cut after every byte, or at ``limit`` places if it is longer; includes the empty file."""
    count = min(len(content), limit)
    for length in np.unique(np.linspace(0, len(content) - 1, count).astype(int)) if count else []:
        yield "truncated", content[:length]


def flipped(content: bytes, rng: np.random.Generator, count: int) -> Iterator[Mutation]:
    """One bit, one byte, or a few bytes changed."""
    for number in range(count):
        data = bytearray(content)
        for _ in range(1 + number % 3):
            where = int(rng.integers(len(data)))
            data[where] ^= 1 << int(rng.integers(8)) if number % 2 else int(rng.integers(1, 256))
        yield "flipped", bytes(data)


def overwritten(content: bytes, rng: np.random.Generator, count: int, start: int = 0) -> Iterator[Mutation]:
    """Invalid counts and numbers written over eight bytes; the first places in turn, then random ones."""
    span = max(1, len(content) - 8 - start)
    for number in range(count):
        word = WORDS[number % len(WORDS)]
        place = number // len(WORDS) if number < count // 2 else int(rng.integers(span))
        data = bytearray(content)
        data[start + place % span : start + place % span + 8] = word
        yield "numbers", bytes(data[: len(content)])


def shifted(content: bytes, rng: np.random.Generator, count: int) -> Iterator[Mutation]:
    """Parts removed, duplicated, inserted from elsewhere, zeroed, or appended."""
    for number in range(count):
        a, b = sorted(int(v) for v in rng.integers(len(content) + 1, size=2))
        part = content[a:b]
        noise = rng.integers(256, size=int(rng.integers(1, 40)), dtype=np.uint8).tobytes()
        yield (
            "moved",
            (
                content[:a] + content[b:],
                content[:b] + part + content[b:],
                content[:a] + noise + content[a:],
                content[:a] + b"\0" * len(part) + content[b:],
                content + (part or noise),
            )[number % 5],
        )


def foreign(content: bytes) -> Iterator[Mutation]:
    """Files of another format under this name."""
    for data in (
        b"", b"\0", b"\0" * 4096, b"\xff" * 4096,
        b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00\x8c\x05posix\x94.",
        b"PK\x03\x04" + b"\0" * 60, b"\x1f\x8b\x08" + b"\0" * 20, b"{}", b"[]", b"null", b"[" * 100_000, b'"',
        b"{" * 50,
        b"ply\n", b"\x89PNG\r\n\x1a\n", b"\n" * 5000, b"9" * 5000, b"\xef\xbb\xbf{}", "日本".encode("utf-16"),
        b"\x93NUMPY\x01\x00\x76\x00{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n",
    ):  # fmt: skip
        yield "foreign", data


def binary(
    content: bytes, rng: np.random.Generator, count: int = 120, limit: int = 400
) -> Iterator[Mutation]:
    """All mutations of a binary file."""
    yield from truncated(content, limit)
    yield from flipped(content, rng, count)
    yield from overwritten(content, rng, count)
    yield from shifted(content, rng, count // 3)
    yield from foreign(content)


def text(content: bytes, rng: np.random.Generator, count: int = 120, limit: int = 300) -> Iterator[Mutation]:
    """All mutations of a text file: words replaced, lines removed, duplicated or reordered."""
    yield from truncated(content, limit)
    yield from flipped(content, rng, count)
    yield from shifted(content, rng, count // 3)
    yield from foreign(content)
    lines = content.decode().split("\n")
    for _ in range(count):
        changed = list(lines)
        row = int(rng.integers(len(lines)))
        words = changed[row].split(" ")
        words[int(rng.integers(len(words)))] = TOKENS[int(rng.integers(len(TOKENS)))]
        changed[row] = " ".join(words)
        yield "words", "\n".join(changed).encode()
    for row in range(len(lines)):
        yield "lines", "\n".join(lines[:row] + lines[row + 1 :]).encode()
        yield "lines", "\n".join(lines[:row] + [lines[row]] * 2 + lines[row + 1 :]).encode()
        yield "lines", "\n".join(lines[row:] + lines[:row]).encode()


def structure(document: Any, rng: np.random.Generator, limit: int = 600) -> Iterator[Mutation]:
    """A JSON document with one value removed, duplicated or replaced; at most ``limit`` of them."""
    changes: list[tuple[list, Callable[[Any], Any] | None]] = []
    for path in _places(document):
        changes.append((path, None))
        changes += [(path, lambda _, value=value: value) for value in (*VALUES, *NAMES[:3])]
        changes.append((path, lambda old: [old, old]))
        changes.append((path, lambda old: {"x": old}))
        changes.append((path, lambda old: old * 2 if isinstance(old, (list, str)) else old))
    chosen = rng.permutation(len(changes))[:limit]
    for index in sorted(chosen.tolist()):
        path, change = changes[index]
        data = _changed(document, path, change)
        # Lone surrogates cannot be encoded as UTF-8, but a file can contain them as escapes.
        yield "structure", json.dumps(data, ensure_ascii=bool(index % 2)).encode("utf-8", "surrogatepass")


def _places(node: Any, path: tuple = ()) -> Iterator[list]:
    yield list(path)
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield from _places(value, (*path, key))


def _changed(document: Any, path: list, change: Callable[[Any], Any] | None) -> Any:
    """A document with another value at a path; what is not on the path is shared with the old one."""
    if not path:
        return None if change is None else change(document)
    copied, (key, *rest) = document.copy(), path
    if change is None and not rest:
        del copied[key]
    else:
        copied[key] = _changed(document[key], rest, change)
    return copied


def json_file(
    content: bytes, rng: np.random.Generator, count: int = 80, limit: int = 600
) -> Iterator[Mutation]:
    """All mutations of a JSON file."""
    yield from truncated(content, 150)
    yield from flipped(content, rng, count)
    yield from shifted(content, rng, count // 3)
    yield from foreign(content)
    yield from structure(json.loads(content), rng, limit)


def safetensors(
    content: bytes, rng: np.random.Generator, count: int = 80, limit: int = 300
) -> Iterator[Mutation]:
    """Mutations of a safetensors file: of its bytes, and of its JSON header with a corrected length."""
    yield from truncated(content, 120)
    yield from flipped(content, rng, count)
    yield from overwritten(content, rng, count)
    yield from foreign(content)
    (length,) = struct.unpack("<Q", content[:8])
    for wrong in (0, 1, length - 1, length + 1, len(content), 100_000_000, 2**40, 2**63, 2**64 - 1):
        yield "counts", struct.pack("<Q", wrong) + content[8:]
    header = json.loads(content[8 : 8 + length])
    for kind, changed in structure(header, rng, limit):
        yield kind, struct.pack("<Q", len(changed)) + changed + content[8 + length :]


def tensors(content: bytes, rng: np.random.Generator, count: int) -> Iterator[Mutation]:
    """Valid safetensors with other content: a tensor missing, of another shape or type, or with NaN or infinity."""
    import torch
    from safetensors.torch import load, save

    good = load(content)
    (length,) = struct.unpack("<Q", content[:8])
    metadata = json.loads(content[8 : 8 + length]).get("__metadata__")
    if metadata is not None:
        metadata.pop("content", None)  # the hash of the tensors: without it they are looked at one by one
    names = sorted(good)
    for number in range(count):
        name = names[number % len(names)]
        data, old = dict(good), good[name]
        change = int(rng.integers(9))
        if change == 0:
            del data[name]
        elif change == 1:
            data[name] = old[..., :0].clone() if old.ndim else old[None].clone()
        elif change == 2:
            data[name] = torch.cat([old, old]) if old.ndim else old[None].clone()
        elif change == 3:
            data[name] = old[:1].clone() if old.ndim else old.double()[None]
        elif change == 4:
            data[name] = old.to([torch.float16, torch.int64, torch.bool, torch.float64][int(rng.integers(4))])
        elif change == 5 and old.ndim:
            data[name] = old.flatten().clone()
        else:
            flat = old.clone().flatten()
            if flat.is_floating_point() and len(flat):
                flat[int(rng.integers(len(flat)))] = [float("nan"), float("inf"), -1e30, 1e30][
                    int(rng.integers(4))
                ]
            elif len(flat):
                flat[int(rng.integers(len(flat)))] = 120
            data[name] = flat.reshape(old.shape)
        yield "tensors", save(data, metadata)
