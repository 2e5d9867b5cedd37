"""Environment of every process that runs stages; imports neither NumPy nor numba, which read it only once.

Call :func:`prepare_environment` first thing in a program. Worker processes get the same variables before they start.

Nothing of the current folder is imported, loaded or obeyed: who works in an unpacked sequence runs none of its code.
Python and the system's loader look into the current folder where a search path has an empty or a relative entry, and
``python -c``, by which workers and the tracker of their semaphores are started, puts it first. numba and matplotlib
read settings there. An absolute entry of a search path stays: it names its folder itself.
"""

from __future__ import annotations

import ctypes
import importlib.abc
import os
import resource
import sys
from collections.abc import Callable
from contextlib import ExitStack, chdir, suppress
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from threading import Lock
from types import ModuleType
from typing import Any

from rille.pipeline.engine.runtime.kernels import use_own_folder
from rille.pipeline.engine.runtime.private import private_folder
from rille.stages.core.errors import ConfigError

SINGLE = ("OMP", "OPENBLAS", "MKL", "NUMBA", "BLIS", "VECLIB_MAXIMUM", "NUMEXPR")
MIN_OPEN_FILES = 128

SEARCH_PATHS = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")

NUMBA_CONFIG = "numba.core.config"

READ_SETTINGS = (NUMBA_CONFIG, "matplotlib")
"""Modules that read settings of the current folder when they are imported."""

_lock, _was_on_path = Lock(), list[bool]()


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


# -- nothing of the current folder ------------------------------------------------------------------------------------


def absolute_search_paths() -> dict[str, str]:
    """Variables without entries that depend on where a process is started."""
    entries = {name: filter(os.path.isabs, os.environ.get(name, "").split(os.pathsep)) for name in SEARCH_PATHS}
    # Never empty: cv2 puts a folder of its own and a colon before LD_LIBRARY_PATH, and "" is the current folder.
    return {name: os.pathsep.join(kept) or os.devnull for name, kept in entries.items()}


def leave_out() -> None:
    """Have Python processes that are started look for no module in the current folder, until :func:`take_back`.

    Workers would take over an empty entry of ``sys.path``, as an interactive Python has it, and read the file of the
    program, which for ``python -`` is ``<stdin>``, one of the current folder. Runs in one process may overlap: the last
    that ends takes back what the first has done.
    """
    main = sys.modules["__main__"]
    if not os.path.exists(getattr(main, "__file__", None) or __file__):
        del main.__file__
    with _lock:
        os.environ["PYTHONSAFEPATH"] = "1"
        _was_on_path.append("" in sys.path)
        if _was_on_path[-1]:
            sys.path.remove("")


def take_back() -> None:
    """Undo one :func:`leave_out`, so that a program that uses this process notices nothing of it."""
    with _lock:
        if _was_on_path.pop():
            sys.path.insert(0, "")
        if not _was_on_path and not sys.flags.safe_path:
            os.environ.pop("PYTHONSAFEPATH", None)


class _Elsewhere(importlib.abc.MetaPathFinder):
    """Finds modules that read settings of the current folder as Python does, and has them executed elsewhere."""

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        """Find the module; also where it is only asked for, and not imported."""
        spec = PathFinder.find_spec(name, path) if name in READ_SETTINGS else None
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module
            spec.loader.exec_module = lambda module: _execute_elsewhere(execute, module)  # type: ignore[method-assign]
        return spec


def ignore_settings() -> None:
    """Have numba and matplotlib, which are not imported yet, read no settings of the current folder.

    For processes of our own: while one of them is imported, the process is in another folder.
    """
    if not any(isinstance(finder, _Elsewhere) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Elsewhere())
    if not os.access(os.path.expanduser("~"), os.W_OK):  # of a service; matplotlib would complain in each process
        os.environ.setdefault("MPLCONFIGDIR", str(private_folder() / "matplotlib"))


def _execute_elsewhere(execute: Callable[[ModuleType], None], module: ModuleType) -> None:
    with ExitStack() as stack:
        with suppress(FileNotFoundError):  # the current folder was removed: it holds nothing
            stack.enter_context(chdir(private_folder()))
        execute(module)
    if module.__name__ == NUMBA_CONFIG:
        module.reload_config = lambda: None  # type: ignore[attr-defined]  # called whenever a kernel is compiled
