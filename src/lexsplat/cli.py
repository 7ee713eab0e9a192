"""The command line: ``lexsplat COMMAND``. Errors are one line and exit status 1, wrong usage is 2."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from lexsplat import __version__
from lexsplat.config import BuildConfig
from lexsplat.errors import LexsplatError, SceneFolderError
from lexsplat.queries import QueryConfig

if TYPE_CHECKING:
    from lexsplat.search import SearchableScene

Settings = Annotated[BuildConfig, tyro.conf.arg(name="")]
Device = Literal["auto", "cpu", "cuda"]


@dataclasses.dataclass
class Demo:
    """Run the whole system on the scene that ships with lexsplat, and show what it can do.

    Reconstructs the scene, extracts language features with the embedded encoders, fits the codebook, makes the
    language field, answers queries on held-out views, and evaluates them against exact masks. Needs no network
    and no GPU. Run it again to go on where it stopped.

    Args:
        output: Folder for everything that is written.
        scene: Which embedded scene: the table top of the pictures, or the second, smaller one.
        method: How language gets into the Gaussians (see ``lexsplat build --help``).
        device: Where to compute.
        seed: Seed of all randomness.
        iterations: Reconstruction steps.
    """

    output: Path = Path("output/demo")
    scene: Literal["tabletop", "second"] = "tabletop"
    method: Literal["trained", "lifted", "lifted+tuned"] | None = None
    device: Device = "auto"
    seed: int = 0
    iterations: int | None = None

    def run(self) -> None:
        """Build, evaluate, print the table."""
        from lexsplat.demo.demo import run_demo
        from lexsplat.progress_bars import ProgressBars

        with ProgressBars() as bars:
            result = run_demo(
                self.output,
                scene=self.scene,
                method=self.method,
                device=self.device,
                seed=self.seed,
                iterations=self.iterations,
                listener=bars,
            )
        _print_evaluation(result, self.output)


@dataclasses.dataclass
class Build:
    """Make a searchable scene from photos with cameras.

    All stages: reconstruct, features, codebook, embed. Run it again with the same output to go on where it
    stopped; only what a changed setting touches is done again.

    Args:
        capture: Folder with photos and cameras: a COLMAP model (images/ and sparse/0/) or a transforms.json of
            nerfstudio, instant-ngp or NeRF-synthetic. Photos alone get cameras by structure from motion.
        output: The scene folder to make.
        test_views: Names of the views to hold out for evaluation.
        settings: What is made and how.
    """

    capture: tyro.conf.Positional[Path]
    output: Path
    test_views: tuple[str, ...] = ()
    settings: Settings = dataclasses.field(default_factory=BuildConfig)

    until = "embed"

    def run(self) -> None:
        """Build up to the last stage of this command."""
        from lexsplat.pipeline import build
        from lexsplat.progress_bars import ProgressBars

        with ProgressBars() as bars:
            folder = build(
                self.capture,
                self.output,
                self.settings,
                until=self.until,
                test_names=list(self.test_views) or None,
                listener=bars,
            )
        print(f"{folder.root}: {', '.join(folder.record['stages'])} finished")
        if self.until == "embed":
            print(f'next: lexsplat query {folder.root} "something you see"')


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


@dataclasses.dataclass
class Reconstruct(Build):
    """Only reconstruct: 3D Gaussians from photos with cameras (the first stage of build)."""

    until = "reconstruct"


@dataclasses.dataclass
class Embed(Build):
    """Give a scene its language: the stages after reconstruct (which is run first where it is missing)."""


@dataclasses.dataclass
class Query:
    """Ask where something is: heatmaps, masks and scores for free text.

    Args:
        scene: A scene folder.
        prompts: What to look for, such as "red apple" "something to sit on".
        view: Names of the views to answer in; none takes the held-out views.
        output: Folder for the pictures; none takes ``SCENE/heatmaps``.
        threshold: Relevancy from which a pixel belongs to the mask; none chooses one for each prompt from the
            scene alone. The paper's is 0.5.
        form: How codes and text are compared: "feature" blends features, then compares (the paper); "code"
            compares each code, then blends. None takes the scene's default.
        negatives: Phrases a prompt has to beat; none takes "object", "things", "stuff", "texture".
        temperature: Factor on cosines; none takes 10.
        template: Sentence with {} for the prompt, such as "a photo of a {}"; may be given several times.
        clip: Text encoder, if it is not where the build found it.
        device: Where to compute.
        json: Print one JSON document on standard output.
    """

    scene: tyro.conf.Positional[str]
    prompts: tyro.conf.Positional[tuple[str, ...]]
    view: tuple[str, ...] = ()
    output: Path | None = None
    threshold: float | None = None
    form: Literal["feature", "code"] | None = None
    negatives: tuple[str, ...] = ()
    temperature: float | None = None
    template: tuple[str, ...] = ()
    clip: str | None = None
    device: Device = "auto"
    json: bool = False

    def __post_init__(self) -> None:
        if self.threshold is not None and not 0 <= self.threshold <= 1:
            raise ValueError(f"threshold must be in 0..1, got {self.threshold:g}")
        self._changed(QueryConfig())

    def _changed(self, config: QueryConfig) -> QueryConfig:
        """The scene's way of answering with what was asked for on the command line."""
        changes: dict[str, Any] = {
            "form": self.form,
            "negatives": self.negatives or None,
            "temperature": self.temperature,
            "templates": self.template or None,
        }
        return dataclasses.replace(config, **{name: v for name, v in changes.items() if v is not None})

    def run(self) -> None:
        """Answer and write pictures."""
        from lexsplat.answers import answer_queries

        scene = _open(self.scene, self.device, self.clip)
        scene.query = self._changed(scene.query)
        folder = self.output or Path(self.scene) / "heatmaps"
        answers = answer_queries(scene, self.prompts, self.view, self.threshold, folder)
        if self.json:
            print(json.dumps(answers, indent=2, ensure_ascii=False))
            return
        for answer in answers["prompts"]:
            print(
                f"{answer['prompt']}: best {answer['peak']:.2f} in {answer['best_view']}, "
                f"threshold {answer['threshold']:.2f}, {answer['gaussians']} Gaussians"
            )
        print(f"pictures in {folder}")


