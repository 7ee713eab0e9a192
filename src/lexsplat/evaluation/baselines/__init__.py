"""The methods that the paper compares with, rebuilt on our Gaussians from the ideas of their papers.

Same scene, same Gaussians, same features as ours; what differs is what a Gaussian carries and how a question is
answered. They are not the authors' programs: docs/evaluation.md says what was kept and what was not.

- `dff`: distilled feature fields (Kobayashi et al. 2022): raw features on the Gaussians, fitted by rendering.
- `lerf`: LERF (Kerr et al. 2023): features at several physical scales, the scale chosen for each question.
- `ovs3d`: 3D-OVS (Liu et al. 2023): a list of classes known in advance, fitted by their distributions.
- `nearest`: no 3D at all: the features of the very photo that is asked about.
"""

from lexsplat.evaluation.baselines.dff import DffConfig, DistilledFeatures, distill
from lexsplat.evaluation.baselines.lerf import LerfConfig, ScaledFeatures, fit_lerf
from lexsplat.evaluation.baselines.nearest import ViewFeatures
from lexsplat.evaluation.baselines.ovs3d import ClassFeatures, Ovs3dConfig, fit_3dovs

__all__ = [
    "ClassFeatures",
    "DffConfig",
    "DistilledFeatures",
    "LerfConfig",
    "Ovs3dConfig",
    "ScaledFeatures",
    "ViewFeatures",
    "distill",
    "fit_3dovs",
    "fit_lerf",
]
