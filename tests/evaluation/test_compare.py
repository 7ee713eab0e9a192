"""All methods in one table on a tiny capture, with encoders that know colors only."""

import csv
import json
import re
import shutil
import time
from dataclasses import replace

import pytest
from support import color_encoder
from support.experiments import CONFIG
from support.experiments import compared as measure_methods
from support.report_pages import Page
from support.schemas import validated

from lexsplat.cli.captures import capture_and_settings
from lexsplat.evaluation import EvaluationConfig
from lexsplat.evaluation.baselines import BASELINES, Dff, DffConfig, Ovs3d, Ovs3dConfig, feature_rendering
from lexsplat.evaluation.compare import ComparisonPlan
from lexsplat.runtime.memory import parse_bytes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def compared(tiny_capture, tmp_path_factory):
    """The folder of a comparison of all kinds of methods."""
    folder = tmp_path_factory.mktemp("comparison")
    with pytest.MonkeyPatch.context() as patch:
        color_encoder.install(patch)
        patch.setitem(BASELINES, "dff", Dff(DffConfig(steps=3)))
        patch.setitem(BASELINES, "3dovs", Ovs3d(Ovs3dConfig(steps=3, pairs=16)))
        methods = ("averaged", "averaged-feature", *BASELINES)
        settings = {"plan": ComparisonPlan(methods=methods), "evaluation": EvaluationConfig(lpips=False)}
        measure_methods(tiny_capture, folder, CONFIG, **settings)
        start = time.perf_counter()
        measure_methods(tiny_capture, folder, CONFIG, **settings)
        again = time.perf_counter() - start
    return folder, again


def rows_of(folder):
    with (folder / "comparison.csv").open(newline="", encoding="utf-8") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def test_every_method_has_a_row_with_the_columns_of_the_papers_table(compared):
    folder, _ = compared
    rows = rows_of(folder)
    assert list(rows) == ["averaged", "averaged-feature", "dff", "lerf", "3dovs", "nearest"]
    columns = (
        "psnr",
        "ssim",
        "mPA",
        "mP",
        "mIoU",
        "mAP",
        "fps",
        "host_bytes",
        "storage_bytes",
        "training_seconds",
    )
    for name, row in rows.items():
        assert all(float(row[column]) >= 0 for column in columns), name
        assert float(row["mAP"]) > 0.2, f"{name} finds the colors"
    heading = (folder / "comparison.tex").read_text().splitlines()[3]
    for name in ("PSNR", "SSIM", "mPA", "mP", "mIoU", "mAP", "FPS", "host memory", "storage", "training"):
        assert name in heading


def test_all_have_the_same_images_and_only_nearest_has_no_3d(compared):
    rows = rows_of(compared[0])
    assert len({row["psnr"] for row in rows.values()}) == 1
    assert {name for name, row in rows.items() if not row["lerf_3d_mIoU"]} == {"nearest"}


def test_storage_is_that_of_each_baseline(compared):
    rows = rows_of(compared[0])
    assert float(rows["lerf"]["storage_bytes"]) > float(rows["dff"]["storage_bytes"])


def test_the_recorded_forms_are_those_that_answer(compared):
    folder, _ = compared
    forms = json.loads((folder / "comparison.json").read_text())["forms"]
    assert forms.pop("averaged") == "segment"
    assert forms == dict.fromkeys(("averaged-feature", *BASELINES), "feature")
    stages = json.loads((folder / "runs" / "dff" / "seed-0.json").read_text())["metrics"]["speed"][
        "stage_seconds"
    ]
    assert set(stages) == {"reconstruct", "features", "dff"}


def test_the_report_shows_every_method_and_loads_nothing(compared):
    folder, _ = compared
    text = (folder / "comparison.html").read_text(encoding="utf-8")
    page = Page(text)
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert not re.search(r"https?:|@import|srcset", text)
    record = json.loads((folder / "comparison.json").read_text())
    validated("comparison", record)
    names = [row["name"] for row in record["rows"]]
    rows = [row for row in page.rows if row]
    table = {row[0]: row for row in rows[1 : 1 + len(names)]}
    assert list(table) == names
    column = rows[0].index("mIoU")
    for row in record["rows"]:
        assert table[row["name"]][column] == f"{row['mIoU'][0]:.3f}"
    cases = re.findall(r'<div class="versus">.*?(?=<div class="versus">|</section>)', text, re.S)
    prompts = record["per_prompt"]["dff"][0]
    assert len(cases) == sum(row["views"] for row in prompts.values())
    for case in cases:
        assert case.count('class="answer"') == len(names), "one column for each method"
        assert case.count("<img") == 1 + 2 * len(names), "ground truth once; heatmap and mask of each method"
    means = [sum(map(float, re.findall(r"IoU ([0-9.]+)", case))) for case in cases]
    assert means == sorted(means), "worst first"
    assert text.count("<polyline") == len(names) * (1 + len(prompts))
    assert record["seeds"] == [0]
    assert {"seeds", "cpu", "versions"} <= {row[0] for row in rows}


