"""The shape of the project: imports point one way, nothing unsafe is used, importing is quick."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "src" / "lexsplat"

# The packages in the order in which data flow. A module may import only its own package and those before it.
ORDER = (
    "runtime", "geometry", "captures", "rendering", "reconstruction", "features", "codebook", "language", "queries",
    "scenes", "pipeline", "evaluation", "viewer", "cli", "demo",
)  # fmt: skip


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def package(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0]


def imported_packages(tree: ast.AST) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("lexsplat."):
            found.add(node.module.split(".")[1])
        elif isinstance(node, ast.ImportFrom) and node.module == "lexsplat":
            found |= {alias.name for alias in node.names if (PACKAGE / alias.name).is_dir()}
        elif isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("lexsplat.")}
    return found


def test_the_top_folder_shows_the_fifteen_packages_and_the_front_door():
    there = {path.name for path in PACKAGE.iterdir() if path.name != "__pycache__"}
    assert there == {*ORDER, "__init__.py", "__main__.py", "py.typed"}
    assert len(ORDER) <= 15


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_only_to_packages_that_come_before(path):
    own = package(path)
    if own not in ORDER:  # the front door opens scenes and the command line, when they are first used
        return
    for other in imported_packages(ast.parse(path.read_text())) - {own}:
        assert ORDER.index(other) < ORDER.index(own), f"{own} must not import {other}"


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_module_uses_pickle_eval_or_a_bare_except(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names = [a.name for a in node.names] + [getattr(node, "module", None) or ""]
            assert not {"pickle", "dill", "cloudpickle", "marshal"} & set(names)
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in ("eval", "exec", "torch.load", "torch.save"), f"{called} at {node.lineno}"
            if called in ("np.load", "numpy.load"):
                keywords = {k.arg: ast.unparse(k.value) for k in node.keywords}
                assert keywords.get("allow_pickle") == "False"
        assert not (isinstance(node, ast.ExceptHandler) and node.type is None)
        if isinstance(node, ast.Assert):
            pytest.fail(f"assert at {path.name}:{node.lineno}: raise an error with words instead")


def test_importing_lexsplat_does_not_load_the_heavy_libraries():
    heavy = ("torch", "transformers", "gsplat", "pycolmap")
    code = f"import sys, lexsplat; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_command_line_helps_without_the_heavy_libraries():
    code = (
        "import sys; from lexsplat import cli\n"
        "try: cli.main(['--help'])\n"
        "except SystemExit as e: assert e.code == 0\n"
        "print([m for m in ('transformers', 'gsplat', 'pycolmap', 'viser') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip().endswith("[]")
    assert "build" in result.stdout
