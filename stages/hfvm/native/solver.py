"""The solver of a level: the native one where it can be had, else the reference; both give the same integers."""

from __future__ import annotations

import multiprocessing
import warnings
from typing import Any

from rille.stages.hfvm.native import build, reference
from rille.stages.hfvm.native.library import Library


def _native() -> Library | None:
    """The solver in C; compiled anew where there is none of these sources. None: it cannot be compiled or loaded."""
    path = build.binary()
    binary = path if path.is_file() else build.compiled()
    try:
        return None if binary is None else Library(str(binary))
    except OSError:
        return None


def _chosen() -> Any:
    native = _native()
    # Workers are processes of their own, and one warning is enough.
    if native is None and multiprocessing.parent_process() is None:
        text = "the compiled matcher is missing: matching takes two to five times as long, with the same results"
        line = _warning("RIL-393", text, remedy="install a C compiler (cc), and then rille again")
        warnings.warn(line, RuntimeWarning, stacklevel=3)
    return native or reference


def _warning(code: str, text: str, remedy: str) -> str:
    return f"{code}: {text}; {remedy}"


solver: Any = _chosen()
"""Functions of :mod:`rille.stages.hfvm.native.reference`."""
