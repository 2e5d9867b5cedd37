"""Where tasks run: in this process, on its threads, on worker processes, or on a running dask cluster.

:func:`make` is the one factory. All executors are the same three verbs: ``submit``, ``wait``, ``close``. Processes of
this machine are :mod:`rille.pipeline.engine.executors.processes`: a task costs them tenths of a millisecond beside
itself, where distributed's scheduler takes seven of a core that the workers need. A cluster given by address is dask's,
and examined first (:mod:`rille.pipeline.engine.executors.dask_cluster`).

Programs call :func:`rille.pipeline.engine.runtime.environment.prepare_environment` first thing, so that this process
and the workers run alike.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import queue
import re
import threading
import time
import traceback
import warnings
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from rille.pipeline.engine.executors import dask_cluster
from rille.pipeline.engine.executors.processes import WorkerDiedError, Workers, died
from rille.pipeline.engine.runtime.environment import cores, prepare_environment
from rille.pipeline.engine.store.location import Location
from rille.pipeline.engine.task import Outcome, Refs, Spec, ensure, resolve
from rille.stages.core.errors import ConfigError, RilleError

__all__ = ["Executor", "Failed", "WorkerDiedError", "make", "prepare_environment"]

WATCH = 0.5
"""Seconds until something else than an end of a task is looked after."""

CONNECT = 10.0
"""Seconds until a scheduler must have answered."""

LOOK = 2.0
"""Seconds between looks at the scheduler of others."""

GRACE = 2.0
"""Seconds to take leave of a scheduler at the end of a run."""

HURRY = 0.5
"""The same for an interrupted run."""


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
            pickle.loads(pickle.dumps(error))
        except Exception:
            error = RuntimeError(f"{type(error).__name__}: {error}")
        return Failed(error, text)


Landed = list[tuple[str, Outcome | Failed]]


class Executor(Protocol):
    """Runs :func:`~rille.pipeline.engine.task.ensure`; ``key`` names the task."""

    def idle(self) -> bool:
        """Whether one more task would start at once."""

    def submit(self, key: str, root: Location, spec: Spec, refs: Refs, force: bool) -> None:
        """Start a task."""

    def wait(self) -> Landed:
        """Block until at least one task has ended."""

    def close(self, kill: bool = False) -> None:
        """Leave nothing behind; ``kill`` does not wait for what is running."""


KINDS = ("processes", "threads", "inline")


def known(kind: str, jobs: int | None = None) -> None:
    """Refuse an executor that there is not, before any work.

    Raises
    ------
    ConfigError
        It is neither one of the kinds nor an address, or there are no ``jobs``.
    """
    if kind not in KINDS and not re.fullmatch(r"(tcp|tls)://[^/\s]+:\d+", kind):
        raise ConfigError("RIL-539", f"executor {kind!r} is unknown", remedy=f"{', '.join(KINDS)} or tcp://host:port")
    if jobs is not None and jobs < 1:
        raise ConfigError("RIL-540", f"{jobs} jobs are not permitted", remedy="give 1 or more")


def make(
    kind: str, jobs: int | None, cache: Location, memory: float = math.inf, modules: Sequence[str] = ()
) -> Executor:
    """``inline``, ``threads``, ``processes`` or a scheduler's address; ``jobs`` None is one a core.

    A worker process of our own that takes more than ``memory`` bytes by itself is ended, before the system ends others.
    ``modules`` are those of the stages to come, in their order: a worker that has nothing to do imports them.

    Raises
    ------
    ConfigError
        There is no such executor, or the cluster does not answer.
    """
    known(kind, jobs)
    jobs = jobs or cores()
    if kind == "inline":
        return Inline()
    if kind == "threads":
        return Threads(jobs)
    if kind == "processes":
        return Processes(jobs, cache, memory, modules)
    return Cluster(kind, cache)


def _attempt(key: str, root: Location, spec: Spec, refs: Refs, force: bool) -> Outcome | Failed:
    try:
        return ensure(root, spec, refs, key=key, force=force)
    except Exception as error:
        return Failed.of(error)


class Inline:
    """One task after the other in this process: for debugging, and where one core is all there is."""

    def __init__(self) -> None:
        self._task: tuple[Any, ...] | None = None

    def idle(self) -> bool:
        """Whether nothing waits to be run."""
        return self._task is None

    def submit(self, key: str, root: Location, spec: Spec, refs: Refs, force: bool) -> None:
        """Remember the task; :meth:`wait` runs it."""
        self._task = (key, root, spec, refs, force)

    def wait(self) -> Landed:
        """Run the task."""
        assert self._task is not None
        task, self._task = self._task, None
        return [(task[0], _attempt(*task))]

    def close(self, kill: bool = False) -> None:
        """Nothing to leave."""
        if kill:
            _leave_unsaid()


class _Futures:
    """Executors whose futures call back when they are done."""

    def __init__(self, slots: int) -> None:
        self._slots = slots
        self._flying: dict[str, Any] = {}
        self._done: queue.SimpleQueue[str] = queue.SimpleQueue()

    def _start(self, key: str, *task: Any) -> Any:
        raise NotImplementedError

    def idle(self) -> bool:
        """Whether a worker has nothing to do."""
        return len(self._flying) < self._slots

    def submit(self, key: str, root: Location, spec: Spec, refs: Refs, force: bool) -> None:
        """Start the task."""
        self._flying[key] = future = self._start(key, root, spec, refs, force)
        future.add_done_callback(lambda _: self._done.put(key))

    def wait(self) -> Landed:
        """Block until a task has ended; all that have ended meanwhile are given."""
        landed: Landed = []
        while not landed or not self._done.empty():
            with suppress(queue.Empty):
                key = self._done.get(timeout=WATCH)
                outcome = self._result(key, self._flying.pop(key))
                landed += [] if outcome is None else [(key, outcome)]
            self._watch()
        return landed

    def _watch(self) -> None:
        """Called now and then while tasks run."""

    def _result(self, key: str, future: Any) -> Outcome | Failed | None:
        """What became of a task; None if it was begun anew."""
        try:
            landed: Outcome | Failed = future.result()
        except Exception as error:
            return Failed.of(error)
        return landed


class Threads(_Futures):
    """Threads of this process; kernels release the lock. What runs at an interruption ends with the process."""

    def _start(self, key: str, *task: Any) -> Any:
        future: Future[Outcome | Failed] = Future()
        threading.Thread(target=lambda: future.set_result(_attempt(key, *task)), daemon=True).start()
        return future

    def close(self, kill: bool = False) -> None:
        """Nothing to leave."""
        if kill:
            _leave_unsaid()


class _Client(_Futures):
    """Tasks on workers of a dask scheduler."""

    def __init__(self, address: str) -> None:
        _quiet()
        from distributed import Client

        try:
            self._client = Client(address, set_as_default=False, timeout=CONNECT)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(
                "RIL-541", f"no dask scheduler answers at {address}", remedy="check the address"
            ) from error
        super().__init__(max(1, sum(self._client.nthreads().values())))
        self._submitted = 0

    def _send(self, task: tuple[Any, ...], key: str, run: Any, *first: Any) -> Any:
        self._submitted += 1
        name = f"{task[1].label}-{key[:12]}-{os.getpid()}-{self._submitted}"
        return self._client.submit(run, *first, key, *task, key=name, pure=False, priority=-self._submitted)

    def _result(self, key: str, future: Any) -> Outcome | Failed | None:
        from distributed import KilledWorker

        if future.status == "error" and isinstance(error := future.exception(), KilledWorker):
            return self._killed(key, str(error.task))
        return super()._result(key, future)

    def _killed(self, key: str, task: str) -> Failed | None:
        return Failed(died("RIL-542", "worker processes died that had it"), "")

    def close(self, kill: bool = False) -> None:
        """Leave the cluster as it is."""
        with suppress(Exception):
            self._client.close(timeout=HURRY if kill else GRACE)


class Cluster(_Client):
    """A dask scheduler that is running already, with workers like this process
    (:mod:`rille.pipeline.engine.executors.dask_cluster`)."""

    def __init__(self, address: str, cache: Location) -> None:
        super().__init__(address)
        self._identity, self._cache = tuple(dask_cluster.identity().items()), cache
        self._presence, self._looked = dask_cluster.Presence(self._client, address), time.monotonic()
        try:
            while not (threads := self._presence.threads()):
                time.sleep(WATCH)
            dask_cluster.examine(self._client, cache)
        except BaseException:
            self.close(kill=True)
            raise
        self._slots = threads

    def _start(self, key: str, *task: Any) -> Any:
        return self._send(task, key, _elsewhere, self._identity)

    def _result(self, key: str, future: Any) -> Outcome | Failed | None:
        if future.status in ("cancelled", "lost"):
            raise self._presence.gone()
        return super()._result(key, future)

    def _watch(self) -> None:
        if time.monotonic() - self._looked > LOOK:
            self._slots = self._presence.threads() or self._slots
            self._looked = time.monotonic()


def _elsewhere(
    identity: tuple[tuple[str, str], ...], key: str, root: Location, spec: Spec, refs: Refs, force: bool
) -> Outcome | Failed:
    """Run a task on a worker that somebody else has started."""
    try:
        dask_cluster.ready(identity)
    except Exception as error:
        return Failed.of(error)
    return _attempt(key, root, spec, refs, force)


class Processes:
    """Worker processes of our own, one thread each (:mod:`rille.pipeline.engine.executors.processes`)."""

    def __init__(self, jobs: int, cache: Location, memory: float = math.inf, modules: Sequence[str] = ()) -> None:
        self._workers = Workers(jobs, _attempt, memory, resolve, modules)

    def idle(self) -> bool:
        """Whether a worker has nothing to do; it may still be starting."""
        return self._workers.idle()

    def submit(self, key: str, root: Location, spec: Spec, refs: Refs, force: bool) -> None:
        """Start the task."""
        self._workers.give(key, (key, root, spec, refs, force))

    def wait(self) -> Landed:
        """Block until a task has ended; a worker that dies is replaced, and its task begun anew."""
        return [(key, Failed(a, "") if isinstance(a, RilleError) else a) for key, a in self._workers.wait()]

    def close(self, kill: bool = False) -> None:
        """End the workers, at once if ``kill``; none is left behind."""
        self._workers.close(kill)


def _leave_unsaid() -> None:
    """Python would warn at exit of each read or write of zarr's that an interruption caught before it began."""
    warnings.filterwarnings("ignore", message="coroutine .* was never awaited", category=RuntimeWarning)


def _quiet() -> None:
    """Silence distributed's log: what matters comes back as an exception, the rest is noise at shutdown."""
    import dask

    dask.config.set({"distributed.logging": {"distributed": "critical"}})
    for name in ("distributed", "distributed.nanny", "distributed.worker", "distributed.scheduler", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
