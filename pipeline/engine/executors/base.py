"""Executors run tasks: on dask workers, or one after the other in this process.

:func:`make` is the one factory. Workers are those of a cluster of this machine (one process a core, one thread
each), of a scheduler that others have started, or behind a ``Client`` that was handed in: the same code path
(:mod:`rille.pipeline.engine.executors.dask_client`).

Programs call :func:`rille.pipeline.engine.runtime.environment.prepare_environment` first thing, so that this process
and the workers run alike.
"""

from __future__ import annotations

import multiprocessing
import pickle
import re
import traceback
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from rille.pipeline.engine.runtime.interrupts import held
from rille.pipeline.engine.spec import Spec, flat
from rille.pipeline.engine.store.manifest import Ref
from rille.pipeline.engine.task import Outcome, ensure
from rille.stages.core.errors import ConfigError

KINDS = ("dask", "inline")

Given = Ref | int
"""An input: the artifact, or the number of the task in flight that makes it."""


def light(ref: Ref) -> Ref:
    """Return a reference without its facts: a task reads them from the store, and those of a trajectory are large."""
    return replace(ref, meta={})


@dataclass(frozen=True)
class Task:
    """A call of :func:`~rille.pipeline.engine.task.ensure`; ``key`` is empty while an input is still to come.

    The least ``number`` runs first.
    """

    number: int
    root: Path
    spec: Spec
    refs: Mapping[str, Given | list[Given]]
    key: str = ""
    force: bool = False

    def upstream(self) -> list[int]:
        """Numbers of the tasks in flight that it waits for."""
        # Each once and in a fixed order: a worker pairs the results that it gets with these numbers by their position.
        return list(dict.fromkeys(g for g in flat(self.refs) if isinstance(g, int)))

    def run(self, made: Mapping[int, Ref]) -> Outcome | Failed:
        """Run it here, with the artifacts of the tasks that it waited for."""

        def ref(given: Given) -> Ref:
            return made[given] if isinstance(given, int) else given

        refs = {
            port: [ref(g) for g in given] if isinstance(given, list) else ref(given)
            for port, given in self.refs.items()
        }
        try:
            return ensure(self.root, self.spec, refs, key=self.key or None, force=self.force)
        except Exception as error:
            return Failed.of(error)


@dataclass(frozen=True)
class Failed:
    """An exception that travels as a value, with the text of its traceback."""

    error: BaseException
    traceback: str

    @staticmethod
    def of(error: BaseException) -> Failed:
        """Wrap an exception; one that cannot be pickled is replaced by its words."""
        text = "".join(traceback.format_exception(error))
        try:
            # Both ways: exceptions with arguments of their own often pickle, and fail when they are made anew.
            pickle.loads(pickle.dumps(error))
        except Exception:
            error = RuntimeError(f"{type(error).__name__}: {error}")
        return Failed(error, text)


class NotBegun:
    """In the place of an outcome: an input did not come, the run was stopped, or the worker died."""


Landed = list[tuple[int, Outcome | Failed | NotBegun]]


class Executor(Protocol):
    """Runs tasks, each known by its number."""

    slots: int
    """Tasks that run at a time."""
    depth: int
    """Tasks that it may have for each slot: enough that workers need not wait for this process."""

    @property
    def pages(self) -> str:
        """Sentence with the address of the dashboard; empty without one."""

    def free(self) -> bool:
        """Whether it takes more tasks now."""

    def submit(self, tasks: Sequence[Task]) -> None:
        """Start tasks, each after those in flight that it waits for."""

    def wait(self) -> Landed:
        """Block until at least one task has ended."""

    def halt(self) -> None:
        """Begin nothing more; what was submitted and not begun comes back so."""

    def close(self, kill: bool = False) -> None:
        """Leave nothing behind; ``kill`` does not wait for what is running."""


def known(kind: Any, jobs: int | None = None) -> None:
    """Refuse an executor that there is not, before any work.

    Raises
    ------
    ConfigError
        It is neither one of the kinds nor an address nor an open ``Client`` of dask, or there are no ``jobs``; or this
        process is a worker that imports its program.
    """
    if not isinstance(kind, str):
        from distributed import Client

        # A closed one has no scheduler; calls of an asynchronous one give coroutines.
        if not isinstance(kind, Client) or kind.scheduler is None or kind.asynchronous:
            text = f"{kind!r} is no open Client of dask, or an asynchronous one"
            raise ConfigError("RIL-588", text, remedy="give Client(...) without asynchronous=True, or leave client out")
    if isinstance(kind, str) and kind not in KINDS and not re.fullmatch(r"(tcp|tls)://[^/\s]+:\d+", kind):
        raise ConfigError("RIL-539", f"executor {kind!r} is unknown", remedy=f"{', '.join(KINDS)} or tcp://host:port")
    # A spawned worker imports the program's main module first: without a guard it would start workers of its own.
    if kind == "dask" and getattr(multiprocessing.current_process(), "_inheriting", False):
        raise ConfigError(
            "RIL-972",
            "a worker that starts came to this call",
            remedy='put what the program does under `if __name__ == "__main__":`',
        )
    if jobs is not None and jobs < 1:
        raise ConfigError("RIL-540", f"{jobs} jobs are not permitted", remedy="give 1 or more")


def make(kind: Any, jobs: int, cache: Path, memory: float) -> Executor:
    """``dask``, the address of a scheduler, a ``Client`` of dask, or ``inline``.

    ``jobs`` and ``memory`` are for workers of our own: how many, and bytes beyond which one that takes so many by
    itself is ended, before the system ends others.

    Raises
    ------
    ConfigError
        There is no such executor, or the cluster does not answer.
    """
    if kind == "inline":
        return Inline()
    from rille.pipeline.engine.executors import dask_client

    return dask_client.here(jobs, cache, memory) if kind == "dask" else dask_client.elsewhere(kind, cache)


class Inline:
    """One task after the other in this process: for debugging, and where one core is all there is."""

    slots = depth = 1
    pages = ""

    def __init__(self) -> None:
        import zarr

        self._task: Task | None = None
        with held():  # zarr makes its event loop when it is first used
            zarr.create_group(zarr.storage.MemoryStore())

    def free(self) -> bool:
        """Whether nothing waits to be run."""
        return self._task is None

    def submit(self, tasks: Sequence[Task]) -> None:
        """Remember the task; :meth:`wait` runs it."""
        (self._task,) = tasks

    def wait(self) -> Landed:
        """Run the task."""
        assert self._task is not None
        task, self._task = self._task, None
        return [(task.number, task.run({}))]

    def halt(self) -> None:
        """Nothing is submitted that is not run."""

    def close(self, kill: bool = False) -> None:
        """Nothing to leave."""
        if kill:  # Python would warn at exit of each read or write of zarr's that was interrupted before it began
            warnings.filterwarnings("ignore", message="coroutine .* was never awaited", category=RuntimeWarning)
