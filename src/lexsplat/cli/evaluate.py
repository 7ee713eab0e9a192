"""``lexsplat evaluate``: a scene against its held-out views."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar, Literal

from lexsplat.cli.options import (
    ALL_PROTOCOLS,
    Device,
    PromptListName,
    ProtocolName,
    SceneArgument,
    open_scene,
    print_evaluation,
    print_json,
)
from lexsplat.cli.waiting import starting


@dataclasses.dataclass
class Evaluate:
    """Measure a scene on its held-out views: image quality, and language where there is ground truth.

    Writes metrics.json, metrics.csv, metrics.tex, report.html and heatmaps/ into the scene folder.

    Args:
        scene: A scene folder.
        ground_truth: Folder with annotations: STEM/PROMPT.png, 3D-OVS masks or LERF-OVS labels.
        prompt_list: Use the prompts of the paper's supplement or of the released code, for scenes of the paper.
        protocols: Evaluation protocols (docs/evaluation.md).
        capture: Folder of the photos.
        form: Form of relevancy (see lexsplat query --help).
        clip: Text encoder: a name on the Hugging Face Hub or a folder.
        device: "auto" takes CUDA where there is a GPU.
        json: Print metrics.json on standard output (docs/schemas/metrics.json).
    """

    scene: SceneArgument
    ground_truth: Path | None = None
    prompt_list: PromptListName | None = None
    protocols: tuple[ProtocolName, ...] = ALL_PROTOCOLS
    capture: Path | None = None
    form: Literal["segment", "code", "feature"] | None = None
    clip: str | None = None
    device: Device = "auto"
    json: bool = False

    synonyms: ClassVar[dict[str, str]] = {"--masks": "--ground-truth"}
    defaults: ClassVar[dict[str, str]] = {
        "capture": "where the build found it",
        "form": "the form of the scene",
    }

    def run(self) -> None:
        """Evaluate and print the table."""
        with starting():
            from lexsplat.cli.progress import ProgressBars
            from lexsplat.evaluation.scenes import evaluate_scene

        scene = open_scene(self.scene, self.device, self.clip)
        if self.form:
            scene.query = dataclasses.replace(scene.query, form=self.form)
        with ProgressBars() as bars:
            result = evaluate_scene(
                scene,
                capture=self.capture,
                masks=self.ground_truth,
                prompt_list=self.prompt_list,
                protocols=self.protocols,
                listener=bars,
            )
        if self.json:
            print_json(result)
        else:
            print_evaluation(result, Path(self.scene))
