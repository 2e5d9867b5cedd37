"""Checks of the program that starts a run: whether it may have the workers that it asks for."""

from __future__ import annotations

import ast
import inspect
import multiprocessing
import os
import re
import traceback
from functools import cache
from pathlib import Path
from typing import Any

from rille.stages.core.errors import ConfigError

KINDS = ("dask", "inline")


def check(kind: Any, jobs: int | None = None) -> None:
    """Refuse an unknown executor before any work.

    Raises
    ------
    ConfigError
        It is neither one of the kinds nor an address nor an open ``Client`` of dask, or there are no ``jobs``; or this
        process runs a program whose workers would run it again, may start no workers, or was forked after a run.
    """
    if not isinstance(kind, str):
        from distributed import Client

        # A closed one has no scheduler; calls of an asynchronous one give coroutines.
        if not isinstance(kind, Client) or kind.scheduler is None or kind.asynchronous:
            text = f"{kind!r} is no open Client of dask, or an asynchronous one"
            raise ConfigError("RIL-588", text, remedy="give Client(...) without asynchronous=True, or leave client out")
    elif kind not in KINDS and not re.fullmatch(r"(tcp|tls)://[^/\s]+:\d+", kind):
        raise ConfigError("RIL-539", f"executor {kind!r} is unknown", remedy=f"{', '.join(KINDS)} or tcp://host:port")
    if kind == "dask" and (where := _unguarded()):
        text = f"{where} runs whenever the program is imported, which each worker does that starts"
        raise ConfigError("RIL-972", text, remedy='put what the program does under `if __name__ == "__main__":`')
    # One of multiprocessing's pools, or of another cluster of dask: Python lets no daemon start processes.
    if kind == "dask" and multiprocessing.current_process().daemon:
        text = "a process of a pool, or a worker of dask, cannot start workers"
        raise ConfigError("RIL-542", text, remedy='give executor="inline"')
    if _process_of_first_run() != os.getpid():
        text = "this process was forked from one that had a run, whose threads it lacks: it would wait for ever"
        raise ConfigError("RIL-543", text, remedy='start it by multiprocessing.get_context("spawn")')
    if jobs is not None and jobs < 1:
        raise ConfigError("RIL-540", f"{jobs} jobs are not permitted", remedy="give 1 or more")


def _unguarded() -> str:
    """Place in the program from which this is called, if a spawned worker, which imports the program, comes there, too;
    empty if a guard keeps it away."""
    for frame, line in traceback.walk_stack(inspect.currentframe()):
        if frame.f_code.co_name == "<module>" and frame.f_globals.get("__name__") in ("__main__", "__mp_main__"):
            file, spec = frame.f_code.co_filename, frame.f_globals.get("__spec__")
            if spec is not None and spec.name.endswith("__main__"):  # of a package: no worker imports that
                return ""
            try:
                statements = ast.parse(Path(file).read_bytes()).body
            except (OSError, SyntaxError, ValueError):  # of an interactive Python there is no file
                return ""
            here = [ast.unparse(one) for one in statements if one.lineno <= line <= (one.end_lineno or 0)]
            return "" if any("__name__" in statement for statement in here) else f"line {line} of {file}"
    return ""


@cache
def _process_of_first_run() -> int:
    """Return the number of the process that asked first; a fork inherits the answer."""
    return os.getpid()
