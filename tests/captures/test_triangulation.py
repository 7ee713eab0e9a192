import numpy as np
import pytest
from support.rooms import texture
from support.written_captures import save, write_json, write_transforms

from lexsplat.captures import initial_points, load_capture, random_points_in_frusta, triangulate
from lexsplat.captures.sfm import triangulation
from lexsplat.captures.sfm.triangulation import matching_pairs
from lexsplat.geometry.cameras import OPENGL_TO_OPENCV, look_at

pytestmark = pytest.mark.slow

SIZE = (160, 120)


def on_the_wall(camera) -> np.ndarray:
    """Intersections of the pixels' rays with the plane z = 0, ``[H, W, 2]``."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.K).T @ camera.viewmat[:3, :3]
    return (camera.position - rays * (camera.position[2] / rays[..., 2:]))[..., :2]


def write_wall(root, pattern: np.ndarray, count: int = 6) -> None:
    """Cameras in an arc in front of a textured wall from -1 to 1 in the plane z = 0."""
    frames = []
    for index, x in enumerate(np.linspace(-1, 1, count)):
        camera = look_at([x, 0.2 * x, 2.2], [0.1 * x, 0, 0], [0, 1, 0], *SIZE, 0.6)
        where = ((on_the_wall(camera) + 1) * 128).clip(0, 254.999)
        low = where.astype(int)
        f = (where - low)[..., None, :]
        u, v = low[..., 0], low[..., 1]
        top = pattern[v, u] * (1 - f[..., 0]) + pattern[v, u + 1] * f[..., 0]
        bottom = pattern[v + 1, u] * (1 - f[..., 0]) + pattern[v + 1, u + 1] * f[..., 0]
        save(root / "images" / f"{index}.png", top * (1 - f[..., 1]) + bottom * f[..., 1])
        pose = np.linalg.inv(camera.viewmat) @ OPENGL_TO_OPENCV
        focal = float(camera.K[0, 0])
        frames.append(
            {
                "file_path": f"images/{index}.png",
                "transform_matrix": pose.tolist(),
                "fl_x": focal,
                "fl_y": focal,
            }
        )
    write_json(root, {"frames": frames, "w": SIZE[0], "h": SIZE[1]})


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    root = tmp_path_factory.mktemp("wall")
    write_wall(root, texture())
    return load_capture(root, test_every=0)


@pytest.fixture(scope="module")
def triangulated(wall, tmp_path_factory):
    cache = tmp_path_factory.mktemp("cache")
    events = []
    return *triangulate(wall, cache_dir=cache, listener=events.append), cache, events


def test_triangulated_points_lie_on_the_wall(triangulated):
    positions, *_ = triangulated
    assert len(positions) > 300
    assert np.median(np.abs(positions[:, 2])) < 0.01
    assert np.mean(np.abs(positions[:, 2]) < 0.05) > 0.95
    assert np.abs(positions[:, :2]).max() < 1.1


def test_triangulated_points_have_the_colors_of_the_wall(triangulated):
    positions, colors, *_ = triangulated
    where = ((positions[:, :2] + 1) * 128).clip(0, 255).astype(int)
    ground_truth = texture()[where[:, 1], where[:, 0]]
    right = np.abs(colors - ground_truth).mean()
    wrong = np.abs(np.random.default_rng(0).permutation(colors) - ground_truth).mean()
    assert right < 0.4 * wrong


def test_the_units_of_features_and_matching_are_counted_for_their_forecasts(wall, monkeypatch):
    counts: dict[str, list[tuple[int, int]]] = {}

    def counted(stage: str, units: str, enough: float = 1.0):
        found = counts.setdefault(stage, [])
        return lambda done, total: found.append((done, total))

    monkeypatch.setattr(triangulation, "FirstUnits", counted)
    triangulate(wall)
    batches = [done for done, _ in counts["SIFT features"]]
    assert batches == sorted({*range(0, 6, batches[1]), 6})
    assert {total for _, total in counts["SIFT features"]} == {6}
    assert (counts["matching"][0], counts["matching"][-1]) == ((0, 15), (15, 15))


def test_triangulation_reports_progress_and_is_deterministic(wall, triangulated):
    positions, colors, _, events = triangulated
    assert {event.stage for event in events} == {"triangulate", "matching"}
    own = [event.done for event in events if event.stage == "triangulate"]
    assert own == sorted(own)
    matched = [event for event in events if event.stage == "matching"]
    assert (matched[0].done, matched[-1].done) == (0, matched[0].total)
    assert (events[-1].done, events[-1].metrics) == (events[-1].total, {"points": len(positions)})
    again = triangulate(wall)
    np.testing.assert_array_equal(again[0], positions)
    np.testing.assert_array_equal(again[1], colors)


def test_masked_pixels_are_not_matched(tmp_path):
    """The wall at x < 0 is masked in all photos but one, which has no mask."""
    write_wall(tmp_path, texture())
    capture = load_capture(tmp_path, test_every=0)
    for name, view in list(capture.views.items())[1:]:
        save(tmp_path / "masks" / f"{name}.png", (on_the_wall(view.camera)[..., :1] > 0).repeat(3, 2))
    positions, _ = triangulate(load_capture(tmp_path, test_every=0))
    assert len(positions) > 100
    assert positions[:, 0].min() > -0.02


def test_cached_points_are_used_until_a_pose_changes_or_the_file_is_damaged(wall, triangulated, monkeypatch):
    from lexsplat.captures.sfm import triangulation

    positions, _, cache, _ = triangulated
    (file,) = cache.iterdir()

    def refuse(*args):
        raise AssertionError("triangulated again")

    monkeypatch.setattr(triangulation, "_run_pycolmap", refuse)
    np.testing.assert_array_equal(triangulate(wall, cache_dir=cache)[0], positions)
    with pytest.raises(AssertionError, match="again"):
        triangulate(wall, cache_dir=cache, seed=1)
    whole = file.read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"PK" + whole[:100]):
        file.write_bytes(content)
        with pytest.raises(AssertionError, match="again"):
            triangulate(wall, cache_dir=cache)
    file.write_bytes(whole)


def test_initial_points_are_triangulated_where_possible(wall, triangulated):
    found = initial_points(wall, cache_dir=triangulated[2])
    assert found.origin == "triangulated"
    np.testing.assert_array_equal(found.points, triangulated[0])
    assert f"{len(triangulated[0]):,} points triangulated" in found.note


def test_initial_points_are_random_on_a_wall_without_texture_and_a_warning_says_so(tmp_path, caplog):
    write_wall(tmp_path, np.full((256, 256, 3), [0.2, 0.4, 0.6]), count=3)
    found = initial_points(load_capture(tmp_path, test_every=0), count=500)
    assert found.origin == "random"
    told = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert sum(found.note in each for each in told) == 1  # another one says that the photos are copies
    assert "500 random points" in found.note
    np.testing.assert_allclose(found.colors, np.tile([0.2, 0.4, 0.6], (500, 1)), atol=0.01)


def test_random_points_are_seen_by_most_views_and_follow_the_seed(wall):
    points, colors = random_points_in_frusta(wall, 400, np.random.default_rng(7))
    seen = np.zeros(len(points))
    for view in wall.train_views:
        camera = view.camera
        local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        uv = local[:, :2] / local[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]
        seen += (local[:, 2] > 0) & (uv >= 0).all(1) & (uv < SIZE).all(1)
    assert seen.min() >= 1
    assert (seen >= 4).mean() > 0.9
    assert ((colors >= 0) & (colors <= 1)).all()
    again, _ = random_points_in_frusta(wall, 400, np.random.default_rng(7))
    np.testing.assert_array_equal(points, again)


def test_held_out_views_are_not_read(tmp_path):
    write_wall(tmp_path, texture(), count=4)
    capture = load_capture(tmp_path, test_names=["1", "2"])
    for view in capture.test_views:
        view.image_path.write_bytes(b"never read")
    random_points_in_frusta(capture, 50, np.random.default_rng(0))
    triangulate(capture)  # would raise on the broken images


def test_views_are_matched_with_their_neighbors(wall, monkeypatch):
    assert len(matching_pairs(wall.train_views)) == 15
    monkeypatch.setattr(triangulation, "NEIGHBORS", 1)
    assert {b - a for a, b in matching_pairs(wall.train_views)} == {1}


def test_views_that_look_away_from_each_other_are_not_matched(tmp_path):
    write_transforms(tmp_path, [f"{index}.png" for index in range(8)])  # on a circle, 45 degrees apart
    pairs = matching_pairs(load_capture(tmp_path, test_every=0).train_views)
    apart = {min(b - a, 8 - b + a) for a, b in pairs}
    assert apart == {1, 2}
