"""Identity of results: canonical digests of values, and what a stage depends on besides its inputs: code and packages.

Two values get one digest exactly when they are the same value of the same type. Floats are written by
``float.hex`` (every bit counts, all NaN are one), ``1``, ``1.0`` and ``True`` are three different values, a tuple is
a list, the order of dictionary keys and of sets does not count, and a parameter model counts with all its defaults
filled. Anything else (paths, arrays, NumPy integers, objects) is refused with ``TypeError``: what has no canonical
form must not enter a key.

>>> digest({"cell_size": 0.01}) == digest({"cell_size": 0.010000000000000002})
False

The code digest of a module covers all *own* modules that it reaches by import statements, at any depth and also from
within functions, with the ``__init__`` of every package on the way. Each counts as its syntax tree without
docstrings, so comments, docstrings and formatting change nothing. C sources beside a package's ``__init__`` count with
their bytes. Own are ``rille.stages``, ``rille.datasets`` and the
package of the module itself. Imports under ``if TYPE_CHECKING:`` never run and do not count; modules loaded by a
computed name are not seen, and neither are data files beside the code: keep tables in modules.

A process reads a file once: it digests the source that it imported, even while somebody edits. Parsing all of them
takes most of a second, so the findings are remembered by the bytes of each file (:func:`remember`).

Packages are those that these modules import from elsewhere: found by the same walk, none can be forgotten. Each counts
with its version and the kind of processor that it works for: NumPy, SciPy and OpenCV choose code for the processor that
they find, and sums of floats that are added in another order round to other bits. (OpenBLAS by its core type, NumPy and
OpenCV by the instruction sets in use; compiled kernels of numba add in the order in which they are written.)
"""

from __future__ import annotations

import ast
import ctypes
import hashlib
import importlib.metadata
import importlib.util
import math
import platform
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from json.encoder import encode_basestring_ascii as _quoted
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

from pydantic import BaseModel, TypeAdapter

from rille.pipeline.engine.runtime.atomic import read_hint, write_hint
from rille.pipeline.engine.runtime.private import private_folder
from rille.stages.core.errors import RilleError


def digest(value: Any, where: str = "value") -> str:
    """SHA-256 of the canonical form, 64 hexadecimal digits."""
    return hashlib.sha256(text(value, where).encode()).hexdigest()


def text(value: Any, where: str = "value") -> str:
    """The canonical form: JSON without spaces, keys in order; each JSON list starts with its tag, so no two values
    share a form.

    Raises
    ------
    TypeError
        A part of the value has no canonical form; the message names the place.
    """
    # By type, not isinstance: an enumeration is an int or str, too, and would share the digest of its value.
    kind = type(value)
    if kind is str:
        return _quoted(value)
    if kind is int or value is None or kind is bool:
        return "null" if value is None else repr(value).lower()
    if isinstance(value, float):
        return f'["float","{"nan" if math.isnan(value) else float(value).hex()}"]'
    if isinstance(value, dict):
        for key in value:
            if type(key) is not str:
                raise TypeError(f"{where} has the key {key!r}: keys are text")
        return "{" + ",".join([f"{_quoted(key)}:{text(value[key], f'{where}.{key}')}" for key in sorted(value)]) + "}"
    if isinstance(value, list | tuple):
        return ",".join(['["list"', *[text(item, f"{where}[{i}]") for i, item in enumerate(value)]]) + "]"
    if isinstance(value, set | frozenset):
        return ",".join(['["set"', *sorted(text(item, where) for item in value)]) + "]"
    if isinstance(value, BaseModel):
        fields = {name: getattr(value, name) for name in type(value).model_fields}
        return f'["model",{_quoted(type(value).__name__)},{text(fields, where)}]'
    raise TypeError(f"{where} is a {type(value).__name__}, which has no canonical form: give plain JSON values")


# -- code --------------------------------------------------------------------------------------------------------------

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


# -- packages ----------------------------------------------------------------------------------------------------------

KNOWN = {
    "cv2": ("opencv-python-headless", "opencv-contrib-python-headless", "opencv-python", "opencv-contrib-python"),
    "yaml": ("pyyaml",),
    "PIL": ("pillow",),
}
"""Import name to the distributions that may give it, where they are named otherwise: looking it up takes 0.2 s."""

NAMED = (
    *("rille", "numpy", "numba", "scipy", "opencv-python-headless", "dask", "zarr", "rasterio", "pycolmap"),
    *("matplotlib", "jinja2"),
)
"""Distributions that ``rille --version`` and reports name, and that workers of a cluster must share."""

CORE_NAMES = ("scipy_openblas_get_corename64_", "scipy_openblas_get_corename", "openblas_get_corename")


def versions(module: str) -> dict[str, str]:
    """Version and kind of each distribution that a module and what it reaches import, by the distribution's name.

    Raises
    ------
    RilleError
        One of them is not installed.
    """
    # Left out: pydantic, which only checks parameters, whose values are in the key; the engine; and types.
    names = external_imports(module) - frozenset({"pydantic", "rille", "typing_extensions"})
    if "numba" in names:
        names.add("llvmlite")  # generates the code
    return dict(sorted(_version(name) for name in names))


def installed() -> dict[str, str]:
    """Versions for people: of Python and of :data:`NAMED`; no stage depends on this."""
    return {name: importlib.metadata.version(name) for name in NAMED} | {"python": platform.python_version()}


@cache
def version(distribution: str) -> str:
    """Exact installed version of a distribution, with the kind of processor that it works for, if that matters."""
    found = importlib.metadata.version(distribution)
    kind = _kind(distribution)
    return f"{found} ({kind})" if kind else found


@cache
def _version(name: str) -> tuple[str, str]:
    """Distribution that gives an import name, and its version."""
    for distribution in KNOWN.get(name, (name,)):
        with suppress(importlib.metadata.PackageNotFoundError):
            return distribution, version(distribution)
    for distribution in _distributions().get(name, []):
        return distribution, version(distribution)
    raise RilleError("RIL-530", f"package {name} is not installed", remedy="run `make install`")


_distributions = cache(importlib.metadata.packages_distributions)


def _kind(distribution: str) -> str:
    if distribution == "numpy":
        import numpy as np

        found = np.show_config(mode="dicts")["SIMD Extensions"]
        return " ".join([*found.get("baseline", ()), *found.get("found", ()), _blas("numpy")]).strip()
    if distribution == "scipy":
        return _blas("scipy")
    if distribution in KNOWN["cv2"]:
        import cv2

        return " ".join(word.lstrip("*") for word in cv2.getCPUFeaturesLine().split() if not word.endswith("?"))
    return ""


def _blas(package: str) -> str:
    """Core type that the OpenBLAS of a package has chosen; empty where it brings none."""
    for root in _roots(package):
        for path in (*root.parent.glob(f"{package}.libs/*openblas*"), *root.glob(".dylibs/*openblas*")):
            # Asked of the library itself: the choice depends on the processor and OPENBLAS_CORETYPE, and no package
            # tells it.
            library = ctypes.CDLL(str(path))  # the one that the package has loaded, or will
            for name in CORE_NAMES:
                if hasattr(library, name):
                    function = getattr(library, name)
                    function.restype = ctypes.c_char_p
                    return f"OpenBLAS {(function() or b'').decode(errors='replace')}"
    return ""
