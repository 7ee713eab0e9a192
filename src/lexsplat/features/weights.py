"""Weights and JSON of a model folder: which files are read, and tensors under the names of transformers."""

from __future__ import annotations

import contextlib
import json
import logging
import re
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lexsplat.runtime.errors import FileFormatError, ModelError
from lexsplat.runtime.files import read_json

log = logging.getLogger("lexsplat")

INDEX = "model.safetensors.index.json"
WEIGHTS = (
    "model.safetensors",
    INDEX,
    "open_clip_model.safetensors",
    "pytorch_model.bin",
    "open_clip_pytorch_model.bin",
)
"""Files of weights; the first that exists is read. The index lists the shards of large models."""
PICKLED_INDEX = "pytorch_model.bin.index.json"
"""The list of shards that are pickles, which are not read."""

_CLIP_NAMES = (
    (r"^visual\.class_embedding$", "vision_model.embeddings.class_embedding"),
    (r"^visual\.positional_embedding$", "vision_model.embeddings.position_embedding.weight"),
    (r"^visual\.conv1\.", "vision_model.embeddings.patch_embedding."),
    (r"^visual\.ln_pre\.", "vision_model.pre_layrnorm."),  # spelled like this by transformers
    (r"^visual\.ln_post\.", "vision_model.post_layernorm."),
    (r"^visual\.proj$", "visual_projection.weight"),
    (r"^positional_embedding$", "text_model.embeddings.position_embedding.weight"),
    (r"^token_embedding\.", "text_model.embeddings.token_embedding."),
    (r"^ln_final\.", "text_model.final_layer_norm."),
    (r"^text_projection$", "text_projection.weight"),
    (r"^visual\.transformer\.resblocks\.", "vision_model.encoder.layers."),
    (r"^transformer\.resblocks\.", "text_model.encoder.layers."),
    (r"(\.\d+)\.ln_([12])\.", r"\1.layer_norm\2."),
    (r"(\.\d+)\.attn\.", r"\1.self_attn."),
    (r"(\.\d+)\.mlp\.c_fc\.", r"\1.mlp.fc1."),
    (r"(\.\d+)\.mlp\.c_proj\.", r"\1.mlp.fc2."),
)
"""Names of OpenCLIP, which are those of OpenAI's CLIP, as patterns, and what transformers calls them."""

_VIT_NAMES = (
    (r"^cls_token$", "embeddings.cls_token"),
    (r"^pos_embed$", "embeddings.position_embeddings"),
    (r"^patch_embed\.proj\.", "embeddings.patch_embeddings.projection."),
    (r"^norm\.", "layernorm."),
    (r"^blocks\.", "encoder.layer."),
    (r"(\.\d+)\.norm1\.", r"\1.layernorm_before."),
    (r"(\.\d+)\.norm2\.", r"\1.layernorm_after."),
    (r"(\.\d+)\.attn\.proj\.", r"\1.attention.output.dense."),
    (r"(\.\d+)\.mlp\.fc1\.", r"\1.intermediate.dense."),
    (r"(\.\d+)\.mlp\.fc2\.", r"\1.output.dense."),
)
"""Names of timm and of the original DINO, and what transformers calls them."""

_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_WHOLE_NUMBERS = re.compile(
    r"((^|[._])(ids|index|mask)|num_batches_tracked|input_resolution|context_length|vocab_size)$"
)
"""Names of tensors that are no weights: places, masks, counts."""


def first_weights(names: Collection[str]) -> str | None:
    """The file of `WEIGHTS` that is read, among the names of a folder's files; None if there is none."""
    return next((name for name in WEIGHTS if name in names), None)


def weight_files(folder: Path) -> list[Path]:
    """The files of weights that `load_weights` reads; empty if there are none or a shard is missing."""
    name = first_weights({path.name for path in folder.iterdir() if path.is_file()})
    if name != INDEX:
        return [] if name is None else [folder / name]
    return _shards(folder)[0]


def fault_of_index(folder: Path) -> str:
    """What is wrong with the index of a folder's shards, or with a shard of it; "" if nothing is."""
    return _shards(folder)[1]


def _shards(folder: Path) -> tuple[list[Path], str]:
    """The shards that the index of a folder lists, or none and why."""
    try:
        table = read_json(folder / INDEX).get("weight_map")
    except FileFormatError as error:
        return [], f"{INDEX} that is no JSON ({error.found[:80]})"
    except AttributeError:
        table = None
    if not isinstance(table, dict) or not table:
        return [], f"{INDEX} without tensors in its weight_map"
    for shard in table.values():  # only files of the folder itself: shard names are not paths
        if not isinstance(shard, str) or not re.fullmatch(r"[\w.-]{1,200}", shard):
            return [], f"{INDEX} with {excerpt(shard)} in place of the name of a file in its folder"
    shards = sorted({folder / shard for shard in table.values()})
    missing = [shard.name for shard in shards if not shard.is_file()]
    return ([], f"no {_some(missing)}, which {INDEX} lists") if missing else (shards, "")


