"""Finds the folder of a model: in the package, a given folder, the Hub's cache, or on the Hub.

Encoders are built from a local folder, so their code is the same with and without internet.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import time
from collections.abc import Collection, Iterable, Iterator
from difflib import get_close_matches
from itertools import chain
from pathlib import Path
from shlex import quote
from typing import Any

from lexsplat.features.weights import (
    INDEX,
    PICKLED_INDEX,
    WEIGHTS,
    fault_of_index,
    first_weights,
    read_config,
    weight_files,
)
from lexsplat.runtime.errors import ModelError
from lexsplat.runtime.files import free_bytes, write_file
from lexsplat.runtime.fingerprints import blocks, digest
from lexsplat.runtime.progress import NOTE
from lexsplat.runtime.user_cache import user_cache

log = logging.getLogger("lexsplat")

BUNDLED_ENCODERS = Path(__file__).resolve().parent.parent / "demo" / "encoders"
"""Folder of the bundled encoders."""

PINNED = {
    # Pinned by public projects, which read its open_clip_model.safetensors.
    "laion/CLIP-ViT-B-16-laion2B-s34B-b88K": "7288da5a0d6f0b51c4a2b27c624837a9236d0112",
    # https://huggingface.co/facebook/dino-vits8/tree/483f2fc47097ae6f0afc8bcfb43004224bddeae2 has model.safetensors.
    "facebook/dino-vits8": "483f2fc47097ae6f0afc8bcfb43004224bddeae2",
}
"""Revisions of the default models on the hub that are looked for before ``main``. No test downloads them."""

_PREPROCESSING = ("preprocessor_config.json", "processor_config.json")
_VOCABULARIES = (
    "tokenizer.json", "vocab.json", "vocab.txt", "spiece.model", "tokenizer.model", "sentencepiece.bpe.model",
)  # fmt: skip
TOKENIZER_SETTINGS = ("tokenizer_config.json", "special_tokens_map.json", "added_tokens.json")
_OTHERS = {"segments": "superpixels, which need no model (`--features.segments slic`)"}
"""Alternative for a role without a bundled model."""
_NEARLY = 0.95  # likeness of names from which on one is the other misspelt
_HUB_TIMEOUT = 5.0  # seconds to wait for the hub's first response; without a network it fails at once

KEPT_FROM = 1 << 26
"""Bytes of a model from which the user's cache keeps its hash; below, it takes a tenth of a second."""
_FRESH = 2.0
"""Seconds after a change in which another one might leave the time of the file as it is."""

_MISTAKES = (ArithmeticError, AssertionError, AttributeError, LookupError, NameError, TypeError)
"""Errors of the program, not of the network."""


def present_name(name: str) -> str:
    """The name of a model; "embedded" is an alias of "bundled"."""
    return "bundled" if name == "embedded" else name


def model_folder(name: str, tower: str) -> Path:
    """The local folder of a model, downloaded if necessary.

    Args:
        name: A folder, a name on the Hugging Face Hub, or "bundled".
        tower: Role of the model: "clip", "dino" or "segments".

    Returns:
        A folder with a configuration, weights, and for "clip" a tokenizer.

    Raises:
        ModelError: If the folder lacks one of them or may not be read, or the model is neither in the hub's cache nor
            can be downloaded.
    """
    if present_name(name) == "bundled":
        return BUNDLED_ENCODERS / tower
    if not name.strip():  # as a path, it is the working directory
        expected = "a folder or a model name"
        raise ModelError("model", expected=expected, found="nothing", remedy=_choices(tower))
    folder = Path(name).expanduser()
    if folder.is_dir():
        _check_readable(folder, os.R_OK | os.X_OK)
        lacking = missing_part(folder, tower)
        if lacking:
            if "tokenizer" in lacking:
                _check_has_text(folder, name)
            pickled = lacking == "model.safetensors" and (folder / PICKLED_INDEX).is_file()
            found = f"{PICKLED_INDEX}, whose shards are pickles" if pickled else _contents(folder)
            raise ModelError(
                name,
                expected=f"a model folder with {lacking}",
                found=fault_of_index(folder) if lacking.startswith("all") else found,
                remedy=_remedy_of_pickles(name) if pickled else _remedy_for(lacking, name, tower),
            )
        for path in loaded_files(folder, tower):
            _check_readable(path)
        return folder
    if folder.exists():
        is_model = (folder.parent / "config.json").is_file()
        remedy = f"give its folder: {_option(tower)} {folder.parent}" if is_model else _choices(tower)
        raise ModelError(name, expected="a model folder", found="a file", remedy=remedy)
    if "/" not in name and get_close_matches(name.lower(), ("bundled", "embedded")):
        expected, remedy = "a model folder, or a name OWNER/NAME", f"use `--{tower} bundled`"
        raise ModelError(name, expected=expected, found="no such folder", remedy=remedy)
    if len(folder.parts) > 2 or name.startswith((".", "~")):  # names on the hub are OWNER/NAME
        expected = "a model folder, or a name OWNER/NAME"
        raise ModelError(name, expected=expected, found="no such folder", remedy=_choices(tower))
    cached, lacking = _cached_folder(name, tower)
    return cached if cached is not None else _download(name, tower, lacking)


