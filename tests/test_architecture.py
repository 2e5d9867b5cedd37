"""The house: one-way imports, what stages keep their hands off, codes for messages."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections import defaultdict
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("stages", "datasets", "pipeline")
FLOORS = (
    "rille.stages.core",
    "rille.stages.facts",
    "rille.stages.geometry rille.stages.numeric",
    "rille.stages.imaging rille.stages.hazard rille.stages.terrain",
    "rille.stages.terrain.locus rille.stages.planning rille.stages.driving",
    "rille.stages.hfvm",
    "rille.stages.odometry rille.stages.planning.local_planner",
    "rille.stages.odometry.resection rille.stages.calibration",
    "rille.stages.evaluation",
    "rille.datasets",
    "rille.pipeline.engine",
    "rille.pipeline.flow",
    "rille.pipeline.export",
    "rille.pipeline.report",
    "rille.pipeline.runs",
    "rille.pipeline.python",
    "rille.pipeline.commands",
    "rille.pipeline",
)
"""Rooms from the ground up: a module imports from its own room and from the floors below it."""
NOT_IN_STAGES = {"zarr", "dask", "distributed", "pathlib", "os", "time", "datetime", "logging", "rich", "random"}
CODE = re.compile(r"RIL-\d{3}")
MODULES = {str(p.relative_to(ROOT)): p for name in PACKAGES for p in sorted((ROOT / name).rglob("*.py"))}


@cache
def parsed(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(tree: ast.Module) -> set[str]:
    """Dotted names that a module imports, or may import, also within functions; ``.`` for relative ones."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {"."} if node.level else {str(node.module), *(f"{node.module}.{a.name}" for a in node.names)}
    return names


@cache
def tops(path: Path) -> set[str]:
    """First parts of the names that a file imports."""
    return {name.split(".")[0] or "." for name in imported(parsed(path))}


def test_modules_are_imported_by_one_name() -> None:
    assert not {name for name, path in MODULES.items() if tops(path) & {*PACKAGES, "."}}


def room(module: str) -> str:
    """The longest name in the table that a module's name begins with."""
    return max((r for floor in FLOORS for r in floor.split() if f"{module}.".startswith(f"{r}.")), key=len)


def floor(name: str) -> int:
    """Number of a room's floor."""
    return next(k for k, floor in enumerate(FLOORS) if name in floor.split())


def upwards(module: str, tree: ast.Module) -> list[str]:
    """Modules of other rooms that a module imports and that are not below it."""
    ours = imported(tree) & NAMES
    return sorted(n for n in ours if room(n) != room(module) and floor(room(n)) >= floor(room(module)))


