"""``lexsplat export``: a scene for other programs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from lexsplat.cli.options import PRESENCE, Device, check_relevancy, open_scene


@dataclasses.dataclass
class Export:
    """Write a scene, or what was found in it, for other programs. The ending of the name says the format.

    .ply (the standard of 3D Gaussian Splatting), .splat, .glb (glTF with KHR_gaussian_splatting), .points.ply (a
    plain point cloud); .spz, .compressed.ply and .ksplat with `pip install "lexsplat[formats]"`; .csv and .json for
    labels (see docs/formats.md).

    Args:
        scene: A scene folder, or ``demo`` for the scene that ships with lexsplat.
        file: The file to write.
        select: Write only what answers to these phrases (see `lexsplat find --help`); in .csv and .json, which
            Gaussian answers to which.
        view: Whose left and right a phrase means; none takes the view that shows the other thing best.
        language: Write codes and codebook along (.ply and .glb).
        threshold: Relevancy from which a Gaussian answers; none chooses one for each phrase.
        clip: Text encoder, if it is not where the build found it.
        device: Where to compute.
    """

    scene: tyro.conf.Positional[str]
    file: tyro.conf.Positional[Path]
    select: tuple[str, ...] = ()
    view: str | None = None
    language: bool = False
    threshold: float | None = None
    clip: str | None = None
    device: Device = "auto"

    def __post_init__(self) -> None:
        check_relevancy(self.threshold)

    def run(self) -> None:
        """Write the file."""
        from lexsplat.geometry.world import world_of
        from lexsplat.scenes.exporting import ending_of, export_gaussians, export_scene
        from lexsplat.scenes.folder import SceneFolder

        ending_of(self.file)
        SceneFolder.open(Path(self.scene)).refuse_own_file(self.file)
        if self.select or self.language:
            scene = open_scene(self.scene, self.device, self.clip)
            found = [
                dataclasses.replace(scene.find(phrase, self.view, threshold=self.threshold), phrase=phrase)
                for phrase in self.select
            ]
            for selection in found:
                print(f"{selection.phrase}: {len(selection):,} Gaussians{PRESENCE[selection.present]}")
            files = export_scene(scene, self.file, found=found, language=self.language)
        else:
            folder = SceneFolder.open(Path(self.scene))
            cameras = {name: view.camera for name, view in folder.read_cameras().items()}
            world = world_of(folder.record, cameras)
            files = export_gaussians(folder.read_gaussians(), self.file, world=world)
        for file in files:
            print(f"{file}: {file.stat().st_size:,} bytes")
