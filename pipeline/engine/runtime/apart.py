"""Nothing of the current folder is imported, loaded or obeyed: who works in an unpacked sequence runs none of its code.

Python and the system's loader look into the current folder where a search path has an empty or a relative entry, and
``python -c``, by which workers and the tracker of their semaphores are started, puts it first. numba and matplotlib
read settings there. An absolute entry of a search path stays: it names its folder itself.
"""

from __future__ import annotations

import importlib.abc
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack, chdir, suppress
from importlib.machinery import ModuleSpec, PathFinder
from threading import Lock
from types import ModuleType
from typing import Any

from rille.pipeline.engine.runtime.private import private_folder

SEARCH_PATHS = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")

NUMBA_CONFIG = "numba.core.config"

READ_SETTINGS = (NUMBA_CONFIG, "matplotlib")
"""Modules that read settings of the current folder when they are imported."""

_lock, _was_on_path = Lock(), list[bool]()


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
