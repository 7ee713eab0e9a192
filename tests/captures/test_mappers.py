"""The ladder of mappers: which one finds the model, and what is shown meanwhile."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.rooms import FEW, SIZE, room_photo
from support.written_captures import save

from lexsplat.captures import PoseConfig, load_capture, poses_from_photos
from lexsplat.captures.sfm import mapping, photos
from lexsplat.captures.sfm.mapping import Attempt
from lexsplat.geometry.cameras import look_at
from lexsplat.runtime.progress import Event

pytestmark = pytest.mark.usefixtures("own_size_features")


@pytest.mark.slow
def test_forward_facing_photos_are_registered_by_a_more_lenient_mapper(tmp_path):
    """All photos see each point within about 5 degrees; pycolmap starts from 16 and tries 8."""
    angles = np.linspace(0.0, 0.18, 6)
    cameras = [
        look_at([1 + 0.5 * np.cos(a), 0.9, 1 + 0.5 * np.sin(a)], [0.2] * 3, [0, 1, 0], *SIZE, 0.9)
        for a in angles
    ]
    for index, camera in enumerate(cameras):
        save(tmp_path / "photos" / f"{index}.png", room_photo(camera))
    poses = poses_from_photos(tmp_path / "photos", tmp_path / "out", PoseConfig(max_features=FEW))
    assert len(poses.registered) == len(cameras)
    assert poses.mapper != "incremental"
    assert f'found by the mapper "{poses.mapper}"' in poses.note
    views = load_capture(poses.root, images=poses.images, test_every=0).views
    found = np.stack([views[f"{index}.png"].camera.position for index in range(len(cameras))])
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    np.testing.assert_allclose(steps / steps.mean(), 1, atol=0.1)  # the true steps are equal


def test_the_model_with_more_photos_wins_and_then_the_one_with_less_error():
    def attempt(photos: int, error: float) -> Attempt:
        model = SimpleNamespace(num_reg_images=lambda: photos, compute_mean_reprojection_error=lambda: error)
        return Attempt("incremental", model, 1)

    attempts = [attempt(24, 0.2), attempt(25, 0.7), attempt(25, 0.6)]
    assert max(attempts, key=lambda each: each.rank) is attempts[2]


def test_the_global_mapper_which_reports_nothing_is_shown_while_it_runs(monkeypatch):
    monkeypatch.setattr(mapping, "map_photos", lambda *_: None)
    assert attempted("global", 2) == [("global mapper", 0, 1), ("global mapper", 1, 1)]


def test_the_bar_of_the_mapper_counts_registered_photos_and_no_more_than_there_are(monkeypatch):
    def three_photos_of_which_one_is_tried_again(*arguments) -> None:
        for _ in range(4):
            arguments[-1]()

    monkeypatch.setattr(mapping, "map_photos", three_photos_of_which_one_is_tried_again)
    found = [event for event in attempted("incremental", 3) if event[0] == "mapping"]
    assert found == [("mapping", done, 3) for done in (0, 2, 2, 2, 2, 3)]


def attempted(mapper: str, count: int) -> list[tuple[str, int, int]]:
    """Stage, units done and all units of the events of an attempt that finds nothing."""
    events: list[Event] = []
    names = SimpleNamespace(names=("a.jpg",) * count)
    assert photos._attempt(Path("a.db"), names, mapper, 0, events.append, all_pairs=False) is None
    return [(event.stage, event.done, event.total) for event in events]


@pytest.mark.parametrize(
    ("photos", "threads", "size"), [(8, 2, 2), (12, 2, 4), (15, 2, 4), (300, 2, 8), (12, 1, 3), (300, 32, 32)]
)
def test_features_come_in_calls_that_leave_no_thread_idle_and_allow_a_forecast(photos, threads, size):
    assert mapping.batch_size(photos, threads) == size
    assert size <= photos / 3 or size == threads
