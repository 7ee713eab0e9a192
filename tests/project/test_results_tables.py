"""The page of results from synthetic result files."""

import json
import sys

import pytest
import tables

MACHINE = {
    "cpu": "a chip",
    "cores": 2,
    "gpu": None,
    "platform": "Linux",
    "versions": {"python": "3.11", "torch": "2"},
}
KINDS = {"red apple": "color", "blue mug": "color", "duck": "name"}


def row(name, miou, seeds=2):
    runs = [miou + 0.02 * seed for seed in range(seeds)]
    return {
        "name": name, "runs": seeds, "psnr": [30.0] * seeds, "ssim": [0.9] * seeds, "lpips": [None] * seeds,
        "mIoU": runs, "mIoU_oracle": [0.9] * seeds, "mPA": [0.8] * seeds, "mP": [0.7] * seeds, "mAP": [0.95] * seeds,
        "localization": [1.0] * seeds, "fps": [10.0] * seeds, "query_ms": [5.0] * seeds,
        "language_seconds": [60.0] * seeds, "training_seconds": [300.0] * seeds, "storage_bytes": [2e6] * seeds,
        "host_bytes": [1.5e9] * seeds, "gpu_bytes": [None] * seeds,
    }  # fmt: skip


@pytest.fixture
def comparison(tmp_path):
    """The content of a comparison.json; its capture names the kinds of the prompts."""
    capture = tmp_path / "tabletop"
    capture.mkdir()
    (capture / "prompts.json").write_text(json.dumps(KINDS))
    scores = {"red apple": 0.8, "blue mug": 0.6, "duck": 0.4}

    def prompts(shift):
        return {
            p: {"IoU_auto": v + shift, "AP": 0.9, "localization": None, "views": 3} for p, v in scores.items()
        }

    methods = {"averaged": 0.7, "trained-feature": 0.5, "nearest": 0.9}
    return {
        "rows": [row(name, value) for name, value in methods.items()],
        "seeds": [0, 1],
        "config": {"clip": "bundled", "seed": 0, "features": {"crops": 3}, "gpu": None},
        "evaluation": {},
        "ground_truth": {
            "folder": str(capture / "segmentations"),
            "layout": "segmentations",
            "prompt_list": None,
        },
        "machine": MACHINE,
        "commit": "abc123",
        "runs": {},
        "per_prompt": {name: [prompts(0.0), prompts(0.1)] for name in methods},
    }


def result(miou):
    """The content of a metrics.json."""
    masks = {"mIoU": miou, "mPA": 0.8, "mP": 0.7}
    return {
        "quality": {"psnr": 30.0, "ssim": 0.9, "lpips": None},
        "language": {
            "method": "averaged", "strict": {"auto": masks, "fixed": masks, "oracle": masks, "mAP": 0.9},
            "per_prompt": {"duck": {"IoU_auto": miou}},
        },
        "speed": {"render_fps": 10.0, "query_ms": 5.0, "stage_seconds": {"language": 3.0}},
        "size": {"peak_rss_bytes": 10**9, "peak_gpu_bytes": None, "language_bytes": 10**6},
        "config": {"clip": "bundled"}, "machine": MACHINE, "commit": "abc123",
    }  # fmt: skip


def lines_of(text, start):
    return [line for line in text.splitlines() if line.startswith(start)]


def test_a_stored_comparison_keeps_rows_command_commit_and_machine_and_no_paths(comparison, tmp_path):
    record = tables.stored_record(comparison, "demo_compare")
    assert record["command"] == "lexsplat compare demo --output output/compare_demo"
    assert record["commit"] == "abc123"
    assert record["machine"] == MACHINE
    assert record["rows"] == comparison["rows"]
    assert record["settings"] == {"clip": "bundled", "seed": 0}
    assert record["kinds"] == KINDS
    assert record["prompts"]["averaged"]["duck"]["IoU_auto"] == pytest.approx(0.45), "mean over the seeds"
    assert str(tmp_path) not in json.dumps(record)


def test_an_unknown_command_name_or_file_is_refused(comparison):
    with pytest.raises(tables.ResultsError, match="--command"):
        tables.stored_record(comparison, "bonsai_compare")
    assert tables.stored_record(comparison, "bonsai_compare", "lexsplat compare bonsai")["command"].endswith(
        "bonsai"
    )
    with pytest.raises(tables.ResultsError, match="SCENE_compare"):
        tables.stored_record(comparison, "results")
    with pytest.raises(tables.ResultsError, match="no 'rows'"):
        tables.stored_record({"machine": {}}, "demo_ablate")