def local_folder(name: str) -> Path | None:
    """The folder of a CLIP model if it is on this machine, complete or not; does not use the network."""
    if present_name(name) == "bundled":
        return BUNDLED_ENCODERS / "clip"
    folder = Path(name).expanduser()
    return folder if folder.is_dir() else _cached_folder(name, "clip")[0]


def missing_part(folder: Path, tower: str) -> str:
    """Name of a file that a model folder lacks; "" if it is complete."""
    if not (folder / "config.json").is_file():
        return "config.json"
    if not weight_files(folder):
        return "all shards of model.safetensors" if (folder / INDEX).is_file() else "model.safetensors"
    if tower == "clip" and not _vocabulary(folder):
        return "a tokenizer (tokenizer.json)"
    return ""


def _vocabulary(folder: Path) -> list[Path]:
    """The files of the tokenizer's vocabulary; empty if there are none."""
    found = [folder / name for name in _VOCABULARIES if (folder / name).is_file()]
    if found and found[0].name == "vocab.json":  # byte-pair encoding also needs its merges
        return [*found, folder / "merges.txt"] if (folder / "merges.txt").is_file() else []
    models = [path for path in found if path.suffix == ".model"]  # read even where there is a tokenizer.json
    return [found[0], *(path for path in models if path != found[0])] if found else []


def tokenizer_files(folder: Path) -> list[Path]:
    """The files of a tokenizer: its vocabulary, then its settings."""
    settings = [path for name in TOKENIZER_SETTINGS if (path := folder / name).is_file()]
    return [*_vocabulary(folder), *settings]


def loaded_files(folder: Path, tower: str) -> list[Path]:
    """The files of a model folder on which its output depends, sorted."""
    settings = [] if (path := preprocessing_file(folder)) is None else [path]
    if tower == "clip":
        settings += tokenizer_files(folder)
    index = [folder / INDEX] if (folder / INDEX).is_file() and len(weight_files(folder)) > 1 else []
    return sorted([folder / "config.json", *weight_files(folder), *index, *settings])


def preprocessing(folder: Path) -> dict[str, Any]:
    """The settings of the image preprocessor; empty without a file of them.

    Raises:
        ModelError: If the file is damaged.
    """
    path = preprocessing_file(folder)
    content = {} if path is None else read_config(path, "an image preprocessor")
    inner = content.get("image_processor", content)
    return inner if isinstance(inner, dict) else {}


def preprocessing_file(folder: Path) -> Path | None:
    """The file with the settings of the image preprocessor; None if there is none."""
    return next((path for name in _PREPROCESSING if (path := folder / name).is_file()), None)


def content_hash(folder: Path, tower: str) -> str:
    """Hash of the files on which a model's output depends (`loaded_files`). 32 hex digits.

    The process keeps the hash under the place, size and time of change of the files. The user's cache keeps hashes of
    large models under the same facts.
    """
    return hash_of(loaded_files(folder, tower))


def hash_of(files: list[Path]) -> str:
    """`content_hash` of these files, sorted."""
    state = _state(files)
    if state in _hashes:
        return _hashes[state]
    kept = _path_of_hash(state)
    with contextlib.suppress(OSError, UnicodeDecodeError):
        if kept is not None and re.fullmatch("[0-9a-f]{32}", known := kept.read_text()):
            return _hashes.setdefault(state, known)
    found = digest((part for path in files for part in chain([path.name.encode()], blocks(path))), 16)
    if state and state == _state(files):  # no file has changed meanwhile
        _hashes[state] = found
        with contextlib.suppress(OSError):
            if kept is not None:
                write_file(kept, found)
    return found


_State = tuple[tuple[str, str, int, int, int], ...]
_hashes: dict[_State, str] = {}


def _state(files: Iterable[Path]) -> _State:
    """Names, places, sizes and times of files, which differ once a file is changed; () for fresh files."""
    facts = [(path, path.stat()) for path in files]
    if time.time() - max(stat.st_mtime for _, stat in facts) < _FRESH:
        return ()
    return tuple(
        (path.name, str(path.resolve()), stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)
        for path, stat in facts
    )