@dataclasses.dataclass
class Evaluate:
    """Measure a scene on its held-out views: picture quality, and language where there are masks.

    Writes metrics.json, report.html and heatmaps/ into the scene folder.

    Args:
        scene: A scene folder.
        masks: Folder with STEM/PROMPT.png; none takes ``segmentations/`` of the capture.
        capture: Where the photos are now, if they have moved.
        form: See ``lexsplat query --help``.
        clip: Text encoder, if it is not where the build found it.
        device: Where to compute.
        json: Print metrics.json on standard output.
    """

    scene: tyro.conf.Positional[str]
    masks: Path | None = None
    capture: Path | None = None
    form: Literal["feature", "code"] | None = None
    clip: str | None = None
    device: Device = "auto"
    json: bool = False

    def run(self) -> None:
        """Evaluate and print the table."""
        from lexsplat.answers import evaluate_scene
        from lexsplat.progress_bars import ProgressBars

        scene = _open(self.scene, self.device, self.clip)
        if self.form:
            scene.query = dataclasses.replace(scene.query, form=self.form)
        with ProgressBars() as bars:
            result = evaluate_scene(scene, capture=self.capture, masks=self.masks, listener=bars)
        if self.json:
            print(json.dumps(result, indent=2, ensure_ascii=False))
        else:
            _print_evaluation(result, Path(self.scene))


@dataclasses.dataclass
class Export:
    """Write a scene for other programs.

    Args:
        scene: A scene folder.
        file: The file to write; ``.ply`` is the standard of 3D Gaussian Splatting.
    """

    scene: tyro.conf.Positional[str]
    file: tyro.conf.Positional[Path]

    def run(self) -> None:
        """Write the file."""
        from lexsplat.atomic import atomic_path
        from lexsplat.formats.ply import write_ply
        from lexsplat.scene_folder import SceneFolder

        if self.file.suffix.lower() != ".ply":
            raise SceneFolderError(
                self.file, expected="a name that ends in .ply", found=repr(self.file.suffix)
            )
        gaussians = SceneFolder.open(Path(self.scene)).read_gaussians()
        with atomic_path(self.file) as temporary:
            write_ply(gaussians, temporary)
        print(f"{self.file}: {len(gaussians)} Gaussians")


@dataclasses.dataclass
class Info:
    """Say what is in a scene folder.

    Args:
        scene: A scene folder.
        json: Print one JSON document on standard output.
    """

    scene: tyro.conf.Positional[str]
    json: bool = False

    def run(self) -> None:
        """Print the facts."""
        from lexsplat.answers import scene_facts
        from lexsplat.scene_folder import SceneFolder

        facts = scene_facts(SceneFolder.open(Path(self.scene)))
        if self.json:
            print(json.dumps(facts, indent=2, ensure_ascii=False))
            return
        width = max(len(name) for name in facts)
        for name, value in facts.items():
            text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else value
            print(f"{name.replace('_', ' '):<{width}}  {text}")


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Build, tyro.conf.subcommand("build")]
    | Annotated[Poses, tyro.conf.subcommand("poses")]
    | Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")]
    | Annotated[Embed, tyro.conf.subcommand("embed")]
    | Annotated[Query, tyro.conf.subcommand("query")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Info, tyro.conf.subcommand("info")]
)


def _open(path: str, device: str, clip: str | None) -> SearchableScene:
    from lexsplat.search import open_scene

    return open_scene(path, device=device, clip=clip)


def _print_evaluation(result: dict, folder: Path) -> None:
    from lexsplat.report import format_table

    print(format_table(result))
    print(f"report: {folder / 'report.html'}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] in (["--version"], ["-V"]):
        print(f"lexsplat {__version__}")
        return 0
    try:
        command = tyro.cli(
            Command,  # type: ignore[arg-type]
            prog="lexsplat",
            description="Search a place with words: photos in, 3D Gaussians that carry language out.",
            args=arguments,
        )
    except ValueError as error:  # settings check themselves when they are made
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    try:
        command.run()
    except LexsplatError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped; run the same command again to go on", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever read our output has seen enough, as in `lexsplat info SCENE | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        # A full disk or a folder without permission: the system's words and the file are the whole story.
        print(f"error: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
