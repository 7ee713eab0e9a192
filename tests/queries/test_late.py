"""Patterns that are compiled when they are first used."""

import re

import pytest

from lexsplat.queries import patterns
from lexsplat.queries.late import late


def test_a_late_pattern_answers_as_a_compiled_one():
    pattern, compiled = (make(r"(?P<number>\d+) (mug)s?", re.IGNORECASE) for make in (late, re.compile))
    text = "3 MUGS and 1 mug"
    for name in ("match", "search", "fullmatch"):
        for words in (text, "3 mugs", "none"):
            found, expected = getattr(pattern, name)(words), getattr(compiled, name)(words)
            assert (found and (found.span(), found.groupdict())) == (
                expected and (expected.span(), expected.groupdict())
            )
    assert pattern.sub(r"\2", text) == compiled.sub(r"\2", text)
    assert [found.span() for found in pattern.finditer(text)] == [m.span() for m in compiled.finditer(text)]
    assert (pattern.pattern, pattern.flags) == (compiled.pattern, compiled.flags)


def test_a_late_pattern_is_compiled_once_and_not_before_its_use(monkeypatch):
    calls, compile_now = [], re.compile
    monkeypatch.setattr(re, "compile", lambda *arguments: calls.append(arguments) or compile_now(*arguments))
    pattern = late("mug")
    assert not calls
    assert pattern.match("mug")
    assert pattern.search("a mug")
    assert len(calls) == 1


def test_every_pattern_of_the_grammar_compiles():
    found = [value for name, value in vars(patterns).items() if name.isupper() and hasattr(value, "pattern")]
    assert len(found) > 40
    for pattern in found:
        assert pattern.flags & re.UNICODE


def test_a_late_pattern_with_an_error_raises_at_its_use():
    pattern = late("(")
    with pytest.raises(re.error):
        pattern.match("mug")
