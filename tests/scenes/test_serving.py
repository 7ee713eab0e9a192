"""A scene that many questions are asked of: by lines, by threads, and while its folder changes."""

import io
import json
import shutil
import threading
from pathlib import Path

import pytest
import torch
from jsonschema import Draft202012Validator

from lexsplat.queries.presence import PresenceClassifier
from lexsplat.runtime.bounded import Bounded
from lexsplat.runtime.errors import QueryError
from lexsplat.scenes.answers import answer_queries, find_phrase
from lexsplat.scenes.folder import BUNDLED_SCENE
from lexsplat.scenes.scene import open_scene
from lexsplat.scenes.serving import (
    MAX_LINE,
    OpenScene,
    answer_line,
    json_line,
    lines_of,
    open_scenes,
    sentence,
    worded,
)

SCHEMA = json.loads((Path(__file__).parents[2] / "docs" / "schemas" / "ask.json").read_text())


@pytest.fixture(scope="module")
def served_demo():
    return OpenScene("demo")


def test_a_name_that_a_library_has_is_given_to_no_other_scene():
    assert list(open_scenes(["demo"], taken=dict.fromkeys(["demo", "demo-2"]))) == ["demo-3"]


def test_a_folder_is_served_once():
    assert list(open_scenes(["demo", str(BUNDLED_SCENE), "demo"])) == ["demo"]
    assert list(open_scenes(["demo"], taken={"bundled": BUNDLED_SCENE})) == []


def test_what_was_used_least_recently_is_forgotten():
    kept = Bounded[str, int](2)
    kept.put("a", 1)
    kept.put("b", 2)
    assert kept.get("a") == 1
    kept.put("c", 3)
    assert (kept.get("a"), kept.get("b"), kept.get("c"), len(kept)) == (1, None, 3, 2)
    assert kept.put("a", 9) == 1, "the first one stays"
    assert kept.get_or_make("d", lambda: 4) == 4


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("red apple", ""),
        ('{"ask": "where is the mug?", "view": "view_033", "id": 7}', ""),
        ('{"ask": "unicorn", "threshold": 0.5, "id": null}', ""),
        ("\ufeffred apple\r\n", ""),
        ("🍎", ""),
        ("{", "one JSON object"),
        ("[" * 100_000, "one JSON object"),
        ('\ufeff{"ask": "red apple"}', ""),
        ('{"ask": 5}', "ask: expected text, found 5"),
        ("{}", "ask: expected text, found nothing"),
        ('["mug"]', "one JSON object"),
        ('{"ask": "mug", "vew": "view_033"}', "vew"),
        ('{"ask": "mug", "view": "nope"}', "view"),
        ('{"ask": "mug", "view": 5}', "view"),
        ('{"ask": "mug", "threshold": NaN}', "0..1"),
        ('{"ask": "mug", "threshold": "high"}', "0..1"),
        ('{"ask": "mug", "threshold": [1]}', "0..1"),
        ('{"ask": "mug", "threshold": {}}', "0..1"),
        ('{"ask": "mug", "threshold": 1' + "0" * 400 + "}", "0..1"),
        ('{"ask": "mug", "id": NaN}', "a value of JSON"),
        ('{"ask": "mug", "id": [1e999]}', "a value of JSON"),
        ('{"ask": ""}', "word or phrase"),
        ('{"ask": "\\ud800"}', "UTF-8"),
        ("x" * (2 << 20), "at most"),
    ],
)
def test_each_line_is_answered_in_the_schema_and_errors_report_what_was_expected(served_demo, line, told):
    answer = answer_line(served_demo, line)
    errors = [error.message for error in Draft202012Validator(SCHEMA).iter_errors(answer)]
    assert not errors, errors
    assert json.loads(json.dumps(answer, allow_nan=False)) == answer
    assert told in answer.get("error", {}).get("message", "")
    assert bool(told) == ("error" in answer)


