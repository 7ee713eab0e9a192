"""The tests mirror the packages, and share code only through `support` and fixtures."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
PACKAGES = {path.name for path in (TESTS.parent / "src" / "lexsplat").iterdir() if path.is_dir()}
OTHERS = {"data", "hostile", "project", "support"}
"""Folders of tests that belong to no package: files, damaged inputs of all packages, the repository, helpers."""
TEST_MODULES = {path.stem for path in TESTS.rglob("test_*.py")}


def imported_modules(source: str) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module or ''}.{alias.name}" for alias in node.names}
    return found


def imported_tests(source: str) -> list[str]:
    return [name for name in imported_modules(source) if TEST_MODULES & set(name.split("."))]


@pytest.mark.slow
def test_no_module_of_the_tests_imports_a_test_module():
    for path in sorted(TESTS.rglob("*.py")):
        assert imported_tests(path.read_text(encoding="utf-8")) == [], path


def test_an_import_of_a_test_module_is_noticed():
    assert imported_tests("import numpy\nfrom support.poses import look") == []
    for line in (
        "import test_blocks",
        "from test_blocks import points",
        "from reconstruction import test_blocks",
    ):
        assert len(imported_tests(line)) == 1


def test_each_package_has_a_folder_of_tests_and_each_folder_is_of_a_package():
    folders = {path.name for path in TESTS.iterdir() if path.is_dir() and any(path.rglob("*.py"))}
    assert folders - OTHERS == PACKAGES - {"demo", "__pycache__"}  # demo is data
    assert not list(TESTS.glob("test_*.py"))


def test_no_module_of_the_tests_and_the_tools_has_more_than_450_lines():
    for path in sorted([*TESTS.rglob("*.py"), *(TESTS.parent / "tools").rglob("*.py")]):
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 450, path