def load_weights(folder: Path, name: str) -> dict[str, Tensor]:
    """All tensors of a model folder under the names of transformers.

    Names of OpenCLIP and of timm's vision transformer are translated. Pickled files are read by
    ``torch.load(weights_only=True)``, which runs no code of the file.

    Args:
        folder: The folder.
        name: Name of the model in messages.

    Raises:
        ModelError: If a file is damaged, holds anything but tensors, or weights that are not plain floats.
    """
    state: dict[str, Tensor] = {}
    for path in weight_files(folder):
        found = _pickled(path, name) if path.suffix == ".bin" else _safetensors(path, name)
        _check_floats(path, name, found)
        state.update(found)
    return in_transformers_names(state)


def _check_floats(path: Path, name: str, tensors: Mapping[str, Tensor]) -> None:
    """Refuse quantized and sparse weights, which would be read as other numbers than they stand for."""
    for key, tensor in tensors.items():
        dense = tensor.layout == torch.strided
        if dense and (tensor.dtype in _FLOATS or _WHOLE_NUMBERS.search(key)):
            continue
        found = str(tensor.dtype if dense else tensor.layout).removeprefix("torch.")
        raise ModelError(
            f"model {name}: {path.name}",
            expected="weights in float16, bfloat16, float32 or float64",
            found=f"{found} in {key}",
            remedy="fetch the float version of the model in place of a quantized one"
            if dense
            else f"write it with dense tensors: {key}.to_dense()",
        )


def _safetensors(path: Path, name: str) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise _damaged(path, name, "safetensors", _named(error)) from error


def _is_pointer(path: Path) -> bool:
    """Whether a file was cloned without Git LFS."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        return file.read(24) == b"version https://git-lfs."
    return False


def _pickled(path: Path, name: str) -> dict[str, Tensor]:
    log.warning(
        "%s: %s has no safetensors; %s is read without running its code", name, path.parent, path.name
    )
    expected = "a pickled dictionary of tensors only"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a protocol that torch may not know
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # UnpicklingError, RuntimeError, EOFError, KeyError ...
        raise _damaged(path, name, expected, _cause(path, error)) from error
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        content = content["state_dict"]
    if not isinstance(content, dict) or not all(
        isinstance(key, str) and isinstance(value, Tensor) for key, value in content.items()
    ):
        raise _damaged(path, name, expected, "other objects")
    return {key.removeprefix("module."): value for key, value in content.items()}


def _cause(path: Path, error: Exception) -> str:
    """What is wrong with a pickled file; torch explains at length how to run the code in it."""
    if isinstance(error, OSError | MemoryError) or "allocate memory" in str(error):
        return _named(error)
    if "unsupported global" in str(error).lower():
        return "other objects"
    return "a damaged file" if path.stat().st_size else "an empty file"


def _named(error: Exception) -> str:
    """The first line of an error of a library, with its type."""
    return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'nothing'}"[:160]


def _damaged(path: Path, name: str, expected: str, found: str) -> ModelError:
    remedy = f"delete {path} and fetch it again"
    if _is_pointer(path):
        found, remedy = "a pointer of Git LFS", f"fetch the large files: git -C {path.parent} lfs pull"
    return ModelError(f"model {name}: {path.name}", expected=expected, found=found, remedy=remedy)


def in_transformers_names(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of a CLIP in OpenCLIP's names, or of a vision transformer in timm's, in those of transformers.

    Stacked projections of attention are split, and projections that are stored as ``[in, out]`` transposed. Other
    dictionaries are returned unchanged.
    """
    if "text.ln_final.weight" in state:  # OpenCLIP's newer layout, with a name for the text tower
        state = {key.removeprefix("text."): value for key, value in state.items()}
    patterns: tuple[tuple[str, str], ...]
    if "visual.conv1.weight" in state and "ln_final.weight" in state:
        stacked, patterns = r"^(.*\.\d+)\.attn\.in_proj_(weight|bias)$", _CLIP_NAMES
        parts = [rf"\1.self_attn.{part}_proj.\2" for part in "qkv"]
    elif "patch_embed.proj.weight" in state and "pos_embed" in state:
        stacked, patterns = r"^blocks(\.\d+)\.attn\.qkv\.(weight|bias)$", _VIT_NAMES
        parts = [rf"encoder.layer\1.attention.attention.{part}.\2" for part in ("query", "key", "value")]
    else:
        return state
    found: dict[str, Tensor] = {}
    for key, tensor in state.items():
        if re.match(stacked, key):
            for part, piece in zip(parts, tensor.chunk(3)):
                found[_renamed(re.sub(stacked, part, key), patterns)] = piece.clone()
        elif key in ("visual.proj", "text_projection"):
            found[_renamed(key, patterns)] = tensor.T.contiguous()
        else:
            found[_renamed(key, patterns)] = tensor
    return found


