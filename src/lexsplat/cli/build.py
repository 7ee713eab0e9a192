"""``lexsplat build``, ``reconstruct`` and ``language``: photos in, a searchable scene out."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar, Literal

from lexsplat.cli.arguments import ESSENTIAL_SETTINGS
from lexsplat.cli.captures import capture_and_settings
from lexsplat.cli.options import CaptureArgument, Settings
from lexsplat.pipeline.config import BuildConfig


@dataclasses.dataclass
class Build:
    """Make a searchable scene from photos, with or without cameras, or from a video.

    Runs all stages: reconstruct, features, codebook, language. Run the same command again to continue after an
    interruption. After a change of settings, only the stages that depend on them run again.

    Args:
        capture: Folder with photos and cameras: a COLMAP model (images/ and sparse/0/) or a transforms.json of
            nerfstudio, instant-ngp or NeRF-synthetic. Photos without cameras, and videos (.mp4, .mov), receive
            cameras by structure from motion. Black pixels of ``masks/NAME.png`` are ignored. The words "demo" and
            "second" are the bundled captures.
        output: The scene folder to make.
        test_views: Names of the views to hold out for evaluation.
        settings: Settings of all stages.
    """

    capture: CaptureArgument
    output: Path
    test_views: tuple[str, ...] = ()
    settings: Settings = dataclasses.field(default_factory=BuildConfig)

    essential: ClassVar[tuple[str, ...]] = ESSENTIAL_SETTINGS
    until: ClassVar[Literal["reconstruct", "language"]] = "language"

    def run(self) -> None:
        """Build up to the last stage of this command."""
        from lexsplat.cli.progress import ProgressBars
        from lexsplat.pipeline.build import build

        capture, settings = capture_and_settings(self.capture, self.settings)
        with ProgressBars() as bars:
            folder = build(
                capture,
                self.output,
                settings,
                until=self.until,
                test_names=list(self.test_views) or None,
                splats=getattr(self, "splats", None),
                listener=bars,
            )
        print(f"{folder.root}: finished {', '.join(folder.record['stages'])}")
        if self.until == "language":
            print(f'next: lexsplat query {folder.root} "something you see"')


@dataclasses.dataclass
class Reconstruct(Build):
    """Reconstruct 3D Gaussians from photos: the first stage of build.

    Settings of the later stages are accepted, so that one set of options serves both commands; they have no effect.
    """

    essential: ClassVar[tuple[str, ...]] = tuple(
        name for name in ESSENTIAL_SETTINGS if name not in ("clip", "dino", "method")
    )
    unused: ClassVar[tuple[str, ...]] = (
        "clip", "dino", "features_from", "method", "joint", "features", "codebook", "averaged", "trained",
    )  # fmt: skip
    until: ClassVar[Literal["reconstruct", "language"]] = "reconstruct"


@dataclasses.dataclass
class Language(Build):
    """Put language on the Gaussians of a scene: the stages after reconstruct, which runs first if it is missing.

    With --splats, Gaussians made by another program are used unchanged. Photos and poses must be those that they
    were made from, in the same axes and units.

    Args:
        splats: Gaussians to use instead of reconstructing: .ply, .splat, .spz, .compressed.ply or .ksplat.
    """

    splats: Path | None = None

    def check(self) -> None:
        """Refuse invalid options."""
        if self.splats is not None and self.settings.joint:
            raise ValueError("joint training makes its own Gaussians: give --splats or --joint, not both")