def test_a_line_that_meets_an_unforeseen_error_is_answered_as_well(served_demo, monkeypatch):
    monkeypatch.setattr("lexsplat.scenes.serving.find_phrase", lambda *_: 1 / 0)
    answer = answer_line(served_demo, '{"ask": "mug", "id": 3}')
    assert (answer["id"], "division" in answer["error"]["message"]) == (3, True)


@pytest.mark.parametrize("threshold", [[1], {}, "1", 10**400, float("nan"), True])
def test_a_threshold_that_is_no_number_in_its_range_is_refused_by_the_scene(served_demo, threshold):
    with pytest.raises(QueryError, match=r"0\.\.1"):
        served_demo.scene.find("mug", threshold=threshold)


def test_an_answer_has_the_id_of_its_question_also_if_it_is_an_error(served_demo):
    assert answer_line(served_demo, '{"ask": "mug", "id": [1, "a"]}')["id"] == [1, "a"]
    assert answer_line(served_demo, '{"ask": "mug", "view": "nope", "id": 3}')["id"] == 3
    for wrong in ('{"ask": 5, "id": 3}', '{"ask": "mug", "vew": "", "id": 3}', '{"id": 3}'):
        assert (answer_line(served_demo, wrong)["id"], "error" in answer_line(served_demo, wrong)) == (
            3,
            True,
        )
    assert "id" not in answer_line(served_demo, "mug")


def test_a_line_beyond_the_limit_is_never_held_as_a_whole():
    class Counting(io.StringIO):
        longest = 0

        def readline(self, size=-1):
            line = super().readline(size)
            self.longest = max(self.longest, len(line))
            return line

    for end in ("\n", ""):
        stream = Counting(f"mug\n\n{'x' * (5 * MAX_LINE)}\nduck{end}")
        lines = list(lines_of(stream))
        assert [line[:5] for line in lines] == ["mug\n", "\n", "xxxxx", f"duck{end}"]
        assert len(lines[2]) > MAX_LINE, "answer_line refuses it"
        assert stream.longest <= MAX_LINE + 1


def test_an_answer_is_one_line_for_readers_that_split_at_unicode_separators(served_demo):
    for text in ("mug\u2028lamp", "mug\u2029lamp", "mug\x85lamp"):
        line = json_line(answer_line(served_demo, text))
        assert len(line.splitlines()) == 1
        assert json.loads(line)["phrase"] == text


def test_a_no_has_no_instances_and_says_so(served_demo):
    answer = answer_line(served_demo, "is there a bicycle?")
    assert (answer["present"], answer["count"], answer["gaussians"], answer["instances"]) == ("no", 0, 0, [])
    assert answer["sentence"].startswith("Not here")
    assert not served_demo.scene.find("is there a bicycle?")


@pytest.mark.parametrize(
    ("line", "unknown"),
    [("🍎", "🍎"), ("das rote apfel", 'das", "apfel'), ("красное яблоко", "красное"), ("\x1b[31mmug", "\x1b[31mmug"),
     ("mug left of the \ufffd", "\ufffd")],
)  # fmt: skip
def test_words_that_the_bundled_encoder_does_not_know_are_named_and_nothing_is_certainly_here(
    served_demo, line, unknown
):
    answer = answer_line(served_demo, line)
    assert f'the bundled encoder knows English words alone, not "{unknown}"' in answer["note"]
    assert answer["present"] in ("no", "unsure")
    assert answer["note"] in answer["sentence"]


@pytest.mark.slow
@pytest.mark.parametrize("line", ["x" * 100_000, "where is the " * 7000])
def test_a_text_that_is_too_long_is_asked_as_one_thing_and_says_so(served_demo, line):
    answer = answer_line(served_demo, line)
    assert "too long for grammar" in answer["note"]
    assert answer["present"] in ("no", "unsure")
    assert len(answer["sentence"]) < 1000


