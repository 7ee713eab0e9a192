"""Code shared by ``ablate`` and ``compare``: opening the bench, and printing the table."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from lexsplat.cli.options import PromptListName, print_json
from lexsplat.pipeline.config import BuildConfig

if TYPE_CHECKING:
    from lexsplat.evaluation import EvaluationConfig
    from lexsplat.evaluation.experiments import Bench


class Experiment(Protocol):
    """The options that both commands have."""

    output: Path
    ground_truth: Path | None
    prompt_list: PromptListName | None
    json: bool


@contextlib.contextmanager
def open_bench(
    capture: Path, settings: BuildConfig, evaluation: EvaluationConfig, command: Experiment
) -> Iterator[Bench]:
    """The bench of a command, with progress on standard error."""
    from lexsplat.cli.progress import ProgressBars
    from lexsplat.evaluation import GroundTruthSource
    from lexsplat.evaluation.experiments import Bench

    ground_truth = GroundTruthSource(command.ground_truth, command.prompt_list)
    with ProgressBars() as bars:
        yield Bench(capture, command.output, settings, evaluation, ground_truth, bars)


def print_table(
    command: Experiment, stem: str, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()
) -> None:
    """Print the table and the names of the files, or the content of ``STEM.json``."""
    from lexsplat.evaluation.report import format_rows

    if command.json:
        print_json(json.loads((command.output / f"{stem}.json").read_text(encoding="utf-8")))
        return
    print(format_rows(rows, columns))
    print(f"{command.output}: {', '.join(f'{stem}.{ending}' for ending in ('json', 'csv', 'tex', 'html'))}")
