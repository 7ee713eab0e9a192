"""``lexsplat compare``: several methods in one table."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar, Literal

from lexsplat.cli.arguments import ESSENTIAL_SETTINGS
from lexsplat.cli.captures import capture_and_settings
from lexsplat.cli.options import (
    ALL_PROTOCOLS,
    CaptureArgument,
    PromptListName,
    ProtocolName,
    Settings,
    check_seeds,
    print_json_file,
)
from lexsplat.pipeline.config import BuildConfig


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
        masks: Folder with ground truth: STEM/PROMPT.png, 3D-OVS masks or LERF-OVS labels.
        prompt_list: Use the prompts of the paper's supplement or of the released code, for scenes of the paper.
        protocols: How to measure (docs/evaluation.md).
        lpips: Measure LPIPS if it is installed; --no-lpips leaves it out.
        json: Print comparison.json on standard output.
        settings: Settings of all stages; --seed is the seed of the Gaussians.
    """

    capture: CaptureArgument
    output: Path
    methods: tuple[
        Literal[
            "averaged", "averaged-code", "averaged-feature", "trained", "trained-code", "trained-feature", "dff", "lerf", "3dovs", "nearest",
        ],
        ...,
    ] = ("averaged", "averaged-code", "trained-feature", "dff", "lerf", "3dovs", "nearest")  # fmt: skip
    seeds: tuple[int, ...] = (0,)
    masks: Path | None = None
    prompt_list: PromptListName | None = None
    protocols: tuple[ProtocolName, ...] = ALL_PROTOCOLS
    lpips: bool = True
    json: bool = False
    settings: Settings = dataclasses.field(default_factory=BuildConfig)

    essential: ClassVar[tuple[str, ...]] = ESSENTIAL_SETTINGS
    defaults: ClassVar[dict[str, str]] = {
        "masks": "the ground truth in the capture or beside it",
        "prompt_list": "the prompts of the ground truth",
    }

    def check(self) -> None:
        """Refuse invalid options."""
        check_seeds(self.seeds)

    def run(self) -> None:
        """Measure and print the table."""
        from lexsplat.cli.progress import ProgressBars
        from lexsplat.evaluation import EvaluationConfig, GroundTruthSource
        from lexsplat.evaluation.compare import ComparisonPlan, compare
        from lexsplat.evaluation.report import format_rows

        capture, settings = capture_and_settings(self.capture, self.settings)
        with ProgressBars() as bars:
            rows = compare(
                capture,
                self.output,
                settings,
                ComparisonPlan(self.methods, self.seeds),
                evaluation=EvaluationConfig(lpips=self.lpips, protocols=self.protocols),
                ground_truth=GroundTruthSource(self.masks, self.prompt_list),
                listener=bars,
            )
        if self.json:
            print_json_file(self.output / "comparison.json")
            return
        print(format_rows(rows))
        print(f"{self.output}: comparison.json, comparison.csv, comparison.tex, comparison.html")
