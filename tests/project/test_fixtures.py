"""A fixture name has one meaning over all test files: fixtures of one name give one type."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]


def types_of_fixtures(sources: dict[str, str]) -> dict[str, dict[str, str | None]]:
    """The return annotation of each fixture, by name and file; None where there is none."""
    found: dict[str, dict[str, str | None]] = defaultdict(dict)
    for file, source in sources.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.FunctionDef) and any(
                ast.unparse(decorator).startswith("pytest.fixture") for decorator in node.decorator_list
            ):
                found[node.name][file] = ast.unparse(node.returns) if node.returns else None
    return found


def ambiguous(found: dict[str, dict[str, str | None]]) -> dict[str, dict[str, str | None]]:
    """Fixtures of several files that have no annotation, or not the same one."""
    return {
        name: types
        for name, types in found.items()
        if len(types) > 1 and (None in types.values() or len(set(types.values())) > 1)
    }


@pytest.mark.slow
def test_fixtures_of_one_name_give_one_annotated_type():
    sources = {str(path.relative_to(TESTS)): path.read_text() for path in TESTS.rglob("*.py")}
    found = types_of_fixtures(sources)
    assert len(found) > 50
    assert ambiguous(found) == {}


def test_a_name_with_two_types_or_none_is_noticed():
    fixture = "import pytest\n@pytest.fixture\ndef points(){}: ...\n"
    number, text, nothing = (fixture.replace("{}", each) for each in (" -> int", " -> str", ""))
    for sources, noticed in (
        ({"a": number, "b": number}, set()),
        ({"a": number, "b": text}, {"points"}),
        ({"a": nothing, "b": nothing}, {"points"}),
        ({"a": nothing}, set()),
    ):
        assert set(ambiguous(types_of_fixtures(sources))) == noticed
