"""``lexsplat query``: heatmaps, masks and scores."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from lexsplat.cli.options import (
    PRESENCE,
    Device,
    PhrasesArgument,
    SceneArgument,
    check_phrases,
    check_threshold,
    open_scene,
    print_json,
    print_rests_on,
)

if TYPE_CHECKING:
    from lexsplat.queries.relevancy import QueryConfig


@dataclasses.dataclass
class Query:
    """Show where things are: heatmaps, masks and scores for free text.

    Args:
        scene: A scene folder, or the word "demo" for the bundled scene.
        prompts: Free-text prompts, such as "red apple" "something to sit on".
        view: Names of the views to answer in.
        output: Folder for the images.
        images: Write a heatmap and a mask for each prompt and view; --no-images does not.
        features: Also write the language features of each view: features/VIEW.safetensors and their principal
            components as colors, features/VIEW.png.
        threshold: Relevancy from which a pixel belongs to the mask. The paper's is 0.5.
        form: Form of relevancy: "feature" blends features, then compares (the paper); "code" compares each code, then
            blends; "segment" takes whole segments by the scores of "code".
        negatives: Phrases that a prompt is compared with.
        temperature: Factor on cosine similarities, for --form feature and with --negatives.
        template: Sentences with {} in place of the prompt, such as "a photo of a {}".
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
        json: Print one JSON document on standard output (docs/schemas/query.json).
    """

    scene: SceneArgument
    prompts: PhrasesArgument
    view: tuple[str, ...] = ()
    output: Path | None = None
    images: bool = True
    features: bool = False
    threshold: float | None = None
    form: Literal["segment", "code", "feature"] | None = None
    negatives: tuple[str, ...] = ()
    temperature: float | None = None
    template: tuple[str, ...] = ()
    clip: str | None = None
    device: Device = "auto"
    json: bool = False

    synonyms: ClassVar[dict[str, str]] = {"--pictures": "--images", "--no-pictures": "--no-images"}
    defaults: ClassVar[dict[str, str]] = {
        "view": "up to six of the held-out views",
        "output": 'SCENE/heatmaps; demo_heatmaps for "demo"',
        "threshold": "chosen for each prompt from the scene alone",
        "form": "the form of the scene",
        "negatives": 'everyday words; "object" "things" "stuff" "texture" for --form feature',
        "temperature": "10",
        "template": "those of the scene",
    }

    def check(self) -> None:
        """Refuse invalid options."""
        check_phrases(self.prompts)
        check_threshold(self.threshold)
        if self.features and not self.images:
            raise ValueError("--features writes files: leave --no-images out")
        if any((self.form, self.negatives, self.temperature is not None, self.template)):
            from lexsplat.queries.relevancy import QueryConfig

            self._changed(QueryConfig())

    def _changed(self, config: QueryConfig) -> QueryConfig:
        """The scene's settings of relevancy, with those given on the command line."""
        changes: dict[str, Any] = {
            "form": self.form,
            "negatives": self.negatives or None,
            "temperature": self.temperature,
            "templates": self.template or None,
        }
        return dataclasses.replace(config, **{name: v for name, v in changes.items() if v is not None})

    def run(self) -> None:
        """Answer and write images."""
        scene = open_scene(self.scene, self.device, self.clip)
        from lexsplat.scenes.answers import answer_queries, default_views
        from lexsplat.scenes.feature_maps import write_features
        from lexsplat.scenes.folder import file_of
        from lexsplat.scenes.serving import shortened

        scene.query = self._changed(scene.query)
        folder = (self.output or file_of(scene.folder, "heatmaps")) if self.images else None
        answers = answer_queries(scene, self.prompts, self.view, self.threshold, folder)
        if self.features and folder is not None:
            names = [scene.view(name).name for name in self.view] or default_views(scene)
            answers["features"] = write_features(scene, names, folder)
        if self.json:
            print_json(answers)
            return
        for answer in answers["prompts"]:
            print(
                f"{shortened(answer['prompt'], 60)}: best {answer['peak']:.2f} in {answer['peak_view']}, "
                f"threshold {answer['threshold']:.2f}, {answer['gaussians']} Gaussians"
                f"{PRESENCE[answer['present']]}"
            )
            if answer["note"]:
                print(f"  note: {answer['note']}")
        print_rests_on(scene, answers["rests_on"])
        if folder:
            print(f"images in {folder}")
            if self.features:
                print(f"features, and their colors, in {folder / 'features'}")
