"""Workers that do not see a folder: it has another name while they work."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lexsplat.runtime.workers import ANY_MACHINE, InProcess, Outcome


class BlindWorkers(InProcess):
    """Tasks in this process.

    Args:
        folder: The folder that they do not see.
    """

    distributed = True

    def __init__(self, folder: Path) -> None:
        self.folder, self.tasks = folder, 0

    def see(self, folder) -> bool:
        """Every other folder is seen."""
        return not folder.path.samefile(self.folder)

    def map(self, work, shared, items, needs=ANY_MACHINE) -> Iterator[Outcome]:
        """One task after the other, each while the folder is away."""
        away = self.folder.with_name("away")
        for name in items:
            item = items[name]
            self.tasks += 1
            self.folder.rename(away)
            try:
                (outcome,) = super().map(work, shared, {name: item})
            finally:
                away.rename(self.folder)
            yield outcome
