"""Methods: ways to a language field, each an object behind the protocol `LanguageMethod`.

A new method is a file with a class like those below, an entry in `METHODS` and `MethodName`, and a field for its
settings in `lexsplat.pipeline.config.BuildConfig`. Commands, builds, tables and fingerprints read the rest from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from lexsplat.language.methods.averaged import Averaged
from lexsplat.language.methods.joint import TrainedJointly
from lexsplat.language.methods.method import FitRun, JointMethod, LanguageMethod, TrainingViews
from lexsplat.language.methods.trained import Trained

__all__ = [
    "JOINT_METHODS",
    "METHODS",
    "VARIANTS",
    "FitRun",
    "JointMethod",
    "LanguageMethod",
    "MethodName",
    "TrainingViews",
]

MethodName = Literal["averaged", "trained"]
"""Names of the methods, for the types of settings and options."""

METHODS: Mapping[str, LanguageMethod] = {method.name: method for method in (Averaged(), Trained())}
"""The methods by name."""

JOINT_METHODS: Mapping[str, JointMethod] = {method.name: method for method in (TrainedJointly(),)}
"""Those that train geometry and language together (``--joint``), by name of method."""

VARIANTS = tuple(dict.fromkeys(variant for method in METHODS.values() for variant in method.variants))
"""Names of the variants of all methods, among them the rows of the paper's Table 2."""
