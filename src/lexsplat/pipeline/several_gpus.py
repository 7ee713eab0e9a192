"""Reconstruct one scene on several GPUs. Untried on real GPUs.

torchrun --nproc-per-node 4 -m lexsplat.pipeline.several_gpus photos/ --output gaussians.ply
lexsplat build photos/ --splats gaussians.ply --output scene

``torchrun`` starts a module in every process, so this is no command of ``lexsplat``.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import torch
from torch import distributed

from lexsplat.captures import load_capture
from lexsplat.captures.sfm.triangulation import initial_points
from lexsplat.geometry.gaussians import TENSORS, Gaussians
from lexsplat.reconstruction.settings import ReconstructionConfig
from lexsplat.reconstruction.several_gpus import PartReconstructor
from lexsplat.runtime.errors import BackendError, LexsplatError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.scenes.formats.ply import write_ply


def reconstruct_together(source: Path, output: Path, config: ReconstructionConfig, seed: int = 0) -> None:
    """Reconstruct a capture in all processes of the group; the first one writes ``output``.

    The loop is not `lexsplat.runtime.training.run_training`, which sends a training that diverges back to its last
    good state: one process would go back alone, and all others would wait for its part of the step. So the training
    is neither saved on the way nor repeated with smaller rates.

    Args:
        source: The capture, which all processes see.
        output: The PLY file; parts are written beside it.
        config: Settings of the whole.
        seed: Seed of the whole.

    Raises:
        LexsplatError: As `PartReconstructor` and `lexsplat.captures.load_capture`.
    """
    rank, ranks = distributed.get_rank(), distributed.get_world_size()
    capture = load_capture(source)
    output.parent.mkdir(parents=True, exist_ok=True)
    cache = output.with_suffix(".points")
    if rank == 0:
        initial_points(capture, seed=seed, cache_dir=cache)
    distributed.barrier()
    trainer = PartReconstructor(
        capture, config, initial_points(capture, seed=seed, cache_dir=cache), device="cuda", seed=seed
    )
    while not trainer.done:
        trainer.step()
    parts = [output.with_suffix(f".part{number}.safetensors") for number in range(ranks)]
    write_tensors(parts[rank], trainer.gaussians().to("cpu").tensors(), {})
    distributed.barrier()
    if rank == 0:
        found = [read_tensors(part)[0] for part in parts]
        tensors = {name: torch.cat([part[name] for part in found]) for name in TENSORS}
        write_ply(Gaussians(**tensors, antialiased=config.antialiased), output)
        for part in parts:
            part.unlink()


def main() -> None:
    """Run one process of ``torchrun``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=30_000)
    parser.add_argument("--max-gaussians", type=int, help="of all processes together")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    config = ReconstructionConfig(iterations=given.iterations, max_gaussians=given.max_gaussians)
    try:
        if missing := {"RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"} - set(os.environ):
            raise BackendError(
                "several GPUs",
                expected="processes started by torchrun",
                found=f"no {min(missing)}",
                remedy="run: torchrun --nproc-per-node 4 -m lexsplat.pipeline.several_gpus CAPTURE --output FILE",
            )
        if not torch.cuda.is_available():
            remedy = "reconstruct in one process: lexsplat reconstruct CAPTURE --output SCENE"
            raise BackendError(
                "several GPUs", expected="a CUDA GPU for each process", found="none", remedy=remedy
            )
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        distributed.init_process_group("nccl")
        reconstruct_together(given.capture, given.output, config, given.seed)
    except LexsplatError as error:
        sys.exit(f"error: {error}")
    finally:
        if distributed.is_initialized():
            distributed.destroy_process_group()


if __name__ == "__main__":
    main()
