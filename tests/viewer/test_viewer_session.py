"""The viewer without a browser: questions, clicks, memory, suggestions, pages, files; on balls with known names."""

import io
import json
import os
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from support.viewer_scene import WORDS, ball_scene

from lexsplat.runtime.errors import QueryError
from lexsplat.viewer import pages
from lexsplat.viewer.history import MAX_HISTORY, Memory
from lexsplat.viewer.recording import encode_png, encode_video, looking_at, orbit
from lexsplat.viewer.session import MAX_QUESTIONS, Session, is_plain
from lexsplat.viewer.vocabulary import MAX_PHRASES, clean_phrases, default_vocabulary, suggestions


@pytest.fixture(scope="module")
def balls():
    return ball_scene()


@pytest.fixture
def session(balls):
    return Session(balls[0], Memory(vocabulary=[*WORDS, "spoon", "fork"]))


def changed(session, before) -> np.ndarray:
    return (session.colors() != before).any(1)


# -- questions


def test_a_question_colors_its_ball_at_once_and_selects_it_when_refined(session, balls):
    _, ground_truth = balls
    before = session.colors()
    question = session.ask("  ball   2 ")
    assert question.text == "ball 2"
    assert session.mode == "relevancy"
    assert np.array_equal(changed(session, before), ground_truth.labels == 2)
    assert question.selection is None
    session.refine(question)
    assert np.array_equal(question.selection.mask.numpy(), ground_truth.labels == 2)
    assert np.array_equal(changed(session, before), ground_truth.labels == 2)
    assert session.selection is question.selection


def test_what_is_judged_absent_is_drawn_at_half_from_the_first_moment(balls, monkeypatch):
    fresh = Session(balls[0], Memory(vocabulary=WORDS))
    fresh.warm_up()
    monkeypatch.setattr(type(fresh._judge), "classify", lambda self, scores: "no")
    question = fresh.ask("ball 3")
    assert question.layer.threshold == 0.5
    fresh.refine(question)
    assert question.layer.threshold == 0.5
    assert question.selection.present == "no"


def test_several_questions_are_shown_and_can_be_hidden_and_removed(session, balls):
    _, ground_truth = balls
    before = session.colors()
    first, second = session.ask("ball 0"), session.ask("ball 4")
    assert first.layer.color != second.layer.color
    assert np.array_equal(changed(session, before), np.isin(ground_truth.labels, [0, 4]))
    first.layer.shown = False
    assert np.array_equal(changed(session, before), ground_truth.labels == 4)
    session.remove(second)
    assert session.current is first
    session.remove(first)
    assert session.current is None
    assert not changed(session, before).any()


def test_a_phrase_with_several_parts_is_answered_as_by_find(session, balls):
    scene, ground_truth = balls
    question = session.ask("ball 4 and ball 0")
    session.refine(question)
    expected = scene.find("ball 4 and ball 0")
    assert np.array_equal(question.selection.mask.numpy(), expected.mask.numpy())
    assert np.array_equal(question.selection.mask.numpy(), np.isin(ground_truth.labels, [0, 4]))
    assert np.array_equal(question.layer.marked(), np.flatnonzero(np.isin(ground_truth.labels, [0, 4])))
    assert [is_plain(text) for text in ("ball 4", "something to sit on", 'a "mug', "mug on the cloth")] == [
        True, True, True, False,
    ]  # fmt: skip
    none = session.ask("ball 0 inside ball 4")
    session.refine(none)
    assert len(none.selection) == 0


def test_asking_again_does_not_show_it_twice(session):
    assert session.ask("ball 1") is session.ask("ball 1")
    assert len(session.questions) == 1


def test_the_oldest_question_makes_room_and_colors_stay_different(session):
    for number in range(MAX_QUESTIONS + 3):
        session.ask(f"thing number {number}")
    texts = [question.text for question in session.questions]
    assert texts == [f"thing number {number}" for number in range(3, MAX_QUESTIONS + 3)]
    assert len({question.layer.color for question in session.questions}) == MAX_QUESTIONS


@pytest.mark.parametrize("text", ["", "   ", "x" * 500])
def test_empty_and_endless_questions_are_refused(session, text):
    with pytest.raises(QueryError):
        session.ask(text)
    assert session.questions == []


def test_a_threshold_by_hand_holds_until_automatic_is_chosen_again(session, balls):
    question = session.ask("ball 3")
    session.refine(question)
    automatic = question.layer.threshold
    session.set_threshold(question, 0.0)
    assert len(question.layer.marked()) == len(balls[1].labels)
    session.refine(question)
    assert len(question.selection) == len(balls[1].labels)
    session.set_threshold(question, 1.0)
    assert len(question.layer.marked()) == 0
    session.set_threshold(question, None)
    assert question.layer.threshold == automatic
    with pytest.raises(ValueError, match="threshold"):
        session.set_threshold(question, 1.5)


