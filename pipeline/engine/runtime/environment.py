"""Environment of every process that runs stages; imports neither NumPy nor numba, which read it only once.

Call :func:`prepare_environment` first thing in a program. Worker processes get the same variables before they start.
"""

from __future__ import annotations

import ctypes
import os
import resource
from contextlib import suppress
from functools import cache

from rille.pipeline.engine.runtime.apart import absolute_search_paths
from rille.pipeline.engine.runtime.kernels import use_own_folder
from rille.stages.core.errors import ConfigError

SINGLE = ("OMP", "OPENBLAS", "MKL", "NUMBA", "BLIS", "VECLIB_MAXIMUM", "NUMEXPR")
MIN_OPEN_FILES = 128


def worker_environment() -> dict[str, str]:
    """One thread a library, and no search path that leads to the current folder."""
    return {f"{name}_NUM_THREADS": "1" for name in SINGLE} | {
        "OPENCV_FOR_THREADS_NUM": "1",
        "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1",  # numba colours a hundred thousand errors that nobody sees
        # a killed worker's semaphores are the tracker's business, not the user's
        "PYTHONWARNINGS": os.environ.get("PYTHONWARNINGS") or "ignore:resource_tracker:UserWarning",
        **absolute_search_paths(),
    }


def prepare_environment() -> None:
    """Set this process up to run stages itself, and to start workers."""
    os.environ.update(worker_environment())
    use_own_folder()
    _keep_memory()


@cache
def _keep_memory() -> None:
    """Let this process keep memory that is freed for what comes next."""
    # Only glibc has it.
    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        # By default it gives back every array, and a tenth of the time of matching goes into taking memory anew.
        mallopt(-3, 32 << 20)  # M_MMAP_THRESHOLD: bytes of a block that it takes from the system by itself
        mallopt(-1, 256 << 20)  # M_TRIM_THRESHOLD: bytes of free memory from which on it gives it back


def permit_open_files() -> None:
    """Let this process open as many files as the system permits: pipes of workers, libraries, artifacts.

    Raises
    ------
    ConfigError
        They are too few for a run of few workers; 80 were enough for two.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    permitted = 8192 if hard == resource.RLIM_INFINITY else min(hard, 8192)
    if permitted < MIN_OPEN_FILES:
        text = f"the system permits {hard} open files, a run needs {MIN_OPEN_FILES}"
        raise ConfigError("RIL-584", text, remedy="raise the limit: ulimit -n 1024")
    if 0 <= soft < permitted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (permitted, hard))


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