def name_of(path: Path) -> str:
    """Dotted name of a module."""
    return ".".join(("rille", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")


NAMES = {name_of(p) for p in MODULES.values() if p.name != "__init__.py"}


def test_imports_point_downwards() -> None:
    wrong = {name: upwards(name_of(path), parsed(path)) for name, path in MODULES.items()}
    assert not {name: found for name, found in wrong.items() if found}


def test_the_table_itself_sees_an_import_upwards() -> None:
    below = ast.parse("from rille.stages.terrain import merge")
    assert upwards("rille.stages.geometry.lens", below) == ["rille.stages.terrain.merge"]
    within = ast.parse("def f():\n    import rille.pipeline.cli")
    assert upwards("rille.pipeline.engine.task", within) == ["rille.pipeline.cli"]


def test_stages_know_no_store_no_path_no_clock() -> None:
    # The native solver is compiled and loaded from the folder of its sources.
    compiling = {"stages/hfvm/native/build.py": {"pathlib", "os"}}
    known = {name: tops(path) & NOT_IN_STAGES - compiling.get(name, set()) for name, path in MODULES.items()}
    assert not {name: found for name, found in known.items() if found and name.startswith("stages/")}


def test_every_module_says_what_it_is() -> None:
    assert not [name for name, path in MODULES.items() if not ast.get_docstring(parsed(path))]


def test_kernels_are_compiled_in_one_way() -> None:
    """A plain ``njit`` has each divisor checked, which takes several times as long."""
    assert [name for name, p in MODULES.items() if "njit" in p.read_text(encoding="utf-8")] == ["stages/core/kernel.py"]


def test_the_check_itself_sees_a_wrong_import(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text("def f():\n    from rille.pipeline.engine.store.base import Store\n    import zarr\n")
    assert tops(bad) == {"rille", "zarr"}
    bad = tmp_path / "relative.py"
    bad.write_text("from .base import Store\n")
    assert tops(bad) == {"."}


def test_what_is_imported_is_declared() -> None:
    """An installed wheel has what ``dependencies`` name; an optional extra is imported where it is asked for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    declared = {
        re.split(r"[^A-Za-z0-9._-]", row, maxsplit=1)[0].lower().replace("_", "-")
        for row in [*project["dependencies"], *(row for rows in extras.values() for row in rows)]
    }
    owners = {
        module: {name.lower().replace("_", "-") for name in names} for module, names in packages_distributions().items()
    }
    used = set[str]().union(*map(tops, MODULES.values())) - set(sys.stdlib_module_names) - {"rille"}
    assert {"numpy", "dask", "rosbags"} <= used, "the walk finds imports"
    assert {module for module in used if not owners.get(module, set()) & declared} == set()


def named(node: ast.expr) -> str:
    """``name`` or ``module.name``; empty for anything else."""
    if isinstance(node, ast.Attribute):
        return f"{named(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def error_classes(trees: list[ast.Module]) -> set[str]:
    """Names of RilleError and of every class below it."""
    found = {"RilleError"}
    classes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    while True:
        more = {c.name for c in classes if any(named(base) in found for base in c.bases)} - found
        if not more:
            return found
        found |= more


def coded(call: ast.Call) -> bool:
    """Whether the first argument is a literal code, or one that a caller or another error gives."""
    first = next(iter(call.args), ast.Constant(None))
    if isinstance(first, ast.Constant):
        return CODE.fullmatch(str(first.value)) is not None
    return named(first) == "code" or named(first).endswith(".code")


def without_code(tree: ast.Module, classes: set[str]) -> list[int]:
    """Lines where an error is made whose first argument is no code."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and named(node.func) in classes]
    return [call.lineno for call in calls if not coded(call)]


def codes(tree: ast.Module) -> list[str]:
    """Every literal that is a code."""
    return [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and CODE.fullmatch(str(n.value))]


@cache
def classes_of_rille() -> set[str]:
    """Names of all classes of errors."""
    return error_classes([parsed(path) for path in MODULES.values()])


def test_every_error_has_a_literal_code() -> None:
    classes = classes_of_rille()
    assert {"InputError", "GoneError", "StoreError"} <= classes
    bad = [f"{name}:{line}" for name, path in MODULES.items() for line in without_code(parsed(path), classes)]
    assert not bad, f"give a code that is free as first argument: {bad}"


def test_no_code_is_used_twice() -> None:
    places = defaultdict(list)
    for name, path in MODULES.items():
        for code in codes(parsed(path)):
            places[code].append(name)
    assert len(places) > 250
    assert not {code: where for code, where in places.items() if len(where) > 1}


def test_the_checks_themselves_see_an_error_without_a_code() -> None:
    tree = ast.parse("class A(InputError): ...\ndef f(code):\n    raise A('RIL-12', 'x')\n    raise A(code, 'y')\n")
    assert without_code(tree, error_classes([*map(parsed, MODULES.values()), tree])) == [3]


def matched_by_words(tree: ast.Module, classes: set[str]) -> list[int]:
    """Lines where a test expects one of our errors by its words."""
    found = []
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and named(call.func) == "pytest.raises" and call.args:
            expected = set(re.findall(r"\w+", ast.unparse(call.args[0])))
            if expected & classes and not expected - classes and any(k.arg == "match" for k in call.keywords):
                found.append(call.lineno)
    return found


def test_tests_expect_codes_not_words() -> None:
    classes = classes_of_rille()
    assert matched_by_words(ast.parse("with pytest.raises(InputError, match='x'): f()"), classes) == [1]
    # Only these can: to parse all tests takes seconds.
    tests = [path for path in (ROOT / "tests").rglob("*.py") if "match=" in path.read_text(encoding="utf-8")]
    bad = [f"{path.relative_to(ROOT)}:{line}" for path in tests for line in matched_by_words(parsed(path), classes)]
    assert not bad, f'use `with raises("RIL-123", "facts")` of tests/raising.py: {bad}'


def test_commits_are_checked_by_the_formatter_that_the_tests_use() -> None:
    """The hooks of pre-commit name a revision of ruff, and the development tools a version."""
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    revision = re.search(r"ruff-pre-commit\n +rev: v(\S+)", hooks)
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["dependency-groups"]["dev"]
    assert revision is not None
    assert f"ruff=={revision[1]}" in tools
