"""What the viewer answers pages, without a browser; on balls with known names."""

import io
import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from support.viewer_scene import WORDS, ball_scene

from lexsplat.runtime.errors import FileFormatError, QueryError, SceneFolderError
from lexsplat.scenes.editing import Editor
from lexsplat.scenes.journal import Journal
from lexsplat.scenes.scene import open_scene
from lexsplat.viewer.app import make_app
from lexsplat.viewer.history import History
from lexsplat.viewer.requests import Asked
from lexsplat.viewer.session import Session

OLD = Path(__file__).parents[1] / "data" / "scene_d4e65b3" / "averaged"


@pytest.fixture(scope="module")
def scene_and_balls():
    return ball_scene()


@pytest.fixture
def session(scene_and_balls):
    return Session(scene_and_balls[0], 1_000_000, History(vocabulary=[*WORDS, "spoon", "fork"]))


def read(reply: bytes, count: int) -> tuple[dict, np.ndarray, np.ndarray]:
    """Header, scores and instances of an answer."""
    (length,) = struct.unpack_from("<I", reply)
    values = np.frombuffer(reply, np.uint8, offset=4 + length)
    assert len(values) == 2 * count
    return json.loads(reply[4 : 4 + length]), values[:count], values[count:]


def camera_of(camera) -> dict:
    """A camera as pages send it."""
    lens = [camera.width, camera.height, *map(float, camera.K[[0, 0, 1], [0, 2, 2]])]
    return {"viewmat": camera.viewmat.ravel().tolist(), "lens": lens}


def test_an_answer_has_the_scores_of_ask_and_the_instances_of_the_selection(session, scene_and_balls):
    scene, ground_truth = scene_and_balls
    header, scores, labels = read(session.ask(Asked("ball 2")), len(ground_truth.labels))
    answers = scene.ask("ball 2")
    assert np.abs(scores / 255 - answers.scores[0].numpy()).max() <= 0.5 / 255 + 1e-6
    assert header["presence"] == answers.presences[0] == "yes"
    assert header["threshold"] == pytest.approx(float(answers.thresholds[0]), abs=1e-4)
    assert np.array_equal(labels == 1, ground_truth.labels == 2)
    assert header["instances"][0]["center"] == scene.select("ball 2").center.round(5).tolist()


def test_what_is_absent_has_no_instances(session, scene_and_balls):
    header, _, labels = read(session.ask(Asked("zebra")), len(scene_and_balls[1].labels))
    assert (header["presence"], header["instances"], labels.max()) == ("no", [], 0)


def test_phrases_with_relations_are_answered_by_find_and_say_how_they_were_understood(
    session, scene_and_balls
):
    scene, ground_truth = scene_and_balls
    header, _, labels = read(session.ask(Asked("ball 4 and ball 0")), len(ground_truth.labels))
    assert np.array_equal(labels > 0, scene.find("ball 4 and ball 0").mask.numpy())
    assert np.array_equal(labels > 0, np.isin(ground_truth.labels, [0, 4]))
    assert sorted(set(labels)) == [0, 1, 2]
    assert header["understood"] == str(scene.understand("ball 4 and ball 0").phrase)


@pytest.mark.parametrize(("prompt", "unknown"), [("ball 2", False), ("ball 2 beyond seldom of", True)])
def test_the_page_learns_whether_a_prompt_was_understood(session, prompt, unknown):
    (length,) = struct.unpack_from("<I", reply := session.ask(Asked(prompt)))
    assert json.loads(reply[4 : 4 + length])["unknown"] is unknown


def test_left_and_right_are_those_of_the_page_that_asks(session, scene_and_balls, monkeypatch):
    scene, ground_truth = scene_and_balls
    seen = []
    original = scene.find
    monkeypatch.setattr(scene, "find", lambda *a, **k: (seen.append(a[1]), original(*a, **k))[1])
    for camera in ground_truth.cameras.values():
        session.ask(Asked.from_json({"prompt": "ball 1 left of ball 2", "camera": camera_of(camera)}))
    assert [found.position.round(6).tolist() for found in seen] == [
        camera.position.round(6).tolist() for camera in ground_truth.cameras.values()
    ]