# -- clicks


def test_a_click_names_and_selects_what_is_there(session, balls):
    _, ground_truth = balls
    right = asked = 0
    for name, camera in ground_truth.cameras.items():
        codes = ground_truth.code_maps[name]
        for ball in range(5):
            rows, columns = np.nonzero(codes == ball)
            if len(rows) < 60:
                continue
            middle = np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2)
            found = session.what_is(camera, columns[middle] + 0.5, rows[middle] + 0.5)
            asked += 1
            right += found.phrases[0][0] == f"ball {ball}"
            assert np.array_equal(found.selection.mask.numpy(), ground_truth.labels == ball)
            assert session.selection is found.selection
            scores = [score for _, score in found.phrases]
            assert scores == sorted(scores, reverse=True)
            assert all(0 <= score <= 1 for score in scores)
    assert asked > 10
    assert right == asked


def test_a_click_on_nothing_is_told(session, balls):
    camera = balls[1].cameras["view0"]
    with pytest.raises(QueryError, match="expected a surface"):
        session.what_is(camera, 0.5, 0.5)


def test_a_new_click_replaces_the_old_one(session, balls):
    camera = balls[1].cameras["view0"]
    rows, columns = np.nonzero(balls[1].code_maps["view0"] == 4)
    for _ in range(2):
        session.what_is(camera, columns.mean() + 0.5, rows.mean() + 0.5)
    assert len(session.all_questions()) == 1
    session.remove(session.clicked)
    assert session.all_questions() == []


# -- views and files


def test_the_best_views_are_those_that_show_most(session, balls):
    _, ground_truth = balls
    question = session.ask("ball 1")
    session.refine(question)
    shares = {name: (codes == 1).mean() for name, codes in ground_truth.code_maps.items()}
    best = session.best_views(question.selection, 3)
    assert best[0][0] in sorted(shares, key=shares.get)[-2:]
    assert [share for _, share in best] == sorted((share for _, share in best), reverse=True)
    for name, share in best:
        assert share == pytest.approx(shares[name], abs=0.03)


def test_a_thumbnail_tints_the_selection_alone(session, balls):
    _, ground_truth = balls
    question = session.ask("ball 0")
    session.refine(question)
    picture = session.thumbnail("view1", question.selection).astype(int)
    truth_mask = ground_truth.code_maps["view1"] == 0
    assert picture.shape == (72, 96, 3)
    tinted = picture.sum(-1) > 300  # the ground is white, dimmed to 345
    tinted &= ground_truth.code_maps["view1"] != 255
    assert (tinted & truth_mask).sum() / (tinted | truth_mask).sum() > 0.75


def test_an_exported_selection_is_read_by_plyfile(session, balls):
    from plyfile import PlyData

    scene, ground_truth = balls
    question = session.ask("ball 2")
    session.refine(question)
    name, content = session.export(question.selection)
    assert name == "ball_2.ply"
    vertices = PlyData.read(io.BytesIO(content))["vertex"]
    assert len(vertices) == (ground_truth.labels == 2).sum()
    expected = scene.gaussians.means.numpy()[ground_truth.labels == 2]
    assert np.array_equal(np.stack([vertices["x"], vertices["y"], vertices["z"]], 1), expected)


def test_an_exported_glb_holds_the_selection(session):
    question = session.ask("ball 2")
    session.refine(question)
    name, content = session.export(question.selection, ".glb")
    assert name == "ball_2.glb"
    assert content[:4] == b"glTF"
    with pytest.raises(ValueError, match="ending"):
        session.export(question.selection, ".exe")


def test_nothing_is_not_exported(session):
    question = session.ask("ball 2")
    session.set_threshold(question, 1.0)
    session.refine(question)
    with pytest.raises(QueryError):
        session.export(question.selection)


def test_an_orbit_keeps_height_and_distance_and_looks_at_its_middle():
    target, up = np.array([1.0, 2, 3]), np.array([0.0, 0, 2])
    poses = orbit(np.array([4.0, 2, 5]), target, up, 12)
    assert np.allclose(poses[0][0], [4, 2, 5])
    for place, rotation in poses:
        assert np.linalg.norm(place - target) == pytest.approx(np.sqrt(13))
        assert place[2] == pytest.approx(5)
        assert np.allclose(rotation.T @ rotation, np.eye(3))
        assert np.linalg.det(rotation) == pytest.approx(1)
        along = (target - place) / np.linalg.norm(target - place)
        assert np.allclose(rotation[:, 2], along)
        assert rotation[2, 1] < 0  # y points down in the picture, so its world z falls
    angles = np.unwrap([np.arctan2(p[1] - 2, p[0] - 1) for p, _ in poses])
    assert np.allclose(np.diff(angles), 2 * np.pi / 12)


