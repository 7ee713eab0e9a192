"""``lexsplat publish``: a scene as a static page that is searched in the browser."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from shlex import quote
from typing import Annotated, ClassVar

import tyro

from lexsplat.cli.options import Device, SceneArgument, named, open_scene
from lexsplat.cli.waiting import starting
from lexsplat.runtime.errors import SceneFolderError

FolderArgument = Annotated[Path, tyro.conf.Positional, named("FOLDER")]


@dataclasses.dataclass
class Publish:
    """Write a scene as a page that is searched with words in the browser. No server computes anything.

    Any web server can serve the folder, for example python -m http.server. The page answers thousands of everyday
    phrases from tables; scenes of CLIP encoders also get the text tower, which answers any phrase. What was asked of
    the scene in the viewer is offered to visitors (see docs/publishing.md).

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        folder: The folder to write: new, empty, or an earlier page. With --single-file a file that ends in .html.
        title: Title of the page.
        description: A sentence under the title.
        start_view: Name of the view from which the page starts.
        max_splats: Publish this many Gaussians, those that cover most.
        words_only: Leave out the text tower: the page answers only the phrases of its dictionary.
        single_file: Write one HTML file that opens by double click, of files of up to 50 MB.
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
    """

    scene: SceneArgument
    folder: FolderArgument
    title: str = ""
    description: str = ""
    start_view: str | None = None
    max_splats: int | None = None
    words_only: bool = False
    single_file: bool = False
    clip: str | None = None
    device: Device = "auto"

    defaults: ClassVar[dict[str, str]] = {
        "start_view": "the first view",
        "max_splats": "all",
        "clip": "the encoder of the build",
    }

    def check(self) -> None:
        """Refuse invalid options."""
        if self.max_splats is not None and self.max_splats < 2:
            raise ValueError(f"--max-splats must be at least 2, got {self.max_splats}")

    def run(self) -> None:
        """Write the page."""
        with starting():
            from lexsplat.scenes.folder import refuse_within_scene
            from lexsplat.scenes.publishing import PublishOptions, check_target, publish

        if (
            not self.single_file
            and self.folder.suffix.lower() in (".html", ".htm")
            and not self.folder.is_dir()
        ):
            raise SceneFolderError(
                self.folder,
                expected="a folder",
                found="the name of a page",
                remedy="give --single-file as well",
            )
        refuse_within_scene(self.folder)  # before anything is loaded
        check_target(self.folder, self.single_file)
        options = PublishOptions(
            self.title,
            self.description,
            self.start_view,
            self.max_splats,
            self.words_only,
            self.single_file,
        )
        written = publish(open_scene(self.scene, self.device, self.clip), self.folder, options)
        free = "any phrase" if written.free_text else "no other phrases"
        print(
            f"{written.path}: {written.bytes / 1e6:.1f} MB, {written.splats:,} Gaussians, "
            f"{written.phrases:,} phrases and {free}"
        )
        if not self.single_file:
            print(f"open it with: python -m http.server --directory {quote(str(written.path))}")