@pytest.mark.slow
def test_a_click_names_and_selects_what_is_there(session, scene_and_balls):
    _, ground_truth = scene_and_balls
    asked = 0
    for name, camera in ground_truth.cameras.items():
        codes = ground_truth.code_maps[name]
        for ball in range(5):
            rows, columns = np.nonzero(codes == ball)
            if len(rows) < 60:
                continue
            middle = np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2)
            click = [float(columns[middle]) + 0.5, float(rows[middle]) + 0.5]
            reply = session.what_is(Asked.from_json({"click": click, "camera": camera_of(camera)}))
            header, _, labels = read(reply, len(ground_truth.labels))
            asked += 1
            assert header["names"][0]["phrase"] == f"ball {ball}"
            assert np.array_equal(labels > 0, ground_truth.labels == ball)
    assert asked > 10
    corner = {"click": [0.5, 0.5], "camera": camera_of(ground_truth.cameras["view0"])}
    with pytest.raises(QueryError, match="expected a surface"):
        session.what_is(Asked.from_json(corner))


def test_pages_get_all_gaussians_and_choose_themselves_which_to_draw(scene_and_balls):
    session = Session(scene_and_balls[0], 200, History())
    known = session.content.manifest["scene"]
    assert (known["gaussians"], known["of"], known["budget"]) == (1500, 1500, 200)


def test_scores_come_in_the_order_of_the_file_when_pages_get_fewer_gaussians(scene_and_balls, monkeypatch):
    scene, ground_truth = scene_and_balls
    monkeypatch.setattr("lexsplat.viewer.session.MOST_SPLATS", 200)
    session = Session(scene, 200, History())
    header, _, labels = read(session.ask(Asked("ball 3")), 200)
    drawn = session.content.drawn.numpy()
    assert session.content.manifest["scene"]["gaussians"] == 200
    assert np.array_equal(labels > 0, ground_truth.labels[drawn] == 3)
    assert header["gaussians"] == int((ground_truth.labels == 3).sum())  # answers use all of them
    assert len(session.colors("language")) == 3 * 200


def test_an_exported_selection_is_read_by_plyfile(session, scene_and_balls):
    scene, ground_truth = scene_and_balls
    name, content = session.export(Asked("ball 3"), ".ply")
    assert name == "ball_3.ply"
    x = np.asarray(PlyData.read(io.BytesIO(content))["vertex"]["x"])
    assert np.allclose(x, scene.gaussians.means[torch.from_numpy(ground_truth.labels == 3), 0])
    name, part = session.export(Asked("ball 4 and ball 0", instance=1), ".ply")
    assert len(part) < len(session.export(Asked("ball 4 and ball 0"), ".ply")[1])
    with pytest.raises(QueryError, match="at least one Gaussian"):
        session.export(Asked("zebra"), ".ply")
    with pytest.raises(QueryError, match="format"):
        session.export(Asked("ball 3"), ".exe")


def test_details_have_size_and_the_views_that_show_most(session, scene_and_balls):
    found = session.details(Asked("ball 1"))
    chosen = scene_and_balls[0].select("ball 1")
    assert np.allclose(found["size"], chosen.size, atol=1e-4)
    assert [view["name"] for view in found["views"]] == [name for name, _ in chosen.view_shares[:3]]


# -- editing


def test_edits_are_those_of_the_editor_and_can_be_undone_and_redone(session, scene_and_balls):
    _, ground_truth = scene_and_balls
    count = len(ground_truth.labels)
    manifest = session.edit("delete", Asked("ball 2"), {})
    assert manifest["server"]["version"] == session.version == 2
    assert manifest["server"]["steps"] == ["delete ball 2 (300 Gaussians)"]
    assert manifest["scene"]["gaussians"] == count - 300
    assert read(session.ask(Asked("ball 2")), count - 300)[0]["gaussians"] == 0
    assert session.edit("undo", Asked(), {})["scene"]["gaussians"] == count
    assert session.edit("redo", Asked(), {})["scene"]["gaussians"] == count - 300
    session.edit("move", Asked("ball 1"), {"by": [0, 0, 0.5]})
    assert session.scene.select("ball 1").center[2] == pytest.approx(
        scene_and_balls[0].select("ball 1").center[2] + 0.5, abs=1e-3
    )
    session.edit("recolor", Asked("ball 0"), {"color": [1, 0, 0]})
    session.edit("duplicate", Asked("ball 3"), {"by": [0, 0, 5]})
    assert session.edit("keep", Asked("ball 4"), {})["scene"]["gaussians"] == 300


