"""``lexsplat poses``: where the photos were taken."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from lexsplat.captures.readers.video import DEFAULT_FRAMES
from lexsplat.captures.sfm.photos import PoseConfig
from lexsplat.runtime.device import check_seed
from lexsplat.runtime.memory import parse_bytes


@dataclasses.dataclass
class Poses:
    """Estimate the cameras of photos, or of a video, and write them as a COLMAP model.

    ``build`` does this by itself where there are no cameras; this is for looking at them first, or for use in other
    programs. The output is a COLMAP project: ``sparse/0``, and ``images`` with the frames of a video, with upright
    copies of photos that are stored turned, or linked to the photos. ``lexsplat build OUTPUT`` goes on from it.

    Args:
        photos: Folder of photos that overlap by 60 to 80 percent, with ``masks/`` if wanted; or a video.
        output: Folder to write into.
        frames: How many frames a video is sampled to.
        seed: Seed of all randomness.
        memory: Host memory that may be taken, beside the libraries: decides how much is done at once.
        settings: How photos are compared and placed.
    """

    photos: tyro.conf.Positional[Path]
    output: Path
    frames: int = DEFAULT_FRAMES
    seed: int = 0
    memory: str = "4GB"
    settings: Annotated[PoseConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=PoseConfig)

    def __post_init__(self) -> None:
        if self.frames < 3:
            raise ValueError(f"frames must be at least 3, got {self.frames}")
        check_seed(self.seed)
        parse_bytes(self.memory)

    def run(self) -> None:
        """Write the model and say how many photos were placed, and which were not."""
        from lexsplat.captures import poses_from_photos
        from lexsplat.captures.readers.video import is_video, sample_video
        from lexsplat.cli.progress import ProgressBars
        from lexsplat.scenes.folder import SceneFolder

        photos, memory = self.photos, parse_bytes(self.memory)
        with SceneFolder(self.output).locked(), ProgressBars() as bars:
            if is_video(photos):
                photos = self.output / "images"
                sample_video(self.photos, photos, self.frames, memory=memory, listener=bars)
            result = poses_from_photos(
                photos, self.output, self.settings, seed=self.seed, memory=memory, listener=bars
            )
        for note in result.notes:
            print(note)
        print(f"{self.output / 'sparse' / '0'}: {result.note}")
        images = self.output / "images"
        if not images.exists() and result.images.resolve() != self.output.resolve():
            with contextlib.suppress(OSError):  # a system without links: the photos stay where they are
                images.symlink_to(result.images.resolve(), target_is_directory=True)
        print(f"next: lexsplat build {self.output} --output SCENE")
