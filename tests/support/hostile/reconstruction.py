"""Reader of the checkpoints of a reconstruction."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from support.hostile import mutations as mutate
from support.hostile.registry import Reader, finite, reader


@reader
def reconstruction_checkpoints() -> Reader:
    """A damaged checkpoint is reported and ignored; the training then starts from the beginning."""
    from lexsplat.captures import load_capture
    from lexsplat.captures.sfm.triangulation import InitialPoints
    from lexsplat.reconstruction import ReconstructionConfig, Reconstructor
    from lexsplat.runtime.training import Checkpoint
    from support.tiny_capture import write_capture

    config = ReconstructionConfig(iterations=10, max_gaussians=5, sh_degree=1, exposure=True)
    points = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    kept: dict[str, Any] = {}

    def trainer(folder: Path) -> Any:
        if "capture" not in kept:
            kept["capture"] = load_capture(write_capture(folder / "capture", views=3, width=16, height=12))
        start = InitialPoints(points, np.full_like(points, 0.5), "capture", "")
        return Reconstructor(kept["capture"], config, start)

    def make(folder: Path) -> None:
        made = trainer(folder)
        made.step()
        Checkpoint(folder / "state", "inputs").save(made)
        kept["fresh"] = trainer(folder).state_dict()

    unused = []

    def read(folder: Path) -> tuple[bool, dict]:
        made = unused.pop() if unused else trainer(folder)
        resumed = Checkpoint(folder / "state", "inputs").resume(made)
        if not resumed:
            unused.append(made)  # which is as it was, as `check` confirms
        return resumed, made.state_dict()

    def check(result: tuple[bool, dict]) -> None:
        import torch

        resumed, state = result
        if resumed:
            finite(*(t for name, t in state.items() if "parameters" in name or "matrices" in name))
            assert len({len(t) for name, t in state.items() if name.startswith("parameters/")}) == 1
            assert 0 <= int(state["steps_done"]) <= 10
        else:
            same = all(
                torch.equal(state[n].nan_to_num(), kept["fresh"][n].nan_to_num()) for n in kept["fresh"]
            )
            assert state.keys() == kept["fresh"].keys()
            assert same, "a partial state was loaded"

    return Reader(
        make, read, check,
        {"state": lambda c, rng: [*mutate.safetensors(c, rng, 20, 50), *mutate.tensors(c, rng, 50)]},
    )  # fmt: skip
