"""Features, averages and scenes on workers are those of one process; what fails is told and the rest is kept."""

import contextlib
import dataclasses
import functools
import json
import logging
import os
import shutil
import time
import types
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from support.blind_workers import BlindWorkers
from support.color_encoder import ColorClip, ColorDino
from support.language_scene import make_scene
from support.schemas import SCHEMAS
from support.tiny_capture import write_capture

from lexsplat import cli
from lexsplat.captures import Capture, load_capture
from lexsplat.features import FeatureMap, FeatureMaps, extract_features
from lexsplat.language.methods.averaged import AveragedConfig
from lexsplat.language.methods.averaging import MOST_SHARDS, SHARD_VIEWS, average_features, view_shards
from lexsplat.pipeline import build, distribution, scene_progress
from lexsplat.pipeline.config import BuildConfig
from lexsplat.pipeline.distribution import extract_on_workers, scene_tasks
from lexsplat.runtime.errors import CaptureError, LexsplatError, WorkersError
from lexsplat.runtime.progress import Event
from lexsplat.runtime.workers import ANY_MACHINE, IN_PROCESS, InProcess, SharedFolder

CONFIG = BuildConfig(device="cpu", encoder_device="cpu")
SMALL_BUILD = [
    "--clip", "bundled", "--dino", "none", "--device", "cpu", "--iterations", "20", "--downscale", "2",
    "--features.crop-sizes", "0.5", "--features.crop-strides", "0.5",
]  # fmt: skip
"""Options for scenes of which only the files matter."""


class Encoders:
    clip, dino = ColorClip(), ColorDino()


@pytest.fixture
def capture(tiny_capture, tmp_path, monkeypatch) -> Capture:
    monkeypatch.setattr(distribution, "_encoders", lambda *_: Encoders())
    return load_capture(shutil.copytree(tiny_capture, tmp_path / "capture"))


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("visible", [True, False], ids=["shared files", "object store"])
def test_features_of_workers_are_those_of_one_process(visible, capture, tmp_path, monkeypatch):
    monkeypatch.setattr(SharedFolder, "is_visible", visible)
    events, cache = [], tmp_path / "cache"
    extract_on_workers(capture, CONFIG, Encoders(), cache, IN_PROCESS, events.append)
    assert [event.done for event in events] == list(range(1, 13))
    torch.set_num_threads(1)
    extract_features(capture, ColorClip(), ColorDino(), CONFIG.features, cache_dir=tmp_path / "one")
    assert files(cache) == files(tmp_path / "one")
    extract_on_workers(capture, CONFIG, Encoders(), cache, IN_PROCESS, events.append)
    assert len(events) == 12, "nothing is missing any more"


@pytest.mark.slow
def test_a_broken_photo_is_reported_and_the_other_views_are_kept(capture, tmp_path):
    broken = capture.views["view_03.png"].image_path
    broken.write_bytes(broken.read_bytes()[:2000])
    with pytest.raises(CaptureError, match=r"view_03\.png"):
        extract_on_workers(capture, CONFIG, Encoders(), tmp_path / "cache", IN_PROCESS)
    assert len(files(tmp_path / "cache")) == 22, "two files for each of eleven views"


def test_a_photo_that_a_worker_does_not_see_is_reported_with_the_remedy(capture, tmp_path):
    capture.views["view_05.png"].image_path.unlink()
    view = capture.views["view_05.png"]
    with SharedFolder.offered(tmp_path / "cache") as cache:
        shared = distribution._Extraction(capture, CONFIG, cache)
        with pytest.raises(CaptureError, match=r"a photo that every worker sees.*every node mounts"):
            distribution._extract_view(shared, view)


@pytest.mark.parametrize("count", [1, 16, 17, 5000])
def test_shards_depend_on_the_views_alone(count):
    names = [f"{i:05}" for i in range(count)]
    shards = view_shards(names)
    assert [name for shard in shards for name in shard] == names
    assert len(shards) <= MOST_SHARDS
    assert all(len(shard) >= min(SHARD_VIEWS, count) for shard in shards[:-1])


def test_feature_maps_travel_without_what_they_keep():
    import pickle

    maps = FeatureMaps(["a"], _one_map)
    assert maps["a"] is maps["a"]
    copy = pickle.loads(pickle.dumps(maps))
    assert copy.cached_bytes == 0
    assert torch.equal(copy["a"].clip, maps["a"].clip)


def _one_map(name):
    return FeatureMap(torch.ones(2, 2, 3))


class Stored(Mapping):
    """Feature maps in the files of a folder."""

    def __init__(self, folder, names):
        self.folder, self.names = folder, names

    def __getitem__(self, name):
        return FeatureMap(torch.from_numpy(np.load(self.folder / f"{name}.npy")))

    def __iter__(self):
        return iter(self.names)

    def __len__(self):
        return len(self.names)