@pytest.mark.parametrize("action", ["delete", "keep", "recolor", "move", "duplicate"])
def test_a_preview_applies_to_what_the_edit_does_with_hidden_gaussians(session, action, monkeypatch):
    inside = session.scene.select("ball 2").mask.clone()
    inside[inside.nonzero()[::3]] = False
    monkeypatch.setattr(type(session.scene), "hidden", property(lambda _: inside))
    reply = session.preview(action, Asked("ball 2"))
    assert (session.version, session.editor.steps) == (1, [])
    session.edit(action, Asked("ball 2"), {"color": [1, 0, 0], "by": [0, 0, 5]})
    (step,) = session.editor.steps
    assert struct.unpack_from("<I", reply)[0] == int(step.mask.sum())
    assert np.array_equal(np.frombuffer(reply, np.uint8, offset=4), step.mask.numpy())


def test_a_preview_of_no_edit_is_refused(session):
    with pytest.raises(QueryError):
        session.preview("undo", Asked("ball 2"))


def test_steps_are_called_by_the_words_of_the_visitor(session):
    asked = "ball 4 next to ball 0"
    assert session.edit("recolor", Asked(asked), {"color": [1, 0, 0]})["server"]["steps"] == [
        f"recolor {asked} (300 Gaussians)"
    ]


def test_a_step_for_one_of_several_places_says_so(session):
    one = session.edit("recolor", Asked("ball 4 and ball 0", instance=1), {"color": [1, 0, 0]})
    assert one["server"]["steps"][0].startswith("recolor 2 of 2 of ball 4 and ball 0 (")
    both = session.edit("recolor", Asked("ball 4 and ball 0"), {"color": [1, 0, 0]})
    assert both["server"]["steps"][1].startswith("recolor ball 4 and ball 0 (")


@pytest.mark.parametrize(
    ("action", "values"),
    [("recolor", {"color": [2, 0, 0]}), ("move", {"scale": -1}), ("move", {"by": [float("nan"), 0, 0]}),
     ("move", {"by": [1, 2]}), ("explode", {}), ("move", {"turn": "90"}), ("move", {}),
     ("move", {"by": [0, 0, 0], "turn": 0, "scale": 1}), ("duplicate", {})],
)  # fmt: skip
def test_edits_without_meaning_are_refused_and_change_nothing(session, action, values):
    with pytest.raises(QueryError):
        session.edit(action, Asked("ball 1"), values)
    assert session.version == 1
    assert session.editor.steps == []


@pytest.mark.parametrize("by", [1e6, 1e8])
def test_things_can_be_moved_far_away_and_back(session, by):
    session.edit("move", Asked("ball 1"), {"by": [by, 0, 0]})
    assert session.content.manifest["server"]["version"] == session.version == 2
    session.edit("undo", Asked(""), {})
    assert (session.editor.steps, session.version) == ([], 3)


@pytest.mark.parametrize("action", ["recolor", "undo", "redo"])
def test_an_edit_whose_page_cannot_be_written_changes_nothing(session, tmp_path, monkeypatch, action):
    from lexsplat.viewer import session as module

    session.editor.journal = Journal(tmp_path / "edits.jsonl", session.scene)
    session.edit("recolor", Asked("ball 1"), {"color": [1, 0, 0]})
    session.edit("recolor", Asked("ball 2"), {"color": [1, 0, 0]})
    session.edit("undo", Asked(""), {})

    def state():
        steps = [str(step) for step in (*session.editor.steps, *session.editor.undone)]
        return steps, session.version, session.content, (tmp_path / "edits.jsonl").read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    before = state()
    with monkeypatch.context() as patched:
        patched.setattr(module, "write_splats", full)
        with pytest.raises(SceneFolderError, match=r"No space left on device; nothing was changed"):
            session.edit(action, Asked("ball 3"), {"color": [0, 1, 0]})
    assert state() == before
    assert session.edit(action, Asked("ball 3"), {"color": [0, 1, 0]})["server"]["version"] == before[1] + 1


def test_a_scene_is_never_edited_to_nothing(session, scene_and_balls, monkeypatch):
    everything = scene_and_balls[0].select("ball 1")
    everything = everything | ~everything
    monkeypatch.setattr(session, "_chosen", lambda _: everything)
    with pytest.raises(QueryError, match="at least 2 Gaussians after the edit"):
        session.edit("delete", Asked("ball 1"), {})


