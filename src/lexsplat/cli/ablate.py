"""``lexsplat ablate``: the method without its parts."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import tyro

from lexsplat.cli.captures import capture_and_settings
from lexsplat.cli.options import PromptListName, Settings, check_seeds, print_json_file
from lexsplat.language.methods import MethodName
from lexsplat.pipeline.config import BuildConfig


@dataclasses.dataclass
class Ablate:
    """Measure the method without its parts, as in the paper's Table 2, over several seeds.

    Gaussians and features are made once, codebooks once a setting and seed. Writes ablation.json, .csv, .tex and
    .html. Run it again with the same output to go on where it stopped.

    Args:
        capture: Folder with photos, cameras and masks; "demo" or "second" for the scenes that ship.
        output: Where everything goes.
        seeds: Seeds of codebook and language.
        variants: Which rows; none takes all that make a difference for the method.
        methods: Which ways to the language, beside each other; none takes that of the settings (trained).
        wrong_labels: Stress test: replace the code of this share of the pixels by a random one, others in every
            view.
        masks: Folder with ground truth: STEM/PROMPT.png, 3D-OVS masks or LERF-OVS labels; none takes what
        lies in or beside
            the capture.
        prompt_list: Ask the words of the paper's supplement or of the released code, for scenes of the paper.
        forms: How codes and text are compared, each beside the others; the paper's is "feature".
        as_in_paper: Fit and train as the paper does (30,000 steps) instead of our short settings.
        json: Print ablation.json on standard output.
        settings: What is made and how; ``--seed`` is the seed of the Gaussians.
    """

    capture: tyro.conf.Positional[str]
    output: Path
    seeds: tuple[int, ...] = (0, 1, 2)
    variants: tuple[
        Literal[
            "w/o DINO",
            "w/o L_lb",
            "w/o u_G",
            "w/o MLP",
            "w/o u_G & MLP",
            "one code",
            "full",
        ],
        ...,
    ] = ()
    methods: tuple[MethodName, ...] = ()
    wrong_labels: float = 0.0
    masks: Path | None = None
    prompt_list: PromptListName | None = None
    forms: tuple[Literal["feature", "code"], ...] = ("feature",)
    as_in_paper: bool = False
    json: bool = False
    settings: Settings = dataclasses.field(default_factory=lambda: BuildConfig(method="trained"))

    def __post_init__(self) -> None:
        check_seeds(self.seeds)
        if not self.forms:
            raise ValueError("--forms takes at least one of feature, code")
        if not 0 <= self.wrong_labels <= 1:
            raise ValueError(f"--wrong-labels must be in 0..1, got {self.wrong_labels:g}")

    def run(self) -> None:
        """Measure and print the table."""
        from lexsplat.cli.progress import ProgressBars
        from lexsplat.evaluation import ablate as ablation
        from lexsplat.evaluation.report import format_rows

        capture, settings = capture_and_settings(self.capture, self.settings)
        if self.as_in_paper:
            settings = ablation.as_in_paper(settings)
        with ProgressBars() as bars:
            rows = ablation.ablate(
                capture,
                self.output,
                settings,
                seeds=self.seeds,
                variants=self.variants,
                methods=self.methods,
                wrong_labels=self.wrong_labels,
                forms=self.forms,
                masks=self.masks,
                prompt_list=self.prompt_list,
                listener=bars,
            )
        if self.json:
            print_json_file(self.output / "ablation.json")
            return
        print(format_rows(rows, ablation.COLUMNS))
        print(f"{self.output}: ablation.json, ablation.csv, ablation.tex, ablation.html")
