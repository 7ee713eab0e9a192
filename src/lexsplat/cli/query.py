"""``lexsplat query``: heatmaps, masks and scores."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from lexsplat.cli.options import PRESENCE, Device, check_relevancy, open_scene, print_json
from lexsplat.queries.relevancy import QueryConfig

if TYPE_CHECKING:
    from lexsplat.scenes.scene import Scene


@dataclasses.dataclass
class Query:
    """Ask where something is: heatmaps, masks and scores for free text.

    Args:
        scene: A scene folder, or ``demo`` for the scene that ships with lexsplat.
        prompts: What to look for, such as "red apple" "something to sit on".
        view: Names of the views to answer in; none takes the held-out views.
        output: Folder for the pictures; none takes ``SCENE/heatmaps``, or ``demo_heatmaps`` here for ``demo``.
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
        check_relevancy(self.threshold)
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
        from lexsplat.scenes.answers import answer_queries

        scene = open_scene(self.scene, self.device, self.clip)
        scene.query = self._changed(scene.query)
        folder = self.output or _pictures_folder(scene)
        answers = answer_queries(scene, self.prompts, self.view, self.threshold, folder)
        if self.json:
            print_json(answers)
            return
        for answer in answers["prompts"]:
            print(
                f"{answer['prompt']}: best {answer['peak']:.2f} in {answer['best_view']}, "
                f"threshold {answer['threshold']:.2f}, {answer['gaussians']} Gaussians"
                f"{PRESENCE[answer['present']]}"
            )
        print(f"pictures in {folder}")


def _pictures_folder(scene: Scene) -> Path:
    """Where answers go unless told otherwise; the scene that ships is never written to."""
    if scene.folder is None or scene.folder.is_bundled:
        return Path("demo_heatmaps")
    return scene.folder.root / "heatmaps"