def _path_of_hash(state: _State) -> Path | None:
    """Where the hash of files is kept; None for small models, fresh files, and users without a home."""
    if sum(size for _, _, size, _, _ in state) < KEPT_FROM:
        return None
    with contextlib.suppress(RuntimeError):
        return user_cache() / "hashes" / digest([repr(list(state)).encode()], 16)
    return None


def _check_readable(path: Path, mode: int = os.R_OK) -> None:
    """Refuse a file or folder without permission."""
    if not os.access(path, mode):
        remedy = f"allow it: chmod u+r{'x' if mode & os.X_OK else ''} {quote(str(path))}"
        raise ModelError(path, expected="permission to read it", found="none", remedy=remedy)


def _check_has_text(folder: Path, name: str) -> None:
    """Refuse an encoder of photos alone where an image-text model is needed: a tokenizer would not help it."""
    config = read_config(folder / "config.json", "a model configuration")
    if "model_type" in config and not any(key.startswith("text_config") for key in config):
        found = f"a {config['model_type']!r} model without a text tower"
        expected = "an image-text model such as CLIP"
        raise ModelError(name, expected=expected, found=found, remedy=_choices("clip"))


def _contents(folder: Path) -> str:
    links = sorted(f"{path.name} (a broken link)" for path in folder.iterdir() if not path.exists())
    folders = sorted(f"{path.name} (a folder)" for path in folder.iterdir() if path.is_dir())
    names = [*links, *folders, *sorted(path.name for path in folder.iterdir() if path.is_file())]
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "") if names else "an empty folder"


def _remedy_for(lacking: str, name: str, tower: str) -> str:
    if "tokenizer" in lacking:
        return (
            f"copy the tokenizer files of its repository to {name}, or write them there with save_pretrained"
        )
    other = _OTHERS.get(tower, f"`--{tower} bundled`")
    return f"give a folder written by save_pretrained, a model name, or {other}"


def _remedy_of_pickles(name: str) -> str:
    """How to write safetensors of pickled shards."""
    place = repr(str(Path(name).expanduser()))
    written = f"AutoModel.from_pretrained({place}).save_pretrained({place})"
    return f"write it in Python: from transformers import AutoModel; {written}"


# -- the hub


def _revisions(name: str) -> list[str]:
    return [*([PINNED[name]] if name in PINNED else []), "main"]


def _cached_folder(name: str, tower: str) -> tuple[Path | None, str]:
    """Folder of a model in the hub's cache, or None, and what a cached copy lacks; does not use the network."""
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError

    lacking = ""
    for revision in _revisions(name):
        try:
            folder = Path(snapshot_download(name, revision=revision, local_files_only=True))
        except (OSError, HFValidationError):
            continue
        lacking = missing_part(folder, tower)
        if not lacking:
            return folder, ""
    return None, lacking


def _download(name: str, tower: str, lacking: str) -> Path:
    """Download a model from the hub; logs its license and size first. ``lacking``: what a copy in the cache lacks."""
    from huggingface_hub import HfApi, constants, snapshot_download

    cache = Path(constants.HF_HUB_CACHE)
    try:
        facts = _repository(HfApi(), name)
        sizes = {file.rfilename: file.size or 0 for file in facts.siblings or []}
        files = _wanted(sizes, tower)
        _check_complete(name, tower, sizes, files)
        size = sum(sizes[file] for file in files)
        card = facts.card_data or {}
        license_name = card.get("license_name") or card.get("license") or "unknown, see its page"
        log.log(
            NOTE, "%s: %s are downloaded once to %s; license: %s", name, _megabytes(size), cache, license_name
        )
        _check_space(name, size, cache)
        folder = snapshot_download(name, revision=facts.sha, allow_patterns=files, etag_timeout=_HUB_TIMEOUT)
    except (ModelError, *_MISTAKES):
        raise
    except Exception as error:
        # A missing network raises many types, depending on the HTTP library and the proxy.
        raise _refusal(name, tower, error, cache, lacking) from error
    return Path(folder)


def _repository(api: Any, name: str) -> Any:
    """The hub's description of a model, at its pinned revision if it has one."""
    from huggingface_hub.errors import RevisionNotFoundError

    for revision in _revisions(name):
        try:
            return api.model_info(name, revision=revision, files_metadata=True, timeout=_HUB_TIMEOUT)
        except RevisionNotFoundError:
            if revision == "main":
                raise
            log.warning("%s: the hub has no revision %s; main is taken", name, revision[:8])
    raise AssertionError("the last revision is main")


def _wanted(names: Collection[str], tower: str) -> list[str]:
    """The files of a repository that are needed, of those that it has."""
    weights = first_weights(names)
    shards = [name for name in names if name.startswith("model-") and name.endswith(".safetensors")]
    wanted = {"config.json", *_PREPROCESSING, weights, *(shards if weights == INDEX else [])}
    if tower == "clip":
        wanted |= {*_VOCABULARIES, "merges.txt", *TOKENIZER_SETTINGS}
    return sorted(name for name in names if name in wanted)


