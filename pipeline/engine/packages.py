"""Packages that a stage's result depends on: those that its modules import, with version and kind of processor.

They are found by the same walk over import statements as the code digest (:mod:`rille.pipeline.engine.code_digest`), so
none can be forgotten. NumPy, SciPy and OpenCV choose code for the processor that they find, and sums of floats that are
added in another order round to other bits: so the kind that each works for belongs to its version. (OpenBLAS by its
core type, NumPy and OpenCV by the instruction sets in use; compiled kernels of numba add in the order in which they
are written.)
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
import platform
from contextlib import suppress
from functools import cache
from pathlib import Path

from rille.pipeline.engine.code_digest import external_imports
from rille.stages.core.errors import RilleError

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
    spec = importlib.util.find_spec(package)
    for root in map(Path, (spec and spec.submodule_search_locations) or ()):
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