def _renamed(key: str, patterns: Iterable[tuple[str, str]]) -> str:
    for pattern, name in patterns:
        key = re.sub(pattern, name, key)
    return key


def read_config(path: Path, what: str) -> dict[str, Any]:
    """A JSON object of a model folder.

    Args:
        path: The file.
        what: Its content, such as "a tokenizer", for messages.

    Raises:
        ModelError: If the file is not a JSON object.
    """
    try:
        content = read_json(path)
    except FileFormatError as error:
        raise _no_json(path, what, error.found[:200]) from error
    if not isinstance(content, dict):
        kinds = {list: "a list", str: "a text", type(None): "null"}
        raise _no_json(path, what, kinds.get(type(content), f"{content}"[:20]))
    return content


def towers_of(config: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The settings of a configuration and of the towers within, each after its place, such as ``vision_config.``."""
    waiting = [("", config)]
    while waiting:
        place, settings = waiting.pop(0)
        yield place, settings
        waiting += [
            (f"{place}{key}.", value)
            for key, value in settings.items()
            if key.endswith(("_config", "_config_dict")) and isinstance(value, dict)
        ]


def excerpt(value: Any) -> str:
    """The begin of a JSON value, for a message."""
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:80]}..."


def _no_json(path: Path, what: str, found: str) -> ModelError:
    return ModelError(path, expected=f"{what} in JSON", found=found, remedy="fetch the model again")


def build_model(folder: Path, name: str, spare: str) -> Any:
    """The model of transformers that a folder describes, with all its weights.

    Args:
        folder: Folder with ``config.json`` and weights.
        name: Name of the model in messages.
        spare: Pattern of the names of tensors whose absence does not matter.

    Raises:
        ModelError: If transformers cannot build it, a tensor is missing or has another shape, or the folder holds
            layers that the configuration does not have.
    """
    from transformers import AutoConfig, AutoModel

    what = "a model configuration"
    kind_of_model = read_config(folder / "config.json", what).get("model_type")
    state = load_weights(folder, name)
    damaged = ": config.json"  # what transformers has read when it fails
    try:
        config = AutoConfig.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
        # SAM 2 as it is published; its part for photos is a model of its own.
        if config.model_type == "sam2_video":
            from transformers import Sam2Config

            parts = ("vision_config", "prompt_encoder_config", "mask_decoder_config")
            config = Sam2Config(**{part: getattr(config, part) for part in parts})
        with torch.device("meta"):
            kind = type(AutoModel.from_config(config))
        damaged = ""
        model, report = kind.from_pretrained(
            None, config=config, state_dict=state, output_loading_info=True, ignore_mismatched_sizes=True
        )
    except Exception as error:  # KeyError, OSError, ValueError, RuntimeError ...
        if not isinstance(kind_of_model, str):  # transformers may do without, by the name of the folder
            raise _no_json(folder / "config.json", what, "no model_type") from error
        _check_activations(folder)
        raise ModelError(
            f"model {name}{damaged}",
            expected="a model that transformers can load",
            found=f"{str(error)[:160]}",
            remedy="fetch it again, or choose another model",
        ) from error
    mismatched = sorted(entry[0] for entry in report["mismatched_keys"])
    if mismatched:
        _refuse(folder, name, "weights of the sizes in config.json", f"{_some(mismatched)} of another size")
    total = len(model.state_dict())
    missing = sorted(key for key in report["missing_keys"] if not re.search(spare, key))
    if missing:
        _refuse(
            folder, name, f"all {total} tensors of the model", f"{len(missing)} missing: {_some(missing)}"
        )
    shapes = {re.sub(r"\d+", "*", key) for key in model.state_dict()}
    unmatched = sorted(key for key in report["unexpected_keys"] if re.sub(r"\d+", "*", key) in shapes)
    if unmatched:
        _refuse(
            folder, name, "a config.json with all layers of the weights", f"no place for {_some(unmatched)}"
        )
    return model.float()  # some models are stored in half precision


def _check_activations(folder: Path) -> None:
    """Refuse an activation that transformers does not know, of which it says the name alone."""
    from transformers.activations import ACT2FN

    path = folder / "config.json"
    for place, settings in towers_of(read_config(path, "a model configuration")):
        value = settings.get("hidden_act")
        if isinstance(value, str) and value not in ACT2FN:
            expected = "an activation of transformers, such as quick_gelu or gelu"
            remedy = "fetch config.json again, or choose another model"
            raise ModelError(
                f"{path}: {place}hidden_act", expected=expected, found=excerpt(value), remedy=remedy
            )


def _refuse(folder: Path, name: str, expected: str, found: str) -> None:
    files = ", ".join(path.name for path in weight_files(folder))
    remedy = "fetch the whole model again, or choose another model"
    raise ModelError(f"model {name}: {files}", expected=expected, found=found, remedy=remedy)


def _some(keys: list[str]) -> str:
    return ", ".join(keys[:2]) + (f" and {len(keys) - 2} more" if len(keys) > 2 else "")
