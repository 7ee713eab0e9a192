"""Settings of dense feature extraction (section 3.2)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from lexsplat.features.cache import Tokens
from lexsplat.features.encoders import Facet

GRID_SETTINGS = ("crop_sizes", "crop_strides", "crop_tokens")
"""Settings of mode "grid"."""

RANDOM_SETTINGS = ("random_crops", "random_levels", "random_sizes", "seed")
"""Settings of mode "random"."""

PATCH_SIDE = 0.36 / 14
"""Side of a patch as a fraction of the photo's short side, where large encoders are read at their patches."""


@dataclass(frozen=True)
class FeatureConfig:
    """Settings of feature extraction. The defaults suit class tokens and DINO ViT-S/8 on a GPU; see `suited`.

    Args:
        mode: "grid": a regular grid of crops for each size, as in LERF and the authors' code. "random": the paper's
            hierarchical random crops.
        crop_sizes: Grid: sides of the crops as fractions of the image's short side.
        crop_strides: Grid: distance between crops of each size, as a fraction of their side.
        crop_tokens: Grid: which embeddings of a crop are used. "class": the image-level embedding, placed at the
            center of the crop (the paper). "patch": patch-level embeddings as in MaskCLIP, each placed at its patch;
            needs a model of CLIP's own architecture. "both": both. None is "class"; a build takes "both" for such
            models.
        random_crops: Random: crops per view, divided evenly among the sizes.
        random_levels: Random: number of sizes.
        random_sizes: Random: smallest and largest side as fractions of the image's short side.
        seed: Random: seed of the positions; every view draws its own.
        map_cells: Cells of the feature maps along the short side (fewer for images longer than 16 short sides).
        max_short_side: Larger images are reduced to this many pixels on the short side before cropping.
        dino_short_side: Pixels on the short side of DINO's input.
        dino_stride: Pixels of DINO's input between features; below the patch size, shifted copies of the image are
            evaluated.
        dino_facet: "key": attention keys. "token": output tokens.
        dino_layer: Layer of the keys, 0-based; None is the last.
        dino_max_tokens: Most patches that DINO's attention sees at once; larger images are evaluated in overlapping
            windows.
        segments: 2D segments by which the features of a photo are pooled, so that they end where segments end:
            "none", "slic" (superpixels), "sam2", the name or folder of a SAM 2 model, or a folder with one map of
            segments a photo (docs/captures.md).

    Raises:
        ValueError: If a setting is out of range, or two contradict each other.
    """

    mode: Literal["grid", "random"] = "grid"
    crop_sizes: tuple[float, ...] = (0.05, 0.125, 0.2, 0.275, 0.35, 0.425, 0.5)
    crop_strides: tuple[float, ...] = (1.0, 0.625, 0.5, 0.5, 0.5, 0.5, 0.5)
    crop_tokens: Tokens | None = None
    random_crops: int = 3000
    random_levels: int = 20
    random_sizes: tuple[float, float] = (0.05, 0.2)
    seed: int = 0
    map_cells: int = 112
    max_short_side: int = 1080
    dino_short_side: int = 224
    dino_stride: int = 2
    dino_facet: Facet = "key"
    dino_layer: int | None = None
    dino_max_tokens: int = 4096
    segments: str = "none"

    def __post_init__(self) -> None:
        if self.mode not in ("grid", "random"):
            raise ValueError(f"mode must be 'grid' or 'random', got {self.mode!r}")
        if len(self.crop_sizes) != len(self.crop_strides) or not self.crop_sizes:
            raise ValueError(
                f"needs one crop stride per crop size, got {len(self.crop_strides)} for {len(self.crop_sizes)}"
            )
        if min(self.crop_sizes) <= 0 or min(self.crop_strides) <= 0:
            raise ValueError("crop sizes and strides must be positive")
        if not 0 < self.random_sizes[0] <= self.random_sizes[1]:
            raise ValueError(f"random_sizes must be positive and in order, got {self.random_sizes}")
        if self.crop_tokens not in (None, "class", "patch", "both"):
            raise ValueError(f"crop_tokens must be 'class', 'patch' or 'both', got {self.crop_tokens!r}")
        if self.tokens != "class" and self.mode != "grid":
            raise ValueError(f"crop_tokens={self.crop_tokens} needs mode=grid; random crops have no patches")
        if self.dino_facet not in ("key", "token"):
            raise ValueError(f"dino_facet must be 'key' or 'token', got {self.dino_facet!r}")
        if not self.segments.strip():
            raise ValueError("segments must be none, slic, sam2, a folder or a model, got nothing")
        sizes = ("map_cells", "max_short_side", "dino_short_side", "dino_stride", "dino_max_tokens")
        for name in (*sizes, "random_crops", "random_levels"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def tokens(self) -> Tokens:
        """Which embeddings of a crop are used."""
        return self.crop_tokens or "class"

    @classmethod
    def suited(cls, patches: int = 0, *, sparse: bool = True) -> FeatureConfig:
        """Settings for large encoders.

        An encoder with patch-level embeddings reads few large crops at their patches, too: 24 of a 4:3 photo for
        14x14 patches. A patch covers `PATCH_SIDE` of the photo, so finer grids of patches take larger crops, up to
        half of it.

        Args:
            patches: Patches along a side of the encoder's input (`lexsplat.features.clip.patch_grid`); 0 if it has no
                patch-level embeddings.
            sparse: For a CPU: fewer crops of encoders without patches, and a quarter of DINO's work.
        """
        stride = 4 if sparse else cls.dino_stride
        if patches:
            size = min(0.5, max(patches, 6) * PATCH_SIDE)
            return cls(crop_sizes=(size,), crop_strides=(0.6,), crop_tokens="both", dino_stride=stride)
        if sparse:
            return cls(crop_sizes=(0.2, 0.4), crop_strides=(0.5, 0.5), map_cells=56, dino_stride=stride)
        return cls()

    @classmethod
    def bundled(cls) -> FeatureConfig:
        """Settings for the bundled encoders, chosen by measurement."""
        return cls(
            crop_sizes=(18 / 240, 44 / 240),
            crop_strides=(0.5, 0.35),
            crop_tokens="both",
            map_cells=120,
            max_short_side=360,
            dino_short_side=320,
            dino_stride=8,
        )

    def on_top_of(self, base: FeatureConfig) -> FeatureConfig:
        """``base`` with every setting in which this one differs from the defaults.

        Sizes and strides of the grid are taken together, because they must have the same length.
        """
        if self.mode == "random":  # random crops have no patches
            base = dataclasses.replace(base, crop_tokens=None)
        usual = FeatureConfig()
        given = {name for name in dataclasses.asdict(self) if getattr(self, name) != getattr(usual, name)}
        if given & {"crop_sizes", "crop_strides"}:
            given |= {"crop_sizes", "crop_strides"}
        return dataclasses.replace(base, **{name: getattr(self, name) for name in given})

    def result_settings(self, use_dino: bool) -> FeatureConfig:
        """The settings that affect the result: the other mode and an unused DINO are at their defaults."""
        usual = FeatureConfig()
        unused = set(RANDOM_SETTINGS if self.mode == "grid" else GRID_SETTINGS)
        if self.tokens == "class":
            unused.add("crop_tokens")
        if not use_dino:
            unused |= {name for name in dataclasses.asdict(self) if name.startswith("dino_")}
        return dataclasses.replace(self, **{name: getattr(usual, name) for name in unused})
