"""The ablation on a tiny capture: what is shared, what is switched off, and going on after a stop."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support import color_encoder
from support.experiments import CONFIG
from support.report_pages import Page

from lexsplat import cli
from lexsplat.evaluation import ablate as ablation
from lexsplat.evaluation import experiments
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.memory import parse_bytes


@pytest.fixture(scope="module", autouse=True)
def colors():
    """The color encoders in place of CLIP and DINO."""
    with pytest.MonkeyPatch.context() as patch:
        color_encoder.install(patch)
        yield


@pytest.fixture(scope="module")
def ablated(tiny_capture, tmp_path_factory):
    """All variants with two seeds."""
    folder = tmp_path_factory.mktemp("ablation")
    ablation.ablate(tiny_capture, folder, CONFIG, seeds=(0, 1))
    return folder


def rows_of(folder):
    with (folder / "ablation.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_row_of_the_papers_table_switches_off_what_it_says():
    config = BuildConfig(method="trained")
    assert ablation.changed(config, "full") == config
    assert not ablation.changed(config, "w/o DINO").codebook.use_dino
    assert not ablation.changed(config, "w/o L_lb").codebook.load_balancing
    assert not ablation.changed(config, "w/o u_G").trained.use_uncertainty
    assert not ablation.changed(config, "w/o MLP").trained.use_smoothing
    both = ablation.changed(config, "w/o u_G & MLP")
    assert not both.trained.use_uncertainty
    assert not both.trained.use_smoothing
    assert both.codebook == config.codebook
    with pytest.raises(ValueError, match="w/o everything"):
        ablation.changed(config, "w/o everything")


def test_a_lifted_field_is_ablated_in_its_quantization_only():
    assert ablation.variants_of("lifted") == ("w/o DINO", "w/o L_lb", "with neighbors", "one code", "full")
    table_2 = ("w/o DINO", "w/o L_lb", "w/o u_G", "w/o MLP", "w/o u_G & MLP", "full")
    assert ablation.variants_of("trained") == table_2
    assert ablation.variants_of("lifted+tuned") == tuple(ablation.VARIANTS)
    config = BuildConfig(method="lifted")
    assert ablation.changed(config, "with neighbors").lifted.use_smoothing
    assert ablation.changed(config, "one code").lifted.top == 1


def test_several_methods_stand_beside_each_other_with_wrong_labels(
    ablated, tiny_capture, tmp_path, monkeypatch
):
    shutil.copytree(ablated / "scene", tmp_path / "scene")
    seen, original = [], ablation.make_field
    monkeypatch.setattr(ablation, "make_field", lambda *a: seen.append(a[2]) or original(*a))
    rows = ablation.ablate(
        tiny_capture, tmp_path, CONFIG, seeds=(0,), methods=("trained", "lifted"), variants=("full", "one code"),
        wrong_labels=0.3,
    )  # fmt: skip
    assert [row["name"] for row in rows] == ["trained: full", "lifted: full", "lifted: one code"]
    assert all(row["language_seconds"][0] > 0 and row["storage_bytes"][0] > 0 for row in rows)
    clean = ablation.ablate(
        tiny_capture, tmp_path, CONFIG, seeds=(0,), methods=("trained", "lifted"), variants=("full",)
    )  # other labels are other runs: they are measured anew
    assert len(seen) == 5
    name = next(iter(seen[0]))
    assert 0.1 < np.mean(seen[0][name] != seen[3][name]) < 0.35
    assert rows[1]["mAP"] != clean[1]["mAP"]


def test_a_language_is_made_once_and_measured_in_both_forms(ablated, tiny_capture, tmp_path, monkeypatch):
    shutil.copytree(ablated / "scene", tmp_path / "scene")
    made, original = [], ablation.make_field
    monkeypatch.setattr(ablation, "make_field", lambda *a: made.append(1) or original(*a))
    rows = ablation.ablate(
        tiny_capture, tmp_path, CONFIG, seeds=(0, 1), variants=("full",), forms=("feature", "code")
    )
    assert [row["name"] for row in rows] == ["full, feature", "full, code"]
    assert len(made) == 2, "one for each seed"
    for form in ("feature", "code"):
        record = json.loads((tmp_path / "runs" / f"full__{form}" / "seed-0.json").read_text())
        assert record["metrics"]["language"]["form"] == form
    known = json.loads((ablated / "runs" / "full" / "seed-0.json").read_text())["metrics"]["language"]
    assert rows[0]["mAP"] != rows[1]["mAP"]
    again = json.loads((tmp_path / "runs" / "full__feature" / "seed-0.json").read_text())["metrics"][
        "language"
    ]
    assert again["strict"] == known["strict"], "as if it stood alone"
    with pytest.raises(ValueError, match="form"):
        ablation.ablate(tiny_capture, tmp_path, CONFIG, forms=())


def test_wrong_labels_differ_in_every_view_and_keep_their_share():
    maps = {name: np.zeros((80, 90), np.uint8) for name in "ab"}
    wrong = ablation.with_wrong_labels(maps, 0.25, 10, seed=3)
    assert np.mean(wrong["a"] != 0) == pytest.approx(0.25 * 0.9, abs=0.02)
    assert (wrong["a"] != wrong["b"]).any()
    assert wrong["a"].dtype == np.uint8
    assert wrong["a"].max() == 9
    again = ablation.with_wrong_labels(maps, 0.25, 10, seed=3)
    assert all((again[name] == wrong[name]).all() for name in maps)
    with pytest.raises(ValueError, match="share"):
        ablation.with_wrong_labels(maps, 1.5, 10, seed=3)


def test_the_tables_have_all_rows_with_mean_and_spread(ablated):
    rows = rows_of(ablated)
    assert [row["name"] for row in rows] == list(ablation.variants_of("trained"))
    assert all(row["runs"] == "2" for row in rows)
    record = json.loads((ablated / "ablation.json").read_text())
    values = [run["auto"]["mIoU"] for run in record["runs"]["full"]]
    assert float(rows[-1]["mIoU"]) == pytest.approx(sum(values) / 2, abs=1e-5)
    assert float(rows[-1]["mAP"]) > 0.2, "the colors are found"
    assert record["config"]["method"] == "trained"
    assert record["evaluation"]["query"]["form"] == "feature"
    assert r"w/o u\_G \& MLP" in (ablated / "ablation.tex").read_text()


def test_the_report_has_mean_and_spread_and_the_pictures_of_the_first_seed(ablated):
    text = (ablated / "report.html").read_text(encoding="utf-8")
    rows = {row[0]: row for row in reversed(Page(text).rows) if row}
    values = [float(entry["mIoU"]) for entry in rows_of(ablated) if entry["name"] == "w/o MLP"]
    assert rows["w/o MLP"][3].startswith(f"{values[0]:.3f} ± ")
    assert text.count('class="answer"') == text.count('class="versus"') * 6 > 0
    assert "over 2 seeds" in text
    assert (ablated / "runs" / "full" / "seed-0.pictures.safetensors").is_file()
    assert not (ablated / "runs" / "full" / "seed-1.pictures.safetensors").exists()


def test_codebooks_are_shared_where_the_quantization_is_the_same(ablated):
    # Full, w/o DINO and w/o L_lb need their own; the others take that of the full method. Two seeds.
    assert len(list((ablated / "codebooks").glob("*.safetensors"))) == 6


def test_memory_is_that_of_the_codebook_too_whoever_made_it(ablated, tiny_capture, tmp_path):
    shutil.copytree(ablated / "scene", tmp_path / "scene")
    shutil.copytree(ablated / "codebooks", tmp_path / "codebooks")
    for path in (tmp_path / "codebooks").iterdir():
        tensors, facts = read_tensors(path)
        peaks = json.loads(facts["peaks"])
        assert peaks["peak_rss_bytes"] is None or peaks["peak_rss_bytes"] > 1e7
        write_tensors(path, tensors, {**facts, "peaks": json.dumps({"peak_rss_bytes": 10**15})})
    rows = ablation.ablate(tiny_capture, tmp_path, CONFIG, seeds=(0,), variants=("full",))
    assert rows[0]["host_bytes"][0] in (None, 10**15)


def test_memory_granted_bounds_codebook_and_language(ablated, tiny_capture, tmp_path, monkeypatch):
    from lexsplat.evaluation import experiments

    shutil.copytree(ablated / "scene", tmp_path / "scene")
    granted = []
    fit, field = experiments.fit_codebook, ablation.make_field
    monkeypatch.setattr(
        experiments, "fit_codebook", lambda *a, **k: granted.append(k["memory"]) or fit(*a, **k)
    )
    monkeypatch.setattr(
        ablation, "make_field", lambda *a: granted.append(a[4].trained.memory_bytes) or field(*a)
    )
    config = replace(CONFIG, memory="800MB")
    ablation.ablate(tiny_capture, tmp_path, config, seeds=(0,), variants=("full",))
    assert granted == [parse_bytes("800MB"), parse_bytes("200MB")]


def test_seeds_differ_and_the_gaussians_are_shared(ablated):
    full = [json.loads((ablated / "runs" / "full" / f"seed-{seed}.json").read_text()) for seed in (0, 1)]
    assert full[0]["metrics"]["quality"] == full[1]["metrics"]["quality"]
    assert full[0]["metrics"]["language"] != full[1]["metrics"]["language"]


def test_a_stopped_ablation_goes_on_with_what_is_missing(ablated, tiny_capture, monkeypatch):
    before = rows_of(ablated)
    missing = ablated / "runs" / "w_o_MLP" / "seed-1.json"
    language = json.loads(missing.read_text())["metrics"]["language"]
    missing.unlink()
    (ablated / "runs" / "full" / "seed-0.json").write_text("{")  # damaged
    next((ablated / "codebooks").glob("*.safetensors")).write_bytes(b"damaged")
    made, original = [], ablation.make_field
    monkeypatch.setattr(ablation, "make_field", lambda *a: made.append(a[4].seed) or original(*a))
    ablation.ablate(tiny_capture, ablated, CONFIG, seeds=(0, 1))
    assert made == [0, 1], "only what is missing is made"
    again = json.loads(missing.read_text())["metrics"]["language"]
    assert again == language, "the same seed gives the same numbers"
    assert [row["name"] for row in rows_of(ablated)] == [row["name"] for row in before]
    for name in ("mIoU", "mAP", "official_mAP"):
        values = [[float(row[name]) for row in rows] for rows in (rows_of(ablated), before)]
        assert values[0] == values[1], name


def test_another_program_measures_anew_what_the_one_before_kept(ablated, tiny_capture, tmp_path, monkeypatch):
    """A method that was mended must not show the numbers of the broken one under today's versions."""
    output = shutil.copytree(ablated, tmp_path / "ablated")
    monkeypatch.setattr(experiments, "code_identity", lambda: "another")
    made, original = [], ablation.make_field
    monkeypatch.setattr(ablation, "make_field", lambda *a: made.append(a[4].seed) or original(*a))
    ablation.ablate(tiny_capture, output, CONFIG, variants=("full",), seeds=(0,))
    assert made == [0]


