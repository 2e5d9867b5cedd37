"""The house: one-way imports, and what stages keep their hands off."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MAY_IMPORT = {"stages": {"stages"}, "datasets": {"datasets", "stages"}, "pipeline": {"pipeline", "datasets", "stages"}}
NOT_IN_STAGES = {"zarr", "dask", "distributed", "pathlib", "os", "time", "datetime", "logging", "rich", "random"}
MODULES = sorted(p for name in MAY_IMPORT for p in (ROOT / name).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Top-level names that a module imports, also within functions."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add("." if node.level else str(node.module).split(".")[0])
    return names


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_one_way(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    ours = imported(path) & (set(MAY_IMPORT) | {"."})
    assert ours <= MAY_IMPORT[package]


@pytest.mark.parametrize("path", [p for p in MODULES if p.relative_to(ROOT).parts[0] == "stages"], ids=lambda p: p.stem)
def test_stages_know_no_store_no_path_no_clock(path: Path) -> None:
    assert not imported(path) & NOT_IN_STAGES


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_module_says_what_it_is(path: Path) -> None:
    assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))


def test_the_check_itself_sees_a_wrong_import(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text("def f():\n    from pipeline.store import Store\n    import zarr\n")
    assert imported(bad) == {"pipeline", "zarr"}
