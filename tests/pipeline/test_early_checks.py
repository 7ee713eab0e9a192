"""What a build refuses or tells before it works for hours."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import color_encoder
from support.refusals import assert_reports
from support.written_captures import save

from lexsplat.captures import load_capture
from lexsplat.captures.readers.video import require_video
from lexsplat.evaluation.demo import demo_capture
from lexsplat.pipeline import build as pipeline
from lexsplat.pipeline.build import build
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.encoding import check_encoders
from lexsplat.reconstruction import ReconstructionConfig
from lexsplat.runtime.errors import BackendError, CaptureError, FileFormatError, LexsplatError, ModelError
from lexsplat.runtime.progress import NOTE
from lexsplat.scenes.folder import BUNDLED_SCENE, SceneFolder

pytestmark = pytest.mark.slow

CONFIG = BuildConfig(clip="bundled", dino="none", device="cpu", iterations=2)


@pytest.fixture
def photos(tmp_path, monkeypatch) -> Path:
    """Photos without cameras; structure from motion must not be reached."""
    folder = tmp_path / "photos"
    for number in range(4):
        save(folder / "images" / f"{number}.png", np.full((60, 80, 3), number / 4))
    monkeypatch.setattr(
        "lexsplat.pipeline.inputs.poses_from_photos", lambda *_, **__: pytest.fail("too late")
    )
    return folder


def refused(
    source: Path | None, output: Path, *parts: str, kind=CaptureError, config=CONFIG, **options
) -> None:
    with pytest.raises(kind) as caught:
        build(source, output / "new" / "scene", config, **options)
    assert isinstance(caught.value, LexsplatError)
    assert_reports(caught.value, *parts)
    assert not output.exists(), "nothing half-written, and no empty folder"


def test_an_empty_output_folder_stays_and_stays_empty_after_a_refused_build(photos, tmp_path):
    output = tmp_path / "scene"
    output.mkdir()
    with pytest.raises(ModelError):
        build(photos, output, replace(CONFIG, clip=str(tmp_path / "nowhere")))
    assert list(output.iterdir()) == []


@pytest.mark.parametrize(
    ("cameras", "named"),
    [(False, ""), (True, ""), (True, "transforms.json")],
    ids=["photos alone", "with cameras", "file of cameras"],
)
@pytest.mark.parametrize("inside", ["", "images"])
def test_a_scene_is_not_mixed_into_its_capture(photos, tiny_capture, tmp_path, cameras, named, inside):
    capture = shutil.copytree(tiny_capture, tmp_path / "capture") if cameras else photos
    if named:
        (capture / named).write_text("{}")
    before = {path: path.stat().st_mtime_ns for path in capture.rglob("*")}
    with pytest.raises(CaptureError) as caught:
        build(capture / named, capture / inside, CONFIG)
    assert_reports(
        caught.value, str(capture / inside), "an output folder of its own", "of the capture", "--output"
    )
    assert {path: path.stat().st_mtime_ns for path in capture.rglob("*")} == before


def test_ground_truth_is_checked_before_structure_from_motion(photos, tmp_path):
    save(photos / "segmentations" / "2" / "wall.png", np.ones((60, 60)))
    refused(photos, tmp_path / "out", "wall.png", "80x60", "60x60")
    shutil.rmtree(photos / "segmentations")
    save(photos / "segmentations" / "9" / "wall.png", np.ones((60, 80)))
    refused(photos, tmp_path / "out", "segmentations/9", "no view of that name")


@pytest.mark.parametrize(
    ("files", "told"),
    [(None, "no such folder"), ([], "an empty folder"), (["0.png", "1.png"], "at least 3 photos")],
)
def test_a_missing_capture_is_reported_before_an_encoder_is_fetched(files, told, tmp_path, monkeypatch):
    source = tmp_path / "capture"
    if files is not None:
        source.mkdir()
    for name in files or []:
        save(source / name, np.zeros((60, 80, 3)))
    monkeypatch.setattr(pipeline, "fetch_clip", lambda _: pytest.fail("fetched before"))
    refused(source, tmp_path / "out", "capture", told)


def test_held_out_names_are_checked_before_structure_from_motion(photos, tmp_path):
    refused(photos, tmp_path / "out", "'7'", "matches no view", test_names=["7"])


def test_a_photo_that_is_none_is_reported_before_structure_from_motion(photos, tmp_path):
    (photos / "images" / "3.png").write_text("no image")
    refused(photos, tmp_path / "out", "3.png")


def test_encoders_are_checked_before_structure_from_motion(photos, clip_folder, tmp_path):
    folder = shutil.copytree(clip_folder, tmp_path / "clip")
    (folder / "tokenizer.json").unlink()
    refused(photos, tmp_path / "out", "tokenizer", kind=ModelError, config=replace(CONFIG, clip=str(folder)))


@pytest.mark.parametrize("number", [errno.EACCES, errno.ENOSPC])
def test_an_error_of_the_system_before_the_first_stage_leaves_nothing(
    tiny_capture, tmp_path, monkeypatch, number
):
    def fail(*_):
        raise OSError(number, os.strerror(number), "weights")

    monkeypatch.setattr("lexsplat.pipeline.build.check_encoders", fail)
    with pytest.raises(OSError, match="weights"):
        build(tiny_capture, tmp_path / "scene", CONFIG)
    assert not (tmp_path / "scene").exists(), "nothing half-written"


def test_masks_are_checked_before_features_are_searched(tmp_path):
    folder, stages = tmp_path / "photos", []
    for number in range(4):
        save(folder / f"{number}.png", np.full((60, 80, 3), number / 4))
    save(folder / "masks" / "2.png", np.ones((60, 60)))
    refused(folder, tmp_path / "out", "2.png", "60x60", listener=lambda event: stages.append(event.stage))
    assert "poses" not in stages


def test_photos_that_become_too_small_are_refused_before_structure_from_motion(photos, tmp_path):
    config = replace(CONFIG, downscale=1000.0)
    refused(photos, tmp_path / "out", "at least 6 pixels a side", "smaller --downscale", config=config)


def test_splats_need_cameras(photos, tmp_path):
    refused(photos, tmp_path / "out", "without cameras", splats=BUNDLED_SCENE / "gaussians.ply")


@pytest.mark.parametrize("name", ["notes.txt", "splats.pt"])
def test_files_that_are_no_splats_are_refused_before_an_encoder_is_loaded(name, tmp_path, monkeypatch):
    monkeypatch.setattr("lexsplat.pipeline.build.check_encoders", lambda *_, **__: pytest.fail("too late"))
    (tmp_path / name).write_bytes(b"no splats")
    refused(None, tmp_path / "out", name, splats=tmp_path / name, kind=FileFormatError)


def test_a_video_that_is_missing_is_reported_before_an_encoder_is_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr("lexsplat.pipeline.build.check_encoders", lambda *_, **__: pytest.fail("too late"))
    refused(tmp_path / "walk.mp4", tmp_path / "out", "walk.mp4: expected a video, found no such file")


def test_a_missing_reader_of_videos_is_reported_before_an_encoder_is_loaded(tmp_path, monkeypatch):
    (tmp_path / "walk.mp4").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "av", None)  # importing it fails
    monkeypatch.setattr(pipeline, "fetch_clip", lambda _: pytest.fail("too late"))
    refused(tmp_path / "walk.mp4", tmp_path / "out", "walk.mp4", "PyAV", "lexsplat[video]", kind=BackendError)
    frames = tmp_path / "scene" / "poses" / "images"
    frames.mkdir(parents=True)
    (frames / "frames.json").write_text("{}")
    require_video(tmp_path / "walk.mp4", frames)  # what is kept needs no reader


def test_splats_of_another_place_are_refused_and_those_of_the_place_taken(tmp_path):
    splats = BUNDLED_SCENE / "gaussians.ply"
    options = {"splats": splats, "until": "reconstruct"}
    folder = build(demo_capture("tabletop"), tmp_path / "own", CONFIG, **options)
    assert folder.record["stages"]["reconstruct"]["splats"] == str(splats)
    refused(demo_capture("second"), tmp_path / "other", "gaussians.ply", "correlate", **options)


def test_a_gpu_without_a_compiler_is_reported_before_anything_is_written(photos, tmp_path, monkeypatch):
    def without_extension(instead):
        raise BackendError("gsplat", expected="its extension", found="none", remedy=f"use {instead}")

    monkeypatch.setattr(pipeline, "choose_device", lambda wanted: "cuda")
    monkeypatch.setattr(pipeline, "require_gsplat", without_extension)
    refused(photos, tmp_path / "out", "--device cpu --encoder-device cuda", kind=BackendError)


def test_an_encoder_device_that_is_missing_is_reported_before_anything_is_written(
    photos, tmp_path, monkeypatch
):
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: False)
    config = replace(CONFIG, encoder_device="mps")
    refused(photos, tmp_path / "out", "--encoder-device mps", kind=BackendError, config=config)


def test_bundled_encoders_warn_of_other_places(tiny_capture, caplog):
    with caplog.at_level(logging.WARNING, logger="lexsplat"):
        check_encoders(CONFIG.resolved("cpu", (96, 72)), demo_capture("second"))
        assert not caplog.messages
        check_encoders(CONFIG.resolved("cpu", (96, 72)), tiny_capture)
    assert "knows only scenes like the demo's" in caplog.text


def test_the_time_of_the_features_is_reported_first(clip_folder, tmp_path, caplog):
    config = replace(CONFIG, clip=str(clip_folder)).resolved("cpu", (400, 300))
    with caplog.at_level(NOTE, logger="lexsplat"):
        events = []
        check_encoders(config, tmp_path, 5_000, (400, 300), events.append)
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("encoders", done, 4) for done in range(5)
    ]
    # The encoder has patches. Crops of 46 pixels every 27.6 or less: 14 x 11.
    assert "features on cpu: 154 crops and about" in caplog.text
    assert "for 5,000 training photos" in caplog.text
    assert "words match bundled images by" in caplog.text, "random weights match no words"


@pytest.mark.parametrize(("photos", "told"), [(99, False), (5_000, True)])
def test_bundled_encoders_tell_the_time_of_many_photos_first(photos, told, caplog):
    with caplog.at_level(NOTE, logger="lexsplat"):
        check_encoders(CONFIG.resolved("cpu", (96, 72)), demo_capture("second"), photos, (96, 72))
    assert (f"for {photos:,} training photos" in caplog.text or "at most" in caplog.text) == told


def test_a_build_that_stops_for_its_encoder_goes_on_from_what_was_finished(
    tiny_capture, tmp_path, monkeypatch
):
    class Failing(color_encoder.ColorClip):
        works = True

        def encode_images(self, images):
            if not Failing.works:
                raise ModelError(
                    "model color", expected="finite features", found="NaN", remedy="choose another"
                )
            return super().encode_images(images)

    color_encoder.install(monkeypatch)
    settings = ReconstructionConfig(max_gaussians=400)
    config = BuildConfig(dino="none", device="cpu", iterations=2, reconstruction=settings)
    monkeypatch.setattr("lexsplat.features.encoders.load_clip", lambda *_: Failing())

    def stop(event):
        Failing.works = event.stage != "features" or event.done < 3

    with pytest.raises(ModelError, match="finite features"):
        build(tiny_capture, tmp_path / "scene", config, listener=stop)
    assert list(SceneFolder.open(tmp_path / "scene").record["stages"]) == ["reconstruct"]
    stored = list((tmp_path / "scene" / "checkpoints" / "features").glob("*.safetensors"))
    views = len(load_capture(tiny_capture).train_names)
    assert 0 < len(stored) < views
    first, kept = [], {}
    color_encoder.install(monkeypatch)

    def listen(event):
        first.append((event.stage, event.done))
        kept[event.stage] = bool(event.metrics.get("kept"))

    build(tiny_capture, tmp_path / "scene", config, listener=listen)
    assert kept["reconstruct"]
    assert next(done for stage, done in first if stage == "features") == len(stored)