def test_averages_of_workers_that_do_not_see_the_scene_folder_are_those_of_one_process(tmp_path):
    made = make_scene()
    eight = list(made.cameras.values())
    cameras = {f"{number:02}": eight[number % 8] for number in range(40)}
    maps = Stored(tmp_path / "scene", list(cameras))
    maps.folder.mkdir()
    rng = np.random.default_rng(0)
    for name in cameras:
        np.save(maps.folder / f"{name}.npy", rng.normal(size=(6, 8, 5)).astype(np.float16))
    workers = BlindWorkers(maps.folder)
    found = [
        average_features(
            made.gaussians, cameras, maps, AveragedConfig(), memory=memory, scratch=maps.folder, workers=each
        )
        for each, memory in ((IN_PROCESS, 1 << 30), (workers, 1 << 30), (workers, 1 << 16))
    ]
    assert workers.tasks > 4, "two shards, and several ranges of dimensions where memory is short"
    for other in found[1:]:
        assert np.array_equal(found[0].means, other.means)
        assert torch.equal(found[0].totals, other.totals)


class ElsewhereWorkers(InProcess):
    """Tasks in this process, in another working folder."""

    distributed = True

    def __init__(self, folder):
        self.folder, self.required = folder, []

    def require(self, paths):
        self.required += paths

    def map(self, work, shared, items, needs=ANY_MACHINE):
        for name in items:
            item = items[name]
            before = Path.cwd()
            os.chdir(self.folder)
            try:
                (outcome,) = super().map(work, shared, {name: item})
            finally:
                os.chdir(before)
            yield outcome


@contextlib.contextmanager
def opened(workers, given, paths=()):
    """In place of `open_workers`."""
    workers.require(paths)
    yield workers


@pytest.mark.slow
def test_relative_paths_serve_workers_with_another_working_folder(tmp_path, monkeypatch, capsys):
    (tmp_path / "elsewhere").mkdir()
    write_capture(tmp_path / "capture", views=6)
    monkeypatch.chdir(tmp_path)
    workers = ElsewhereWorkers(tmp_path / "elsewhere")
    monkeypatch.setattr(build, "open_workers", functools.partial(opened, workers))
    made = ["build", "capture", "--output", "scene", *SMALL_BUILD, "--workers", "ray", "--blocks", "2"]
    assert cli.main(made) == 0
    assert "scene: finished reconstruct, features, language" in capsys.readouterr().out.splitlines()
    assert (tmp_path / "scene" / "language.safetensors").exists()
    assert list((tmp_path / "elsewhere").iterdir()) == []
    assert all(path.is_absolute() for path in workers.required)


def test_folders_of_settings_get_full_paths(tmp_path, monkeypatch):
    (tmp_path / "own").mkdir()
    monkeypatch.chdir(tmp_path)
    config = BuildConfig(clip="own", dino="facebook/dino", features_from=Path("features"))
    found = scene_tasks({Path("room"): config}, Path("scenes"))["room"].config
    assert (found.clip, found.dino) == (str(tmp_path / "own"), "facebook/dino")
    assert found.features_from == tmp_path / "features"


def test_a_cluster_that_is_not_there_is_reported_before_anything_is_written(
    tiny_capture, tmp_path, monkeypatch
):
    def refuse(*_):
        raise WorkersError("Ray at head:1", expected="a running cluster")

    monkeypatch.setattr(build, "open_workers", refuse)
    with pytest.raises(WorkersError, match="a running cluster"):
        build.build(tiny_capture, tmp_path / "scene", dataclasses.replace(CONFIG, workers="ray"))
    assert not (tmp_path / "scene").exists()


def test_an_output_that_a_worker_does_not_see_is_one_line_and_not_one_a_scene(tmp_path):
    class Blind(InProcess):
        def see(self, folder):
            return False

    tasks = scene_tasks({tmp_path / name: CONFIG for name in ("bath", "attic")}, tmp_path / "scenes")
    with pytest.raises(WorkersError, match="scenes: expected a folder that every worker sees"):
        list(distribution.build_scenes(tasks, tmp_path / "scenes", Blind()))


def test_a_folder_that_is_a_scene_and_holds_scenes_is_warned_of(tmp_path, caplog):
    from lexsplat.cli.build import Build

    (tmp_path / "s" / "attic").mkdir(parents=True)
    (tmp_path / "s" / "attic" / "scene.json").write_text("{}")
    for more, what in ((), "holds the scenes of several captures"), (("b",), "is the scene of one capture"):
        if more:
            (tmp_path / "s" / "scene.json").write_text("{}")
        with contextlib.suppress(LexsplatError):
            Build(str(tmp_path / "none"), tmp_path / "s", more=more).run()
        assert what in caplog.messages[-1]
        assert "one CAPTURE is written into --output itself" in caplog.messages[-1]


