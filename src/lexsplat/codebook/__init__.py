"""Quantization of language features: Eq. 2 to 7 of the paper and its supplement A.

A scene has few distinct meanings, so its hybrid features F = F_CLIP (+) F_DINO (Eq. 2) are replaced by the nearest
of K codes (N in the paper). The codebook is fitted first; then every view is assigned in one pass with the final
codes. Held-out views take no part in the fit.

Equations are numbered 1 to 15 through the main text of the paper; supplement A describes the load-balancing loss.
"""

from lexsplat.codebook.assignment import assign_code_maps, code_usage
from lexsplat.codebook.fitting import fit_codebook, mean_cosine, sample_features, spherical_kmeans
from lexsplat.codebook.forecasting import tell_codebook
from lexsplat.codebook.losses import load_balancing_loss, quantization_loss
from lexsplat.codebook.settings import MAX_CODES, CodebookConfig
from lexsplat.codebook.space import Codebook, similarity

__all__ = [
    "MAX_CODES",
    "Codebook",
    "CodebookConfig",
    "assign_code_maps",
    "code_usage",
    "fit_codebook",
    "load_balancing_loss",
    "mean_cosine",
    "quantization_loss",
    "sample_features",
    "similarity",
    "spherical_kmeans",
    "tell_codebook",
]
