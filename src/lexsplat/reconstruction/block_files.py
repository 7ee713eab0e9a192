"""The state of a reconstruction by blocks, on disk: the Gaussians of each cell with their moments and statistics.

A visit trains the views of one block, or of two, for some steps. Its file has the cells that it trained, complete and
as they were after it. The present state of a cell is in the file of the last visit that trained it. All visits are
planned before the first, so a run that was killed knows from the files alone where to go on.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lexsplat.geometry.gaussians import Gaussians
from lexsplat.reconstruction.blocks import Block, Blocks, side_by_side
from lexsplat.runtime.errors import FileFormatError
from lexsplat.runtime.files import read_json, write_json, write_tensors
from lexsplat.runtime.workers import SharedFolder

MOMENTS = ("exp_avg", "exp_avg_sq")
STATISTICS = ("grad2d", "count")
EXPOSURES = "exposures/"
BETAS = (0.3, 0.999)
"""Decays of Adam's moments. In one piece a Gaussian is seen every few steps, between which the first moment moves it
on; in a visit most steps show it, and a decay of 0.9 would carry it too far."""


@dataclass
class CellState:
    """The Gaussians of cells, with what their training needs.

    Args:
        parameters: The tensors of `Gaussians` by name.
        moments: Adam's two moments of each of them, as "exp_avg/means".
        statistics: Those of density control ``[N]``, by name.
    """

    parameters: dict[str, Tensor]
    moments: dict[str, Tensor]
    statistics: dict[str, Tensor]

    def __len__(self) -> int:
        return len(self.parameters["means"])

    @classmethod
    def untrained(cls, gaussians: Gaussians) -> CellState:
        """The state before the first step."""
        parameters = gaussians.tensors()
        moments = {f"{m}/{name}": torch.zeros_like(t) for m in MOMENTS for name, t in parameters.items()}
        count = torch.zeros(len(gaussians))
        return cls(parameters, moments, {name: count.clone() for name in STATISTICS})

    @classmethod
    def joined(cls, states: Iterable[CellState]) -> CellState:
        """The Gaussians of several states, one after the other."""
        tensors = [state.tensors() for state in states]
        return cls.of_tensors({name: torch.cat([each[name] for each in tensors]) for name in tensors[0]})

    @classmethod
    def of_tensors(cls, tensors: dict[str, Tensor]) -> CellState:
        """The inverse of `tensors`."""
        parts: dict[str, dict[str, Tensor]] = {"parameters": {}, "moments": {}, "statistics": {}}
        for name, tensor in tensors.items():
            part, _, rest = name.partition("/")
            parts[part][rest] = tensor
        return cls(**parts)

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name; the first dimension of each is that of the Gaussians."""
        named = (("parameters", self.parameters), ("moments", self.moments), ("statistics", self.statistics))
        return {f"{part}/{name}": tensor for part, of in named for name, tensor in of.items()}

    def select(self, chosen: Tensor) -> CellState:
        """Copies of the chosen Gaussians, by index or by mask."""
        return self.of_tensors({name: tensor[chosen] for name, tensor in self.tensors().items()})


@dataclass(frozen=True)
class Visit:
    """A part of the training: some steps on the views of one block, or of two.

    Args:
        number: Index among all visits.
        round: Round of density control that begins with it.
        block: The block, or the two as one.
        parts: Of each of them: the block, the number of steps on its views before this visit, and in it.
        start: Number of steps of the whole training before it.
        end: The same after it.
        round_steps: Number of steps of a round.
    """

    number: int
    round: int
    block: Block
    parts: tuple[tuple[Block, int, int], ...]
    start: int
    end: int
    round_steps: int

    def views(self, seed: int) -> list[str]:
        """Names of the views of its steps.

        Each block goes through random permutations of its views, over all its visits; the views of two are mixed.
        """
        names = []
        for block, first, steps in self.parts:
            for turn, place in (divmod(step, len(block.views)) for step in range(first, first + steps)):
                order = np.random.default_rng([seed, block.number, turn]).permutation(len(block.views))
                names.append(block.views[int(order[place])])
        if len(self.parts) > 1:
            np.random.default_rng([seed, self.number]).shuffle(names)
        return names