@pytest.mark.slow
def test_what_killed_commands_left_is_removed_when_it_serves_no_more(tiny_capture, tmp_path):
    output = tmp_path / "scene"
    left = output / "checkpoints" / "blocks" / "0-00018.safetensors"
    mark = output / "checkpoints" / "features" / ".workers-0"
    above = output / "checkpoints" / ".workers-1"
    for path in (left, mark, above):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert cli.main(["reconstruct", str(tiny_capture), "--output", str(output), *SMALL_BUILD]) == 0
    assert not left.parent.exists()
    assert not mark.exists()
    assert not above.exists()


def test_two_captures_of_one_name_are_refused(tmp_path):
    sources = {tmp_path / "a" / "room": CONFIG, tmp_path / "b" / "room": CONFIG}
    with pytest.raises(CaptureError, match="expected captures of different names"):
        scene_tasks(sources, tmp_path / "scenes")
    tasks = scene_tasks({tmp_path / "room": dataclasses.replace(CONFIG, workers="ray")}, tmp_path / "scenes")
    assert tasks["room"].config.workers == "none"
    assert tasks["room"].output == tmp_path / "scenes" / "room"


class FromAnotherProcess(InProcess):
    """Workers that do not share the listener, as those of Ray; they wait until their event was read."""

    distributed = True


@pytest.mark.parametrize("workers", [IN_PROCESS, FromAnotherProcess()], ids=["in process", "workers"])
def test_events_and_warnings_of_scenes_carry_their_names(workers, tmp_path, monkeypatch, caplog):
    def build_one(source, output, config, until, listener):
        if source.name == "attic":
            raise CaptureError(source, expected="photos", found="none")
        logging.getLogger("lexsplat").warning("%d photos are dark", 3)
        listener(Event("features", 1, 9))
        wanted = time.monotonic() + 20
        while workers.distributed and not any(event.stage == "features" for event in events):
            assert time.monotonic() < wanted
            time.sleep(0.05)
        return types.SimpleNamespace(record={"stages": ["features"]})

    events: list[Event] = []
    monkeypatch.setattr(build, "build", build_one)
    monkeypatch.setattr(scene_progress, "_READ_SECONDS", 0.05)
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / ".progress-attic.json").write_text('["left", 1, 2, {}]')
    tasks = scene_tasks({tmp_path / name: CONFIG for name in ("attic", "bath")}, tmp_path / "scenes")
    list(distribution.build_scenes(tasks, tmp_path / "scenes", workers, events.append))
    assert [(event.scene, event.stage, event.done) for event in events] == [
        ("", "scenes", 0), ("attic", "failed", 1), ("", "scenes", 1),
        ("bath", "features", 1), ("bath", "finished", 1), ("", "scenes", 2),
    ]  # fmt: skip
    assert events[-1].metrics["failed"] == 1
    assert list((tmp_path / "scenes").iterdir()) == []
    if not workers.distributed:  # those of workers are named by the engine
        assert caplog.messages == ["bath: 3 photos are dark"]


@pytest.mark.slow
def test_many_captures_make_many_scenes_and_one_that_fails_is_reported(tmp_path, capsys):
    for name in ("bath", "kitchen"):
        write_capture(tmp_path / "captures" / name, views=4)
    (tmp_path / "captures" / "attic").mkdir()
    rooms = [str(path) for path in sorted((tmp_path / "captures").iterdir())]
    arguments = ["build", *rooms, "--output", str(tmp_path / "scenes"), *SMALL_BUILD]
    assert cli.main(arguments) == 1
    said = capsys.readouterr()
    assert "error: " in said.err
    assert "expected 3 scenes, found 1 failed, listed above" in said.err
    assert "attic: " in said.err
    assert "bath: features: " in said.err, "the stages of each scene are shown, not only the number of scenes"
    assert "scenes: 0/3" in said.err
    for name in ("bath", "kitchen"):
        assert (tmp_path / "scenes" / name / "language.safetensors").exists()
        assert f"{name}: finished reconstruct, features, language" in said.out


@pytest.mark.slow
def test_progress_as_json_is_one_event_a_line_in_its_schema(tiny_capture, tmp_path, capsys):
    from jsonschema import Draft202012Validator

    schema = Draft202012Validator(json.loads((SCHEMAS / "progress.json").read_text()))
    arguments = ["reconstruct", str(tiny_capture), "--output", str(tmp_path / "s"), *SMALL_BUILD]
    assert cli.main([*arguments, "--progress", "json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {event["stage"] for event in events} == {"reconstruct"}
    for event in events:
        schema.validate(event)
    assert events[-1]["done"] == events[-1]["total"] == 20
    assert events[-1]["seconds_left"] == 0
