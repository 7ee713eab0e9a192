"""The ablation on a tiny capture: what is shared, what is switched off, and resuming."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.experiments import CONFIG
from support.experiments import ablated as measure_variants
from support.report_pages import Page
from support.schemas import validated

from lexsplat import cli
from lexsplat.captures import Annotations
from lexsplat.evaluation import ablate as ablation
from lexsplat.evaluation import experiments
from lexsplat.evaluation.ablate import AblationPlan
from lexsplat.evaluation.ground_truth import GroundTruthSource
from lexsplat.language.methods import METHODS, VARIANTS
from lexsplat.language.methods.averaged import Averaged
from lexsplat.language.methods.trained import Trained
from lexsplat.pipeline.config import BuildConfig
from lexsplat.runtime.errors import CaptureError
from lexsplat.runtime.files import read_tensors, write_tensors
from lexsplat.runtime.memory import parse_bytes

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("color_encoders")]


@pytest.fixture(scope="module")
def ablated(six_views, tmp_path_factory):
    """All variants with two seeds."""
    folder = tmp_path_factory.mktemp("ablation")
    measure_variants(six_views, folder, CONFIG, AblationPlan(seeds=(0, 1)))
    return folder


@pytest.fixture
def fits(monkeypatch):
    """Every fit of a method: the training views, settings and run it receives."""
    received = []
    for method in (Averaged, Trained):

        def fit(self, gaussians, views, config, run, *, original=method.fit):
            received.append((views, config, run))
            return original(self, gaussians, views, config, run)

        monkeypatch.setattr(method, "fit", fit)
    return received


def rows_of(folder):
    with (folder / "ablation.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_row_of_the_papers_table_switches_off_its_part():
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


def test_each_method_has_the_variants_that_change_it():
    table_2 = ("w/o DINO", "w/o L_lb", "w/o u_G", "w/o MLP", "w/o u_G & MLP", "full")
    assert tuple(METHODS["trained"].variants) == table_2
    lifting = (
        "gate",
        "least weight",
        "squared weights",
        "agreement",
        "w/o reliability",
        "all views",
        "all liftings",
    )
    averaged = ("one code", "w/o DINO", "with DINO", *lifting, "full")
    assert tuple(METHODS["averaged"].variants) == averaged
    assert set(VARIANTS) == {*table_2, *averaged}
    weighed = [name for name in averaged if ablation.changed(BuildConfig(), name).averaged.weighs_entries]
    assert weighed == [name for name in lifting if name not in ("w/o reliability", "all views")]
    assert ablation.changed(BuildConfig(), "one code").averaged.top == 1
    with pytest.raises(ValueError, match="averaged"):
        ablation.changed(BuildConfig(), "w/o MLP")


def test_a_variant_that_no_method_has_is_refused_before_any_work(six_views, tmp_path):
    for methods in (("averaged",), ("trained", "averaged")):
        with pytest.raises(ValueError, match="with neighbors"):
            measure_variants(
                six_views,
                tmp_path / "a",
                CONFIG,
                AblationPlan(methods=methods, variants=("with neighbors",)),
            )
    with pytest.raises(ValueError, match="averaged"):
        measure_variants(
            six_views, tmp_path / "a", CONFIG, AblationPlan(methods=("averaged",), variants=("w/o MLP",))
        )
    with pytest.raises(ValueError, match="lifted"):
        measure_variants(six_views, tmp_path / "a", CONFIG, AblationPlan(methods=("lifted",)))
    assert not (tmp_path / "a").exists()


def test_several_methods_with_wrong_labels_and_a_variant_that_one_lacks(
    ablated, six_views, tmp_path, fits, caplog
):
    shutil.copytree(ablated / "scene", tmp_path / "scene")
    methods = ("trained", "averaged")
    rows = measure_variants(
        six_views,
        tmp_path,
        CONFIG,
        AblationPlan(seeds=(0,), methods=methods, variants=("full", "one code"), wrong_labels=0.3),
    )
    assert [row["name"] for row in rows] == ["trained: full", "averaged: full", "averaged: one code"]
    assert "trained has no variant 'one code': the row is left out" in caplog.text
    assert all(row["language_seconds"][0] > 0 and row["storage_bytes"][0] > 0 for row in rows)
    clean = measure_variants(
        six_views, tmp_path, CONFIG, AblationPlan(seeds=(0,), methods=methods, variants=("full",))
    )
    assert len(fits) == 5, "other labels are other runs"
    wrong, right = fits[0][0].code_maps, fits[3][0].code_maps
    name = next(iter(wrong))
    assert 0.1 < np.mean(wrong[name] != right[name]) < 0.35
    assert rows[1]["mAP"] != clean[1]["mAP"]


def test_a_language_is_made_once_and_measured_in_both_forms(ablated, six_views, tmp_path, fits):
    shutil.copytree(ablated / "scene", tmp_path / "scene")
    rows = measure_variants(
        six_views,
        tmp_path,
        CONFIG,
        AblationPlan(seeds=(0, 1), variants=("full",), forms=("feature", "code")),
    )
    assert [row["name"] for row in rows] == ["full, feature", "full, code"]
    assert len(fits) == 2, "one for each seed"
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
        measure_variants(six_views, tmp_path, CONFIG, AblationPlan(forms=()))


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
    assert [row["name"] for row in rows] == list(METHODS["trained"].variants)
    assert all(row["runs"] == "2" for row in rows)
    record = json.loads((ablated / "ablation.json").read_text())
    validated("ablation", record)
    values = [run["auto"]["mIoU"] for run in record["runs"]["full"]]
    assert float(rows[-1]["mIoU"]) == pytest.approx(sum(values) / 2, abs=1e-5)
    assert float(rows[-1]["mAP"]) > 0.2, "the colors are found"
    assert record["config"]["method"] == "trained"
    assert set(record["forms"].values()) == {"feature"}
    assert r"w/o u\_G \& MLP" in (ablated / "ablation.tex").read_text()


def test_the_report_has_mean_and_spread_and_the_images_of_the_first_seed(ablated):
    text = (ablated / "ablation.html").read_text(encoding="utf-8")
    rows = {row[0]: row for row in reversed(Page(text).rows) if row}
    values = [float(entry["mIoU"]) for entry in rows_of(ablated) if entry["name"] == "w/o MLP"]
    assert rows["w/o MLP"][3].startswith(f"{values[0]:.3f} ± ")
    assert text.count('class="answer"') == text.count('class="versus"') * 6 > 0
    assert "over 2 seeds" in text
    assert (ablated / "runs" / "full" / "seed-0.images.safetensors").is_file()
    assert not (ablated / "runs" / "full" / "seed-1.images.safetensors").exists()


def test_codebooks_are_shared_where_the_quantization_is_the_same(ablated):
    # Full, w/o DINO and w/o L_lb need their own; the others take that of the full method. Two seeds.
    assert len(list((ablated / "codebooks").glob("*.safetensors"))) == 6


def test_memory_is_that_of_the_codebook_too_whoever_made_it(ablated, six_views, tmp_path):
    shutil.copytree(ablated / "scene", tmp_path / "scene")
    shutil.copytree(ablated / "codebooks", tmp_path / "codebooks")
    for path in (tmp_path / "codebooks").iterdir():
        tensors, facts = read_tensors(path)
        peaks = json.loads(facts["peaks"])
        assert peaks["peak_rss_bytes"] is None or peaks["peak_rss_bytes"] > 1e7
        write_tensors(path, tensors, {**facts, "peaks": json.dumps({"peak_rss_bytes": 10**15})})
    rows = measure_variants(six_views, tmp_path, CONFIG, AblationPlan(seeds=(0,), variants=("full",)))
    assert rows[0]["host_bytes"][0] in (None, 10**15)


def test_codebook_and_language_receive_the_memory_budget(ablated, six_views, tmp_path, monkeypatch, fits):
    shutil.copytree(ablated / "scene", tmp_path / "scene")
    granted, fit = [], experiments.fit_codebook
    monkeypatch.setattr(
        experiments, "fit_codebook", lambda *a, **k: granted.append(k["memory"]) or fit(*a, **k)
    )
    config = replace(CONFIG, memory="800MB")
    measure_variants(six_views, tmp_path, config, AblationPlan(seeds=(0,), variants=("full",)))
    assert [*granted, fits[0][2].memory] == [parse_bytes("800MB")] * 2


def test_seeds_differ_and_the_gaussians_are_shared(ablated):
    full = [json.loads((ablated / "runs" / "full" / f"seed-{seed}.json").read_text()) for seed in (0, 1)]
    assert full[0]["metrics"]["quality"] == full[1]["metrics"]["quality"]
    assert full[0]["metrics"]["language"] != full[1]["metrics"]["language"]


def test_an_interrupted_ablation_makes_only_what_is_missing(ablated, six_views, fits):
    before = rows_of(ablated)
    missing = ablated / "runs" / "w_o_MLP" / "seed-1.json"
    language = json.loads(missing.read_text())["metrics"]["language"]
    missing.unlink()
    (ablated / "runs" / "full" / "seed-0.json").write_text("{")  # damaged
    next((ablated / "codebooks").glob("*.safetensors")).write_bytes(b"damaged")
    measure_variants(six_views, ablated, CONFIG, AblationPlan(seeds=(0, 1)))
    assert [run.seed for _, _, run in fits] == [0, 1]
    again = json.loads(missing.read_text())["metrics"]["language"]
    assert again == language, "the same seed gives the same numbers"
    assert [row["name"] for row in rows_of(ablated)] == [row["name"] for row in before]
    for name in ("mIoU", "mAP", "official_mAP"):
        values = [[float(row[name]) for row in rows] for rows in (rows_of(ablated), before)]
        assert values[0] == values[1], name


def test_another_version_of_the_code_measures_again(ablated, six_views, tmp_path, monkeypatch, fits):
    output = shutil.copytree(ablated, tmp_path / "ablated")
    monkeypatch.setattr(experiments, "code_identity", lambda: "another")
    measure_variants(six_views, output, CONFIG, AblationPlan(variants=("full",), seeds=(0,)))
    assert [run.seed for _, _, run in fits] == [0]


def test_missing_seeds_and_unknown_variants_are_refused_before_any_work(six_views, tmp_path):
    with pytest.raises(ValueError, match="seed"):
        measure_variants(six_views, tmp_path / "a", CONFIG, AblationPlan(seeds=()))
    with pytest.raises(ValueError, match="variants"):
        measure_variants(six_views, tmp_path / "a", CONFIG, AblationPlan(variants=("w/o all",)))
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    "plan", [{"seeds": (1, 1)}, {"variants": ("full", "full")}, {"forms": ("code",) * 2}]
)
def test_what_is_given_twice_is_refused_because_its_spread_would_be_none(plan):
    with pytest.raises(ValueError, match=r"given once each; got .* more than once"):
        AblationPlan(**plan)


def test_a_capture_without_masks_cannot_be_ablated(ablated, six_views, monkeypatch):
    empty = Annotations("segmentations", six_views, {})
    monkeypatch.setattr("lexsplat.evaluation.ground_truth.load_annotations", lambda *a: empty)
    with pytest.raises(CaptureError, match="STEM/PROMPT"):
        measure_variants(six_views, ablated, replace(CONFIG, seed=0))


def test_runs_are_kept_for_equal_ground_truth_and_prompts_only(six_views, tmp_path, fits):
    capture, ground_truth = tmp_path / "counter", tmp_path / "ground_truth"
    shutil.copytree(six_views, capture)
    for folder in (
        capture / "segmentations"
    ).iterdir():  # not compressed: masks of one size have files of one size
        (ground_truth / folder.name).mkdir(parents=True)
        for old, new in (("red apple", "stale bread"), ("blue ball", "blue ball")):
            mask = Image.open(folder / f"{old}.png")
            mask.save(ground_truth / folder.name / f"{new}.png", compress_level=0)

    def measure(source=None):
        before = len(fits)
        rows = measure_variants(
            capture,
            tmp_path / "out",
            CONFIG,
            AblationPlan(seeds=(0,), methods=("trained",), variants=("full",)),
            ground_truth=source,
        )
        record = json.loads((tmp_path / "out" / "ablation.json").read_text())
        return (
            list(record["per_prompt"]["full"][0]),
            len(fits) - before,
            rows[0]["mAP"][0],
            record["ground_truth"],
        )

    released = measure(GroundTruthSource(ground_truth, "released"))
    assert released[:2] == (["stale bread"], 1), "no list has the blue ball"
    assert released[3] == {"folder": str(ground_truth), "layout": "segmentations", "prompt_list": "released"}
    assert measure(GroundTruthSource(ground_truth, "paper"))[:2] == (["stable bread"], 1)
    everything = measure(GroundTruthSource(ground_truth))
    assert everything[:2] == (["blue ball", "stale bread"], 1)
    moved = ground_truth.rename(tmp_path / "moved")
    assert measure(GroundTruthSource(moved))[:3] == (everything[0], 0, everything[2]), (
        "equal ground truth in another folder is the same"
    )
    for path in moved.rglob("stale bread.png"):
        size = path.stat().st_size
        Image.fromarray(255 - np.asarray(Image.open(path))).save(path, compress_level=0)
        assert path.stat().st_size == size
    redrawn = measure(GroundTruthSource(moved))
    assert redrawn[1] == 1, "other masks with the same names and sizes are other ground truth"
    assert redrawn[2] != everything[2]
    own = measure()
    assert own[:2] == (["blue ball", "red apple"], 1)
    with pytest.raises(CaptureError, match="the list 'paper'"):
        measure(GroundTruthSource(prompt_list="paper"))


@pytest.mark.parametrize("command", ["ablate", "compare"])
@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--prompt-list", "paper"), "bonsai, counter"),
        (("--ground-truth", "nowhere"), "no such folder"),
        (("--masks", "nowhere"), "no such folder"),
    ],
)
def test_unavailable_ground_truth_is_refused_before_any_work(
    six_views, tmp_path, capsys, command, option, message
):
    output = tmp_path / "out"
    assert cli.main([command, str(six_views), "--output", str(output), *option]) == 1
    assert message in capsys.readouterr().err
    assert not output.exists()


@pytest.mark.parametrize("command", ["ablate", "compare"])
def test_the_command_line_passes_ground_truth_and_protocols(six_views, tmp_path, monkeypatch, command):
    from lexsplat.evaluation import compare as comparison
    from lexsplat.evaluation import experiments

    used = {}

    def bench(capture, output, settings, evaluation, ground_truth, listener):
        used.update(evaluation=evaluation, ground_truth=ground_truth)

    monkeypatch.setattr(experiments, "Bench", bench)
    module = {"ablate": ablation, "compare": comparison}[command]
    monkeypatch.setattr(module, command, lambda *a, **k: [])
    arguments = ["--ground-truth", str(tmp_path), "--prompt-list", "released"]
    arguments += ["--protocols", "strict", "lerf-2d"] if command == "compare" else []
    assert cli.main([command, str(six_views), "--output", str(tmp_path / "out"), *arguments]) == 0
    assert used["ground_truth"] == GroundTruthSource(tmp_path, "released")
    if command == "compare":
        assert used["evaluation"].protocols == ("strict", "lerf-2d")
