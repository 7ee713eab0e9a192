import base64
import csv
import io
import re

import numpy as np
import pytest
from PIL import Image
from support.report_pages import NASTY, Page, evaluated

from lexsplat.evaluation import Metrics
from lexsplat.evaluation.report import (
    Gallery,
    MeasuredMethod,
    format_rows,
    format_table,
    table_rows,
    write_comparison,
    write_report,
    write_rows,
)


@pytest.fixture(scope="module")
def result():
    return evaluated()


@pytest.fixture
def page_text(result, tmp_path):
    path = tmp_path / "new" / "report.html"
    write_report(path, *result, title="A & B")
    assert [entry.name for entry in path.parent.iterdir()] == ["report.html"], "no temporary file remains"
    return path.read_text(encoding="utf-8")


def test_the_page_is_well_formed_and_has_no_scripts(page_text):
    page = Page(page_text)
    assert page_text.startswith("<!doctype html>")
    assert not {"script", "link", "iframe", "object", "base", "form"} & set(page.tags)
    assert not [name for name, _ in page.attributes if name.startswith("on")]


def test_the_page_loads_nothing(page_text):
    assert not re.search(r"https?:|//[a-z]|@import|srcset", page_text)
    page = Page(page_text)
    sources = [value for name, value in page.attributes if name in ("src", "href", "data", "action")]
    assert sources
    assert all(value.startswith("data:image/jpeg;base64,") for value in sources)
    assert all(url.startswith("data:") for url in re.findall(r"url\(([^)]*)\)", page_text))
    assert ("content", "default-src 'none'; img-src data:; style-src 'unsafe-inline'") in page.attributes


def test_its_images_can_be_read(page_text):
    images = re.findall(r"data:image/jpeg;base64,([A-Za-z0-9+/=]+)", page_text)
    assert len(images) >= 3 * 2 * 3 + 3 * 2
    for data in images:
        assert Image.open(io.BytesIO(base64.b64decode(data))).size == (60, 45)


def test_prompts_and_settings_are_shown_as_text(page_text):
    page = Page(page_text)
    assert "<script" not in page_text
    assert NASTY in "".join(page.text)
    assert "a <b> chip" in "".join(page.text)
    assert "not <installed>" in "".join(page.text)


def test_its_numbers_are_those_of_the_metrics(result, page_text):
    data, page = result[0].to_json(), Page(page_text)
    rows = {row[0]: row[1:] for row in page.rows if row}
    strict = data["language"]["strict"]
    columns = ("mIoU", "mPA", "mP")
    assert rows["automatic threshold"][:4] == [f"{strict['auto'][c]:.3f}" for c in columns] + [
        f"{strict['mAP']:.3f}"
    ]
    assert rows["oracle threshold"][:3] == [f"{strict['oracle'][c]:.3f}" for c in columns]
    assert rows["official protocol"][:4] == ["0.500", "0.900", "0.600", "1.000"]
    assert rows["lerf-2d protocol"][0::4] == ["0.300", "1.000"]
    assert rows["seed"] == ["0"]
    assert rows["cpu"] == ["a <b> chip"]
    assert rows["versions"] == ["lexsplat 1.2, torch 2"]
    for prompt, row in data["language"]["per_prompt"].items():
        assert rows[prompt][0] == f"{row['IoU_auto']:.3f}"
        assert rows[prompt][5] == f"{row['AP']:.3f}"
    assert rows["frames per second, color and one prompt"] == ["12.3"]
    assert rows["language"] == ["150.0 KB"]
    assert "31.23" in page.text


def test_worst_cases_come_first_and_are_bounded(result, tmp_path, monkeypatch):
    monkeypatch.setattr("lexsplat.evaluation.report.page.MAX_CASES", 4)
    metrics, gallery = result
    path = tmp_path / "report.html"
    write_report(path, metrics, gallery)
    cases = re.findall(r'<div class="case"><p>.*?IoU ([0-9.]+)', path.read_text(encoding="utf-8"))
    assert len(cases) == 4
    assert cases == sorted(cases)
    assert "2 better cases are left out" in path.read_text(encoding="utf-8")


def test_a_scene_without_masks_has_a_report(result, tmp_path):
    metrics, _ = result
    bare = Metrics(
        metrics.quality, None, {**metrics.speed, "render_fps": None, "query_ms": None}, metrics.size, {}, {}
    )
    write_report(tmp_path / "report.html", bare, Gallery())
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    Page(text)
    assert "no ground truth" in text
    assert "PSNR 31.23 dB" in format_table(bare.to_json())


