"""What a stage's result depends on besides its inputs: its own source code and the packages it declares.

The code digest of a module covers all *own* modules that it reaches by import statements, at any depth and also from
within functions, with the ``__init__`` of every package on the way. Each counts as its syntax tree without
docstrings, so comments, docstrings and formatting change nothing. Own are ``stages``, ``datasets`` and the top-level
package of the module itself. Imports under ``if TYPE_CHECKING:`` never run and do not count; modules loaded by a
computed name are not seen, and neither are data files beside the code: keep tables in modules.

A file is read once a process: what is digested is what was imported, even while somebody edits.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.metadata
import importlib.util
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from pipeline.key import digest
from stages.errors import RilleError

OWN = ("stages", "datasets")


class MissingPackageError(RilleError):
    """A distribution that a stage declares is not installed."""


@dataclass(frozen=True)
class _Source:
    sha256: str
    imports: tuple[str, ...]
    """Absolute dotted names that the module may import (attributes among them)."""


def module_digests(module: str, own: Iterable[str] = OWN) -> dict[str, str]:
    """Digest of each own module that ``module`` reaches, itself included, by dotted name.

    Raises
    ------
    ModuleNotFoundError
        ``module`` itself has no source file.
    """
    packages = tuple(sorted({*own, module.partition(".")[0]}))
    return dict(_reachable(module, packages))


def code_digest(module: str, own: Iterable[str] = OWN) -> str:
    """One digest of :func:`module_digests`."""
    return digest(module_digests(module, own))


def tree_digest(own: Iterable[str] = OWN) -> str:
    """One digest of all modules of the own packages, reached or not (numba's cache folder is named by it)."""
    found: dict[str, str] = {}
    for package in own:
        for root in _roots(package):
            for path in root.rglob("*.py"):
                parts = path.relative_to(root).with_suffix("").parts
                name = ".".join([package, *(p for p in parts if p != "__init__")])
                try:
                    found[name] = _read(name, path).sha256
                except SyntaxError:  # somebody is editing; it matters only to who imports it
                    found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return digest(found)


@cache
def version(distribution: str) -> str:
    """Exact installed version of a distribution."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError as error:
        raise MissingPackageError(f"package {distribution} is not installed", remedy="run `make install`") from error


def environment(requires: Iterable[str]) -> dict[str, str]:
    """Exact installed versions of the distributions that a stage declares."""
    return {name: version(name) for name in sorted(requires)}


@cache
def _reachable(module: str, packages: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    if _file(module) is None:
        raise ModuleNotFoundError(f"module {module} has no source file", name=module)
    found: dict[str, str] = {}
    queue = [module]
    while queue:
        name = queue.pop()
        path = _file(name)
        if name in found or path is None or name.partition(".")[0] not in packages:
            continue
        source = _read(name, path)
        found[name] = source.sha256
        queue += source.imports
        queue += _parents(name)
    return tuple(sorted(found.items()))


def _parents(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[:n]) for n in range(1, len(parts))]


@cache
def _roots(package: str) -> tuple[Path, ...]:
    spec = importlib.util.find_spec(package)
    if spec is None:
        return ()
    return tuple(Path(p) for p in spec.submodule_search_locations or ())


@cache
def _file(module: str) -> Path | None:
    package, *rest = module.split(".")
    for root in _roots(package):
        base = root.joinpath(*rest)
        for path in (base / "__init__.py", base.parent / f"{base.name}.py" if rest else None):
            if path is not None and path.is_file():
                return path
    return None


@cache
def _read(name: str, path: Path) -> _Source:
    tree = _Strip().visit(ast.parse(path.read_bytes()))
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    text = ast.dump(tree)
    return _Source(hashlib.sha256(text.encode()).hexdigest(), tuple(sorted(set(_imports(tree, package)))))


def _imports(tree: ast.AST, package: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)  # a submodule, or an attribute: no such file


class _Strip(ast.NodeTransformer):
    """Takes away what never runs: docstrings, and what stands under ``if TYPE_CHECKING:``."""

    def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
        test = node.test
        name = test.id if isinstance(test, ast.Name) else test.attr if isinstance(test, ast.Attribute) else ""
        self.generic_visit(node)
        return node.orelse if name == "TYPE_CHECKING" else node

    def _documented(self, node: ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> ast.AST:
        if ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:]
        self.generic_visit(node)
        return node

    visit_Module = visit_ClassDef = visit_FunctionDef = visit_AsyncFunctionDef = _documented
