"""``lexsplat export``: a scene for other programs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from lexsplat.cli.options import Device, check_threshold, open_scene


@dataclasses.dataclass
class Export:
    """Write a scene, or what was found in it, for other programs. The ending of the name says the format.

    .ply (the standard of 3D Gaussian Splatting), .splat, .glb (glTF with KHR_gaussian_splatting), .points.ply (a
    plain point cloud); .spz, .compressed.ply and .ksplat with `pip install "lexsplat[formats]"`; .csv and .json for
    labels (see docs/formats.md).

    Args:
        scene: A scene folder.
        file: The file to write.
        select: Write only what answers to these phrases; in .csv and .json, which Gaussian answers to which.
        language: Write codes and codebook along (.ply and .glb).
        threshold: Relevancy from which a Gaussian answers; none chooses one for each phrase.
        clip: Text encoder, if it is not where the build found it.
        device: Where to compute.
    """

    scene: tyro.conf.Positional[str]
    file: tyro.conf.Positional[Path]
    select: tuple[str, ...] = ()
    language: bool = False
    threshold: float | None = None
    clip: str | None = None
    device: Device = "auto"

    def __post_init__(self) -> None:
        check_threshold(self.threshold)

    def run(self) -> None:
        """Write the file."""
        from lexsplat.exporting import ending_of, export_gaussians, export_scene
        from lexsplat.scene_folder import SceneFolder
        from lexsplat.world import world_of

        ending_of(self.file)
        SceneFolder.open(Path(self.scene)).refuse_own_file(self.file)
        if self.select or self.language:
            scene = open_scene(self.scene, self.device, self.clip)
            files = export_scene(
                scene, self.file, phrases=self.select, language=self.language, threshold=self.threshold
            )
        else:
            folder = SceneFolder.open(Path(self.scene))
            cameras = {name: view.camera for name, view in folder.read_cameras().items()}
            world = world_of(folder.record, cameras)
            files = export_gaussians(folder.read_gaussians(), self.file, world=world)
        for file in files:
            print(f"{file}: {file.stat().st_size:,} bytes")
