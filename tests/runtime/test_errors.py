import pickle
import re
from pathlib import Path

import pytest

from lexsplat.runtime import errors
from lexsplat.runtime.errors import CaptureError, LexsplatError

KINDS = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, LexsplatError) and kind is not LexsplatError
]


def test_a_message_is_one_line_with_subject_expected_found_and_remedy():
    error = CaptureError("a.jpg", expected="an\n  image", found="text", remedy="replace it")
    assert str(error) == "a.jpg: expected an image, found text; replace it"


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, "a.jpg"),
        ({"found": "text"}, "a.jpg: found text"),
        ({"remedy": "go"}, "a.jpg; go"),
        ({"expected": "x", "remedy": "go"}, "a.jpg: expected x; go"),
    ],
)
def test_parts_that_are_not_given_leave_no_trace(parts, message):
    assert str(CaptureError("a.jpg", **parts)) == message


@pytest.mark.parametrize("kind", KINDS)
def test_errors_survive_the_way_between_processes(kind):
    error = kind("subject", expected="a", found="b", remedy="c")
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is kind
    assert (str(copy), copy.subject, copy.found) == (str(error), "subject", "b")


def test_there_is_one_base_to_catch():
    assert len(KINDS) >= 7
    assert not issubclass(LexsplatError, ValueError)


def test_the_page_about_the_api_lists_every_error_and_no_other():
    text = (Path(__file__).parents[2] / "docs" / "api.md").read_text(encoding="utf-8")
    section = text.split("\n## Exceptions\n", 1)[1].split("\n## ", 1)[0]
    assert sorted(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)) == sorted(
        kind.__name__ for kind in KINDS
    )
