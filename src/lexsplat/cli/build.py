"""``lexsplat build``, ``reconstruct`` and ``language``: photos in, a searchable scene out."""

from __future__ import annotations

import dataclasses
import logging
import sys
from pathlib import Path
from shlex import quote
from typing import ClassVar, Literal

from lexsplat.cli.arguments import ESSENTIAL_SETTINGS
from lexsplat.cli.captures import capture_and_settings
from lexsplat.cli.options import CaptureArgument, MoreCapturesArgument, OptionalCaptureArgument, ProgressName
from lexsplat.cli.settings import Settings
from lexsplat.cli.waiting import starting
from lexsplat.language.methods import METHODS
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import CaptureError

log = logging.getLogger("lexsplat")

_OF_SPLATS = "lexsplat language --splats FILE --output SCENE"


def _is_splats(capture: str) -> bool:
    """Whether a capture is a file with the name of splats."""
    if not Path(capture).is_file():
        return False
    from lexsplat.scenes.formats.reading import is_splats

    return is_splats(Path(capture))


@dataclasses.dataclass
class Build:
    """Make a searchable scene from photos, with or without cameras, or from a video.

    Runs all stages: reconstruct, features and language, and for method trained the codebook before language. Run the
    same command again to continue after an interruption. After a change of settings, only the stages that depend on
    them run again.

    Args:
        capture: Folder with photos and cameras: a COLMAP model (images/ and sparse/0/) or a transforms.json of
            nerfstudio, instant-ngp or NeRF-synthetic. Photos without cameras, and videos (.mp4, .mov), receive
            cameras by structure from motion. Black pixels of ``masks/NAME.png`` are ignored. The words "demo" and
            "second" are the bundled captures.
        output: The scene folder to make; of several captures, the folder of their scenes.
        more: Further captures, as in: build captures/* --output scenes
        progress: "json" prints every event of progress as a line of JSON (docs/scaling.md).
        test_views: Names of the views to hold out for evaluation.
        settings: Settings of all stages.
    """

    capture: CaptureArgument
    output: Path
    more: MoreCapturesArgument = ()
    progress: ProgressName = "bars"
    test_views: tuple[str, ...] = ()
    settings: Settings = dataclasses.field(default_factory=BuildConfig)

    essential: ClassVar[tuple[str, ...]] = ESSENTIAL_SETTINGS
    rare: ClassVar[tuple[str, ...]] = ("progress", "test_views")
    unused: ClassVar[tuple[str, ...]] = ("keep_floaters", "views_from")
    until: ClassVar[Literal["reconstruct", "language"]] = "language"
    elsewhere: ClassVar[dict[str, str]] = {"--splats": _OF_SPLATS}

    def check(self) -> None:
        """Refuse invalid options."""
        for capture in (self.capture, *self.more):
            if _is_splats(capture):
                raise ValueError(f"{capture}: expected a capture, found splats; use: {_OF_SPLATS}")
        if self.more and (self.test_views or getattr(self, "splats", None) is not None):
            raise ValueError("--test-views and --splats belong to one CAPTURE: build the scenes one by one")

    def run(self) -> None:
        """Build up to the last stage of this command."""
        with starting():
            from lexsplat.cli.progress import shown_progress
            from lexsplat.pipeline.build import build

        if self.more:
            self._build_scenes()
            return
        is_scene = (self.output / "scene.json").exists()  # which may keep its previous version
        holds_scenes = not is_scene and any(self.output.glob("*/scene.json"))
        self._warn_of_mixture(holds_scenes, "holds the scenes of several captures")
        capture, settings = None, self.settings
        if self.capture:
            capture, settings = capture_and_settings(self.capture, settings)
        with shown_progress(self.progress) as bars:
            folder = build(
                capture,
                self.output,
                settings,
                until=self.until,
                test_names=list(self.test_views) or None,
                splats=getattr(self, "splats", None),
                listener=bars,
            )
        if self.progress == "json":
            return
        print(f"{self.output}: finished {', '.join(folder.record['stages'])}")
        if self.until == "language":
            print(f'next: lexsplat query {quote(str(self.output))} "something you see"')

    def _warn_of_mixture(self, mixed: bool, what: str) -> None:
        """Warn where a folder becomes a scene and a folder of scenes, as a pattern may match one capture or more."""
        if mixed:
            log.warning(
                "%s %s: one CAPTURE is written into --output itself, several into folders below it",
                self.output,
                what,
            )

    def _build_scenes(self) -> None:
        """Build one scene per capture; failures are reported and the other scenes are kept."""
        from lexsplat.cli.progress import shown_progress
        from lexsplat.pipeline.distribution import build_scenes, scene_tasks
        from lexsplat.runtime.workers import open_workers

        sources = dict(capture_and_settings(name, self.settings) for name in (self.capture, *self.more))
        tasks = scene_tasks(sources, self.output, self.until)
        self._warn_of_mixture((self.output / "scene.json").exists(), "is the scene of one capture")
        failed = 0
        with (
            shown_progress(self.progress) as bars,
            open_workers(self.settings.workers, tuple(sources)) as workers,
        ):
            for outcome in build_scenes(tasks, self.output, workers, bars):
                if outcome.error is not None:
                    failed += 1
                    line = str(outcome.error)
                    named = line.startswith(f"{outcome.name}: ")
                    print(line if named else f"{outcome.name}: {line}", file=sys.stderr)
                elif self.progress != "json":
                    print(f"{tasks[outcome.name].output}: finished {', '.join(outcome.result)}")
        if failed:
            raise CaptureError(
                self.output,
                expected=f"{len(tasks)} scenes",
                found=f"{failed} failed, listed above",
                remedy="correct their captures and run the same command again; finished scenes are kept",
            )