def test_wrong_wishes_are_told_before_anything_is_made(tiny_capture, tmp_path):
    with pytest.raises(ValueError, match="seed"):
        ablation.ablate(tiny_capture, tmp_path / "a", CONFIG, seeds=())
    with pytest.raises(ValueError, match="variants"):
        ablation.ablate(tiny_capture, tmp_path / "a", CONFIG, variants=("w/o all",))
    assert not (tmp_path / "a").exists()


def test_a_capture_without_masks_cannot_be_ablated(ablated, tiny_capture, monkeypatch):
    from lexsplat.evaluation import experiments

    empty = experiments.Annotations("segmentations", tiny_capture, {})
    monkeypatch.setattr(experiments, "load_annotations", lambda *a: empty)
    with pytest.raises(CaptureError, match="STEM/PROMPT"):
        ablation.ablate(tiny_capture, ablated, replace(CONFIG, seed=0))


def test_truth_from_elsewhere_is_asked_in_the_words_of_either_list_and_runs_are_kept_for_equal_truth_only(
    tiny_capture, tmp_path, monkeypatch
):
    capture, ground_truth = tmp_path / "counter", tmp_path / "ground_truth"
    shutil.copytree(tiny_capture, capture)
    for folder in (
        capture / "segmentations"
    ).iterdir():  # not compressed: masks of one size have files of one size
        (ground_truth / folder.name).mkdir(parents=True)
        for old, new in (("red apple", "stale bread"), ("blue ball", "blue ball")):
            mask = Image.open(folder / f"{old}.png")
            mask.save(ground_truth / folder.name / f"{new}.png", compress_level=0)
    made, original = [], ablation.make_field
    monkeypatch.setattr(ablation, "make_field", lambda *a: made.append(1) or original(*a))

    def measure(**wishes):
        before = len(made)
        rows = ablation.ablate(
            capture, tmp_path / "out", CONFIG, seeds=(0,), methods=("lifted",), variants=("full",), **wishes
        )
        record = json.loads((tmp_path / "out" / "ablation.json").read_text())
        return (
            list(record["per_prompt"]["full"][0]),
            len(made) - before,
            rows[0]["mAP"][0],
            record["ground_truth"],
        )

    released = measure(masks=ground_truth, prompt_list="released")
    assert released[:2] == (["stale bread"], 1), "the blue ball is in no list"
    assert released[3] == {"folder": str(ground_truth), "layout": "segmentations", "prompt_list": "released"}
    assert measure(masks=ground_truth, prompt_list="paper")[:2] == (["stable bread"], 1)
    everything = measure(masks=ground_truth)
    assert everything[:2] == (["blue ball", "stale bread"], 1)
    moved = ground_truth.rename(tmp_path / "moved")
    assert measure(masks=moved)[:3] == (everything[0], 0, everything[2]), (
        "equal ground truth elsewhere is no other truth"
    )
    for path in moved.rglob("stale bread.png"):
        size = path.stat().st_size
        Image.fromarray(255 - np.asarray(Image.open(path))).save(path, compress_level=0)
        assert path.stat().st_size == size
    redrawn = measure(masks=moved)
    assert redrawn[1] == 1, "other masks of the same names and sizes are other truth"
    assert redrawn[2] != everything[2]
    own = measure()
    assert own[:2] == (["blue ball", "red apple"], 1)
    with pytest.raises(CaptureError, match="the list 'paper'"):
        measure(prompt_list="paper")