def test_unknown_methods_are_refused_before_any_work(tiny_capture, tmp_path):
    with pytest.raises(ValueError, match="nerf"):
        measure_methods(tiny_capture, tmp_path / "a", CONFIG, ComparisonPlan(methods=("nerf",)))
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("plan", [{"seeds": (0, 1, 0)}, {"methods": ("averaged", "averaged")}])
def test_what_is_given_twice_is_refused_because_its_spread_would_be_none(plan):
    with pytest.raises(ValueError, match=r"given once each; got (0|averaged) more than once"):
        ComparisonPlan(**plan)


def test_other_protocols_are_measured_again(compared, tiny_capture, tmp_path, monkeypatch):
    color_encoder.install(monkeypatch)
    folder, _ = compared
    for part in ("scene", "runs"):
        shutil.copytree(folder / part, tmp_path / part)
    before = rows_of(folder)["averaged"]
    measure_methods(
        tiny_capture,
        tmp_path,
        CONFIG,
        ComparisonPlan(methods=("averaged",)),
        evaluation=EvaluationConfig(lpips=False, protocols=("lerf-2d",)),
    )
    (row,) = rows_of(tmp_path).values()
    language = json.loads((tmp_path / "runs" / "averaged" / "seed-0.json").read_text())["metrics"]["language"]
    assert "lerf_2d" in language
    assert not {"official", "lerf_3d"} & set(language)
    assert row["mIoU"] == before["mIoU"], "strict is always measured, with the same result"
    with pytest.raises(ValueError, match="lerf-4d"):
        measure_methods(
            tiny_capture, tmp_path / "a", CONFIG, evaluation=EvaluationConfig(protocols=("lerf-4d",))
        )
    assert not (tmp_path / "a").exists()


def test_baselines_receive_a_quarter_of_the_memory(compared, tiny_capture, tmp_path, monkeypatch):
    shutil.copytree(compared[0] / "scene", tmp_path / "scene")
    color_encoder.install(monkeypatch)
    monkeypatch.setitem(BASELINES, "dff", Dff(DffConfig(steps=0)))
    monkeypatch.setitem(BASELINES, "3dovs", Ovs3d(Ovs3dConfig(steps=0)))
    granted, original = [], feature_rendering.TrainingViews.__init__

    def keep(*args, **wishes):
        original(*args, **wishes)
        granted.append(args[0]._limit)

    monkeypatch.setattr(feature_rendering.TrainingViews, "__init__", keep)
    config = replace(CONFIG, memory="800MB")
    measure_methods(
        tiny_capture,
        tmp_path,
        config,
        ComparisonPlan(methods=("dff", "lerf", "3dovs")),
        evaluation=EvaluationConfig(lpips=False),
    )
    assert granted == [parse_bytes("200MB")] * 3


def test_bundled_captures_have_names_and_the_settings_of_the_demo(tmp_path, monkeypatch):
    from lexsplat.pipeline.config import BuildConfig

    monkeypatch.chdir(tmp_path)
    folder, settings = capture_and_settings("second", BuildConfig())
    assert (folder / "segmentations").is_dir()
    assert (settings.clip, settings.dino) == ("bundled", "bundled")
    folder, settings = capture_and_settings("demo", BuildConfig(clip="some/clip"))
    assert folder.name == "tabletop"
    assert settings.clip == "some/clip"
    (tmp_path / "demo").mkdir()
    assert capture_and_settings("demo", BuildConfig())[0].resolve() == tmp_path / "demo"


@pytest.mark.parametrize("command", ["ablate", "compare"])
def test_the_command_line_has_help_and_refuses_no_seeds(command, capsys):
    from lexsplat import cli

    with pytest.raises(SystemExit) as stopped:
        cli.main([command, "--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    assert "--seeds" in text
    assert "--settings" not in text, "settings stand at the top level, as in build"
    with pytest.raises(SystemExit) as stopped:
        cli.main([command, "demo", "--output", "x", "--seeds"])
    assert stopped.value.code == 2
