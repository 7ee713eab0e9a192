"""Readers of codebooks and of the checkpoints of language training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from support.hostile import mutations as mutate
from support.hostile.registry import Reader, finite, reader
from support.hostile.splats import small_gaussians


def small_field(trained: bool) -> Any:
    import torch

    from lexsplat.codebook import Codebook
    from lexsplat.language.fields import CodeField, TrainedField

    generator = torch.Generator().manual_seed(0)
    clip, dino = torch.randn(3, 6, generator=generator), torch.randn(3, 4, generator=generator)
    codebook = Codebook(
        torch.nn.functional.normalize(clip, dim=1), torch.nn.functional.normalize(dino, dim=1)
    )
    if trained:
        return TrainedField.initial(small_gaussians(), codebook, generator=generator)
    codes = torch.tensor([[0, 1], [1, 2], [2, 0], [0, 2]], dtype=torch.uint8)
    return CodeField(codebook, codes, torch.full((4, 2), 0.5), torch.linspace(0, 1, 4))


@reader
def codebook() -> Reader:
    from lexsplat.codebook import Codebook
    from lexsplat.runtime.files import read_tensors, write_tensors

    def check(book: Any) -> None:
        finite(book.clip, book.lambda_dino)
        assert book.clip.is_floating_point()

    return Reader(
        lambda folder: write_tensors(folder / "c", small_field(False).codebook.tensors(), {}),
        lambda folder: Codebook.from_tensors(read_tensors(folder / "c")[0]), check,
        {"c": lambda content, rng: [*mutate.safetensors(content, rng, 60, 150), *mutate.tensors(content, rng, 80)]},
        exact=("c",), value_errors=True,
    )  # fmt: skip


@reader
def checkpoints() -> Reader:
    """A damaged checkpoint is reported and ignored; the training then starts from the beginning."""
    from lexsplat.language.methods.trained_settings import TrainedConfig
    from lexsplat.language.methods.trainer import FieldTrainer
    from lexsplat.runtime.training import Checkpoint
    from support.language_scene import make_scene

    scene = make_scene(per_ball=2, views=1, width=8, height=6)
    config = TrainedConfig(iterations=10, pixel_sample=8, smoothing_sample=4)

    def trainer() -> Any:
        return FieldTrainer(scene.gaussians, scene.codebook, config)

    def make(folder: Path) -> None:
        made = trainer()
        made.step(scene.cameras["view0"], scene.code_maps["view0"])
        Checkpoint(folder / "state", "inputs").save(made)

    fresh = trainer().state_dict()

    unused = []

    def read(folder: Path) -> tuple[bool, dict]:
        made = unused.pop() if unused else trainer()
        resumed = Checkpoint(folder / "state", "inputs").resume(made)
        if not resumed:
            unused.append(made)  # which is as it was, as `check` confirms
        return resumed, made.state_dict()

    def check(result: tuple[bool, dict]) -> None:
        import torch

        resumed, state = result
        assert {name: tuple(t.shape) for name, t in state.items() if name in fresh} == {
            name: tuple(t.shape) for name, t in fresh.items()
        }
        if resumed:
            finite(*(tensor for name, tensor in state.items() if name != "first_loss"))
            assert 0 <= int(state["iteration"]) <= 10
        else:
            assert state.keys() == fresh.keys()
            same = all(torch.equal(state[name].nan_to_num(), fresh[name].nan_to_num()) for name in fresh)
            assert same, "a partial state was loaded"

    return Reader(
        make, read, check,
        {"state": lambda c, rng: [*mutate.safetensors(c, rng, 20, 40), *mutate.tensors(c, rng, 50)]},
    )  # fmt: skip
