"""The encoders of a build, loaded once, and the feature maps they make."""

from __future__ import annotations

import logging
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from lexsplat.captures import Capture
from lexsplat.codebook import MAX_CODES
from lexsplat.features import (
    FeatureMaps,
    check_external_features,
    extract_features,
    load_external_features,
)
from lexsplat.features.cache import without_masked_cells
from lexsplat.features.checks import ENOUGH, ENOUGH_TILES, check_dense, rank_tiles, rank_words
from lexsplat.features.clip import check_patches
from lexsplat.features.clip_text import UNLIKE_WORDS
from lexsplat.features.estimate import Estimate, estimate
from lexsplat.features.extraction import missing_views, reduced
from lexsplat.features.hub import model_folder
from lexsplat.features.segments2d import load_segmenter, pooled_features
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.progress import NOTE, SHORTEST_FORECAST, Event, Listener, silent

if TYPE_CHECKING:
    from lexsplat.features.encoders import DenseEncoder, ImageTextEncoder
    from lexsplat.features.segments2d import Segmenter
    from lexsplat.features.text import TextTower

log = logging.getLogger("lexsplat")

_TOLD_FROM = 12
"""Fewest photos for which the time is estimated here: the estimate takes about as long as one photo."""
_COMPARED, _SHORT_SIDE = 4, 480
"""Photos, and pixels of their short sides, by which features of another program are compared with the encoder."""
_MANY = 100
"""Fewest photos for which the bundled encoders, too, are timed before structure from motion."""


BUNDLED_SCENES = Path(__file__).resolve().parents[1] / "demo"
"""Folder of the captures and scenes that the bundled encoders know."""


class Encoders:
    """CLIP, DINO and the source of 2D segments, each loaded at first use and then kept.

    Args:
        clip: Name or folder of the image-text encoder.
        dino: Name or folder of the dense encoder, or "none".
        device: Device to compute on.
        segments: Source of 2D segments (`FeatureConfig.segments`).
    """

    def __init__(self, clip: str, dino: str, device: str, segments: str = "none") -> None:
        self._clip_name, self._dino_name, self._segments, self.device = clip, dino, segments, device
        self.text: TextTower | None = None
        self.estimate: Estimate | None = None  # of one photo, once it is measured
        self.compared = False  # with features of another program
        self.told = 0  # photos for which the time of the features was told last

    @classmethod
    def of(cls, config: BuildConfig) -> Encoders:
        """Those of resolved settings."""
        dino = config.dino if config.uses_dino else "none"
        return cls(config.clip, dino, config.encoder_device, config.features.segments)

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

    @cached_property
    def segmenter(self) -> Segmenter | None:
        """The source of 2D segments; None if features are not pooled by segments."""
        return None if self._segments == "none" else load_segmenter(self._segments, self.device)

    def keep_text(self, device: str) -> None:
        """Free the encoders of photos; the text tower of CLIP stays as `text`, on a device."""
        from lexsplat.features.clip import ClipEncoder

        clip = self.__dict__.pop("clip", None)
        for name in ("dino", "segmenter"):
            self.__dict__.pop(name, None)
        self.text = clip.text_only(device) if isinstance(clip, ClipEncoder) else clip


def fetch_clip(config: BuildConfig) -> None:
    """Download CLIP if it is not on this machine, because its architecture decides settings (`BuildConfig.resolved`).

    Raises:
        ModelError: If it can be had nowhere.
    """
    model_folder(config.clip, "clip")


def check_encoders(
    config: BuildConfig,
    source: Path | None = None,
    photos: int = 0,
    size: tuple[int, int] = (1440, 1080),
    listener: Listener = silent,
) -> Encoders:
    """Load the encoders of the settings, check them, and log how long the features will take.

    The bundled encoders are only looked at by name, and timed where there are at least `_MANY` photos.

    Args:
        config: Resolved settings.
        source: The capture, to which bundled encoders must suit; None is not checked.
        photos: Number of photos.
        size: Width and height of a photo.
        listener: Receives events of stage "encoders": loaded, checked with words, the dense one checked, timed.

    Returns:
        The encoders, loaded as far as they were checked.

    Raises:
        ModelError: If one is missing, does not load whole, or gives useless features, or the settings ask CLIP for
            patches that it does not have.
    """
    folder, encoders = model_folder(config.clip, "clip"), Encoders.of(config)
    if (
        config.clip == "bundled"
        and source is not None
        and not source.resolve().is_relative_to(BUNDLED_SCENES)
    ):
        log.warning(
            "--clip bundled knows only scenes like the demo's; for other places use CLIP from the Hugging Face Hub"
        )
    if config.features_from is not None:  # CLIP embeds the prompts only, and DINO is not used
        if config.clip != "bundled":
            encoders.clip.encode_text(UNLIKE_WORDS)
        return encoders
    _ = encoders.segmenter
    if config.features.tokens != "class":
        check_patches(folder, config.clip)
    if config.clip == "bundled" and config.dino in ("bundled", "none"):
        if photos >= _MANY:
            _estimate(encoders, config, photos, size)
        return encoders
    log.log(NOTE, "the encoders are loaded, checked and timed")
    listener(Event("encoders", 0, 4))
    clip = encoders.clip
    listener(Event("encoders", 1, 4))
    ranks = {"": rank_words(clip)}
    if config.features.tokens != "class":
        ranks[" at their patches"] = rank_words(clip, patches=True)
    listener(Event("encoders", 2, 4))
    for read, right in ranks.items():
        if right < ENOUGH:
            # Only a warning: an encoder may be made for other things than the bundled images show.
            log.warning(
                "model %s: words match bundled images%s by %.2f only (expected %.2f, chance 0.50);"
                " answers may be wrong",
                config.clip,
                read,
                right,
                ENOUGH,
            )
    if encoders.dino is not None:
        check_dense(encoders.dino)
    listener(Event("encoders", 3, 4))
    if photos:
        _estimate(encoders, config, photos, size)
    listener(Event("encoders", 4, 4))
    return encoders