@pytest.mark.parametrize("command", ["ablate", "compare"])
@pytest.mark.parametrize(
    ("wish", "told"),
    [(("--prompt-list", "paper"), "bonsai, counter"), (("--masks", "nowhere"), "no such folder")],
)
def test_truth_that_cannot_be_had_is_told_before_anything_is_made(
    tiny_capture, tmp_path, capsys, command, wish, told
):
    output = tmp_path / "out"
    assert cli.main([command, str(tiny_capture), "--output", str(output), *wish]) == 1
    assert told in capsys.readouterr().err
    assert not output.exists()


@pytest.mark.parametrize("command", ["ablate", "compare"])
def test_the_command_line_hands_on_which_truth_and_protocols_are_meant(
    tiny_capture, tmp_path, monkeypatch, command
):
    from lexsplat.evaluation import compare as comparison

    module = {"ablate": ablation, "compare": comparison}[command]
    wishes = {}
    monkeypatch.setattr(module, command, lambda *a, **k: wishes.update(k) or [])
    arguments = ["--masks", str(tmp_path), "--prompt-list", "released"]
    arguments += ["--protocols", "strict", "lerf-2d"] if command == "compare" else []
    assert cli.main([command, str(tiny_capture), "--output", str(tmp_path / "out"), *arguments]) == 0
    assert (wishes["masks"], wishes["prompt_list"]) == (tmp_path, "released")
    if command == "compare":
        assert wishes["protocols"] == ("strict", "lerf-2d")
