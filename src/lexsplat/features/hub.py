"""Finds the folder of a model: in the package, a given folder, the hub's cache, or on the hub.

Only safetensors are loaded. Encoders are built from a local folder, so their code is the same with and without
internet.
"""

from __future__ import annotations

import hashlib
import logging
import re
from pathlib import Path
from typing import Any

from lexsplat.runtime.errors import FileFormatError, ModelError
from lexsplat.runtime.files import read_json

log = logging.getLogger("lexsplat")

BUNDLED_ENCODERS = Path(__file__).resolve().parent.parent / "demo" / "encoders"
"""Folder of the bundled encoders."""

_WANTED_FILES = ["*.json", "*.txt", "*.model", "model*.safetensors"]
_HUB_TIMEOUT = 5.0  # seconds to wait for the hub's first response; without a network it fails at once
_CONVERSION_BOT = "SFconvertbot"  # opens pull requests with safetensors on repositories without them


def model_folder(name: str, tower: str) -> Path:
    """The local folder of a model, downloaded if necessary.

    Args:
        name: A folder, a name on the Hugging Face Hub, or "bundled".
        tower: Which of the bundled encoders "bundled" is: "clip" or "dino".

    Returns:
        A folder with ``config.json`` and safetensors.

    Raises:
        ModelError: If the model is not available locally and cannot be downloaded.
    """
    if name in ("bundled", "embedded"):  # "embedded" is an alias
        return BUNDLED_ENCODERS / tower
    folder = Path(name).expanduser()
    if folder.is_dir():
        if not is_model_folder(folder):
            raise ModelError(
                name,
                expected="a Hugging Face model folder (config.json and model.safetensors)",
                found=_contents(folder),
                remedy=f"give a folder saved with save_pretrained, a model name, or `--{tower} bundled`",
            )
        return folder
    cached = _cached_folder(name)
    return cached if cached is not None else _download(name, tower)


def is_model_folder(folder: Path) -> bool:
    """Whether a folder holds a configuration and all shards of its safetensors."""
    if not (folder / "config.json").is_file():
        return False
    index = folder / "model.safetensors.index.json"
    if index.is_file():
        table = read_config(index).get("weight_map")
        shards = list(table.values()) if isinstance(table, dict) else []
        # Only files of the folder itself: shard names are not paths.
        plain = all(isinstance(shard, str) and re.fullmatch(r"[\w.-]{1,200}", shard) for shard in shards)
        return bool(shards) and plain and all((folder / shard).is_file() for shard in set(shards))
    return (folder / "model.safetensors").is_file()


def read_config(path: Path) -> dict[str, Any]:
    """A JSON object of a model folder.

    Raises:
        ModelError: If the file is not a JSON object.
    """
    try:
        content = read_json(path)
    except FileFormatError as error:
        raise ModelError(
            path, expected=error.expected, found=error.found[:200], remedy="fetch the model again"
        ) from error
    if not isinstance(content, dict):
        raise ModelError(path, expected="a JSON object", found=type(content).__name__)
    return content


def content_hash(folder: Path) -> str:
    """Hash of everything a model's output depends on: weights, configuration, tokenizer. 32 hex digits."""
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(folder.glob("*")):
        # Weights in other formats, which are not loaded, and documents such as model cards are skipped.
        if path.suffix in (".json", ".txt", ".model") or path.match("model*.safetensors"):
            digest.update(path.name.encode())
            with path.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
    return digest.hexdigest()


def _contents(folder: Path) -> str:
    names = sorted(path.name for path in folder.iterdir())
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "") if names else "an empty folder"


def _cached_folder(name: str) -> Path | None:
    """Folder of a model in the hub's cache; does not use the network."""
    from huggingface_hub import constants, snapshot_download
    from huggingface_hub.errors import HFValidationError

    refs = Path(constants.HF_HUB_CACHE) / ("models--" + name.replace("/", "--")) / "refs" / "refs" / "pr"
    revisions = ["main", *(f"refs/pr/{path.name}" for path in sorted(refs.glob("*")))]
    for revision in revisions:
        try:
            folder = Path(
                snapshot_download(
                    name, revision=revision, local_files_only=True, allow_patterns=_WANTED_FILES
                )
            )
        except (OSError, HFValidationError):
            continue
        if is_model_folder(folder):
            return folder
    return None


def _download(name: str, tower: str) -> Path:
    """Download a model from the hub; uses the conversion bot's pull request if main has no safetensors."""
    from huggingface_hub import HfApi, snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    fetch: dict[str, Any] = {"allow_patterns": _WANTED_FILES, "etag_timeout": _HUB_TIMEOUT}
    try:
        folder = Path(snapshot_download(name, **fetch))
        if is_model_folder(folder):
            return folder
        for discussion in HfApi().get_repo_discussions(
            name, discussion_type="pull_request", author=_CONVERSION_BOT
        ):
            folder = Path(snapshot_download(name, revision=discussion.git_reference, **fetch))
            if is_model_folder(folder):
                log.info("%s: safetensors taken from %s", name, discussion.git_reference)
                return folder
    except HFValidationError as error:
        raise _missing(name, tower, "neither a folder nor a valid model name") from error
    except HfHubHTTPError as error:
        status = getattr(getattr(error, "response", None), "status_code", None)
        raise _missing(name, tower, f"the hub responded with {status or 'an error'}") from error
    except (
        Exception
    ) as error:  # a missing network raises many types, depending on the HTTP library and the proxy
        raise _missing(
            name, tower, f"no local copy, and the hub cannot be reached ({type(error).__name__})"
        ) from error
    raise _missing(name, tower, "no safetensors in its repository")


def _missing(name: str, tower: str, found: str) -> ModelError:
    return ModelError(
        f"model {name}",
        expected="a downloaded model",
        found=found,
        remedy=f"either connect to the internet and run again (it is downloaded once), or give a folder "
        f"that holds it (`--{tower} FOLDER`), or use the small encoder that ships with lexsplat "
        f"(`--{tower} bundled`)",
    )
