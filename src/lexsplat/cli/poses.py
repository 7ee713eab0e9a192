"""``lexsplat poses``: where the photos were taken."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro


@dataclasses.dataclass
class Poses:
    """Estimate the cameras of a folder of photos and write them as a COLMAP model.

    ``build`` does this by itself where there are no cameras; this is for looking at them first, or for use in other
    programs.

    Args:
        photos: Folder of photos that overlap by 60 to 80 percent.
        output: Folder to write ``sparse/0`` into.
        seed: Seed of all randomness.
    """

    photos: tyro.conf.Positional[Path]
    output: Path
    seed: int = 0

    def run(self) -> None:
        """Write the model and say how many photos were placed."""
        from lexsplat.progress_bars import ProgressBars
        from lexsplat.scenes import poses_from_photos

        with ProgressBars() as bars:
            result = poses_from_photos(self.photos, self.output, seed=self.seed, listener=bars)
        print(f"{self.output / 'sparse' / '0'}: {result.note}")
