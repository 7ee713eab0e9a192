import functools
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.tiny_capture import SPHERES, trace

from lexsplat.captures import Annotations, Capture, load_annotations, load_capture
from lexsplat.evaluation import (
    EvaluationConfig,
    MethodScene,
    Metrics,
    PairResult,
    ViewImages,
    evaluate,
    peak_memory,
    precision_curves,
    summarize_language,
)
from lexsplat.evaluation.metrics import average_precision, mask_scores, threshold_counts
from lexsplat.evaluation.protocols import Lerf2dScores, OfficialScores
from lexsplat.geometry.gaussians import gaussians_from_points
from lexsplat.queries.relevancy import QueryConfig
from lexsplat.scenes.scene import Scene
from lexsplat.scenes.views import StoredView

WORDS = {"red apple": 1, "blue ball": 2}


def encode_text(texts):
    """Apple, ball and the canonical phrases, all at right angles."""
    return torch.eye(4)[[WORDS.get(text, 3) for text in texts]]


@functools.cache
def things_at(pose, focal, width, height):
    pose = np.frombuffer(pose).reshape(4, 4)
    return trace(pose[:3, :3], pose[:3, 3], focal, width, height)[1]


def things_seen(camera):
    """Index of the thing at every pixel ``[H, W]``, by ray tracing."""
    return things_at(camera.viewmat.tobytes(), camera.K[0, 0], camera.width, camera.height)


def drawn(masks, boxes=None):
    return Annotations("segmentations", Path(), masks, boxes or {})


QUICK = EvaluationConfig(timing_views=1, lpips=False, protocols=("strict", "official", "lerf-2d"))


class PerfectField:
    """Knows by ray tracing what is at every pixel: the ground truth, at any size."""

    method = "traced"
    segments = None
    levels = ()

    def __init__(self, order=(0, 1, 2)):
        codewords = torch.eye(4)[:3] + 0.5 * torch.eye(4)[3]  # a little of "stuff" is in everything
        self.codebook = SimpleNamespace(clip=codewords[list(order)])
        self.uncertainties = torch.zeros(9999)
        self.sizes = []

    def code_probabilities(self):
        return torch.eye(3)[torch.arange(9999) % 3]  # everything is somewhere

    def scores(self, table):
        return self.code_probabilities() @ table

    def select(self, index):
        return SimpleNamespace(code_probabilities=lambda: self.code_probabilities()[index])

    def render_code_probabilities(self, gaussians, camera):
        self.sizes.append((camera.width, camera.height))
        return torch.nn.functional.one_hot(torch.from_numpy(things_seen(camera)).long(), 3).float()

    def render_scores(self, gaussians, camera, table):
        return self.render_code_probabilities(gaussians, camera) @ table

    def tensors(self):
        return {"codes": torch.zeros(10, dtype=torch.uint8)}


@pytest.fixture(scope="module")
def capture(tiny_capture) -> Capture:
    return load_capture(tiny_capture)


@pytest.fixture(scope="module")
def gaussians(capture):
    return gaussians_from_points(capture.points, capture.point_colors, sh_degree=0)


def traced(capture, gaussians, field=None):
    """A scene whose language is known by ray tracing."""
    views = {
        name: StoredView(name, view.camera, "test" if name in capture.test_names else "train")
        for name, view in capture.views.items()
    }
    return Scene(gaussians, field or PerfectField(), views, "traced", encode_text=encode_text)


@pytest.fixture(scope="module")
def perfect(capture, gaussians):
    return evaluate(capture, traced(capture, gaussians), QUICK)


def larger_masks(capture, scale):
    masks = {}
    for view in capture.test_views:
        camera = view.camera.resized(scale * view.camera.width, scale * view.camera.height)
        masks[view.name] = {prompt: things_seen(camera) == i for i, prompt in enumerate(SPHERES, start=1)}
    return masks