def test_the_terminal_table_has_the_same_numbers(result):
    data = result[0].to_json()
    lines = format_table(data).splitlines()
    strict = data["language"]["strict"]
    row = next(line for line in lines if line.startswith("automatic threshold"))
    assert row.split()[2:] == [f"{strict['auto'][c]:.3f}" for c in ("mIoU", "mPA", "mP")] + [
        f"{strict['mAP']:.3f}"
    ]
    assert any(line.startswith("red apple") for line in lines)
    assert any("12,345 Gaussians" in line and "2.5 MB" in line for line in lines)
    assert max(map(len, lines)) <= 100


def test_the_same_evaluation_gives_the_same_page(result, tmp_path):
    for name in ("one", "two"):
        write_report(tmp_path / name, *evaluated())
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


# Rows to compare


def results_of_three_seeds():
    data = evaluated()[0].to_json()
    runs = []
    for miou in (0.5, 0.6, 0.7):
        language = {**data["language"], "strict": {**data["language"]["strict"]}}
        language["strict"]["auto"] = {**language["strict"]["auto"], "mIoU": miou}
        runs.append({**data, "language": language})
    return runs


def test_several_seeds_give_mean_and_standard_deviation():
    rows = table_rows({"full": results_of_three_seeds(), "one": results_of_three_seeds()[0]})
    assert rows[0]["runs"] == 3
    assert rows[0]["mIoU"] == [0.5, 0.6, 0.7]
    table = format_rows(rows, ("mIoU", "mAP"))
    assert "0.600 ± 0.100" in table
    assert len({len(line) for line in table.splitlines()}) == 1, "columns are aligned"
    assert "±" not in table.splitlines()[-1]


def test_the_time_of_language_counts_neither_cameras_nor_gaussians_nor_features():
    result = results_of_three_seeds()[0]
    stages = {"poses": 100, "views": 5, "features": 20, "reconstruct": 200, "codebook": 3, "language": 7}
    (row,) = table_rows({"one": {**result, "speed": {**result["speed"], "stage_seconds": stages}}})
    assert row["language_seconds"] == [3 + 7]
    assert row["training_seconds"] == [20 + 200 + 3 + 7]


def test_the_headline_of_a_comparison_names_the_best_method_and_never_the_reference(tmp_path):
    worst, middle, best = results_of_three_seeds()
    results = {"<b>trained</b>": [worst], "averaged": [middle], "nearest": [best]}
    methods = [MeasuredMethod(name, runs) for name, runs in results.items()]
    path = tmp_path / "any name.html"
    write_comparison(path, methods, "<i>title</i>", config={}, machine={})
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert "".join(page.text).count("<i>title</i>") == 2
    card = re.search(r'<div class="card"><b>(.*?)</b><span>best mIoU</span><small>(.*?)</small>', text)
    assert card.groups() == ("0.600", "averaged")
    assert "<b>0.600</b></td>" in text
    assert "<b>0.700</b></td>" not in text
    assert [row[0] for row in page.rows[1:4]] == list(results)


def test_csv_can_be_read_back(tmp_path):
    write_rows(tmp_path, "table", table_rows({'a, "b"': results_of_three_seeds()}))
    with (tmp_path / "table.csv").open(newline="", encoding="utf-8") as file:
        row = next(csv.DictReader(file))
    assert row["name"] == 'a, "b"'
    assert float(row["mIoU"]) == pytest.approx(0.6)
    assert float(row["mIoU_std"]) == pytest.approx(np.std([0.5, 0.6, 0.7], ddof=1))
    assert row["lpips"] == "", "empty where not measured"
    assert float(row["lerf_3d_acc_25"]) == 0


def test_latex_rows_are_escaped_and_have_the_columns_of_the_paper(tmp_path):
    write_rows(tmp_path, "table", table_rows({"100% u_G & MLP": results_of_three_seeds()[0]}))
    lines = (tmp_path / "table.tex").read_text(encoding="utf-8").splitlines()
    heading = next(line for line in lines if line.startswith("Method"))
    row = next(line for line in lines if line.startswith("100"))
    assert row.startswith(r"100\% u\_G \& MLP & 31.23 & 0.912 & ")
    assert heading.split(" & ")[1:7] == ["PSNR", "SSIM", "mPA", "mP", "mIoU", "mAP"], "no LPIPS, no column"
    assert heading.count("&") == row.count(" & ")
    assert lines[-1] == r"\end{tabular}"