def check_given(config: BuildConfig, capture: Capture | None, encoders: Encoders) -> None:
    """Refuse features of another program that do not fit, and warn of those that are of another encoder.

    Args:
        config: Settings of the build.
        capture: The photos; cameras are not read. None checks nothing.
        encoders: The encoders of the build, whose words the features are compared with.

    Raises:
        FileFormatError: As `check_external_features`.
    """
    if config.features_from is None or capture is None:
        return
    clip, folder = encoders.clip, config.features_from
    check_external_features(folder, capture, clip.dim)
    if encoders.compared:
        return
    encoders.compared = True
    names = capture.train_names[:: max(1, len(capture.train_names) // _COMPARED)][:_COMPARED]
    maps = load_external_features(folder, capture, memory=config.memory_bytes, dimension=clip.dim)
    photos = (capture.views[name] for name in names)
    images = (view.load_image(reduced(view.capture_size, _SHORT_SIDE)) for view in photos)
    right = rank_tiles(
        clip,
        (torch.from_numpy(image).permute(2, 0, 1) for image in images),
        (maps[name].clip for name in names),
    )
    if right < ENOUGH_TILES:
        log.warning(
            "%s: the features match what %s sees in the photos by %.2f only (expected %.2f, chance 0.50); "
            "words have no meaning in features of another encoder, which --clip has to name",
            folder,
            f"--clip {config.clip}",
            right,
            ENOUGH_TILES,
        )


def _estimate(encoders: Encoders, config: BuildConfig, photos: int, size: tuple[int, int]) -> None:
    """Measure one photo and log the time of all, before the photos are read."""
    encoders.estimate = estimate(encoders.clip, encoders.dino, config.features, size)
    _tell(encoders, photos, at_most=may_leave_photos_out(config))


def _tell_time(capture: Capture, config: BuildConfig, encoders: Encoders, cache_dir: Path) -> None:
    """Log the estimated time of the features that are not cached, unless it is a few seconds."""
    clip, dino, settings = encoders.clip, encoders.dino, config.features
    missing = missing_views(capture, clip, dino, settings, cache_dir)
    if encoders.estimate is None and len(missing) >= _TOLD_FROM:
        sizes = [capture.views[name].capture_size for name in missing]
        largest = max(sizes, key=lambda size: size[0] * size[1])
        encoders.estimate = estimate(clip, dino, settings, largest)
    if encoders.estimate is not None and len(missing) != encoders.told:
        _tell(encoders, len(missing))


def may_leave_photos_out(config: BuildConfig) -> bool:
    """Whether the method chooses, by the Gaussians, the photos whose features are made."""
    return bool(config.language_method.feature_inputs(config))


def _tell(encoders: Encoders, photos: int, *, at_most: bool = False) -> None:
    """Log the estimated time of the features of some photos, unless it is short."""
    found = encoders.estimate
    if found is not None and found.seconds * photos >= SHORTEST_FORECAST:
        described = found.describe(photos, at_most=at_most)
        log.log(NOTE, "features on %s: %s", encoders.device, described)
    encoders.told = photos


def feature_maps(
    capture: Capture,
    config: BuildConfig,
    encoders: Encoders,
    cache_dir: Path,
    listener: Listener = silent,
) -> FeatureMaps:
    """Features of every view, extracted if the cache does not have them; masked cells are zero.

    They are pooled by 2D segments if ``config.features.segments`` says so. With ``config.features_from`` the features
    of another program are read instead.

    Args:
        capture: Its views, at the resolution they were captured in.
        config: Settings of the build.
        encoders: The encoders of the build.
        cache_dir: Folder of stored features.
        listener: Receives events of stage "features".
    """
    memory = config.memory_bytes
    if config.features_from is None:
        clip, dino = encoders.clip, encoders.dino
        _tell_time(capture, config, encoders, cache_dir)
        maps = extract_features(
            capture, clip, dino, config.features, cache_dir=cache_dir, memory=memory, listener=listener
        )
        maps = without_masked_cells(maps, capture)
        if config.features.segments == "none" or encoders.segmenter is None:
            return maps
        return pooled_features(
            maps, capture, encoders.segmenter, config.features, cache_dir=cache_dir, listener=listener
        )
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