@pytest.mark.parametrize(("asked", "used"), [("feature", "feature"), ("code", "code"), ("segment", "code")])
def test_a_field_that_knows_the_truth_scores_one_everywhere(capture, gaussians, asked, used):
    scene = traced(capture, gaussians)
    scene.query = QueryConfig(form=asked)
    language = evaluate(capture, scene, QUICK).language
    assert language["form"] == used, "the field has no segments"
    strict = language["strict"]
    for kind in ("auto", "fixed", "oracle"):
        assert strict[kind] == pytest.approx({"mIoU": 1, "mPA": 1, "mP": 1}), kind
    assert strict["mAP"] == strict["localization"] == pytest.approx(1)
    assert language["official"]["mIoU"] == pytest.approx(1)
    assert language["official"]["mAP"] == pytest.approx(1.01, abs=1e-6)


def test_a_field_that_confuses_two_things_scores_zero(capture, gaussians):
    metrics = evaluate(capture, traced(capture, gaussians, PerfectField(order=(0, 2, 1))), QUICK)
    assert metrics.language["strict"]["auto"]["mIoU"] == 0
    assert metrics.language["strict"]["localization"] == 0
    assert metrics.language["strict"]["mAP"] < 0.2


def test_relevancy_is_rendered_at_the_size_of_the_truth(capture, gaussians):
    field = PerfectField()
    subject, ground_truth = traced(capture, gaussians, field), drawn(larger_masks(capture, 3))
    metrics = evaluate(capture, subject, QUICK, ground_truth=ground_truth)
    assert (288, 216) in field.sizes
    assert metrics.language["strict"]["auto"]["mIoU"] == pytest.approx(1)
    assert metrics.language["official"]["mPA"] < 1, (
        "officially the ground truth is resized, and its edge is soft"
    )


def test_masks_larger_than_allowed_are_met_by_an_enlarged_map(capture, gaussians):
    field = PerfectField()
    config = replace(QUICK, max_pixels=96 * 72)
    subject, ground_truth = traced(capture, gaussians, field), drawn(larger_masks(capture, 3))
    metrics = evaluate(capture, subject, config, ground_truth=ground_truth)
    assert set(field.sizes) == {(96, 72)}
    assert 0.85 < metrics.language["strict"]["oracle"]["mIoU"] < 1


def test_automatic_thresholds_never_see_the_truth(capture, gaussians, perfect):
    wrong = {
        view.name: {prompt: ~mask for prompt, mask in prompts.items()}
        for view, prompts in zip(capture.test_views, larger_masks(capture, 1).values())
    }
    subject = traced(capture, gaussians)
    misled = evaluate(capture, subject, QUICK, ground_truth=drawn(wrong))
    for prompt in WORDS:
        assert misled.thresholds[prompt]["auto"] == perfect.thresholds[prompt]["auto"]
    assert misled.language["strict"]["auto"]["mIoU"] == 0
    assert misled.language["strict"]["oracle"]["mIoU"] > 0.5


def test_automatic_thresholds_are_those_of_the_scene_and_not_rounded(capture, gaussians, monkeypatch):
    scene, seen, ask = traced(capture, gaussians), [], Scene.ask

    def ask_precisely(self, prompts, **options):
        found = ask(self, prompts, **options)
        seen.append(replace(found, thresholds=torch.tensor([0.1234567, 0.7654321])[: len(found.prompts)]))
        return seen[-1]

    monkeypatch.setattr(Scene, "ask", ask_precisely)
    found = evaluate(capture, scene, QUICK).thresholds
    answers = seen[0]  # the maps of views ask the same again
    assert [found[prompt]["auto"] for prompt in answers.prompts] == answers.thresholds.tolist()


def test_the_automatic_mask_is_that_of_the_threshold_itself():
    scores, mask = np.array([[0.5004, 0.5002, 0.2]], np.float32), np.array([[True, False, False]])
    assert mask_scores(scores >= 0.5003, mask).iou == 1
    assert threshold_counts(scores, mask).at(0.5003).iou == 0.5, "counts are of thresholds of three decimals"


def test_masks_of_training_views_do_not_count(capture, gaussians):
    masks = {capture.train_names[0]: {"red apple": np.ones((72, 96), bool)}}
    subject = traced(capture, gaussians)
    assert evaluate(capture, subject, QUICK, ground_truth=drawn(masks)).language is None


