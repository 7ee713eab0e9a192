"""The settings of a build as options of a command."""

from __future__ import annotations

from typing import Annotated

import tyro

from lexsplat.pipeline.config import BuildConfig
from lexsplat.reconstruction.settings import ReconstructionConfig

# tyro offers --iterations for this one; the settings of the reconstruction do not depend on tyro.
ReconstructionConfig.__annotations__["iterations"] = tyro.conf.Suppress[int]
Settings = Annotated[BuildConfig, tyro.conf.arg(name="")]
