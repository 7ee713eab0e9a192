"""The viewer without a browser: prompts, clicks, history, suggestions, pages, files; on balls with known names."""

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

from lexsplat.queries.vocabulary import default_vocabulary
from lexsplat.runtime.errors import QueryError
from lexsplat.viewer import pages
from lexsplat.viewer.history import MAX_PROMPTS, History
from lexsplat.viewer.recording import encode_png, encode_video, orbit
from lexsplat.viewer.session import MAX_QUESTIONS, Session, is_plain
from lexsplat.viewer.vocabulary import MAX_PHRASES, clean_phrases, suggestions


@pytest.fixture(scope="module")
def scene_and_balls():
    return ball_scene()


@pytest.fixture
def session(scene_and_balls):
    return Session(scene_and_balls[0], History(vocabulary=[*WORDS, "spoon", "fork"]))


def changed(session, before) -> np.ndarray:
    return (session.colors() != before).any(1)


# -- questions


def test_a_prompt_colors_its_ball_at_once_and_selects_it_when_refined(session, scene_and_balls):
    _, ground_truth = scene_and_balls
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


def test_an_absent_object_has_the_threshold_one_half_before_and_after_refinement(
    scene_and_balls, monkeypatch
):
    fresh = Session(scene_and_balls[0], History(vocabulary=WORDS))
    fresh.warm_up()
    monkeypatch.setattr(type(fresh._presence), "classify", lambda self, texts, scores: ("no",) * len(scores))
    question = fresh.ask("ball 3")
    assert question.layer.threshold == 0.5
    fresh.refine(question)
    assert question.layer.threshold == 0.5
    assert question.selection.present == "no"


def test_several_prompts_are_shown_hidden_and_removed(session, scene_and_balls):
    _, ground_truth = scene_and_balls
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


def test_a_phrase_with_relations_is_answered_by_find(session, scene_and_balls):
    scene, ground_truth = scene_and_balls
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


def test_a_repeated_prompt_is_shown_once_and_answered_once(session, monkeypatch):
    question = session.ask("ball 1")
    assert session.ask("ball 1") is question
    assert len(session.questions) == 1
    session.refine(question)
    monkeypatch.setattr(session.scene, "select", None)  # not asked again
    session.refine(question)
    assert len(question.selection) == 300


def test_the_oldest_prompt_is_dropped_and_colors_stay_distinct(session):
    for number in range(MAX_QUESTIONS + 3):
        session.ask(f"thing number {number}")
    texts = [question.text for question in session.questions]
    assert texts == [f"thing number {number}" for number in range(3, MAX_QUESTIONS + 3)]
    assert len({question.layer.color for question in session.questions}) == MAX_QUESTIONS


@pytest.mark.parametrize("text", ["", "   ", "x" * 500])
def test_empty_and_very_long_prompts_are_refused(session, text):
    with pytest.raises(QueryError):
        session.ask(text)
    assert session.questions == []


def test_a_manual_threshold_holds_until_automatic_is_chosen_again(session, scene_and_balls):
    question = session.ask("ball 3")
    session.refine(question)
    automatic = question.layer.threshold
    session.set_threshold(question, 0.0)
    assert len(question.layer.marked()) == len(scene_and_balls[1].labels)
    session.refine(question)
    assert len(question.selection) == len(scene_and_balls[1].labels)
    session.set_threshold(question, 1.0)
    assert len(question.layer.marked()) == 0
    session.set_threshold(question, None)
    assert question.layer.threshold == automatic
    with pytest.raises(ValueError, match="threshold"):
        session.set_threshold(question, 1.5)


# -- clicks


def test_a_click_names_and_selects_what_is_there(session, scene_and_balls):
    _, ground_truth = scene_and_balls
    correct = asked = 0
    for name, camera in ground_truth.cameras.items():
        codes = ground_truth.code_maps[name]
        for ball in range(5):
            rows, columns = np.nonzero(codes == ball)
            if len(rows) < 60:
                continue
            middle = np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2)
            found = session.what_is(camera, columns[middle] + 0.5, rows[middle] + 0.5)
            asked += 1
            correct += found.phrases[0][0] == f"ball {ball}"
            assert np.array_equal(found.selection.mask.numpy(), ground_truth.labels == ball)
            assert session.selection is found.selection
            scores = [score for _, score in found.phrases]
            assert scores == sorted(scores, reverse=True)
            assert all(0 <= score <= 1 for score in scores)
    assert asked > 10
    assert correct == asked


def test_a_click_on_the_background_is_refused(session, scene_and_balls):
    camera = scene_and_balls[1].cameras["view0"]
    with pytest.raises(QueryError, match="expected a surface"):
        session.what_is(camera, 0.5, 0.5)


