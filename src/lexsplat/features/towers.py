"""Image towers of CLIP and DINO without transformers, whose import alone takes seconds.

Their modules are named as the tensors in the Hub's files. What has another layout, or is not whole, is left to
transformers, which loads or refuses it. Tests compare the two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "quick_gelu": lambda hidden: hidden * torch.sigmoid(1.702 * hidden),
    "gelu": F.gelu,
}
_CLIP_DEFAULTS = {  # of transformers' CLIPVisionConfig and ViTConfig, which files may leave out
    "hidden_size": 768, "intermediate_size": 3072, "num_hidden_layers": 12, "num_attention_heads": 12,
    "num_channels": 3, "image_size": 224, "patch_size": 32, "hidden_act": "quick_gelu", "layer_norm_eps": 1e-5,
}  # fmt: skip
_VIT_DEFAULTS = {
    **_CLIP_DEFAULTS,
    "patch_size": 16,
    "hidden_act": "gelu",
    "layer_norm_eps": 1e-12,
    "qkv_bias": True,
}
MOST_LAYERS = 256
"""Layers of a tower, at most: a mistyped number would be built until the memory is full."""


def settings_of(given: Any, defaults: Mapping[str, Any]) -> dict[str, Any] | None:
    """The settings of a tower: those of ``config.json``, or defaults; None if no tower of ours has them."""
    if not isinstance(given, dict):
        return None
    settings = {**defaults, **{key: given[key] for key in defaults if given.get(key) is not None}}
    sizes = [value for key, value in settings.items() if key not in ("hidden_act", "layer_norm_eps")]
    known = (
        all(isinstance(size, int) and 0 < size < 1 << 20 for size in sizes)
        and isinstance(settings["layer_norm_eps"], float)
        and settings["num_hidden_layers"] <= MOST_LAYERS
        and settings["hidden_size"] % settings["num_attention_heads"] == 0
        and settings["hidden_act"] in ACTIVATIONS
        and settings.get("num_channels", 3) == 3
    )
    return settings if known else None


def clip_images(config: Mapping[str, Any], weights: Mapping[str, Tensor]) -> Any:
    """The image tower of a CLIP as `ClipImages` reads it.

    Args:
        config: Its ``config.json``.
        weights: Its tensors by their names in transformers.

    Returns:
        A module without a forward pass; None if the tower is not of this architecture, or its tensors do not fit.
    """
    settings = settings_of(
        config.get("vision_config_dict") or config.get("vision_config") or {}, _CLIP_DEFAULTS
    )
    projection = config.get("projection_dim", 512)
    if settings is None or not isinstance(projection, int):
        return None
    with torch.device("meta"):
        model = _ClipImageTower(settings, projection)
    return _filled(model, weights, ("vision_model.", "visual_projection."))


def vision_transformer(config: Mapping[str, Any], weights: Mapping[str, Tensor]) -> Any:
    """The vision transformer of a DINO (model type "vit"), without the pooler.

    Args:
        config: Its ``config.json``.
        weights: Its tensors by their names in the Hub's files.

    Returns:
        The model; None if it is not of this architecture, or its tensors do not fit.
    """
    settings = settings_of(config, _VIT_DEFAULTS)
    if settings is None or config.get("model_type") != "vit":
        return None
    with torch.device("meta"):
        model = _VisionTransformer(settings)
    return _filled(model, weights, ("embeddings.", "encoder.", "layernorm."))


def _filled(model: nn.Module, weights: Mapping[str, Tensor], prefixes: tuple[str, ...]) -> nn.Module | None:
    """A model with copies of its tensors, in float32; None unless there is exactly one of its size for each."""
    state = {
        name: tensor
        for name, tensor in weights.items()
        if name.startswith(prefixes) and not name.endswith(("position_ids", "mask_token"))
    }
    shapes = {name: tensor.shape for name, tensor in model.state_dict().items()}
    if shapes != {name: tensor.shape for name, tensor in state.items()}:
        return None
    # Copies, because tensors in a file are not aligned, and alignment affects the rounding of sums.
    copies = {name: tensor.to(torch.float32, copy=True).contiguous() for name, tensor in state.items()}
    model.load_state_dict(copies, assign=True)
    return model


def _parts(**modules: nn.Module) -> Any:
    found = nn.Module()
    for name, module in modules.items():
        found.add_module(name, module)
    return found


class _ClipImageTower(nn.Module):
    def __init__(self, settings: Mapping[str, Any], projection: int) -> None:
        super().__init__()
        self.config = SimpleNamespace(model_type="clip", vision_config=SimpleNamespace(**settings))
        width, hidden, patch = (settings[key] for key in ("hidden_size", "intermediate_size", "patch_size"))
        positions = (settings["image_size"] // patch) ** 2 + 1
        activation = ACTIVATIONS[settings["hidden_act"]]

        def norm() -> nn.Module:
            return nn.LayerNorm(width, eps=settings["layer_norm_eps"])

        def layer() -> nn.Module:
            attention = {f"{part}_proj": nn.Linear(width, width) for part in ("q", "k", "v", "out")}
            mlp = _parts(fc1=nn.Linear(width, hidden), fc2=nn.Linear(hidden, width))
            mlp.activation_fn = activation
            return _parts(self_attn=_parts(**attention), layer_norm1=norm(), mlp=mlp, layer_norm2=norm())

        embeddings = _parts(
            patch_embedding=nn.Conv2d(3, width, patch, patch, bias=False),
            # An embedding's own initialization of empty weights would import torch's compiler.
            position_embedding=nn.Embedding.from_pretrained(torch.empty(positions, width)),
        )
        embeddings.class_embedding = nn.Parameter(torch.empty(width))
        layers = nn.ModuleList(layer() for _ in range(settings["num_hidden_layers"]))
        self.vision_model = _parts(
            embeddings=embeddings,
            pre_layrnorm=norm(),  # spelled so by transformers
            encoder=_parts(layers=layers),
            post_layernorm=norm(),
        )
        self.visual_projection = nn.Linear(width, projection, bias=False)


class _VisionTransformer(nn.Module):
    """Pre-norm layers over a class token and patches, with positions that are interpolated to the image."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__()
        self.config = SimpleNamespace(model_type="vit", **settings)
        width, hidden, patch = (settings[key] for key in ("hidden_size", "intermediate_size", "patch_size"))

        def norm() -> nn.Module:
            return nn.LayerNorm(width, eps=settings["layer_norm_eps"])

        def layer() -> nn.Module:
            parts = {part: nn.Linear(width, width) for part in ("query", "key", "value")}
            return _parts(
                attention=_parts(attention=_parts(**parts), output=_parts(dense=nn.Linear(width, width))),
                intermediate=_parts(dense=nn.Linear(width, hidden)),
                output=_parts(dense=nn.Linear(hidden, width)),
                layernorm_before=norm(),
                layernorm_after=norm(),
            )

        self.embeddings = _parts(patch_embeddings=_parts(projection=nn.Conv2d(3, width, patch, patch)))
        self.embeddings.cls_token = nn.Parameter(torch.empty(1, 1, width))
        positions = (settings["image_size"] // patch) ** 2 + 1
        self.embeddings.position_embeddings = nn.Parameter(torch.empty(1, positions, width))
        self.encoder = _parts(layer=nn.ModuleList(layer() for _ in range(settings["num_hidden_layers"])))
        self.layernorm = norm()

    def forward(self, pixel_values: Tensor) -> SimpleNamespace:
        """Normalized images ``[B, 3, H, W]`` to ``last_hidden_state``: a class token, then patches row-major."""
        patches = self.embeddings.patch_embeddings.projection(pixel_values)
        x = torch.cat([self.embeddings.cls_token.expand(len(patches), -1, -1), patches.flatten(2).mT], 1)
        x = x + self._positions(*patches.shape[-2:])
        for layer in self.encoder.layer:
            x = self._attention(layer.attention, layer.layernorm_before(x)) + x
            hidden = ACTIVATIONS[self.config.hidden_act](layer.intermediate.dense(layer.layernorm_after(x)))
            x = layer.output.dense(hidden) + x
        return SimpleNamespace(last_hidden_state=self.layernorm(x))

    def _positions(self, rows: int, cols: int) -> Tensor:
        """Embeddings of the positions of the class token and of a grid of patches ``[1, 1 + rows * cols, W]``."""
        known: Tensor = self.embeddings.position_embeddings
        side = self.config.image_size // self.config.patch_size
        if (rows, cols) == (side, side):
            return known
        grid = known[:, 1:].unflatten(1, (side, side)).permute(0, 3, 1, 2)
        grid = F.interpolate(grid, size=(rows, cols), mode="bicubic", align_corners=False)
        return torch.cat([known[:, :1], grid.flatten(2).mT], 1)

    def _attention(self, attention: Any, x: Tensor) -> Tensor:
        parts = attention.attention
        q, k, v = (
            project(x).unflatten(-1, (self.config.num_attention_heads, -1)).transpose(1, 2)
            for project in (parts.query, parts.key, parts.value)
        )
        mixed: Tensor = F.scaled_dot_product_attention(q, k, v)
        return attention.output.dense(mixed.transpose(1, 2).flatten(2))
