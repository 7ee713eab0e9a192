"""``lexsplat export``: a scene for other programs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from lexsplat.cli.options import (
    PRESENCE,
    Device,
    FileArgument,
    SceneArgument,
    check_threshold,
    confirmed,
    open_folder,
    open_scene,
    work_on,
)
from lexsplat.cli.waiting import LateProgress, starting
from lexsplat.runtime.errors import SceneFolderError
from lexsplat.runtime.progress import uncounted


@dataclasses.dataclass
class Export:
    """Write a scene, or what was found in it, for other programs. The ending of the file name selects the format.

    .ply (the standard of 3D Gaussian Splatting), .spz (version 4; .v3.spz is version 3), .sog (compressed images),
    .glb (glTF with KHR_gaussian_splatting), .splat, .points.ply (a plain point cloud); .compressed.ply and .ksplat
    with pip install "lexsplat[formats]"; .csv and .json for labels (see docs/formats.md).

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        file: The file to write.
        select: Write only what matches these phrases (see lexsplat find --help). .json lists the Gaussians of each
            phrase; .csv has a row for every Gaussian of the scene, with the phrase that it matches.
        view: Name of the view that left and right refer to.
        language: Include codes and codebook (.ply and .glb).
        force: Replace a file that exists without asking.
        threshold: Relevancy from which a Gaussian matches.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
    """

    scene: SceneArgument
    file: FileArgument
    select: tuple[str, ...] = ()
    view: str | None = None
    language: bool = False
    force: bool = False
    threshold: float | None = None
    clip: str | None = None
    device: Device = "auto"

    def check(self) -> None:
        """Refuse invalid options."""
        check_threshold(self.threshold)
        if not self.select and (self.view is not None or self.threshold is not None):
            raise ValueError("--view and --threshold need --select PHRASE")

    def run(self) -> None:
        """Write the file."""
        with starting():
            from lexsplat.geometry.world import world_of
            from lexsplat.scenes.exporting import ending_of, export_gaussians, export_scene, exported

        work = work_on(self.scene, ending_of(self.file), *self.select)
        folder = open_folder(self.scene)
        folder.refuse_own_file(self.file)
        if not self.force:
            _refuse_existing(self.file)
        if self.select or self.language:
            # As a full path and with steps, so that the notes of `open_folder` are not printed again.
            scene = open_scene(str(folder.root.resolve()), self.device, self.clip, shows_steps=True)
            found = [
                dataclasses.replace(scene.find(phrase, self.view, threshold=self.threshold), phrase=phrase)
                for phrase in self.select
            ]
            for asked, thing in zip(found, exported(scene, self.file, found)):
                whole = f", {len(thing):,} with the hidden ones inside it" if len(thing) > len(asked) else ""
                print(f"{asked.phrase}: {len(asked):,} Gaussians{whole}{PRESENCE[asked.present]}")
            with uncounted(scene.listener, "export", work):
                files = export_scene(scene, self.file, found=found, language=self.language, overwrite=True)
        else:
            cameras = {name: view.camera for name, view in folder.read_cameras().items()}
            world = world_of(folder.record, cameras)
            progress = LateProgress()
            with uncounted(progress, "export", work):
                gaussians = folder.read_gaussians()
                files = export_gaussians(gaussians, self.file, world=world, overwrite=True, listener=progress)
        for file in files:  # an existing file was confirmed above
            print(f"{file}: {file.stat().st_size:,} bytes")


def _refuse_existing(file: Path) -> None:
    """Ask before an existing file is replaced."""
    if file.exists() and not confirmed(f"{file} exists. Replace it?"):
        raise SceneFolderError(
            file,
            expected="a new file",
            found="a file that exists",
            remedy="give another name, or --force to replace it",
        )