def test_a_new_click_replaces_the_old_one(session, scene_and_balls):
    camera = scene_and_balls[1].cameras["view0"]
    rows, columns = np.nonzero(scene_and_balls[1].code_maps["view0"] == 4)
    for _ in range(2):
        session.what_is(camera, columns.mean() + 0.5, rows.mean() + 0.5)
    assert len(session.all_questions()) == 1
    session.remove(session.clicked)
    assert session.all_questions() == []


# -- views and files


def test_the_best_views_are_those_that_show_most(session, scene_and_balls):
    _, ground_truth = scene_and_balls
    question = session.ask("ball 1")
    session.refine(question)
    shares = {name: (codes == 1).mean() for name, codes in ground_truth.code_maps.items()}
    best = question.selection.view_shares[:3]
    assert best[0][0] in sorted(shares, key=shares.get)[-2:]
    assert [share for _, share in best] == sorted((share for _, share in best), reverse=True)
    for name, share in best:
        assert share == pytest.approx(shares[name], abs=0.03)


def test_a_thumbnail_tints_only_the_selection(session, scene_and_balls):
    _, ground_truth = scene_and_balls
    question = session.ask("ball 0")
    session.refine(question)
    image = session.thumbnail("view1", question.selection).astype(int)
    truth_mask = ground_truth.code_maps["view1"] == 0
    assert image.shape == (72, 96, 3)
    tinted = image.sum(-1) > 300  # the white background is dimmed to 345
    tinted &= ground_truth.code_maps["view1"] != 255
    assert (tinted & truth_mask).sum() / (tinted | truth_mask).sum() > 0.75


def test_an_exported_selection_is_read_by_plyfile(session, scene_and_balls):
    from plyfile import PlyData

    scene, ground_truth = scene_and_balls
    question = session.ask("ball 2")
    session.refine(question)
    name, content = session.export(question.selection)
    assert name == "ball_2.ply"
    vertices = PlyData.read(io.BytesIO(content))["vertex"]
    assert len(vertices) == (ground_truth.labels == 2).sum()
    expected = scene.gaussians.means.numpy()[ground_truth.labels == 2]
    assert np.array_equal(np.stack([vertices["x"], vertices["y"], vertices["z"]], 1), expected)


def test_an_exported_glb_contains_the_selection(session):
    question = session.ask("ball 2")
    session.refine(question)
    name, content = session.export(question.selection, ".glb")
    assert name == "ball_2.glb"
    assert content[:4] == b"glTF"
    with pytest.raises(ValueError, match="ending"):
        session.export(question.selection, ".exe")


def test_an_empty_selection_is_not_exported(session):
    question = session.ask("ball 2")
    session.set_threshold(question, 1.0)
    session.refine(question)
    with pytest.raises(QueryError):
        session.export(question.selection)


def test_an_orbit_keeps_height_and_distance_and_looks_at_its_target():
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
        assert rotation[2, 1] < 0  # y points down in the image, so its world z is negative
    angles = np.unwrap([np.arctan2(p[1] - 2, p[0] - 1) for p, _ in poses])
    assert np.allclose(np.diff(angles), 2 * np.pi / 12)


@pytest.mark.slow
@given(st.floats(0.1, 3.9), st.floats(-1.9, 1.9))
@settings(deadline=None)
def test_an_orbit_stays_within_the_arc_of_the_photos(width, start):
    """With photos on an arc of ``width`` radians around 0, the cameras swing over it and reach both ends."""
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


def test_an_orbit_from_vertically_above_is_refused():
    with pytest.raises(ValueError, match="above"):
        orbit(np.array([0.0, 0, 5]), np.zeros(3), np.array([0.0, 0, 1]), 4)


def test_without_pyav_a_video_is_a_gif_with_all_frames(monkeypatch):
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
def test_a_video_is_an_mp4_with_its_frames_in_order(shape):
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


# -- history and suggestions


def test_the_history_is_stored_with_the_latest_prompt_first(tmp_path):
    history = History.load(tmp_path)
    assert history.vocabulary == default_vocabulary()
    for phrase in ("mug", "red apple", "mug"):
        history.add(phrase)
    history.set_vocabulary([" pear ", "", "Pear", "plum"])
    again = History.load(tmp_path)
    assert again.prompts == ["mug", "red apple"]
    assert again.vocabulary == ["pear", "plum"]
    again.set_vocabulary([])
    assert History.load(tmp_path).vocabulary == default_vocabulary()
    again.prompts = [f"thing {number}" for number in range(2 * MAX_PROMPTS)]
    again.add("the last")
    assert History.load(tmp_path).prompts == ["the last", *(f"thing {n}" for n in range(MAX_PROMPTS - 1))]