def test_masks_without_a_pixel_and_prompts_in_two_spellings_are_told(capture, gaussians, caplog):
    masks = {
        name: {"red apple": mask, "Red  apple": mask, "blue ball": np.zeros_like(mask)}
        for name, prompts in larger_masks(capture, 1).items()
        for mask in [prompts["red apple"]]
    }
    evaluate(capture, traced(capture, gaussians), QUICK, ground_truth=drawn(masks))
    first = sorted(masks)[0]
    assert f"{len(masks)} masks cover no pixel: 'blue ball' in {first}" in caplog.text
    assert "'Red  apple' and 'red apple' differ only in case or spaces" in caplog.text
    assert caplog.text.count("masks cover no pixel") == 1


def test_without_masks_images_are_measured_alone(capture, gaussians):
    metrics = evaluate(capture, traced(capture, gaussians), QUICK, ground_truth=drawn({}))
    assert metrics.language is None
    assert metrics.speed["query_ms"] is None
    assert metrics.speed["rgb_fps"] > 0
    assert set(metrics.quality["per_view"]) == set(capture.test_names)


def test_quality_is_the_mean_over_the_held_out_views(capture, gaussians, perfect):
    from lexsplat.rendering import render

    values = []
    for view in capture.test_views:
        image = render(gaussians, view.camera).image.clamp(0, 1).numpy().astype(np.float64)
        values.append(-10 * np.log10(np.mean((image - view.load_image()) ** 2)))
    assert perfect.quality["psnr"] == pytest.approx(np.mean(values), abs=1e-4)
    assert perfect.quality["lpips"] is None or perfect.quality["lpips"] > 0
    assert ("lpips_reason" in perfect.quality) == (perfect.quality["lpips"] is None)


def test_observers_see_every_view_once(capture, gaussians):
    seen: list[ViewImages] = []
    evaluate(capture, traced(capture, gaussians), QUICK, observer=seen.append)
    assert [pictures.name for pictures in seen] == list(capture.test_names)
    for pictures in seen:
        assert pictures.photo.shape == pictures.image.shape == (72, 96, 3)
        assert set(pictures.relevancy) == set(pictures.ground_truth) == set(pictures.thresholds) == set(WORDS)


def test_progress_is_reported(capture, gaussians):
    events = []
    evaluate(capture, traced(capture, gaussians), QUICK, ground_truth=drawn({}), listener=events.append)
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("evaluate", i, 3) for i in (0, 1, 2, 3)
    ]


def test_metrics_json_has_the_sections_of_the_design_and_is_strict_json(capture, gaussians):
    metrics = evaluate(capture, traced(capture, gaussians), QUICK)
    tensors = metrics.size["language_bytes"], metrics.size["gaussian_bytes"]
    assert tensors == (10, 4 * 14 * len(gaussians)), "in memory, while nothing is known about files"
    metrics = metrics.with_facts(
        stage_seconds={"language": 1.5}, stored_bytes={"language_bytes": 7}, settings={"seed": 3},
        machine={"cores": 2},
    )  # fmt: skip
    found = json.loads(json.dumps(metrics.to_json(), allow_nan=False))
    assert list(found) == ["quality", "language", "speed", "size", "config", "machine"]
    assert {"psnr", "ssim", "lpips"} <= set(found["quality"])
    assert set(found["language"]["strict"]) == {"auto", "fixed", "oracle", "mAP", "localization"}
    assert set(found["language"]["official"]) == {"mIoU", "mPA", "mP", "mAP"}
    assert found["speed"]["stage_seconds"] == {"language": 1.5}
    assert found["size"]["gaussians"] == len(gaussians)
    assert found["size"]["language_bytes"] == 7
    assert found["size"]["gaussian_bytes"] == 4 * 14 * len(gaussians)
    assert found["config"]["evaluation"]["query"]["form"] == "segment"
    assert found["config"]["seed"] == 3
    assert found["machine"] == {"cores": 2}


