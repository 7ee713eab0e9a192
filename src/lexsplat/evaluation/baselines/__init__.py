"""The methods that the paper compares with, rebuilt on our Gaussians from their papers.

Scene, Gaussians and features are those of our methods; what differs is what a Gaussian stores and how a prompt is
scored. They are not the authors' programs: docs/evaluation.md lists the differences.

- `dff`: distilled feature fields (Kobayashi et al. 2022): raw features on the Gaussians, fitted by rendering.
- `lerf`: LERF (Kerr et al. 2023): features at several physical scales, the scale chosen per prompt.
- `ovs3d`: 3D-OVS (Liu et al. 2023): a list of classes known in advance, fitted by their distributions.
- `nearest`: no 3D: the features of the evaluated photo itself, a check of sanity and no method.

A new one is a file with a class like `Dff`, and an entry in `BASELINES`; tables and options read the rest from it.
"""

from collections.abc import Mapping

from lexsplat.evaluation.baselines.baseline import Baseline, BaselineRun
from lexsplat.evaluation.baselines.dff import Dff, DffConfig
from lexsplat.evaluation.baselines.feature_rendering import GaussianFeatures, TrainingData
from lexsplat.evaluation.baselines.lerf import Lerf, LerfConfig
from lexsplat.evaluation.baselines.nearest import Nearest, ViewFeatures
from lexsplat.evaluation.baselines.ovs3d import ClassFeatures, Ovs3d, Ovs3dConfig

__all__ = [
    "BASELINES",
    "Baseline",
    "BaselineRun",
    "ClassFeatures",
    "Dff",
    "DffConfig",
    "GaussianFeatures",
    "Lerf",
    "LerfConfig",
    "Nearest",
    "Ovs3d",
    "Ovs3dConfig",
    "TrainingData",
    "ViewFeatures",
]

BASELINES: Mapping[str, Baseline] = {method.name: method for method in (Dff(), Lerf(), Ovs3d(), Nearest())}
"""The compared methods by name, in the order of tables."""