@pytest.mark.parametrize(
    ("prompt", "understood"),
    [
        ("where is the mug?", '"mug"'),
        ("mug on the cloth", '("mug" on "cloth")'),
        ("the red mugs", ""),
        ("mug", ""),
    ],
)
def test_a_query_that_is_a_question_reports_how_find_understands_it(served_demo, prompt, understood):
    (answer,) = answer_queries(served_demo.scene, prompt, ["view_033"], None, None)["prompts"]
    assert answer["note"] == (understood and f"asked in these words; lexsplat find understands {understood}")


def test_a_query_that_is_not_understood_is_reported(served_demo):
    (answer,) = answer_queries(served_demo.scene, "the first mug", ["view_033"], None, None)["prompts"]
    assert answer["note"] == 'not understood ("first"): asked for as one thing, in these words'


def test_a_query_of_words_that_the_encoder_does_not_know_is_unsure_at_most_as_in_find(served_demo):
    prompts = ["xxxxxxx", "mug"]
    unknown, mug = answer_queries(served_demo.scene, prompts, ["view_033"], None, None)["prompts"]
    assert unknown["note"] == 'the bundled encoder knows English words alone, not "xxxxxxx"'
    assert (unknown["present"], mug["present"], mug["note"]) == ("unsure", "yes", "")


@pytest.mark.slow
@pytest.mark.parametrize("prompt", ["xxxxxxx", "the third teddy bear", "mug", "is there a bicycle?"])
@pytest.mark.parametrize("first", ["find", "ask"])
def test_a_prompt_has_one_presence_whatever_asks_it_and_in_any_order(served_demo, prompt, first):
    scene = served_demo.scene.with_content(served_demo.scene.gaussians, served_demo.scene.field)
    asked = {
        "find": lambda: scene.find(prompt).present,
        "ask": lambda: scene.ask(prompt).presences[0],
        "selection": lambda: scene.ask(prompt).selection(0).present,
        "select": lambda: scene.select(prompt).present,
        "given threshold": lambda: scene.select(prompt, 0.5).present,
        "query": lambda: answer_queries(scene, prompt, ["view_033"], None, None)["prompts"][0]["present"],
    }
    order = sorted(asked, key=lambda name: name != first)
    assert len({asked[name]() for name in order}) == 1


def test_words_in_quotation_marks_have_no_grammar_that_could_make_them_unsure(served_demo):
    scene = served_demo.scene
    assert scene.find('"the third toy car"').present == "yes"
    assert scene.ask("the third toy car").presences == ("unsure",)


@pytest.mark.parametrize(
    ("phrase", "understood", "names"),
    [
        ("red thing", "(red any object)", {"apple", "toy car"}),
        ("the yellow object", "(yellow any object)", {"rubber duck", "banana", "stack of books"}),
        ("show me the green things", "(green any object)", {"bottle", "potted plant"}),
        ("red toy", '(red "toy")', {"toy car"}),
        ("which fruit is yellow?", '(yellow "fruit")', {"banana"}),
        ("blue thing on the cloth", '((blue any object) on "cloth")', {"mug"}),
        ("pink object", "(pink any object)", set()),
    ],
)
def test_a_thing_or_kind_in_a_color_is_the_objects_that_the_list_has_in_this_color(
    served_demo, phrase, understood, names
):
    answer = answer_line(served_demo, phrase)
    assert answer["understood"] == understood
    assert {thing["name"] for thing in answer["instances"]} == names


@pytest.mark.parametrize(
    ("understood", "told"),
    [
        ("(red any object)", "anything red"),
        ('((dark blue any object) left of "mug")', '(anything dark blue left of "mug")'),
        ('(any object on "cloth")', '(any object on "cloth")'),
        ('"red any object"', '"red any object"'),
    ],
)
def test_a_sentence_says_anything_red_where_the_parsed_phrase_says_red_any_object(understood, told):
    assert worded(understood) == told
    assert (
        sentence({"understood": understood, "present": "no", "note": ""}) == f"Not here: nothing fits {told}."
    )


