"""``lexsplat demo``: everything, on the scene that ships."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

from lexsplat.cli.options import Device, print_evaluation
from lexsplat.language.methods import MethodName
from lexsplat.pipeline.config import BuildConfig


@dataclasses.dataclass
class Demo:
    """Run the whole system on the scene that ships with lexsplat, and show what it can do.

    Reconstructs the scene, extracts language features with the bundled encoders, fits the codebook, makes the
    language field, answers queries on held-out views, and evaluates them against exact masks. Needs no network
    and no GPU. Run it again to go on where it stopped.

    Args:
        output: Folder for everything that is written.
        scene: Which bundled scene: the table top of the pictures, or the second, smaller one.
        method: How language gets into the Gaussians (see ``lexsplat build --help``).
        device: Where to compute.
        seed: Seed of all randomness.
        iterations: Reconstruction steps.
    """

    output: Path = Path("output/demo")
    scene: Literal["tabletop", "second"] = "tabletop"
    method: MethodName | None = None
    device: Device = "auto"
    seed: int = 0
    iterations: int | None = None

    def __post_init__(self) -> None:
        BuildConfig(seed=self.seed, iterations=self.iterations)

    def run(self) -> None:
        """Build, evaluate, print the table."""
        from lexsplat.cli.progress import ProgressBars
        from lexsplat.evaluation.demo import run_demo

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
        print_evaluation(result, self.output)
