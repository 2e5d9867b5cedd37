"""Environment of every process that runs stages; imports neither NumPy nor numba, which read it only once.

Call :func:`prepare_environment` first thing in a program. Worker processes get the same variables before they start.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from pipeline.code import remember_in, tree_digest
from pipeline.kernels import guard
from pipeline.location import hints_folder, locate

SINGLE = ("OMP", "OPENBLAS", "MKL", "NUMBA", "BLIS", "VECLIB_MAXIMUM", "NUMEXPR")


def worker_environment(cache: Path | str) -> dict[str, str]:
    """One thread a library, and numba's cache in a folder named by the digest of all own code.

    Numba does not notice that a callee in another file has changed (numba#1833), hence a folder for each state of
    the sources.
    """
    cache = hints_folder(locate(cache))
    return {f"{name}_NUM_THREADS": "1" for name in SINGLE} | {
        "OPENCV_FOR_THREADS_NUM": "1",
        # a killed worker's semaphores are the tracker's business, not the user's
        "PYTHONWARNINGS": os.environ.get("PYTHONWARNINGS") or "ignore:resource_tracker:UserWarning",
        "NUMBA_CACHE_DIR": str(cache.absolute() / "numba" / tree_digest()[:32]),
    }


def prepare_environment(cache: Path | str) -> None:
    """Set this process up to run stages itself, and to start workers."""
    cache = hints_folder(locate(cache))
    remember_in(cache / "sources.json")
    environment = worker_environment(cache)
    os.environ.update(environment)
    guard()
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = environment["NUMBA_CACHE_DIR"]


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