@dataclasses.dataclass
class Reconstruct(Build):
    """Reconstruct 3D Gaussians from photos: the first stage of build.

    Settings of the later stages are accepted, so that one set of options serves both commands. They have no effect.
    Only --as-in-paper and --joint train language along, so that features and codebook run first.
    """

    essential: ClassVar[tuple[str, ...]] = tuple(
        name for name in ESSENTIAL_SETTINGS if name not in ("clip", "dino", "method")
    )
    unused: ClassVar[tuple[str, ...]] = (
        "clip", "dino", "features_from", "method", "joint", "features", "keep_floaters", "views_from",
        *dict.fromkeys(part for method in METHODS.values() for part in method.settings),
    )  # fmt: skip
    until: ClassVar[Literal["reconstruct", "language"]] = "reconstruct"


@dataclasses.dataclass
class Language(Build):
    """Put language on the Gaussians of a scene: the stages after reconstruct, which runs first if it is missing.

    With --splats, Gaussians made by another program are used. A CAPTURE must be the photos and poses that they were
    made from, in the same axes and units. Without CAPTURE, views of the splats are chosen and rendered; they are kept
    in OUTPUT/poses, with a contact sheet. Where many Gaussians float free of all surfaces, they are then left out.

    Args:
        capture: Folder with photos and cameras, as in build; not needed with --splats.
        splats: Gaussians to use instead of reconstructing: .ply, .spz, .sog, .glb and others (docs/formats.md).
    """

    capture: OptionalCaptureArgument = dataclasses.field(default="", kw_only=True)
    splats: Path | None = None

    essential: ClassVar[tuple[str, ...]] = (
        "clip", "dino", "device", "method", "iterations", "downscale", "seed", "memory",
        "up", "keep_floaters", "views_from",
    )  # fmt: skip
    unused: ClassVar[tuple[str, ...]] = ()
    elsewhere: ClassVar[dict[str, str]] = {}

    def check(self) -> None:
        """Refuse invalid options."""
        super().check()
        if self.splats is not None:
            self.settings.spelled_out().refuse_beside_splats()
        if self.splats is None and not self.capture:
            raise ValueError("a CAPTURE is needed, or --splats FILE")
        if self.test_views and not self.capture:
            raise ValueError("--test-views needs a CAPTURE: views chosen from splats are no ground truth")
