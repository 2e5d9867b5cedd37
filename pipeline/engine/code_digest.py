"""What a stage's result depends on besides its inputs: its own source code (for packages:
:mod:`rille.pipeline.engine.packages`).

The code digest of a module covers all *own* modules that it reaches by import statements, at any depth and also from
within functions, with the ``__init__`` of every package on the way. Each counts as its syntax tree without
docstrings, so comments, docstrings and formatting change nothing. C sources beside a package's ``__init__`` count with
their bytes. Own are ``rille.stages``, ``rille.datasets`` and the
package of the module itself. Imports under ``if TYPE_CHECKING:`` never run and do not count; modules loaded by a
computed name are not seen, and neither are data files beside the code: keep tables in modules.

A process reads a file once: it digests the source that it imported, even while somebody edits. Parsing all of them
takes most of a second, so the findings are remembered by the bytes of each file (:func:`remember`).
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from pydantic import TypeAdapter

from rille.pipeline.engine.keys import digest
from rille.pipeline.engine.runtime.hints import read_hint, write_hint
from rille.pipeline.engine.runtime.private import private_folder

OWN = ("rille.stages", "rille.datasets")

_READING = Lock()
"""Held while a source is parsed or the memory changes: runs in several threads share both, and Python 3.11 counts the
depth of a syntax tree over all threads, so that it fails where two are made at once."""


class _Source(NamedTuple):
    """Digest of a module, and absolute dotted names that it may import (attributes among them)."""

    sha256: str
    imports: tuple[str, ...]


@dataclass
class _Kept:
    """What the file of the memory holds; ``digest`` is that of the sources."""

    digest: str
    sources: dict[str, _Source]


_KEPT = TypeAdapter(_Kept)


class _Memory:
    """What was found in source files, by the bytes of each and of this module, as a file keeps it from process to
    process; a damaged file counts as none."""

    def __init__(self, path: Path) -> None:
        self._path, self.used, self.new = path, set[str](), False
        self._reader = hashlib.sha256(f"{sys.version}\0".encode() + Path(__file__).read_bytes()).digest()
        found = read_hint(path, _KEPT)
        self.known = found.sources if found is not None and found.digest == digest(found.sources) else {}

    def name(self, module: str, path: Path, data: bytes) -> str:
        return hashlib.sha256(self._reader + f"{module}\0{path.name}\0".encode() + data).hexdigest()

    def save(self) -> None:
        if not self.new:
            return
        # Eight states of the sources are remembered, before those not in use are forgotten.
        # Each edit adds an entry: without this the file would grow with every save of every module.
        if len(self.known) > 8 * len(self.used):
            self.known = {name: self.known[name] for name in self.used}
        write_hint(self._path, {"digest": digest(self.known), "sources": self.known})
        self.new = False


@cache
def _memory() -> _Memory:
    return _Memory(private_folder() / "sources.json")


def remember() -> None:
    """Write what was found in source files for later processes; a hint, never a matter of correctness."""
    with _READING:
        _memory().save()


@cache
def package_of(module: str) -> str:
    """Package that a module belongs to: ``rille.stages`` of one of Rille's own, else the first part of its name."""
    return ".".join(module.split(".")[: 2 if module.startswith("rille.") else 1])


@cache
def module_digests(module: str) -> dict[str, str]:
    """Digest of each own module that ``module`` reaches, itself included, by dotted name, in order.

    Raises
    ------
    ModuleNotFoundError
        ``module`` itself has no source file.
    """
    own = {*OWN, package_of(module)}
    if _file(module) is None:
        raise ModuleNotFoundError(f"module {module} has no source file", name=module)
    found: dict[str, str] = {}
    queue = [module]
    while queue:
        name = queue.pop()
        # The package first: of modules of others no file is looked for.
        if name in found or package_of(name) not in own or (path := _file(name)) is None:
            continue
        source = _read(name, path)
        found[name] = source.sha256
        queue += source.imports
        found |= _other_languages(name, path)
        # Importing a module runs the __init__ of every package above it.
        queue.append(name.rpartition(".")[0])
    return dict(sorted(found.items()))


@cache
def code_digest(module: str) -> str:
    """One digest of :func:`module_digests`."""
    return digest(module_digests(module))


def tree_digest(own: Iterable[str] = OWN) -> str:
    """One digest of all modules of the own packages, reached or not."""
    found: dict[str, str] = {}
    for package in own:
        for root in _roots(package):
            for path in root.rglob("*.py"):
                parts = path.relative_to(root).with_suffix("").parts
                name = ".".join([package, *(p for p in parts if p != "__init__")])
                try:
                    found[name] = _read(name, path).sha256
                    found |= _other_languages(name, path)
                except SyntaxError:  # somebody is editing; it matters only to who imports it
                    found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    remember()
    return digest(found)


def external_imports(module: str) -> set[str]:
    """Top-level names of what a module and all own modules that it reaches import from elsewhere, but from Python."""
    own = {*OWN, package_of(module)}
    return {
        imported.partition(".")[0]
        for name in module_digests(module)
        if (path := _file(name)) is not None
        for imported in _read(name, path).imports
        if package_of(imported) not in own and imported.partition(".")[0] not in sys.stdlib_module_names
    }


def _other_languages(name: str, path: Path) -> dict[str, str]:
    """Digests of C sources beside a package's ``__init__``, by ``package/file``: what is compiled from them runs."""
    sources = sorted(path.parent.glob("*.[ch]")) if path.name == "__init__.py" else []
    return {f"{name}/{source.name}": hashlib.sha256(source.read_bytes()).hexdigest() for source in sources}


@cache
def _roots(package: str) -> tuple[Path, ...]:
    spec = importlib.util.find_spec(package)
    return tuple(map(Path, (spec and spec.submodule_search_locations) or ()))


@cache
def _file(module: str) -> Path | None:
    package = package_of(module)
    rest = module.split(".")[package.count(".") + 1 :]
    for root in _roots(package):
        base = root.joinpath(*rest)
        for path in (base / "__init__.py", base.parent / f"{base.name}.py" if rest else None):
            if path is not None and path.is_file():
                return path
    return None


@cache
def _read(name: str, path: Path) -> _Source:
    data = path.read_bytes()
    with _READING:
        memory = _memory()
        known = memory.name(name, path, data)
        memory.used.add(known)
        if known not in memory.known:
            tree = _Strip().visit(ast.parse(data))
            # Relative imports count from the package: of an __init__ that is the module itself.
            package = name if path.name == "__init__.py" else name.rpartition(".")[0]
            text = hashlib.sha256(ast.dump(tree).encode()).hexdigest()
            memory.known[known] = _Source(text, tuple(sorted(set(_imports(tree, package)))))
            memory.new = True
        return memory.known[known]


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

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        documents = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if documents else self.generic_visit(node)
