"""The encoders of a build, loaded once, and the feature maps they make."""

from __future__ import annotations

import logging
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from lexsplat.captures import Capture
from lexsplat.codebook import MAX_CODES
from lexsplat.features import FeatureMaps, extract_features, load_external_features
from lexsplat.features.clip import check_patches
from lexsplat.features.hub import model_folder
from lexsplat.features.masking import without_masked_cells
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.memory import parse_bytes
from lexsplat.runtime.progress import Listener, silent

if TYPE_CHECKING:
    from lexsplat.features.encoders import DenseEncoder, ImageTextEncoder

log = logging.getLogger("lexsplat")


class Encoders:
    """CLIP and DINO, each loaded when it is first used and then kept.

    Args:
        clip: Name or folder of the image-text encoder.
        dino: Name or folder of the dense encoder, or "none".
        device: Device to compute on.
    """

    def __init__(self, clip: str, dino: str, device: str) -> None:
        self._clip_name, self._dino_name, self.device = clip, dino, device

    @cached_property
    def clip(self) -> ImageTextEncoder:
        """The image-text encoder."""
        from lexsplat.features.encoders import load_clip

        return load_clip(self._clip_name, self.device)

    @cached_property
    def dino(self) -> DenseEncoder | None:
        """The dense encoder; None if features are made without."""
        from lexsplat.features.encoders import load_dino

        return None if self._dino_name == "none" else load_dino(self._dino_name, self.device)


def check_encoders(config: BuildConfig) -> None:
    """Find the encoders of the settings without loading them.

    Raises:
        ModelError: If one is missing, or the settings ask CLIP for patches that it does not have.
    """
    clip = model_folder(config.clip, "clip")
    if config.features_from is not None:
        return  # CLIP embeds the prompts only, and DINO is not used
    if config.features.tokens != "class":
        check_patches(clip, config.clip)
    if config.uses_dino:
        model_folder(config.dino, "dino")


def feature_maps(
    capture: Capture,
    config: BuildConfig,
    encoders: Encoders,
    cache_dir: Path,
    listener: Listener = silent,
) -> FeatureMaps:
    """Features of every view, extracted if the cache does not have them; masked cells are zero.

    With ``config.features_from`` the features of another program are read instead.

    Args:
        capture: Its views, at the resolution they were captured in.
        config: Settings of the build.
        encoders: The encoders of the build.
        cache_dir: Folder of stored features.
        listener: Receives events of stage "features".
    """
    memory = parse_bytes(config.memory)
    if config.features_from is None:
        clip, dino = encoders.clip, encoders.dino
        maps = extract_features(
            capture, clip, dino, config.features, cache_dir=cache_dir, memory=memory, listener=listener
        )
        return without_masked_cells(maps, capture)
    if any(view.lens.distorts for view in capture.views.values()):
        log.warning("the photos are distorted; features of another program are taken as undistorted")
    maps = load_external_features(
        config.features_from,
        capture,
        memory=memory,
        dimension=encoders.clip.dim,
        allow_holes=config.codebook.num_codes < MAX_CODES,
    )
    return without_masked_cells(maps, capture)
