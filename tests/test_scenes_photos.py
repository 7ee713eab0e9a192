import numpy as np
import pytest
from captures import save
from test_scenes import assert_tells, fails
from test_scenes_triangulation import texture

from lexsplat.cameras import look_at
from lexsplat.errors import CaptureError
from lexsplat.scenes import load_scene, poses_from_photos

SIZE = (240, 180)
COUNT = 9


def room_cameras() -> list:
    return [
        look_at(
            [1.0 + 0.5 * np.cos(a), 0.9 + 0.3 * np.sin(2 * a), 1.0 + 0.5 * np.sin(a)],
            [0.2, 0.2, 0.2],
            [0, 1, 0],
            *SIZE,
            0.9,
        )
        for a in np.linspace(-0.6, 2.0, COUNT)
    ]


def room_photo(camera, textures: list[np.ndarray]) -> np.ndarray:
    """A corner of a room: the planes x = 0, y = 0 and z = 0, each with its texture over 2 units."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.K).T @ camera.viewmat[:3, :3]
    with np.errstate(divide="ignore"):
        distance = -camera.position / rays
    distance[distance <= 0] = np.inf
    wall = distance.argmin(-1)
    hit = camera.position + rays * distance.min(-1)[..., None]
    image = np.zeros((SIZE[1], SIZE[0], 3))
    for axis, pattern in enumerate(textures):
        on_axis = wall == axis
        u, v = np.abs(np.delete(hit, axis, -1)[on_axis].T) * 128
        low_u, low_v = np.minimum(u.astype(int), 254), np.minimum(v.astype(int), 254)
        fu, fv = np.clip(u - low_u, 0, 1)[:, None], np.clip(v - low_v, 0, 1)[:, None]
        rows = [pattern[low_v + d, low_u] * (1 - fu) + pattern[low_v + d, low_u + 1] * fu for d in (0, 1)]
        image[on_axis] = rows[0] * (1 - fv) + rows[1] * fv
    return image


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    textures = [texture(), np.flip(texture(), 0), np.roll(texture(), 1, 2)]
    for index, camera in enumerate(room_cameras()):
        save(folder / f"{index}.png", room_photo(camera, textures))
    save(folder / "unrelated.png", np.full((SIZE[1], SIZE[0], 3), 0.5))
    events = []
    return folder, poses_from_photos(folder, tmp_path_factory.mktemp("poses"), listener=events.append), events


def test_photos_are_placed_and_the_one_that_cannot_be_is_named(room):
    _, poses, events = room
    assert poses.placed == tuple(f"{index}.png" for index in range(COUNT))
    assert poses.left_out == ("unrelated.png",)
    assert "9 of 10 photos placed" in poses.note
    assert events[-1].done == events[-1].total
    assert events[-1].metrics == {"placed": 9, "photos": 10}


def test_estimated_poses_are_the_true_ones_up_to_a_similarity(room):
    folder, poses, _ = room
    scene = load_scene(poses.root, images=folder, test_every=0)
    truth = room_cameras()
    found = [scene.views[f"{index}.png"].camera for index in range(COUNT)]
    for a in range(COUNT):
        for b in range(a):
            turns = [c[a].viewmat[:3, :3] @ c[b].viewmat[:3, :3].T for c in (truth, found)]
            cosine = (np.trace(turns[0].T @ turns[1]) - 1) / 2
            assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 1.0
    distances = [
        np.array([np.linalg.norm(c[a].position - c[b].position) for a in range(COUNT) for b in range(a)])
        for c in (truth, found)
    ]
    ratio = distances[1] / distances[0]
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=0.1)
    assert len(scene.points) == poses.points > 200


def test_folders_that_are_no_capture_are_told(tmp_path):
    for folder, found in ((tmp_path / "nowhere", "no such folder"), (tmp_path, "found 0")):
        with pytest.raises(CaptureError) as caught:
            poses_from_photos(folder, tmp_path / "out")
        assert_tells(caught.value, str(folder), found)


def test_photos_that_do_not_overlap_leave_no_output(tmp_path):
    for index in range(3):
        save(tmp_path / "photos" / f"{index}.png", np.full((60, 80, 3), 0.3 * index))
    with pytest.raises(CaptureError) as caught:
        poses_from_photos(tmp_path / "photos", tmp_path / "out")
    assert_tells(caught.value, "3 photos of which none")
    assert not (tmp_path / "out").exists()
    (tmp_path / "photos" / "1.png").write_bytes(b"no image")
    with pytest.raises(CaptureError) as caught:
        poses_from_photos(tmp_path / "photos", tmp_path / "out")
    assert_tells(caught.value, "1.png")
    fails(tmp_path / "photos", "lexsplat poses")
