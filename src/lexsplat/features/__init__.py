"""Dense language features: CLIP (+) DINO maps of every view, cached on disk (section 3.2).

Maps are never all in memory: `extract_features` writes small files per view, and `FeatureMaps` reads them on access.

To add an encoder: implement `ImageTextEncoder` or `DenseEncoder` of ``encoders.py`` and return it from `load_clip` or
`load_dino` there. Its ``content_hash`` is part of the cache keys.
"""

from typing import TYPE_CHECKING

from lexsplat.runtime.lazy import at_first_use

if TYPE_CHECKING:
    from lexsplat.features.cache import FeatureMap, FeatureMaps
    from lexsplat.features.external import (
        check_external_features,
        external_identity,
        load_external_features,
        read_external_features,
    )
    from lexsplat.features.extraction import extract_features, load_level_maps
    from lexsplat.features.settings import FeatureConfig
    from lexsplat.features.text import TextCache

__all__ = [
    "FeatureConfig",
    "FeatureMap",
    "FeatureMaps",
    "TextCache",
    "check_external_features",
    "external_identity",
    "extract_features",
    "load_external_features",
    "load_level_maps",
    "read_external_features",
]

__getattr__ = at_first_use(
    "lexsplat.features",
    {
        "cache": ("FeatureMap", "FeatureMaps"),
        "external": (
            "check_external_features",
            "external_identity",
            "load_external_features",
            "read_external_features",
        ),
        "extraction": ("extract_features", "load_level_maps"),
        "settings": ("FeatureConfig",),
        "text": ("TextCache",),
    },
)