def plan(blocks: Blocks, iterations: int, rounds: int, *, pairs: bool = True) -> list[list[Visit]]:
    """The visits of the whole training, in groups that can run side by side.

    Args:
        blocks: The blocks.
        iterations: Number of steps of the whole training.
        rounds: Number of visits to each block.
        pairs: Visit two blocks together where they share cells.
    """
    views, count = sum(len(block.views) for block in blocks.blocks), len(blocks.blocks)
    groups, step, number, done = [], 0, 0, [0] * count
    # Rounding is done on the blocks in order, so that the visits add up to the iterations.
    before = [sum(len(b.views) for b in blocks.blocks[:n]) / views for n in range(count + 1)]
    for index in range(rounds):
        ends = [round((index + 1) * iterations / rounds * share) for share in before]
        sets = blocks.pairs(index) if pairs else [(n,) for n in range(count)]
        joined = [blocks.joined(numbers) for numbers in sets]
        for indices in side_by_side(joined):
            group = []
            for place in indices:
                parts = tuple(
                    (blocks.blocks[n], done[n], ends[n + 1] - ends[n] - done[n]) for n in sets[place]
                )
                for block, first, steps in parts:
                    done[block.number] = first + steps
                end = step + sum(steps for _, _, steps in parts)
                group.append(Visit(number, index, joined[place], parts, step, end, iterations // rounds))
                step, number = end, number + 1
            groups.append(group)
    return groups


class CellFiles:
    """The files of the visits, in a folder that all workers see.

    Args:
        folder: The folder.
        key: Fingerprint of everything that the result depends on; part of the names.
        blocks: Cells and blocks.
        groups: From `plan`.
    """

    def __init__(self, folder: Path, key: str, blocks: Blocks, groups: list[list[Visit]]) -> None:
        self._folder, self._key, self._count = folder, key, len(blocks.cells)
        self._blocks, self._groups = blocks, groups

    def path(self, visit: int) -> Path:
        """File of a visit; -1 is the state before the first."""
        return self._folder / f"{self._key}-{visit + 1:05}.safetensors"

    def at(self, folder: Path) -> CellFiles:
        """The same files in another folder."""
        return CellFiles(folder, self._key, self._blocks, self._groups)

    def needed(self, visit: Visit, groups: int) -> set[str]:
        """Names of the files that a visit reads.

        Args:
            visit: The visit.
            groups: Number of finished groups of visits.
        """
        latest, block = self.latest(groups), visit.block
        read = [str(cell) for cell in (*block.trained, *block.shown)]
        read += [name for name in [f"{EXPOSURES}{block.number}"] if name in latest]
        return {self.path(latest[name][0]).name for name in read}

    @property
    def photos(self) -> Path:
        """Folder of the reduced photos."""
        return self._folder / f"{self._key}-photos"

    def latest(self, groups: int) -> dict[str, tuple[int, int]]:
        """Visit that wrote the present state of each cell and of the exposures of each block, and its last step.

        Args:
            groups: Number of finished groups of visits.
        """
        found = {str(cell): (-1, 0) for cell in range(self._count)}
        for group in self._groups[:groups]:
            for visit in group:
                for cell in visit.block.trained:
                    found[str(cell)] = visit.number, visit.end
                found[f"{EXPOSURES}{visit.block.number}"] = visit.number, visit.end
        return found

    def finished(self) -> int:
        """Number of groups that earlier runs have finished and whose state is complete; -1 without any state."""
        for groups in range(len(self._groups), -1, -1):
            if all(self.path(visit).exists() for visit, _ in self.latest(groups).values()):
                return groups
        return -1

    def remove_old(self, groups: int) -> None:
        """Delete the files that no state after ``groups`` groups needs."""
        needed = {self.path(visit) for visit, _ in self.latest(groups).values()}
        for path in self._folder.glob(f"{self._key}-*.safetensors"):
            if path not in needed:
                path.unlink()

    def write(self, visit: int, cells: dict[int, CellState], others: dict[str, Tensor] | None = None) -> None:
        """Write the file of a visit."""
        tensors = {f"{c}/{name}": t for c, state in cells.items() for name, t in state.tensors().items()}
        write_tensors(self.path(visit), {**tensors, **(others or {})}, {})

    def write_start(self, gaussians: Gaussians, cells: NDArray[np.int64]) -> None:
        """Write the state before the first visit: no moments and statistics yet, which would be zeros.

        Args:
            gaussians: Those of the whole.
            cells: The cell of each ``[N]``.
        """
        tensors = {
            f"{cell}/parameters/{name}": tensor[torch.from_numpy(cells == cell)]
            for name, tensor in gaussians.tensors().items()
            for cell in range(self._count)
        }
        write_tensors(self.path(-1), tensors, {})

    def read(self, visit: int, prefix: str) -> dict[str, Tensor]:
        """The tensors of a visit's file whose names start with ``prefix``, without it.

        Raises:
            FileFormatError: If the file is missing or damaged.
        """
        from safetensors import SafetensorError, safe_open

        path = self.path(visit)
        try:
            with safe_open(path, framework="pt") as file:
                names = [name for name in file.keys() if name.startswith(prefix)]  # noqa: SIM118
                return {name.removeprefix(prefix): file.get_tensor(name).clone() for name in names}
        except (OSError, SafetensorError, ValueError, RuntimeError, OverflowError) as error:
            raise FileFormatError(
                path,
                expected="the Gaussians of a block, in a folder that every worker sees",
                found=str(error)[:200],
                remedy=f"delete {path.parent} and run again",
            ) from error

    def cell(self, visit: int, cell: int) -> CellState:
        """The state of a cell after a visit."""
        if visit < 0:
            return CellState.untrained(self.gaussians(visit, cell, antialiased=False))
        return CellState.of_tensors(self.read(visit, f"{cell}/"))

    def all_statistics(self, groups: int) -> list[tuple[Tensor, Tensor]]:
        """Sums of gradients and numbers of views ``[N]`` of each cell, after ``groups`` groups of visits."""
        found, latest = [], self.latest(groups)
        for cell in range(self._count):
            visit = latest[str(cell)][0]
            each = self.cell(visit, cell).statistics if visit < 0 else self.read(visit, f"{cell}/statistics/")
            found.append((each["grad2d"], each["count"]))
        return found

    def room(self, number: int) -> tuple[int, ...] | None:
        """The numbers that `write_room` wrote for a round; None if it wrote none."""
        path = self._room_path(number)
        return tuple(read_json(path)["gaussians"]) if path.exists() else None

    def write_room(self, number: int, room: tuple[int, ...]) -> None:
        """Keep the numbers of Gaussians that a round may add to the cells."""
        write_json(self._room_path(number), {"gaussians": list(room)})

    def _room_path(self, number: int) -> Path:
        return self._folder / f"{self._key}-round-{number:04}.json"

    def gaussians(self, visit: int, cell: int, antialiased: bool) -> Gaussians:
        """The Gaussians of a cell after a visit."""
        return Gaussians(**self.read(visit, f"{cell}/parameters/"), antialiased=antialiased)


@dataclass(frozen=True)
class VisitsOfGroup(Mapping[str, tuple[Visit, Mapping[str, bytes] | None]]):
    """The visits of a group, each with the files that it reads, loaded when it begins.

    Args:
        visits: The visits by name.
        files: The files.
        groups: Number of groups of visits before this one.
        folder: The folder, if workers do not see it; None sends no files.
    """

    visits: Mapping[str, Visit]
    files: CellFiles
    groups: int
    folder: SharedFolder | None

    def __getitem__(self, name: str) -> tuple[Visit, Mapping[str, bytes] | None]:
        visit = self.visits[name]
        if self.folder is None:
            return visit, None
        return visit, self.folder.read(self.files.needed(visit, self.groups))

    def __iter__(self) -> Iterator[str]:
        return iter(self.visits)

    def __len__(self) -> int:
        return len(self.visits)


def idle(state: CellState, name: str, rate: float, steps: int, at: int) -> None:
    """Give a parameter that no step has loaded the updates that Adam would have made without gradients, in place.

    The moments decay, and the first one moves the parameter on. With constant decays this is a geometric series;
    the corrections of the bias are those of its middle.

    Args:
        state: The Gaussians.
        name: Name of the parameter.
        rate: Its learning rate.
        steps: Number of steps in which it was not loaded.
        at: Steps of its optimizer before these.
    """
    if steps == 0 or at == 0:
        return
    first, second = BETAS
    ratio = first / math.sqrt(second)
    series = ratio * (1 - ratio**steps) / (1 - ratio)
    middle = at + min(steps, round(1 / (1 - ratio)))
    bias = math.sqrt(1 - second**middle) / (1 - first**middle)
    mean, square = (state.moments[f"{moment}/{name}"] for moment in MOMENTS)
    state.parameters[name].sub_(rate * series * bias * mean / (square.sqrt() + 1e-15))
    mean.mul_(first**steps)
    square.mul_(second**steps)