@pytest.mark.parametrize(
    ("typed", "understood"),
    [("blu mug", "blue mug"), ("duk", "duck"), ("mgu", "mug"), ("appel", "apple"),
     ("teh mug", "mug"), ("whre is the bannana", "banana"), ("orang cone", "orange cone")],
)  # fmt: skip
def test_typing_errors_find_what_is_meant_and_are_reported(served_demo, typed, understood):
    answer = answer_line(served_demo, typed)
    (thing,) = answer["instances"]
    (meant,) = answer_line(served_demo, understood)["instances"]
    assert (answer["present"], answer["understood"]) == ("yes", f'"{understood}"')
    assert thing["center"] == meant["center"]
    assert "may be a typing error" in answer["note"]


@pytest.mark.parametrize(
    ("typed", "understood", "word", "meant"),
    [
        ("which tyos are there?", '"toy"', "tyos", "toy"),
        ("mgus on the cloth", '("mug" on "cloth")', "mgus", "mug"),
        ("blu animls", '(blue "animal")', "animls", "animal"),
        ("red aples", '"red apple"', "aples", "apple"),
    ],
)
def test_plurals_with_typing_errors_are_corrected_and_the_word_is_reported_as_it_was_typed(
    served_demo, typed, understood, word, meant
):
    answer = answer_line(served_demo, typed)
    assert answer["understood"] == understood
    assert f'"{word}" may be a typing error: asked for "{meant}"' in answer["note"]


@pytest.mark.parametrize("phrase", ["mug 3", '"apple 42"'])
def test_numbers_are_no_words_that_the_bundled_encoder_knows(served_demo, phrase):
    answer = answer_line(served_demo, phrase)
    assert answer["present"] != "yes"
    assert "the bundled encoder knows English words alone" in answer["note"]


def test_what_is_not_understood_stays_unsure_whatever_was_asked_before(served_demo):
    certain, stated = (
        answer_line(served_demo, "the smallest duck"),
        answer_line(served_demo, "is the duck small?"),
    )
    assert certain["understood"] == stated["understood"] == '(smallest "duck")'
    assert (certain["present"], stated["present"]) == ("yes", "unsure")


@pytest.mark.parametrize(
    ("phrase", "present", "note"),
    [
        ("is there an apple and a cat?", "no", 'nothing fits "cat"'),
        ("is there an apple and a banana?", "yes", ""),
        ("show me the apple and the cat", "yes", 'nothing fits "cat"'),
        ("is everything on the floor?", "no", '0 of 14 are (any object on "floor")'),
    ],
)
def test_what_is_missing_of_a_question_is_reported(served_demo, phrase, present, note):
    answer = answer_line(served_demo, phrase)
    assert (answer["present"], answer["note"]) == (present, note)


@pytest.mark.parametrize("typed", ["qzx", "kup", "tape duk"])
def test_a_word_that_is_none_and_resembles_nothing_here_is_reported(served_demo, typed):
    answer = answer_line(served_demo, typed)
    assert f'"{typed.split()[-1]}"' in answer["note"]
    assert answer["present"] != "yes"


def test_a_threshold_that_nothing_reaches_is_reported_in_a_whole_sentence(served_demo):
    best = float(served_demo.scene.ask("mug").scores.max())
    answer = answer_line(served_demo, '{"ask": "mug", "threshold": 1}')
    assert (answer["count"], answer["instances"]) == (0, [])
    assert answer["note"] == f'nothing of "mug" reaches the threshold 1: the best score is {best:.4f}'
    assert answer["sentence"] == f'None found for "mug". Note: {answer["note"]}.'
    related = find_phrase(served_demo.scene, "mug on the violin", None, 1.0)
    assert (related["present"], related["note"]) == ("no", answer["note"])
    assert find_phrase(served_demo.scene, "mug", None, best)["note"] == ""


