"""Dense language features: CLIP (+) DINO for every view, cached on disk (section 3.2).

The maps never lie in memory all at once: `extract_features` writes small files for one view after the other,
`FeatureMaps` reads them when asked.
"""

from lexsplat.features.cache import FeatureMap, FeatureMaps
from lexsplat.features.external import external_identity, load_external_features
from lexsplat.features.extraction import FeatureConfig, extract_features, load_level_maps
from lexsplat.features.pca import pca_image
from lexsplat.features.text import TextCache

__all__ = [
    "FeatureConfig",
    "FeatureMap",
    "FeatureMaps",
    "TextCache",
    "external_identity",
    "extract_features",
    "load_external_features",
    "load_level_maps",
    "pca_image",
]