def _check_complete(name: str, tower: str, names: Collection[str], wanted: Collection[str]) -> None:
    if "config.json" not in wanted:
        others = "config.json of transformers", "a repository of another library"
    elif not set(WEIGHTS) & set(wanted):
        others = f"one of {', '.join(WEIGHTS)}", PICKLED_INDEX if PICKLED_INDEX in names else "none of them"
    elif tower == "clip" and not set(_VOCABULARIES) & set(names):
        others = "a tokenizer", "none in its repository"
    else:
        return
    raise ModelError(f"model {name}", expected=others[0], found=others[1], remedy=_choices(tower))


def _check_space(name: str, size: int, cache: Path) -> None:
    free = free_bytes(cache)
    if free < size:
        raise _no_space(name, cache, f"{_megabytes(size)} of free space", _megabytes(free))


def _no_space(name: str, cache: Path, expected: str, found: str) -> ModelError:
    remedy = "free some space, or set HF_HOME to a folder on another disk"
    return ModelError(f"model {name}: {cache}", expected=expected, found=found, remedy=remedy)


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.0f} MB"


def _choices(tower: str) -> str:
    other = _OTHERS.get(tower, f"the small bundled encoder (`--{tower} bundled`)")
    other += "; or go without (`--dino none`)" if tower == "dino" else ""
    return f"give another model, a folder (`{_option(tower)} FOLDER`), or {other}"


def _near(name: str, tower: str) -> str:
    """The start of a remedy for a name that is nearly that of a default model; "" for others."""
    known = {pinned.lower(): pinned for pinned in PINNED}
    found = get_close_matches(name.lower(), known, n=1, cutoff=_NEARLY) if name not in PINNED else []
    return f"use `--{tower} {known[found[0]]}` if you mean that; or " if found else ""


def _option(tower: str) -> str:
    return f"--features.{tower}" if tower in _OTHERS else f"--{tower}"


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error and the errors that it was raised from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _refusal(name: str, tower: str, error: Exception, cache: Path, lacking: str) -> ModelError:
    """The error for a failed download, by its cause."""
    from huggingface_hub import errors as hub

    def refuse(expected: str, found: str, remedy: str) -> ModelError:
        return ModelError(f"model {name}", expected=expected, found=found, remedy=remedy)

    numbers = {getattr(cause, "errno", None) for cause in _causes(error)}
    if errno.ENOSPC in numbers or errno.EDQUOT in numbers:
        return _no_space(name, cache, "free space for the download", "a full disk")
    if numbers & {errno.EACCES, errno.EPERM, errno.EROFS}:
        remedy = "allow writing there, or set HF_HOME to a folder of your own"
        return ModelError(
            f"model {name}: {cache}",
            expected="a folder that can be written",
            found="no permission",
            remedy=remedy,
        )
    if isinstance(error, hub.GatedRepoError):
        page = f"https://huggingface.co/{name}"
        remedy = f"accept the license on {page}, run `hf auth login`, and run again; or {_choices(tower)}"
        return refuse(
            "access to its files", "a gated model whose license this account has not accepted", remedy
        )
    if isinstance(error, hub.RepositoryNotFoundError):
        remedy = f"check the spelling (a private model needs `hf auth login`); or {_choices(tower)}"
        remedy = _near(name, tower) + remedy
        return refuse(
            "a folder or the name of a model on the hub", "no such folder and no such model", remedy
        )
    if isinstance(error, hub.HFValidationError):
        return refuse("a folder or a model name", "neither a folder nor a valid model name", _choices(tower))
    found = f"no local copy, and the hub cannot be reached ({type(error).__name__})"
    if isinstance(error, hub.OfflineModeIsEnabled):
        found = "no local copy, and HF_HUB_OFFLINE is set"
    elif isinstance(error, hub.HfHubHTTPError):
        status = getattr(getattr(error, "response", None), "status_code", None)
        found = f"the hub responded with {status or 'an error'}"
    expected = "a downloaded model"
    remedy = f"connect to the internet and run again (it is downloaded once); or {_choices(tower)}"
    if lacking:
        found = f"a copy in {cache} without {lacking}; {found.removeprefix('no local copy, and ')}"
    elif name not in PINNED:  # OWNER/NAME may as well be a path
        found = f"no such folder, {'' if found.startswith('no ') else 'and '}{found}"
        expected = f"a model folder or {expected}"
        remedy = f"{_near(name, tower)}check the path, or {remedy}"
    return refuse(expected, found, remedy)