def test_files_of_earlier_versions_are_read_and_rewritten_unchanged(tmp_path):
    content = {"history": ["mug", "red apple"], "vocabulary": ["pear", "plum"]}
    (tmp_path / "viewer.json").write_text(json.dumps(content))
    history = History.load(tmp_path)
    assert history.prompts == content["history"]
    assert history.vocabulary == content["vocabulary"]
    history.add("mug")
    assert json.loads((tmp_path / "viewer.json").read_text()) == content


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"history": 3}', '{"history": [1]}', '{"vocabulary": null}']
)
def test_a_damaged_history_is_reported_and_ignored(tmp_path, content, caplog):
    (tmp_path / "viewer.json").write_text(content)
    history = History.load(tmp_path)
    assert history.prompts == []
    assert history.vocabulary == default_vocabulary()
    assert "viewer.json" in caplog.text
    history.add("mug")
    assert json.loads((tmp_path / "viewer.json").read_text())["history"] == ["mug"]


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_nothing_is_written_to_a_read_only_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    history = History.load(tmp_path)
    history.add("mug")
    assert history.prompts == ["mug"]
    assert list(tmp_path.iterdir()) == []


def test_scenes_of_the_bundled_encoder_start_with_its_own_vocabulary(tmp_path):
    known = History.load(tmp_path, "bundled").vocabulary
    assert {"teddy bear", "rubber duck", "traffic cone"} <= set(known)
    assert len(known) == 22
    History.load(tmp_path, "bundled").add("duck")  # does not store the default vocabulary
    assert History.load(tmp_path, "openai/clip-vit-base-patch16").vocabulary == default_vocabulary()


def test_suggestions_rank_beginnings_before_words_and_history_before_vocabulary():
    history, vocabulary = ["red mug", "apple"], ["apron", "toy apple", "mug", "red mug"]
    assert suggestions("ap", history, vocabulary) == ["apple", "apron", "toy apple"]
    assert suggestions("MUG", history, vocabulary) == ["red mug"]
    assert suggestions("", history, vocabulary) == history
    assert suggestions("xyz", history, vocabulary) == []
    assert len(suggestions("a", [], [f"a{n}" for n in range(50)], count=4)) == 4


@given(st.lists(st.text(max_size=12) | st.just("long " * 60), max_size=8))
def test_cleaning_phrases_is_idempotent_and_removes_duplicates(phrases):
    cleaned = clean_phrases(phrases)
    assert len(cleaned) <= MAX_PHRASES
    assert all(phrase and phrase == " ".join(phrase.split()) and len(phrase) <= 120 for phrase in cleaned)
    assert len({phrase.lower() for phrase in cleaned}) == len(cleaned)
    assert clean_phrases(cleaned) == cleaned


# -- pages


class Reader(HTMLParser):
    """Collects the tags, attributes and text of a page."""

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


def test_text_of_users_never_becomes_a_tag(session, scene_and_balls):
    session.history.vocabulary = [HOSTILE, *WORDS]
    question = session.ask(HOSTILE[:100])
    session.refine(question)
    camera = scene_and_balls[1].cameras["view0"]
    rows, columns = np.nonzero(scene_and_balls[1].code_maps["view0"] == 4)
    found = session.what_is(camera, columns.mean() + 0.5, rows.mean() + 0.5, count=6)
    everything = [
        pages.note(HOSTILE),
        pages.warning(HOSTILE),
        pages.click_answer(found),
        pages.selection_facts(question),
        pages.legend([question], "relevancy", (0, 1), HOSTILE),
        pages.legend([question, *session.all_questions()], "relevancy", (0, 1), HOSTILE),
        pages.legend([], "relevancy", (0, 1), HOSTILE),
    ]
    for page in everything:
        reader = Reader(page)
        assert not set(reader.tags) - {"div", "span", "b", "br", "img", "style"}
        assert not reader.attributes - {"class", "style", "src", "alt"}
        assert "alert" not in page or "<script>alert(1)</script>" in reader.text


def test_a_hostile_title_stays_a_string_in_the_script_of_the_page():
    script = pages.page_script(HOSTILE, HOSTILE)
    assert "<" not in script.split(";")[0]
    (title,) = [line for line in script.splitlines() if line.startswith("document.title = ")]
    assert json.loads(title.removeprefix("document.title = ").removesuffix(";")) == HOSTILE


def test_the_legend_explains_the_colors_of_each_mode(session):
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
