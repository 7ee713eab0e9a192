"""``lexsplat poses``: the cameras of photos."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from shlex import quote
from typing import Annotated

import tyro

from lexsplat.captures.readers.video import DEFAULT_FRAMES
from lexsplat.captures.sfm.photos import PoseConfig
from lexsplat.cli.options import named
from lexsplat.runtime.device import check_seed
from lexsplat.runtime.memory import parse_bytes

PhotosArgument = Annotated[Path, tyro.conf.Positional, named("CAPTURE")]


@dataclasses.dataclass
class Poses:
    """Estimate the cameras of photos, or of a video, and write them as a COLMAP model.

    build runs the same step where there are no cameras. Use this command to inspect the cameras first, or to use
    them in other programs. The output is a COLMAP project: sparse/0, and images/ with the frames of a video, with
    upright copies of photos that are stored turned, or linked to the photos. Continue with lexsplat build OUTPUT.

    Args:
        photos: Folder of photos that overlap by 60 to 80 percent, optionally with masks/; or a video.
        output: Folder for the COLMAP project.
        frames: Number of frames that are taken from a video.
        seed: Seed of all randomness.
        memory: Memory budget, such as 4GB, in addition to what the libraries need. It determines how many photos are
            processed at once.
        settings: Settings of structure from motion.
    """

    photos: PhotosArgument
    output: Path
    frames: int = DEFAULT_FRAMES
    seed: int = 0
    memory: str = "4GB"
    settings: Annotated[PoseConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=PoseConfig)

    def check(self) -> None:
        """Refuse invalid options."""
        if self.frames < 3:
            raise ValueError(f"frames must be at least 3, got {self.frames}")
        check_seed(self.seed)
        parse_bytes(self.memory)

    def run(self) -> None:
        """Write the model and state how many photos are registered, and which are not."""
        from lexsplat.captures import poses_from_photos
        from lexsplat.captures.readers.video import is_video, require_video, sample_video
        from lexsplat.captures.sfm.preparation import checked_photos, photo_folder
        from lexsplat.cli.progress import ProgressBars
        from lexsplat.scenes.folder import SceneFolder

        photos, memory = self.photos, parse_bytes(self.memory)
        if is_video(photos):  # before --output is made
            require_video(photos, self.output / "images")
        else:
            checked_photos(photo_folder(photos), self.output)
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
            with contextlib.suppress(OSError):  # without symbolic links the photos stay where they are
                images.symlink_to(result.images.resolve(), target_is_directory=True)
        print(f"next: lexsplat build {quote(str(self.output))} --output SCENE")
