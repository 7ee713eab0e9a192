"""``lexsplat ablate``: the method without its parts."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from lexsplat.cli.arguments import MEASURED_SETTINGS
from lexsplat.cli.captures import capture_and_settings
from lexsplat.cli.experiments import open_bench, print_table
from lexsplat.cli.options import CaptureArgument, PromptListName, ProtocolName, check_seeds
from lexsplat.cli.settings import Settings
from lexsplat.language.methods import VARIANTS, MethodName
from lexsplat.pipeline.config import BuildConfig

if TYPE_CHECKING:
    from lexsplat.evaluation.ablate import AblationPlan

    VariantName = str
else:
    VariantName = Literal[VARIANTS]


@dataclasses.dataclass
class Ablate:
    """Measure the method without its parts, as in the paper's Table 2, over several seeds.

    Gaussians and features are made once, codebooks once for each setting and seed. Writes ablation.json, .csv, .tex
    and a report into the output folder. Run the same command again to continue after an interruption.

    Args:
        capture: Folder with photos, cameras and ground truth, or the word "demo" or "second" for a bundled capture.
        output: Folder for all results.
        seeds: Seeds of codebook and language.
        variants: Rows to measure.
        methods: Methods to measure side by side.
        wrong_labels: Stress test: share of the pixels whose code is replaced by a random one, drawn anew for each
            view.
        ground_truth: Folder with annotations: STEM/PROMPT.png, 3D-OVS masks or LERF-OVS labels.
        prompt_list: Use the prompts of the paper's supplement or of the released code, for scenes of the paper.
        forms: Forms of relevancy, measured side by side. The paper's form is "feature".
        protocols: Evaluation protocols (docs/evaluation.md).
        json: Print ablation.json on standard output (docs/schemas/ablation.json).
        settings: Settings of all stages; --seed is the seed of the Gaussians.
    """

    capture: CaptureArgument
    output: Path
    seeds: tuple[int, ...] = (0, 1, 2)
    variants: tuple[VariantName, ...] = ()
    methods: tuple[MethodName, ...] = ()
    wrong_labels: float = 0.0
    ground_truth: Path | None = None
    prompt_list: PromptListName | None = None
    forms: tuple[Literal["segment", "code", "feature"], ...] = ("feature",)
    protocols: tuple[ProtocolName, ...] = ("strict", "official")
    json: bool = False
    settings: Settings = dataclasses.field(default_factory=lambda: BuildConfig(method="trained"))

    essential: ClassVar[tuple[str, ...]] = MEASURED_SETTINGS
    rare: ClassVar[tuple[str, ...]] = ("wrong_labels", "prompt_list", "forms", "protocols")
    synonyms: ClassVar[dict[str, str]] = {"--masks": "--ground-truth"}
    defaults: ClassVar[dict[str, str]] = {
        "variants": "all that differ for the method",
        "methods": "the method of the settings",
    }

    def check(self) -> None:
        """Refuse invalid options."""
        check_seeds(self.seeds)
        self._plan()

    def _plan(self) -> AblationPlan:
        from lexsplat.evaluation.ablate import AblationPlan

        methods = self.methods or (self.settings.method,)
        return AblationPlan(self.seeds, self.variants, methods, self.wrong_labels, self.forms)

    def run(self) -> None:
        """Measure and print the table."""
        from lexsplat.evaluation import ablate as ablation

        capture, settings = capture_and_settings(self.capture, self.settings)
        evaluation = ablation.paper_evaluation(self.protocols)
        with open_bench(capture, settings, evaluation, self) as bench:
            rows = ablation.ablate(bench, self._plan())
        print_table(self, "ablation", rows, ablation.columns_of(evaluation))
