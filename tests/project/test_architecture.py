"""The shape of the project: imports point one way, nothing unsafe is used, importing is quick."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "src" / "lexsplat"

# The packages in the order in which data flow. A module may import only its own package and those before it.
ORDER = (
    "runtime", "geometry", "captures", "rendering", "reconstruction", "features", "codebook", "language", "queries",
    "scenes", "pipeline", "evaluation", "viewer", "mcp", "cli",
)  # fmt: skip


every_package = pytest.mark.parametrize("package", [*ORDER, "demo", "."])


@cache
def modules(package: str) -> dict[Path, list[ast.AST]]:
    """All nodes of the modules of a package; "." is the top folder."""
    paths = PACKAGE.glob("*.py") if package == "." else (PACKAGE / package).rglob("*.py")
    return {
        path.relative_to(PACKAGE): list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        for path in sorted(paths)
    }


def imported_packages(nodes: list[ast.AST]) -> set[str]:
    found = set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("lexsplat."):
            found.add(node.module.split(".")[1])
        elif isinstance(node, ast.ImportFrom) and node.module == "lexsplat":
            found |= {alias.name for alias in node.names if (PACKAGE / alias.name).is_dir()}
        elif isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("lexsplat.")}
    return found


def dotted(function: ast.expr) -> str:
    """The name of a called function, such as ``torch.load``; of others, "" and what follows."""
    if isinstance(function, ast.Attribute):
        return f"{dotted(function.value)}.{function.attr}"
    return function.id if isinstance(function, ast.Name) else ""


def test_the_top_folder_shows_the_fifteen_packages_the_data_and_the_front_door():
    there = {path.name for path in PACKAGE.iterdir() if path.name != "__pycache__"}
    assert there == {*ORDER, "demo", "__init__.py", "__main__.py", "py.typed"}
    assert len(ORDER) <= 15


@pytest.mark.slow
@pytest.mark.parametrize("package", ORDER)
def test_imports_point_only_to_packages_that_come_before(package):
    for path, nodes in modules(package).items():
        for other in imported_packages(nodes) - {package}:
            assert ORDER.index(other) < ORDER.index(package), f"{path} must not import {other}"


@pytest.mark.slow
@every_package
def test_no_module_uses_pickle_eval_or_a_bare_except(package):
    for path, nodes in modules(package).items():
        for node in nodes:
            where = f"{path}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                names = [a.name for a in node.names] + [getattr(node, "module", None) or ""]
                assert not {"pickle", "dill", "cloudpickle", "marshal"} & set(names), where
            if isinstance(node, ast.Call):
                called = dotted(node.func)
                assert called not in ("eval", "exec", "torch.save"), f"{called} at {where}"
                keywords = {k.arg: getattr(k.value, "value", None) for k in node.keywords}
                if called == "torch.load":  # weights of encoders; it then reads tensors only
                    assert keywords.get("weights_only") is True, where
                    assert path.name == "weights.py", where
                if called in ("np.load", "numpy.load"):
                    assert keywords.get("allow_pickle") is False, where
            assert not (isinstance(node, ast.ExceptHandler) and node.type is None), where
            assert not isinstance(node, ast.Assert), f"assert at {where}: raise an error with words instead"


@every_package
def test_no_module_has_more_than_450_lines(package):
    for path in modules(package):
        assert len((PACKAGE / path).read_text(encoding="utf-8").splitlines()) <= 450, path


def unexplained(source: str, nodes: list[ast.AST] | None = None, most: int = 7) -> list[str]:
    """Functions with more than ``most`` parameters, self and cls aside, and no comment in the line above."""
    lines, found = source.splitlines(), []
    for node in ast.walk(ast.parse(source)) if nodes is None else nodes:
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        given = node.args
        every = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
        count = sum(1 for parameter in every if parameter and parameter.arg not in ("self", "cls"))
        above = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)]) - 2
        if count > most and not (above >= 0 and lines[above].strip().startswith("#")):
            found.append(f"{node.name} has {count} parameters")
    return found


@every_package
def test_functions_have_at_most_seven_parameters_or_a_reason_above(package):
    for path, nodes in modules(package).items():
        if "kernels" in path.parts or path.stem.endswith(("_kernel", "_kernels")):
            continue  # kernels take arrays and numbers one by one
        assert not unexplained((PACKAGE / path).read_text(encoding="utf-8"), nodes), path


def test_parameters_of_all_kinds_are_counted_and_a_reason_stands_above_the_decorators():
    eight = "def f(self, a, /, b, c, *d, e, g, h, **i): ..."
    assert unexplained(eight) == ["f has 8 parameters"]
    assert unexplained(f"class C:\n    # Why.\n    @wrap\n    {eight}") == []
    assert unexplained(f"# Why.\n\n@wrap\n{eight}") == ["f has 8 parameters"]
    assert unexplained(eight.replace(", **i", "")) == []