def test_the_page_has_its_sections_in_order_and_the_conditions_once(comparison):
    records = {
        "second_compare": tables.stored_record(comparison, "second_compare"),
        "demo_compare": tables.stored_record(comparison, "demo_compare"),
        "demo_ablate": tables.stored_record(
            {**comparison, "rows": [row("w/o DINO", 0.3), row("full", 0.5)]}, "demo_ablate"
        ),
        "benchmark_render": tables.stored_record(
            {"command": "python benchmarks/render.py", "commit": "abc123", "machine": MACHINE,
             "rows": [{"size": "320x240", "gaussians": 20000, "forward_ms": 12.3456}]},
            "benchmark_render",
        ),
    }  # fmt: skip
    text = tables.tables(records)
    assert [line[3:] for line in lines_of(text, "## ")] == [
        "Methods", "By kind of prompt", "Ablation (the paper's Table 2)", "Speed and memory",
    ]  # fmt: skip
    assert text.count("abc123") == 1
    assert text.count("a chip") == 1
    (head,) = lines_of(text, "|  | demo: mIoU")
    assert head.index("demo: mIoU") < head.index("second scene: mIoU"), "scenes in the order of the page"
    default = lines_of(text, "| averaged (default) |")[0]
    assert default.count("**0.710 ± 0.014**") == 2, "the best method is bold in both scenes"
    assert "**" not in lines_of(text, "| nearest (reference")[0]
    assert "| color (2) | 0.750 |" in text
    assert "| name (1) | 0.450 |" in text
    assert "| w/o DINO | 0.800" in text
    assert "| 320x240 | 20,000 | 12.35 |" in text
    columns = {
        line.count("|")
        for line in text[text.index("## Methods") : text.index("Image quality")].splitlines()[2:-1]
    }
    assert len(columns) == 1, "every row has a cell for every column"


def test_files_of_several_commits_are_refused_unless_allowed(comparison):
    records = {
        "demo_compare": tables.stored_record(comparison, "demo_compare"),
        "second_compare": tables.stored_record({**comparison, "commit": "def456"}, "second_compare"),
    }
    with pytest.raises(tables.ResultsError, match="demo_compare of abc123, second_compare of def456"):
        tables.tables(records)
    text = tables.tables(records, allow_mixed=True)
    assert "several commits" in text
    assert {"abc123", "def456"} <= set(text.split())
    with pytest.raises(tables.ResultsError, match="no result files"):
        tables.tables({})


def test_a_single_evaluation_has_its_prompts_by_kind(tmp_path):
    (tmp_path / "prompts.json").write_text(json.dumps(KINDS))
    content = result(0.6)
    content["config"]["ground_truth"] = {"folder": str(tmp_path / "segmentations")}
    record = tables.stored_record(content, "demo_evaluate")
    text = tables.tables({"demo_evaluate": record})
    assert "| demo: kind (prompts) | averaged (default) |" in text
    assert "| name (1) | 0.600 |" in text


def test_the_script_adds_files_and_writes_the_page(comparison, tmp_path, monkeypatch, capsys):
    source, results = tmp_path / "comparison.json", tmp_path / "results"
    source.write_text(json.dumps(comparison))

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["tables.py", "--results", str(results), *map(str, arguments)])
        tables.main()

    run("--add", source, "--name", "demo_compare")
    output = tmp_path / "results.md"
    with pytest.raises(SystemExit, match="expected the line"):
        run("--output", output)
    assert not output.exists()
    output.write_text(f"# Results\n\n{tables.BEGIN}\nold\n{tables.END}\n\nBy hand.\n")
    for _ in range(2):
        run("--output", output)
        text = output.read_text(encoding="utf-8")
        assert text.startswith(f"# Results\n\n{tables.BEGIN}\n")
        assert "\nold\n" not in text
        assert text.endswith(f"{tables.END}\n\nBy hand.\n")
    with pytest.raises(SystemExit):
        run("--add", source)
    assert "--name" in capsys.readouterr().err


def test_the_page_has_the_tables_of_the_stored_results_and_they_are_of_one_commit(tmp_path, monkeypatch):
    page = tmp_path / "results.md"
    page.write_bytes(tables.PAGE.read_bytes())
    monkeypatch.setattr(sys, "argv", ["tables.py", "--output", str(page)])
    tables.main()
    assert page.read_text(encoding="utf-8") == tables.PAGE.read_text(encoding="utf-8")
