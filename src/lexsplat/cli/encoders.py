"""``lexsplat encoders``: fetch, check and time encoders before a long build."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, ClassVar, Literal

import tyro

from lexsplat.cli.options import Device, print_json
from lexsplat.cli.waiting import LateProgress, starting
from lexsplat.features.encoders import DEFAULT_CLIP, DEFAULT_DINO
from lexsplat.runtime.progress import Event

_PHOTOS, _SIZE = 100, (1440, 1080)
"""Number and size of the photos for which the time is stated if no capture is given."""


@dataclasses.dataclass
class EncodersCommand:
    """Fetch, check and time encoders before a long build.

    Downloads what is missing, loads it, checks that words match bundled images, and measures the time of the
    features of one photo and of a capture.

    Args:
        clip: Image-text encoder: a name on the Hugging Face Hub, a folder, or "bundled".
        dino: Dense encoder to check, too: a name, a folder, "bundled", or "none". The time counts it where a build
            needs it: where CLIP is read at class tokens alone.
        capture: Folder of photos or capture for which the time is stated.
        device: Device of the rasterizer.
        encoder_device: Device of the encoders; "auto" takes that of the rasterizer.
        json: Print one JSON document on standard output (docs/schemas/encoders.json).
    """

    clip: str = DEFAULT_CLIP
    dino: str | None = None
    capture: Annotated[str | None, tyro.conf.arg(metavar="CAPTURE")] = None
    device: Device = "auto"
    encoder_device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    json: bool = False

    defaults: ClassVar[dict[str, str]] = {
        "dino": "that of a build, if it needs one",
        "capture": f"{_PHOTOS} photos of {_SIZE[0]}x{_SIZE[1]}",
    }

    def run(self) -> None:
        """Print what was found.

        Raises:
            ModelError: If an encoder is not usable.
        """
        with starting():
            from lexsplat.features.checks import check_dense, check_words
            from lexsplat.features.estimate import estimate
            from lexsplat.features.hub import model_folder
            from lexsplat.pipeline.config import BuildConfig
            from lexsplat.pipeline.encoding import Encoders, may_leave_photos_out
            from lexsplat.pipeline.inputs import count_photos
            from lexsplat.runtime.device import choose_device

        photos, size = _PHOTOS, _SIZE
        config = BuildConfig(
            clip=self.clip,
            dino=self.dino or DEFAULT_DINO,
            device=self.device,
            encoder_device=self.encoder_device,
        )
        if self.capture is not None:
            survey = count_photos(_place(self.capture), config)
            photos, size = survey.count, survey.size
        model_folder(config.clip, "clip")  # downloads it: its architecture decides the settings
        config = config.resolved(choose_device(self.device), size)
        progress = LateProgress()
        progress(Event("encoders", 0, 4))
        dino = config.dino if self.dino or config.uses_dino else "none"
        encoders = Encoders(config.clip, dino, config.encoder_device)
        clip = encoders.clip
        progress(Event("encoders", 1, 4))
        facts: dict[str, Any] = {"clip": _facts(clip) | {"words_ranked": check_words(clip)}}
        if config.features.tokens != "class":
            facts["clip"]["patches_ranked"] = check_words(clip, patches=True)
        progress(Event("encoders", 2, 4))
        if encoders.dino is not None:
            check_dense(encoders.dino)
            facts["dino"] = _facts(encoders.dino)
        progress(Event("encoders", 3, 4))
        found = estimate(clip, encoders.dino if config.uses_dino else None, config.features, size)
        progress(Event("encoders", 4, 4))
        facts["time"] = {
            "device": config.encoder_device,
            "crops_per_photo": found.crops,
            "seconds_per_photo": found.seconds,
            "photos": photos,
            "seconds": found.seconds * photos,
        }
        if self.json:
            print_json(facts)
            return
        for tower in ("clip", "dino"):
            if tower in facts:
                print(
                    ", ".join(
                        f"{name.replace('_', ' ')} {_short(value)}" for name, value in facts[tower].items()
                    )
                )
        described = found.describe(photos, at_most=photos > 1 and may_leave_photos_out(config))
        print(f"features on {config.encoder_device}: {described}")


def _place(capture: str) -> Any:
    from lexsplat.cli.captures import capture_and_settings
    from lexsplat.pipeline.config import BuildConfig

    return capture_and_settings(capture, BuildConfig())[0]


def _facts(encoder: Any) -> dict[str, Any]:
    return {"encoder": encoder.name, "dimensions": encoder.dim, "hash": encoder.content_hash}


def _short(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)