@pytest.mark.slow
def test_threads_get_the_answers_of_a_single_one(served_demo):
    phrases = ["red apple", "toys", "what is on the cloth?", "vase left of the bear", "pumpkin", "mugs"]
    alone = {phrase: served_demo.scene.find(phrase).mask for phrase in phrases}
    scene, found, failed = open_scene("demo"), [], []

    def ask(number):
        try:
            phrase = phrases[number % len(phrases)]
            found.append((phrase, scene.find(phrase).mask))
        except BaseException as error:
            failed.append(error)

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    assert len(found) == 12
    for phrase, mask in found:
        assert torch.equal(mask, alone[phrase])


@pytest.mark.slow
def test_a_question_and_a_click_wait_for_no_lock_that_the_other_holds(monkeypatch):
    # Before Python 3.12, all scenes share the lock of a `cached_property`; it is held while colors are embedded.
    # From 3.12 on there is no such lock, and this cannot fail.
    scene, asking, within = open_scene("demo"), threading.Event(), threading.Event()
    encode, colored = scene.encode_text, PresenceClassifier.colored.fget
    scene.embed("red mug")
    scene.question(["mug"])

    def slowly(texts):
        asking.set()
        within.wait(0.5)  # Without the fix it does not wait: the click is within, and holds its lock.
        return encode(texts)

    def listed(classifier):
        within.set()
        return colored(classifier)

    monkeypatch.setattr(scene, "encode_text", slowly)
    monkeypatch.setattr(PresenceClassifier, "colored", property(listed))
    ask = threading.Thread(target=scene.ask, args=("green mug",), daemon=True)
    click = threading.Thread(target=scene.question, args=(["red mug"],), daemon=True)
    ask.start()
    assert asking.wait(30)
    click.start()
    ask.join(30)
    click.join(30)
    assert not ask.is_alive()
    assert not click.is_alive()


@pytest.mark.slow
def test_what_is_kept_is_bounded_and_belongs_to_one_way_of_asking(served_demo, monkeypatch):
    from lexsplat.queries.relevancy import QueryConfig
    from lexsplat.scenes import scene as module

    monkeypatch.setattr(module, "_KEPT_BYTES", 0)
    scene = open_scene("demo")
    scene.query = QueryConfig()
    first = scene.ask("mug")
    for number in range(40):
        scene.ask(f"thing {number}", 0.5)
    assert len(scene._words) == 32
    assert torch.equal(scene.ask("mug").scores, first.scores)
    scene.query = QueryConfig(negatives=("object", "things"))
    assert not torch.equal(scene.ask("mug").scores, first.scores)


def test_a_scene_that_changes_while_it_is_opened_is_read_again_at_the_first_question(tmp_path, monkeypatch):
    folder = tmp_path / "scene"
    shutil.copytree(BUNDLED_SCENE, folder)

    def open_and_change(*arguments, **options):
        scene = open_scene(*arguments, **options)
        record = json.loads((folder / "scene.json").read_text())
        record["world"] = {**record.get("world", {}), "meters_per_unit": 0.1}
        (folder / "scene.json").write_text(json.dumps(record))
        return scene

    with monkeypatch.context() as patched:
        patched.setattr("lexsplat.scenes.serving.open_scene", open_and_change)
        served = OpenScene(folder, "cpu")
    assert served.scene.world.meters_per_unit == 0.1


@pytest.mark.slow
def test_a_scene_that_is_rebuilt_moved_or_deleted_while_it_is_asked(tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(BUNDLED_SCENE, folder)
    served = OpenScene(folder, "cpu")
    before = served.scene
    assert answer_line(served, "red apple")["present"] == "yes"
    record = json.loads((folder / "scene.json").read_text())
    record["world"] = {**record.get("world", {}), "meters_per_unit": 0.1}
    (folder / "scene.json").write_text(json.dumps(record))
    assert served.scene is not before
    assert (
        "0.05" in answer_line(served, "red apple")["sentence"]
        or " m" in answer_line(served, "mug")["sentence"]
    )
    folder.rename(tmp_path / "moved")
    assert "moved or deleted" in answer_line(served, "red apple")["error"]["message"]
    assert not folder.exists()
    (tmp_path / "moved").rename(folder)
    assert answer_line(served, "red apple")["present"] == "yes"
