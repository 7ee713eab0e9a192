"""``lexsplat compare``: several methods in one table."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import tyro

from lexsplat.cli.captures import capture_and_settings
from lexsplat.cli.options import (
    ALL_PROTOCOLS,
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

    Ours, and what the paper compares with, rebuilt from the ideas of their papers (docs/evaluation.md says how).
    Writes comparison.json, .csv, .tex and .html. Run it again with the same output to go on where it stopped.

    Args:
        capture: Folder with photos, cameras and masks; "demo" or "second" for the scenes that ship.
        output: Where everything goes; that of ``ablate`` shares its Gaussians and features.
        methods: Which rows. "-feature" is the paper's form of relevancy in place of our default.
        seeds: Seeds of codebook and language.
        masks: Folder with ground truth: STEM/PROMPT.png, 3D-OVS masks or LERF-OVS labels; none takes what
        lies in or beside
            the capture.
        prompt_list: Ask the words of the paper's supplement or of the released code, for scenes of the paper.
        protocols: How to measure (docs/evaluation.md).
        lpips: Measure LPIPS if it is installed.
        json: Print comparison.json on standard output.
        settings: What is made and how; ``--seed`` is the seed of the Gaussians.
    """

    capture: tyro.conf.Positional[str]
    output: Path
    methods: tuple[
        Literal[
            "averaged", "averaged-feature", "trained", "trained-feature", "dff", "lerf", "3dovs", "nearest",
        ],
        ...,
    ] = ("averaged", "trained-feature", "dff", "lerf", "3dovs", "nearest")  # fmt: skip
    seeds: tuple[int, ...] = (0,)
    masks: Path | None = None
    prompt_list: PromptListName | None = None
    protocols: tuple[ProtocolName, ...] = ALL_PROTOCOLS
    lpips: bool = True
    json: bool = False
    settings: Settings = dataclasses.field(default_factory=BuildConfig)

    def __post_init__(self) -> None:
        check_seeds(self.seeds)

    def run(self) -> None:
        """Measure and print the table."""
        from lexsplat.cli.progress import ProgressBars
        from lexsplat.evaluation.compare import compare
        from lexsplat.evaluation.report import format_rows

        capture, settings = capture_and_settings(self.capture, self.settings)
        with ProgressBars() as bars:
            rows = compare(
                capture,
                self.output,
                settings,
                methods=self.methods,
                seeds=self.seeds,
                lpips=self.lpips,
                masks=self.masks,
                prompt_list=self.prompt_list,
                protocols=self.protocols,
                listener=bars,
            )
        if self.json:
            print_json_file(self.output / "comparison.json")
            return
        print(format_rows(rows))
        print(f"{self.output}: comparison.json, comparison.csv, comparison.tex, comparison.html")