def test_the_same_scene_gives_the_same_numbers_times_aside(capture, gaussians, perfect):
    again = evaluate(capture, traced(capture, gaussians), QUICK).to_json()
    first = perfect.to_json()
    for section in ("quality", "language", "config"):
        assert again[section] == first[section]


# Sums by hand


def pair(scores, ground_truth):
    scores, ground_truth = np.asarray(scores), np.asarray(ground_truth, dtype=bool)
    official = OfficialScores(0.25, 0.5, 0.75, 1.0)
    counts = threshold_counts(scores, ground_truth)
    return PairResult(
        counts,
        counts.at(0.5),
        average_precision(scores, ground_truth),
        float(scores.argmax() == 0),
        official,
    )


def test_means_by_hand():
    pairs = {
        "a": {"x": pair([0.9, 0.8, 0.1, 0.1], [1, 0, 0, 0]), "y": pair([0.9, 0.2, 0.2, 0.2], [1, 1, 0, 0])},
        "b": {"x": pair([0.1, 0.6, 0.1, 0.1], [0, 1, 0, 0])},
    }
    thresholds = {p: {"auto": 0.5, "fixed": 0.85, "oracle": 0.55} for p in "xy"}
    found = summarize_language(pairs, thresholds)
    # auto: a/x 1 of 2, a/y 1 of 2, b/x 1; fixed: a/x 1, a/y 1/2, b/x nothing found
    assert found["strict"]["auto"]["mIoU"] == pytest.approx(((1 / 2 + 1 / 2) / 2 + 1) / 2)
    assert found["strict"]["fixed"]["mIoU"] == pytest.approx(((1 + 1 / 2) / 2 + 0) / 2)
    assert found["strict"]["auto"]["mPA"] == pytest.approx((3 / 4 + 1) / 2)
    assert found["strict"]["auto"]["mP"] == pytest.approx(((1 / 2 + 1) / 2 + 1) / 2)
    assert found["strict"]["localization"] == pytest.approx((1 + 0) / 2)
    assert found["official"] == pytest.approx({"mIoU": 0.25, "mPA": 0.5, "mP": 0.75, "mAP": 1.0})
    assert found["per_prompt"]["x"]["IoU_auto"] == pytest.approx((1 / 2 + 1) / 2)
    assert found["per_prompt"]["x"]["views"] == 2
    assert found["per_view"]["a"]["mIoU"] == pytest.approx(1 / 2)


def test_an_image_without_the_object_is_left_out_of_rankings_only():
    pairs = {"a": {"x": pair([0.9, 0.1], [1, 0])}, "b": {"x": pair([0.9, 0.1], [0, 0])}}
    thresholds = {"x": {"auto": 0.5, "fixed": 0.5, "oracle": 0.5}}
    found = summarize_language(pairs, thresholds)["strict"]
    assert found["mAP"] == pytest.approx(1)
    assert found["auto"]["mIoU"] == pytest.approx(0.5)


def test_curves_pool_the_pixels_of_all_views():
    pairs = {
        "a": {"x": pair([0.9, 0.1, 0.1, 0.1], [1, 0, 0, 0])},
        "b": {"x": pair([0.1, 0.95, 0.1, 0.1], [1, 0, 0, 0])},
    }
    curve = precision_curves(pairs)["x"]
    assert curve[0] == curve[50] == pytest.approx(1 / 2)
    assert curve[51] == curve[100] == pytest.approx(2 / 8)


def test_numbers_that_are_not_finite_become_null():
    metrics = Metrics(
        {"psnr": math.inf}, None, {"x": np.float32(0.5)}, {"n": np.int64(3)}, {"t": (1, math.nan)}, {}
    )
    assert metrics.to_json() == {
        "quality": {"psnr": None}, "language": None, "speed": {"x": 0.5}, "size": {"n": 3},
        "config": {"t": [1, None]}, "machine": {},
    }  # fmt: skip


