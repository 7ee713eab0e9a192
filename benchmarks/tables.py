"""Write docs/results.md from the result files in benchmarks/results/.

First run the measurements and add their files, all from one checkout. --add stores the rows (no images) with the
command, the commit and the machine:

    lexsplat compare demo --output output/compare_demo
    python benchmarks/tables.py --add output/compare_demo/comparison.json --name demo_compare

    lexsplat compare second --output output/compare_second
    python benchmarks/tables.py --add output/compare_second/comparison.json --name second_compare

    lexsplat compare BONSAI --output output/compare_bonsai --downscale 4
    python benchmarks/tables.py --add output/compare_bonsai/comparison.json --name bonsai_compare \\
        --command "lexsplat compare bonsai --downscale 4"

    lexsplat ablate demo --methods trained --output output/ablate_demo
    python benchmarks/tables.py --add output/ablate_demo/ablation.json --name demo_ablate

    lexsplat demo --output output/demo          # the prompts of the default method
    python benchmarks/tables.py --add output/demo/metrics.json --name demo_evaluate

    python benchmarks/render.py --json benchmarks/results/benchmark_render.json    # optional, as are the others

Then write the page:

    python benchmarks/tables.py

Names are SCENE_compare, SCENE_ablate, SCENE_evaluate and benchmark_SUBJECT. Files of different commits are refused
(--allow-mixed writes the page and states the commit of each file). The last section is docs/results_notes.md, which
is written by hand. --command states a command that differs from the one above.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from records import REPOSITORY, RESULTS, argument_parser, commit

from lexsplat.evaluation.report.numbers import number
from lexsplat.evaluation.report.tables import best_rows, heading, row_cells, table_rows
from lexsplat.runtime.files import atomic_path, read_json, write_json

PAGE = REPOSITORY / "docs" / "results.md"
NOTES = REPOSITORY / "docs" / "results_notes.md"

COMMANDS = {
    "demo_compare": "lexsplat compare demo --output output/compare_demo",
    "second_compare": "lexsplat compare second --output output/compare_second",
    "demo_ablate": "lexsplat ablate demo --methods trained --output output/ablate_demo",
    "demo_evaluate": "lexsplat demo --output output/demo",
}
"""Commands that are recorded where --command is not given."""

SCENES = {"demo": "demo", "second": "second scene", "bonsai": "bonsai"}
METHODS = {
    "averaged": "averaged (default)",
    "trained-feature": "trained (the paper)",
    "nearest": "nearest (reference, uses the evaluated photo)",
}
QUALITY = ("mIoU", "mIoU_oracle", "mAP", "localization")
ABLATION = ("mPA", "mP", "mIoU", "mAP", "mIoU_oracle", "localization")
COSTS = (
    "fps",
    "query_ms",
    "language_seconds",
    "training_seconds",
    "storage_bytes",
    "host_bytes",
    "gpu_bytes",
)
SETTINGS = ("method", "clip", "dino", "device", "downscale", "iterations", "seed", "memory")
PROMPT_SCORES = ("IoU_auto", "AP", "localization")
_KIND_NOTE = "IoU at the automatic threshold: mean over the views of a prompt, then over prompts."

Record = Mapping[str, Any]


class ResultsError(Exception):
    """Result files that do not make one page."""


# Adding files


def stored_record(content: Record, name: str, given_command: str | None = None) -> dict[str, Any]:
    """What is kept of a comparison.json, ablation.json, metrics.json or benchmark file.

    Raises:
        ResultsError: If the name or the file has another form, or the command is unknown.
    """
    kind = kind_of(name)
    shared = {
        "command": given_command or content.get("command") or COMMANDS.get(name),
        "commit": content.get("commit") or commit(),
        "machine": content.get("machine", {}),
    }
    if shared["command"] is None:
        raise ResultsError(f"{name}: the command is unknown; give it with --command")
    if kind == "benchmark":
        return {**shared, "rows": _required(content, "rows", name)}
    config = content.get("config", {})
    shared |= {
        "settings": {key: config[key] for key in SETTINGS if config.get(key) is not None},
        "kinds": _prompt_kinds(content),
    }
    if kind == "evaluate":
        language = _required(content, "language", name) or {}
        method = str(language.get("method", config.get("method", "images only")))
        prompts = _prompt_means({method: [language.get("per_prompt", {})]})
        return {**shared, "rows": table_rows({method: content}), "prompts": prompts}
    return {
        **shared,
        "seeds": content.get("seeds", []),
        "rows": _required(content, "rows", name),
        "prompts": _prompt_means(content.get("per_prompt", {})),
    }


def kind_of(name: str) -> str:
    """The kind of a result file by its name.

    Raises:
        ResultsError: If the name has another form.
    """
    found = re.fullmatch(r"(benchmark)_\w+|\w+_(compare|ablate|evaluate)", name)
    if not found:
        raise ResultsError(
            f"{name}: expected SCENE_compare, SCENE_ablate, SCENE_evaluate or benchmark_SUBJECT"
        )
    return found[1] or found[2]


def _required(content: Record, key: str, name: str) -> Any:
    if key not in content:
        raise ResultsError(
            f"{name}: the file has no {key!r}; expected the JSON of lexsplat or of a benchmark"
        )
    return content[key]


def _prompt_kinds(content: Record) -> dict[str, str]:
    """``prompts.json`` of the capture whose ground truth was used, ``{prompt: kind}``; empty without one."""
    ground_truth = content.get("ground_truth") or content.get("config", {}).get("ground_truth") or {}
    path = Path(ground_truth.get("folder", "")).parent / "prompts.json"
    return dict(read_json(path)) if ground_truth and path.is_file() else {}


def _prompt_means(
    per_prompt: Mapping[str, Sequence[Record]],
) -> dict[str, dict[str, dict[str, float | None]]]:
    """``{method: {prompt: {score: mean over the seeds}}}``."""
    return {
        name: {
            prompt: {score: _mean([run[prompt].get(score) for run in runs]) for score in PROMPT_SCORES}
            for prompt in runs[0]
        }
        for name, runs in per_prompt.items()
        if runs
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


# The page


def page(records: Mapping[str, Record], notes: str, *, allow_mixed: bool = False) -> str:
    """The Markdown page.

    Args:
        records: Stored records by name.
        notes: The section "What falls short".
        allow_mixed: Accept records of several commits.

    Raises:
        ResultsError: If there are no records or their commits differ.
    """
    if not records:
        raise ResultsError("no result files: add some with --add FILE --name NAME")
    commits = {name: str(record["commit"]) for name, record in records.items()}
    if len(set(commits.values())) > 1 and not allow_mixed:
        listed = ", ".join(f"{name} of {version}" for name, version in sorted(commits.items()))
        raise ResultsError(f"result files of several commits: {listed}; measure again, or use --allow-mixed")
    compared, ablated, evaluated, measured = (
        {_scene(name): record for name, record in _ordered(records) if kind_of(name) == kind}
        for kind in ("compare", "ablate", "evaluate", "benchmark")
    )
    kinds = list(filter(None, (_kind_table(scene, r) for scene, r in {**evaluated, **compared}.items())))
    sections = [
        _conditions(records),
        _section("Methods", [_method_table(compared)] if compared else []),
        _section("By kind of prompt", [*kinds, _KIND_NOTE] if kinds else []),
        _section("Ablation (the paper's Table 2)", [_ablation(scene, r) for scene, r in ablated.items()]),
        _section(
            "Speed and memory",
            [_costs(scene, r) for scene, r in compared.items()]
            + [_benchmark(s, r) for s, r in measured.items()],
        ),
        _section("What falls short", [notes.strip()]),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def _ordered(records: Mapping[str, Record]) -> list[tuple[str, Record]]:
    known = list(SCENES)

    def key(item: tuple[str, Record]) -> tuple[int, str]:
        scene = _scene(item[0])
        return (known.index(scene) if scene in known else len(known), item[0])

    return sorted(records.items(), key=key)


def _scene(name: str) -> str:
    return name.removeprefix("benchmark_") if kind_of(name) == "benchmark" else name.rsplit("_", 1)[0]


def _title(scene: str) -> str:
    return SCENES.get(scene, scene)


def _section(title: str, parts: Sequence[str]) -> str:
    kept = [part for part in parts if part]
    return "\n\n".join([f"## {title}", *kept]) if kept else ""


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], *, texts: int = 1) -> str:
    """A Markdown table whose first ``texts`` columns are aligned to the left."""
    lines = [list(headings), ["---"] * texts + ["---:"] * (len(headings) - texts), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _conditions(records: Mapping[str, Record]) -> str:
    """Commit, machines, and the commands with their settings."""
    mixed = len({record["commit"] for record in records.values()}) > 1
    machines = list(dict.fromkeys(_machine(record["machine"]) for record in records.values()))
    rows = []
    for name, record in _ordered(records):
        settings = ", ".join(f"{key} {value}" for key, value in record.get("settings", {}).items())
        seeds = ", ".join(map(str, record.get("seeds", []))) or "-"
        row = [name.replace("_", " "), f"`{record['command']}`", settings or "-", seeds]
        row += [str(record["commit"])] if mixed else []
        row += [str(machines.index(_machine(record["machine"])) + 1)] if len(machines) > 1 else []
        rows.append(row)
    heads = ["file", "command", "settings", "seeds", *(["commit"] if mixed else [])]
    heads += ["machine"] if len(machines) > 1 else []
    first = next(iter(records.values()))
    stated = "several commits, listed below" if mixed else f"commit `{first['commit']}`"
    where = "; ".join(f"({i}) {m}" for i, m in enumerate(machines, 1)) if len(machines) > 1 else machines[0]
    return "\n\n".join(
        [
            "# Results",
            "Generated by `python benchmarks/tables.py` from `benchmarks/results/*.json`; do not edit.",
            f"All numbers are of {stated}, measured on held-out views. Machine: {where}.",
            "mIoU, mPA and mP use the automatic threshold, which is chosen on training views only. The oracle "
            "threshold uses the ground truth and is an upper bound. ± is the standard deviation over the seeds. "
            "Definitions: [evaluation.md](evaluation.md).",
            _table(heads, rows, texts=len(heads)),
        ]
    )


def _machine(facts: Record) -> str:
    versions = facts.get("versions", {})
    known = [f"{facts.get('cpu', 'unknown CPU')}, {facts.get('cores', '?')} cores"]
    known += [str(facts["gpu"])] if facts.get("gpu") else []
    known += [", ".join(f"{name} {versions[name]}" for name in ("python", "torch") if name in versions)]
    return ", ".join(filter(None, known))


def _cells(rows: Sequence[Record], keys: Sequence[str]) -> tuple[list[str], dict[str, list[str]]]:
    """Headings, and the cells of each row by its name; the best value of a column is bold."""
    shown, texts = row_cells(rows, keys)
    best = {key: best_rows(rows, key) for key in shown}
    return [heading(key) for key in shown], {
        str(row["name"]): [f"**{t}**" if i in best[key] else t for key, t in zip(shown, line)]
        for i, (row, line) in enumerate(zip(rows, texts))
    }


def _method_table(compared: Mapping[str, Record]) -> str:
    """All methods on all scenes: one row per method, a group of columns per scene."""
    heads, columns = [""], []
    names = list(dict.fromkeys(str(row["name"]) for record in compared.values() for row in record["rows"]))
    for scene, record in compared.items():
        found, cells = _cells(record["rows"], QUALITY)
        heads += [f"{_title(scene)}: {found[0]}", *found[1:]] if found else []
        columns.append((len(found), cells))
    rows = [
        [METHODS.get(name, name), *(cell for n, cells in columns for cell in cells.get(name, ["-"] * n))]
        for name in names
    ]
    images = [
        f"{_title(scene)}: " + ", ".join(f"{head} {text}" for head, text in zip(*_first(record["rows"])))
        for scene, record in compared.items()
    ]
    note = "Image quality is that of the shared Gaussians. " + "; ".join(images) + "."
    return _table(heads, rows) + "\n\n" + note


def _first(rows: Sequence[Record]) -> tuple[list[str], list[str]]:
    first = [{key: row[key][:1] for key in ("psnr", "ssim", "lpips") if row.get(key)} for row in rows[:1]]
    shown, texts = row_cells(first, ("psnr", "ssim", "lpips"))
    return [heading(key) for key in shown], texts[0] if texts else []


def _kind_table(scene: str, record: Record) -> str:
    """Mean IoU over the prompts of each kind, one column per method; empty without kinds."""
    kinds = record.get("kinds") or {}
    names = [name for name, prompts in record.get("prompts", {}).items() if set(prompts) & set(kinds)]
    if not names:
        return ""
    rows = []
    for kind in sorted(set(kinds.values())):
        prompts = [p for p in record["prompts"][names[0]] if kinds.get(p) == kind]
        means = [_mean([record["prompts"][n].get(p, {}).get("IoU_auto") for p in prompts]) for n in names]
        if prompts:
            rows.append([f"{kind} ({len(prompts)})", *map(number, means)])
    heads = [f"{_title(scene)}: kind (prompts)", *(METHODS.get(name, name) for name in names)]
    return _table(heads, rows)


def _ablation(scene: str, record: Record) -> str:
    heads, cells = _cells(record["rows"], ABLATION)
    return _table([f"{_title(scene)}", *heads], [[name, *texts] for name, texts in cells.items()])


def _costs(scene: str, record: Record) -> str:
    heads, cells = _cells(record["rows"], COSTS)
    rows = [[METHODS.get(name, name), *texts] for name, texts in cells.items()]
    return _table([_title(scene), *heads], rows)


def _benchmark(subject: str, record: Record) -> str:
    """Rows of a benchmark as they are."""
    keys = list(dict.fromkeys(key for row in record["rows"] for key in row))
    rows = [[_text(row.get(key)) for key in keys] for row in record["rows"]]
    return f"`{record['command']}`:\n\n" + _table([key.replace("_", " ") for key in keys], rows)


def _text(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return "-" if value is None else str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


# The command


def main() -> None:
    parser = argument_parser(__doc__, json_option=False)
    parser.add_argument(
        "--add", type=Path, metavar="FILE", help="store a result file instead of writing the page"
    )
    parser.add_argument("--name", help="of the stored file, such as demo_compare")
    parser.add_argument("--command", help="the command that made FILE, if it does not record it")
    parser.add_argument(
        "--results", type=Path, default=RESULTS, metavar="FOLDER", help="folder of stored files"
    )
    parser.add_argument(
        "--notes", type=Path, default=NOTES, metavar="FILE", help='section "What falls short"'
    )
    parser.add_argument("--output", type=Path, default=PAGE, metavar="FILE", help="the page")
    parser.add_argument("--allow-mixed", action="store_true", help="accept files of several commits")
    options = parser.parse_args()
    if options.add and not options.name:
        parser.error("--add needs --name")
    try:
        if options.add:
            path = options.results / f"{options.name}.json"
            write_json(path, stored_record(read_json(options.add), options.name, options.command))
        else:
            path = options.output
            records = {file.stem: read_json(file) for file in sorted(options.results.glob("*.json"))}
            if not options.notes.is_file():
                raise ResultsError(
                    f'{options.notes}: no such file; write the section "What falls short" there'
                )
            text = page(records, options.notes.read_text(encoding="utf-8"), allow_mixed=options.allow_mixed)
            with atomic_path(path) as temporary:
                temporary.write_text(text, encoding="utf-8")
    except ResultsError as error:
        sys.exit(f"error: {error}")
    print(f"written to {path}")


if __name__ == "__main__":
    main()
