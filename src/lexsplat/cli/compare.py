"""``lexsplat compare``: several methods in one table."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from lexsplat.cli.arguments import MEASURED_SETTINGS
from lexsplat.cli.captures import capture_and_settings
from lexsplat.cli.experiments import open_bench, print_table
from lexsplat.cli.options import ALL_PROTOCOLS, CaptureArgument, PromptListName, ProtocolName, check_seeds
from lexsplat.cli.settings import Settings
from lexsplat.evaluation.compare import COMPARED, ComparisonPlan
from lexsplat.pipeline.config import BuildConfig

if TYPE_CHECKING:
    ComparedName = str
else:
    ComparedName = Literal[COMPARED]


@dataclasses.dataclass
class Compare:
    """Measure several methods on the same Gaussians and the same features, in the columns of the paper's Table 1.

    The methods of lexsplat and those that the paper compares with, rebuilt after their papers (docs/evaluation.md).
    Writes comparison.json, .csv, .tex and a report into the output folder. Run the same command again to continue
    after an interruption.

    Args:
        capture: Folder with photos, cameras and ground truth, or the word "demo" or "second" for a bundled capture.
        output: Folder for all results. ``ablate`` with the same folder uses the same Gaussians and features.
        methods: Rows to measure. "-code" answers by single Gaussians, "-feature" in the paper's form.
        seeds: Seeds of codebook and language.
        ground_truth: Folder with annotations: STEM/PROMPT.png, 3D-OVS masks or LERF-OVS labels.
        prompt_list: Use the prompts of the paper's supplement or of the released code, for scenes of the paper.
        protocols: Evaluation protocols (docs/evaluation.md).
        lpips: Measure LPIPS if it is installed; --no-lpips leaves it out.
        json: Print comparison.json on standard output (docs/schemas/comparison.json).
        settings: Settings of all stages; --seed is the seed of the Gaussians.
    """

    capture: CaptureArgument
    output: Path
    methods: tuple[ComparedName, ...] = tuple(ComparisonPlan.methods)
    seeds: tuple[int, ...] = (0,)
    ground_truth: Path | None = None
    prompt_list: PromptListName | None = None
    protocols: tuple[ProtocolName, ...] = ALL_PROTOCOLS
    lpips: bool = True
    json: bool = False
    settings: Settings = dataclasses.field(default_factory=BuildConfig)

    essential: ClassVar[tuple[str, ...]] = MEASURED_SETTINGS
    rare: ClassVar[tuple[str, ...]] = ("prompt_list", "protocols", "lpips")
    synonyms: ClassVar[dict[str, str]] = {"--masks": "--ground-truth"}

    def check(self) -> None:
        """Refuse invalid options."""
        check_seeds(self.seeds)
        plan = ComparisonPlan(self.methods, self.seeds)
        if self.settings.features_from is not None:
            plan.refuse_without_crop_sizes()

    def run(self) -> None:
        """Measure and print the table."""
        from lexsplat.evaluation import EvaluationConfig
        from lexsplat.evaluation.compare import compare

        capture, settings = capture_and_settings(self.capture, self.settings)
        evaluation = EvaluationConfig(lpips=self.lpips, protocols=self.protocols)
        with open_bench(capture, settings, evaluation, self) as bench:
            rows = compare(bench, ComparisonPlan(self.methods, self.seeds))
        print_table(self, "comparison", rows)