def test_peak_memory_is_in_bytes():
    assert peak_memory() is None or peak_memory() > 50e6


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peaks are counted anew on Linux only")
def test_what_was_freed_before_does_not_count_as_needed_after():
    script = """
from lexsplat.evaluation import forget_peak_memory, peak_memory
blocks = [bytearray(64 << 10) for _ in range(4000)]
top = bytearray(64 << 10)  # lies above them all: the allocator gives nothing back by itself
full = peak_memory()
del blocks
assert forget_peak_memory()
print(full - peak_memory())
"""
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert int(found.stdout) > 200e6


def test_the_lerf_protocols_average_all_pairs_alike():
    def scored(iou, hit, silhouette):
        return replace(pair([0.9, 0.1], [1, 0]), lerf_2d=Lerf2dScores(iou, hit), lerf_3d=silhouette)

    pairs = {
        "a": {"x": scored(0.2, True, 0.3), "y": scored(0.4, False, 0.6)},
        "b": {"x": scored(0.9, True, 0.0)},
    }
    thresholds = {p: {"auto": 0.5, "fixed": 0.5, "oracle": 0.5} for p in "xy"}
    found = summarize_language(pairs, thresholds)
    assert found["lerf_2d"] == pytest.approx({"mIoU": 0.5, "localization": 2 / 3})
    assert found["lerf_3d"] == pytest.approx({"mIoU": 0.3, "acc_25": 2 / 3, "acc_50": 1 / 3})
    assert found["per_prompt"]["x"]["IoU_lerf_3d"] == pytest.approx(0.15)


class PaintedMethod:
    """A `Method` whose Gaussians know what they are: those near a sphere belong to it."""

    method = "painted"

    def __init__(self, gaussians):
        self.owner = torch.zeros(len(gaussians), dtype=torch.long)
        for index, (center, radius, _) in enumerate(SPHERES.values(), start=1):
            near = (gaussians.means - torch.tensor(center)).norm(dim=1) < 1.2 * radius
            self.owner[near] = index

    def gaussian_scores(self, question):
        return torch.stack([(self.owner == int(p.argmax())).float() for p in question.positives])

    def relevancy(self, gaussians, camera, question):
        things = torch.from_numpy(things_seen(camera)).long()
        return torch.stack([(things == int(p.argmax())).float() for p in question.positives])

    def tensors(self):
        return {"owner": self.owner}


def painted_scene(capture, gaussians, method):
    cameras = [view.camera for view in capture.train_views]
    return MethodScene(gaussians, method, cameras, encode_text, QueryConfig())


def test_lerf_3d_scores_what_is_selected_in_space_and_any_method_can_be_measured(capture):
    dense = gaussians_from_points(capture.points, capture.point_colors, sh_degree=0, opacity=0.95)
    config = replace(QUICK, protocols=("strict", "lerf-3d"))
    language = evaluate(capture, painted_scene(capture, dense, PaintedMethod(dense)), config).language
    assert (language["method"], language["form"]) == ("painted", "feature")
    assert language["strict"]["auto"]["mIoU"] == 1
    assert 0.4 < language["lerf_3d"]["mIoU"] < 1, "the silhouette of sparse points is ragged"
    assert "official" not in language
    painted = PaintedMethod(dense)
    painted.owner[:] = 0
    missed = evaluate(capture, painted_scene(capture, dense, painted), config).language
    assert missed["lerf_3d"] == {"mIoU": 0, "acc_25": 0, "acc_50": 0}


def test_boxes_of_the_annotation_decide_about_localization(capture, gaussians):
    elsewhere = {v: {p: np.array([[0.0, 0.0, 1.0, 1.0]]) for p in WORDS} for v in capture.test_names}
    ground_truth = drawn(load_annotations(capture).masks, elsewhere)
    subject = traced(capture, gaussians)
    right = evaluate(capture, subject, QUICK).language["lerf_2d"]
    wrong = evaluate(capture, subject, QUICK, ground_truth=ground_truth).language["lerf_2d"]
    assert wrong["localization"] == 0 < right["localization"]
    assert wrong["mIoU"] == right["mIoU"]


def test_unknown_protocols_are_refused():
    with pytest.raises(ValueError, match="lerf-4d"):
        EvaluationConfig(protocols=("strict", "lerf-4d"))