@given(st.floats(0.1, 3.9), st.floats(-1.9, 1.9))
@settings(deadline=None)
def test_an_orbit_stays_where_photos_were_taken(width, start):
    """Photos on an arc of ``width`` radians around 0: the cameras swing over it, and reach both ends."""
    seen = [np.array([3 * np.cos(a), 3 * np.sin(a), 1.0]) for a in np.linspace(-width / 2, width / 2, 30)]
    start = float(np.clip(start, -width / 2, width / 2))
    begin = np.array([2 * np.cos(start), 2 * np.sin(start), 0.5])
    poses = orbit(begin, np.zeros(3), np.array([0, 0, 1.0]), 200, seen)
    angles = np.array([np.arctan2(place[1], place[0]) for place, _ in poses])
    assert np.allclose(poses[0][0], begin, atol=1e-6)
    assert np.abs(angles).max() <= width / 2 + 1e-6
    assert angles.max() == pytest.approx(width / 2, abs=0.01)
    assert angles.min() == pytest.approx(-width / 2, abs=0.01)
    steps = np.abs(np.diff(np.append(angles, angles[0])))
    assert steps.max() <= width / 2 * 2 * np.pi / 200 + 1e-6  # smooth, also from the last to the first


def test_photos_from_all_around_give_a_full_turn():
    seen = [np.array([np.cos(a), np.sin(a), 0]) for a in np.linspace(0, 2 * np.pi, 9)]
    args = np.array([4.0, 0, 1]), np.zeros(3), np.array([0, 0, 1.0]), 12
    for (place, _), (expected, _) in zip(orbit(*args, seen), orbit(*args)):
        assert np.allclose(place, expected)


def test_an_orbit_from_above_is_refused():
    with pytest.raises(ValueError, match="above"):
        orbit(np.array([0.0, 0, 5]), np.zeros(3), np.array([0.0, 0, 1]), 4)


def test_looking_at_is_the_camera_of_cameras():
    from lexsplat.geometry.cameras import look_at

    place, target, up = np.array([1.0, -2, 0.5]), np.array([0.3, 0.2, 0]), np.array([0.1, 0, 1])
    camera = look_at(place, target, up, 8, 8, 1.0)
    assert np.allclose(looking_at(place, target, up), camera.viewmat[:3, :3].T)


def test_a_video_without_an_encoder_is_a_gif_with_all_frames(monkeypatch):
    monkeypatch.setattr("lexsplat.viewer.recording.importlib.util.find_spec", lambda name: None)
    frames = [np.full((31, 41, 3), 20 * k, np.uint8) for k in range(6)]
    suffix, content = encode_video(frames, fps=10)
    assert suffix == ".gif"
    with Image.open(io.BytesIO(content)) as video:
        assert video.n_frames == 6
        assert video.size == (41, 31)
        assert video.info["duration"] == 100
        video.seek(3)
        assert abs(int(np.asarray(video.convert("RGB"))[5, 5, 0]) - 60) < 6
    with pytest.raises(ValueError, match="frame"):
        encode_video([])


@pytest.mark.parametrize("shape", [(64, 80), (63, 81)])
def test_a_video_is_an_mp4_whose_frames_come_back_in_order(shape):
    av = pytest.importorskip("av")
    frames = [np.full((*shape, 3), 20 * k, np.uint8) for k in range(12)]
    suffix, content = encode_video(frames, fps=10)
    assert suffix == ".mp4"
    assert content.index(b"moov") < content.index(b"mdat"), "the index comes first"
    with av.open(io.BytesIO(content)) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert float(video.streams.video[0].average_rate) == 10
    assert len(pictures) == 12
    assert {picture.shape for picture in pictures} == {(shape[0] // 2 * 2, shape[1] // 2 * 2, 3)}
    assert np.abs([picture.mean() for picture in pictures] - 20.0 * np.arange(12)).max() < 4


def test_a_screenshot_is_a_png_of_the_same_pixels():
    picture = np.random.default_rng(0).integers(0, 255, (9, 7, 3)).astype(np.uint8)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(encode_png(picture)))), picture)


# -- memory and suggestions


