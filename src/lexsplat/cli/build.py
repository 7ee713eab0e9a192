"""``lexsplat build``, ``reconstruct`` and ``language``: photos in, a searchable scene out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from lexsplat.cli.options import Settings
from lexsplat.pipeline.config import BuildConfig


@dataclasses.dataclass
class Build:
    """Make a searchable scene from photos, with or without cameras, or from a video.

    All stages: reconstruct, features, codebook, language. Run it again with the same output to go on where it
    stopped; only what a changed setting touches is done again.

    Args:
        capture: Folder with photos and cameras: a COLMAP model (images/ and sparse/0/) or a transforms.json of
            nerfstudio, instant-ngp or NeRF-synthetic. Photos alone, and a video (.mp4, .mov), get cameras by
            structure from motion; pixels that are black in ``masks/NAME.png`` take no part in anything.
        output: The scene folder to make.
        test_views: Names of the views to hold out for evaluation.
        settings: What is made and how.
    """

    capture: tyro.conf.Positional[Path]
    output: Path
    test_views: tuple[str, ...] = ()
    settings: Settings = dataclasses.field(default_factory=BuildConfig)

    until = "language"

    def run(self) -> None:
        """Build up to the last stage of this command."""
        from lexsplat.cli.progress import ProgressBars
        from lexsplat.pipeline.build import build

        with ProgressBars() as bars:
            folder = build(
                self.capture,
                self.output,
                self.settings,
                until=self.until,
                test_names=list(self.test_views) or None,
                splats=getattr(self, "splats", None),
                listener=bars,
            )
        print(f"{folder.root}: {', '.join(folder.record['stages'])} finished")
        if self.until == "language":
            print(f'next: lexsplat query {folder.root} "something you see"')


@dataclasses.dataclass
class Reconstruct(Build):
    """Only reconstruct: 3D Gaussians from photos with cameras (the first stage of build)."""

    until = "reconstruct"


@dataclasses.dataclass
class Language(Build):
    """Give a scene its language: the stages after reconstruct (which is run first where it is missing).

    With --splats, Gaussians made by another program are taken as they are; photos and poses must be those they were
    made from, in the same axes and units.

    Args:
        splats: Gaussians to take instead of reconstructing: .ply, .splat, .spz, .compressed.ply or .ksplat.
    """

    splats: Path | None = None

    def __post_init__(self) -> None:
        if self.splats is not None and self.settings.joint:
            raise ValueError("joint training makes its own Gaussians: leave --splats or --joint out")
