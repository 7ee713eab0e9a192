"""``lexsplat demo``: the whole system on a bundled capture."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar, Literal

from lexsplat.cli.options import Device, print_evaluation
from lexsplat.cli.waiting import starting
from lexsplat.language.methods import MethodName
from lexsplat.pipeline.config import BuildConfig


@dataclasses.dataclass
class Demo:
    """Build, query and evaluate a bundled capture.

    Reconstructs the scene, extracts language features with the bundled encoders, makes the language field,
    answers queries on held-out views and compares the answers with exact ground truth. Needs no network
    and no GPU. Run the same command again to continue after an interruption.

    Args:
        output: Folder for all results.
        capture: The bundled capture to take: the table top, or the second and smaller one.
        method: Method that puts language on the Gaussians (see lexsplat build --help).
        device: "auto" takes CUDA where there is a GPU.
        seed: Seed of all randomness.
        iterations: Reconstruction steps.
    """

    output: Path = Path("output/demo")
    capture: Literal["tabletop", "second"] = "tabletop"
    method: MethodName | None = None
    device: Device = "auto"
    seed: int = 0
    iterations: int | None = None

    synonyms: ClassVar[dict[str, str]] = {"--scene": "--capture"}
    defaults: ClassVar[dict[str, str]] = {"method": "averaged"}

    def check(self) -> None:
        """Refuse invalid options."""
        BuildConfig(seed=self.seed, iterations=self.iterations)

    def run(self) -> None:
        """Build, evaluate and print the table."""
        with starting():
            from lexsplat.cli.progress import ProgressBars
            from lexsplat.evaluation.demo import run_demo

        with ProgressBars() as bars:
            result = run_demo(
                self.output,
                capture=self.capture,
                method=self.method,
                device=self.device,
                seed=self.seed,
                iterations=self.iterations,
                listener=bars,
            )
        print_evaluation(result, self.output)