@pytest.mark.slow
def test_steps_are_kept_in_the_journal_of_the_edit_command(built, tmp_path):
    import shutil

    from lexsplat.scenes.editing import Editor
    from lexsplat.scenes.scene import open_scene

    folder = tmp_path / "scene"
    shutil.copytree(built, folder)
    scene = open_scene(folder)
    session = Session(scene, 1_000_000, History())
    everything = scene.select("red mug", 0.0)
    session.editor.change("recolor", everything, color=[0, 0, 1])
    again = Session(open_scene(folder), 1_000_000, History())
    assert len(again.content.manifest["server"]["steps"]) == 1
    with Editor(open_scene(folder), folder / "edits.jsonl").journal.path.open("a") as journal:
        journal.write('{"undo": true}\n')
    with pytest.raises(SceneFolderError, match="another program"):
        session.edit("undo", Asked(), {})


@pytest.mark.slow
def test_deleting_an_apple_is_previewed_with_what_is_hidden_inside_it():
    from lexsplat.scenes.scene import open_scene

    scene = open_scene("demo")
    session = Session(scene, 1_000_000, History())
    session.editor.journal = None
    asked = Asked("red apple")
    reply = session.preview("delete", asked)
    (count,) = struct.unpack_from("<I", reply)
    shown = session.details(asked)["gaussians"]
    drawn = session.content.drawn
    session.edit("delete", asked, {})
    gone = session.editor.steps[0].mask
    assert shown < count == sum(reply[4:])
    assert count <= int(gone.sum()) <= 1.1 * count, "and remains under it, which no view shows"
    assert gone[drawn][torch.tensor(list(reply[4:]), dtype=torch.bool)].all()


def test_steps_of_another_program_are_shown_when_a_session_catches_up(scene_and_balls, tmp_path):
    scene, _ = scene_and_balls
    session, path = Session(scene, 1_000_000, History()), tmp_path / "edits.jsonl"
    session.editor = Editor(scene, path, session._prepare)
    session.catch_up()
    assert session.version == 1, "nothing is new"
    other = Editor(scene, path)
    other.delete(scene.select("ball 0"), fill=False)
    session.catch_up()
    assert (session.version, session.content.manifest["server"]["version"]) == (2, 2)
    assert len(session.scene.gaussians) == len(other.scene.gaussians) < len(scene.gaussians)
    session.edit("undo", Asked(), {})
    assert len(Editor(scene, path).undone) == 1, "it goes on after them"
    path.unlink()  # as "discard" does
    session.catch_up()
    assert (session.version, session.editor.undone) == (4, [])
    path.write_text("no journal\n")
    before = session.content
    with pytest.raises(FileFormatError, match="discard the edit"):
        session.catch_up()
    assert session.content is before


def test_a_page_is_told_that_another_program_has_edited_the_scene(scene_and_balls, tmp_path):
    from starlette.testclient import TestClient

    scene, _ = scene_and_balls
    session, path = Session(scene, 1_000_000, History()), tmp_path / "edits.jsonl"
    session.editor = Editor(scene, path, session._prepare)
    client = TestClient(make_app(session))
    asked = {"version": 1, "prompt": "ball 1"}
    assert client.post("/objects", json=asked).status_code == 200
    Editor(scene, path).delete(scene.select("ball 0"), fill=False)
    assert client.post("/objects", json=asked).status_code == 409
    assert client.post("/objects", json={**asked, "version": 2}).status_code == 200
    path.write_text("no journal\n")
    assert client.get("/manifest.json").json()["server"]["version"] == 2
    refused = client.post("/objects", json={**asked, "version": 2})
    assert (refused.status_code, "discard the edit" in refused.text) == (400, True)


def test_an_edit_with_a_misspelled_key_is_refused(session):
    from starlette.testclient import TestClient

    client = TestClient(make_app(session))
    asked = {"version": 1, "prompt": "ball 1", "action": "move", "by": [0, 0, 1]}
    refused = client.post("/edit", json={**asked, "scael": 2})
    assert refused.status_code == 400
    assert "found 'scael'" in refused.json()["error"]["message"]
    assert session.editor.steps == []
    assert client.post("/edit", json={**asked, "scale": 2}).status_code == 200


def test_photos_that_are_gone_are_reported_without_options_that_the_viewer_lacks(tmp_path):
    from starlette.testclient import TestClient

    folder = shutil.copytree(OLD, tmp_path / "scene")
    client = TestClient(make_app(Session(open_scene(folder, device="cpu"), 1_000_000, History())))
    refused = client.get("/photo/0")
    assert refused.status_code == 404
    assert refused.json()["error"]["remedy"] == "put the photos back where the build found them"


def test_a_prompt_that_is_no_text_is_told_so():
    with pytest.raises(QueryError, match="expected a text of at most 120 characters, found int"):
        Asked.from_json({"prompt": 5})
