"""Package data: every file of the demo and every template, and no other files."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # a dependency of pytest

REPOSITORY = Path(__file__).parents[2]
DATA = REPOSITORY / "src" / "lexsplat"
PAGE = ("LICENSES.txt", "index.html", "page.css", "page.js", "page.wasm", "words.txt")


def patterns() -> list[str]:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    return project["tool"]["setuptools"]["package-data"]["lexsplat"]


def packaged(root: Path) -> set[str]:
    found = (path for pattern in patterns() for path in root.glob(pattern) if path.is_file())
    return {path.relative_to(root).as_posix() for path in found}


def test_every_file_of_the_demo_of_the_page_and_every_template_is_packaged():
    bundled = {
        path.relative_to(DATA).as_posix()
        for path in (DATA / "demo").rglob("*")
        if path.is_file()
        and path.suffix not in (".py", ".pyc")
        and path.name[0] != "."
        and "ground_truth" not in path.parts
    }
    assert len(bundled) > 400
    templates = {path.relative_to(DATA).as_posix() for path in DATA.rglob("templates/*.*")}
    page = {f"scenes/publishing/page/{name}" for name in PAGE}
    assert bundled | templates | page | {"py.typed", "queries/everyday_words.txt"} == packaged(DATA)


def test_package_data_take_less_than_38_megabytes():
    assert sum((DATA / path).stat().st_size for path in packaged(DATA)) < 38_000_000


@pytest.mark.parametrize(
    "stray",
    [
        "demo/__pycache__/demo.cpython-311.pyc",
        "demo/captures/tabletop/truth/view_000.npz",
        "demo/captures/tabletop/truth/things.json",
        "demo/captures/tabletop/images/.DS_Store",
        "demo/scene/codes/view_000.png",
    ],
)
def test_files_left_by_tools_and_runs_are_not_packaged(tmp_path, stray):
    path = tmp_path / stray
    path.parent.mkdir(parents=True)
    path.touch()
    assert packaged(tmp_path) == set()