def test_memory_comes_back_and_keeps_the_latest_first(tmp_path):
    memory = Memory.load(tmp_path)
    assert memory.vocabulary == default_vocabulary()
    for phrase in ("mug", "red apple", "mug"):
        memory.remember(phrase)
    memory.set_vocabulary([" pear ", "", "Pear", "plum"])
    again = Memory.load(tmp_path)
    assert again.history == ["mug", "red apple"]
    assert again.vocabulary == ["pear", "plum"]
    again.set_vocabulary([])
    assert Memory.load(tmp_path).vocabulary == default_vocabulary()
    again.history = [f"thing {number}" for number in range(2 * MAX_HISTORY)]
    again.remember("the last")
    assert Memory.load(tmp_path).history == ["the last", *(f"thing {n}" for n in range(MAX_HISTORY - 1))]


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"history": 3}', '{"history": [1]}', '{"vocabulary": null}']
)
def test_a_damaged_memory_is_told_and_not_used(tmp_path, content, caplog):
    (tmp_path / "viewer.json").write_text(content)
    memory = Memory.load(tmp_path)
    assert memory.history == []
    assert memory.vocabulary == default_vocabulary()
    assert "viewer.json" in caplog.text
    memory.remember("mug")
    assert json.loads((tmp_path / "viewer.json").read_text())["history"] == ["mug"]


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_a_folder_that_cannot_be_written_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    memory = Memory.load(tmp_path)
    memory.remember("mug")
    assert memory.history == ["mug"]
    assert list(tmp_path.iterdir()) == []


def test_scenes_of_the_embedded_encoder_start_with_what_it_knows(tmp_path):
    known = Memory.load(tmp_path, "bundled").vocabulary
    assert {"teddy bear", "rubber duck", "traffic cone"} <= set(known)
    assert len(known) == 22
    Memory.load(tmp_path, "bundled").remember("duck")  # does not fix the words
    assert Memory.load(tmp_path, "openai/clip-vit-base-patch16").vocabulary == default_vocabulary()


def test_suggestions_take_beginnings_before_words_and_history_before_vocabulary():
    history, vocabulary = ["red mug", "apple"], ["apron", "toy apple", "mug", "red mug"]
    assert suggestions("ap", history, vocabulary) == ["apple", "apron", "toy apple"]
    assert suggestions("MUG", history, vocabulary) == ["red mug"]
    assert suggestions("", history, vocabulary) == history
    assert suggestions("xyz", history, vocabulary) == []
    assert len(suggestions("a", [], [f"a{n}" for n in range(50)], count=4)) == 4


@given(st.lists(st.text(max_size=12) | st.just("long " * 60), max_size=8))
def test_cleaned_phrases_are_short_single_and_stable(phrases):
    cleaned = clean_phrases(phrases)
    assert len(cleaned) <= MAX_PHRASES
    assert all(phrase and phrase == " ".join(phrase.split()) and len(phrase) <= 120 for phrase in cleaned)
    assert len({phrase.lower() for phrase in cleaned}) == len(cleaned)
    assert clean_phrases(cleaned) == cleaned


# -- pages


class Reader(HTMLParser):
    """Collects the tags and the text of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: set[str] = set()
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data):
        self.text += data


HOSTILE = '<script>alert(1)</script><img src=x onerror="alert(2)">&quot;\'"x"'


def test_text_of_users_and_scenes_never_becomes_a_tag(session, balls):
    session.memory.vocabulary = [HOSTILE, *WORDS]
    question = session.ask(HOSTILE[:100])
    session.refine(question)
    camera = balls[1].cameras["view0"]
    rows, columns = np.nonzero(balls[1].code_maps["view0"] == 4)
    found = session.what_is(camera, columns.mean() + 0.5, rows.mean() + 0.5, count=6)
    everything = [
        pages.note(HOSTILE),
        pages.warning(HOSTILE),
        pages.answer(found),
        pages.selection_facts(question),
        pages.legend([question], "relevancy", (0, 1), HOSTILE),
        pages.legend([question, *session.all_questions()], "relevancy", (0, 1), HOSTILE),
        pages.legend([], "relevancy", (0, 1), HOSTILE),
    ]
    for page in everything:
        reader = Reader(page)
        assert not set(reader.tags) - {"div", "span", "b", "br", "img"}
        assert not reader.attributes - {"style", "src", "alt"}
        assert "alert" not in page or "<script>alert(1)</script>" in reader.text


def test_the_legend_says_what_the_colors_mean(session):
    assert "Type" in pages.legend([], "relevancy", (0, 1), "Type something")
    question = session.ask("ball 0")
    text = Reader(pages.legend([question], "relevancy", (0, 1), "")).text
    assert "ball 0" in text
    assert "…" in text  # not yet refined
    session.refine(question)
    text = Reader(pages.legend([question], "relevancy", (0, 1), "")).text
    assert "300 splats" in text
    assert f"{question.layer.threshold:.2f}" in text
    assert "uncertainty" in pages.legend([], "uncertainty", (0, 0.4), "")
    assert "0.40" in pages.legend([], "uncertainty", (0, 0.4), "")
    assert "distance" in pages.legend([], "depth", (1, 4), "")
