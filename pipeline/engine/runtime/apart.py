"""Nothing of the current folder is imported, loaded or obeyed: who works in an unpacked sequence runs none of its code.

Python and the system's loader look into the current folder where a search path has an empty or a relative entry, and
``python -c``, by which workers and the tracker of their semaphores are started, puts it first. numba and matplotlib
read settings there. An absolute entry of a search path stays: it names its folder itself.
"""

from __future__ import annotations

import importlib.abc
import os
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, chdir, suppress
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

from rille.pipeline.engine.runtime.private import private_folder

Execute = Callable[[ModuleType], None]

SEARCH_PATHS = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")

NUMBA_CONFIG = "numba.core.config"


def environment() -> dict[str, str]:
    """Variables of a process for which no search path depends on where it is started."""
    found = {"PYTHONSAFEPATH": "1"}
    for name in SEARCH_PATHS:
        entries = os.environ.get(name, "").split(os.pathsep)
        # Never empty: cv2 puts a folder of its own and a colon before LD_LIBRARY_PATH, and "" is the current folder.
        found[name] = os.pathsep.join(filter(os.path.isabs, entries)) or os.devnull
    return found


class Apart:
    """While entered, processes that are started look for no module, library or program in the current folder.

    Variables and ``sys.path`` of this process are as before once nobody is in it any more: it may be a user's.
    """

    def __init__(self) -> None:
        self._lock, self._inside, self._empty = threading.Lock(), 0, 0
        self._before: dict[str, str | None] = {}

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._before = {name: os.environ.get(name) for name in environment()}
                # Of an interactive Python; a worker would take it over as the folder in which this process was started.
                self._empty = sys.path.count("")
                sys.path[:] = filter(None, sys.path)
            self._inside += 1
            os.environ.update(environment())

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                sys.path[:0] = [""] * self._empty
                for name, value in self._before.items():
                    os.environ.pop(name)
                    os.environ |= {} if value is None else {name: value}


APART = Apart()


class Hook(importlib.abc.MetaPathFinder):
    """Lets ``run`` execute a module, when it is imported."""

    def __init__(self, name: str, run: Callable[[Execute, ModuleType], None]) -> None:
        self.name, self.run = name, run

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        """Find the module as Python does; also where it is only asked for, and not imported."""
        spec = PathFinder.find_spec(name, path) if name == self.name else None
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module
            spec.loader.exec_module = lambda module: self.run(execute, module)  # type: ignore[method-assign]
        return spec


def hook(name: str, run: Callable[[Execute, ModuleType], None]) -> None:
    """Let ``run`` execute a module that is not imported yet; a second time nothing changes."""
    if not any(isinstance(finder, Hook) and finder.name == name for finder in sys.meta_path):
        sys.meta_path.insert(0, Hook(name, run))


def ignore_settings() -> None:
    """Have numba and matplotlib, which are not imported yet, read no settings of the current folder.

    For processes of our own: while one of them is imported, the process is in another folder.
    """
    for name in (NUMBA_CONFIG, "matplotlib"):
        hook(name, _execute_elsewhere)


def _execute_elsewhere(execute: Execute, module: ModuleType) -> None:
    with ExitStack() as stack:
        with suppress(FileNotFoundError):  # the current folder was removed: it holds nothing
            stack.enter_context(chdir(private_folder()))
        execute(module)
    if module.__name__ == NUMBA_CONFIG:
        module._config_fname = ""  # type: ignore[attr-defined]  # it is read again whenever a kernel is compiled
