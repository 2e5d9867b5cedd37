"""Where tasks run: in this process, on its threads, on worker processes, or on a running dask cluster.

:func:`make` is the one factory. All executors are the same three verbs: ``submit``, ``wait``, ``close``. Worker
processes are spawned (never forked) with one thread each, for isolation: a crash takes one task with it, and a task
that has taken three workers along is given up (:class:`WorkerDiedError`). Who ran when a worker died is told by a mark
on the disk; tasks that only waited there begin elsewhere, as often as it takes. A cluster given by address is examined
first (:mod:`pipeline.cluster`).

Programs call :func:`pipeline.environment.prepare_environment` first thing, so that this process and the workers run
alike.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import queue
import re
import shutil
import signal
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Protocol

import psutil

from pipeline import cluster
from pipeline.environment import cores, prepare_environment, worker_environment
from pipeline.location import Location
from pipeline.task import Outcome, Refs, Spec, ensure
from stages.errors import ConfigError, RilleError

__all__ = ["Executor", "Failed", "WorkerDiedError", "make", "prepare_environment"]

DEATHS = 3
"""Worker processes that one task may take along."""

INNOCENT = 30
"""Worker processes that may die before they even begin a task that was sent to them."""

LOST = 4.0
"""Seconds without a process after which a worker is replaced: its keeper gives up if it dies while it starts."""

START = 60.0
"""Seconds more for one that has not begun yet."""

REPLACED = 12
"""Workers replaced without a single task done before the run is given up."""

WATCH = 0.5
"""Seconds between looks at the memory of the workers."""

CONNECT = 10.0
"""Seconds until a scheduler must have answered."""

LOOK = 2.0
"""Seconds between looks at the scheduler of others."""

GRACE = 2.0
"""Seconds that workers get to leave at the end of a run before they are killed."""


HURRY = 0.5
"""The same for the client and the scheduler of an interrupted run, whose workers are killed already."""


class WorkerDiedError(RilleError):
    """A task took several worker processes along: out of memory, or a crash in native code."""


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
    """Runs :func:`~pipeline.task.ensure`; ``key`` names the task."""

    def idle(self) -> bool:
        """Whether one more task would start at once."""

    def submit(self, key: str, root: Location, spec: Spec, refs: Refs, force: bool) -> None:
        """Start a task."""

    def wait(self) -> Landed:
        """Block until at least one task has ended."""

    def close(self, kill: bool = False) -> None:
        """Leave nothing behind; ``kill`` does not wait for what is running."""


KINDS = ("processes", "threads", "inline")


def known(kind: str) -> None:
    """Refuse an executor that there is not, before any work.

    Raises
    ------
    ConfigError
        It is neither one of the kinds nor an address.
    """
    if kind not in KINDS and not re.fullmatch(r"(tcp|tls)://[^/\s]+:\d+", kind):
        raise ConfigError(f"executor {kind!r} is unknown", remedy=f"{', '.join(KINDS)} or tcp://host:port")


def make(kind: str, jobs: int | None, cache: Location, memory: float = math.inf) -> Executor:
    """``inline``, ``threads``, ``processes`` or a scheduler's address; ``jobs`` None is one a core.

    A worker process of our own that takes more than ``memory`` bytes by itself is ended, before the system ends others.

    Raises
    ------
    ConfigError
        There is no such executor, or the cluster does not answer.
    """
    known(kind)
    if jobs is not None and jobs < 1:
        raise ConfigError(f"{jobs} jobs are not permitted", remedy="give 1 or more")
    jobs = jobs or cores()
    if kind == "inline":
        return Inline()
    if kind == "threads":
        return Threads(jobs)
    if kind == "processes":
        return Processes(jobs, cache, memory)
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
            raise ConfigError(f"no dask scheduler answers at {address}", remedy="check the address") from error
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
        return Failed(_died("worker processes died that had it"), "")

    def close(self, kill: bool = False) -> None:
        """Leave the cluster as it is."""
        with suppress(Exception):
            self._client.close(timeout=HURRY if kill else GRACE)


class Cluster(_Client):
    """A dask scheduler that is running already, with workers like this process (:mod:`pipeline.cluster`)."""

    def __init__(self, address: str, cache: Location) -> None:
        super().__init__(address)
        self._identity, self._cache = tuple(cluster.identity().items()), cache
        self._presence, self._looked = cluster.Presence(self._client, address), time.monotonic()
        try:
            while not (threads := self._presence.threads()):
                time.sleep(WATCH)
            cluster.examine(self._client, cache)
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
        cluster.ready(identity, root)
    except Exception as error:
        return Failed.of(error)
    return _attempt(key, root, spec, refs, force)


class Processes(_Client):
    """Worker processes of our own, one thread each."""

    def __init__(self, jobs: int, cache: Location, memory: float = math.inf) -> None:
        _quiet()
        import dask
        from distributed import LocalCluster

        self._memory: dict[str, int] = {}
        """Greatest memory of a worker that ran a task, bytes, by the task's key."""
        self._deaths: Counter[str] = Counter()
        self._strays: Counter[str] = Counter()
        self._tasks: dict[str, tuple[Any, ...]] = {}
        self._marks = Path(tempfile.mkdtemp(prefix="rille-"))
        self._alive: dict[Any, float] = {}
        """When each worker was last seen with a process."""
        self._replaced = 0
        self._settings = ExitStack()
        settings = {
            "distributed.deploy.lost-worker-timeout": "10 days",  # it takes workers away that are just restarting
            "distributed.nanny.pre-spawn-environ": worker_environment(cache)
            | {"DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "critical"},
            "distributed.scheduler.allowed-failures": 0,  # it would blame what only waited on a worker that died
            "distributed.scheduler.work-stealing": False,
            "distributed.scheduler.http.routes": [],
            "distributed.worker.multiprocessing-method": "spawn",
            "distributed.worker.profile.enabled": False,
            # tasks were admitted by their memory: a worker must not refuse one that the others left room for
            **{f"distributed.worker.memory.{step}": False for step in ("target", "spill", "pause")},
            "distributed.admin.system-monitor.gil.enabled": False,
        }
        try:
            self._settings.enter_context(dask.config.set(settings))  # workers that replace others need them too
            with _interrupts_deferred():
                self._cluster = LocalCluster(
                    n_workers=jobs,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=round(memory) if math.isfinite(memory) else "auto",
                    dashboard_address=None,
                    scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # else port 8787, with a warning if taken
                    silence_logs=logging.CRITICAL,
                )
                super().__init__(self._cluster.scheduler_address)
        except KeyboardInterrupt:
            self.close(kill=True)
            raise
        except BaseException:
            self._settings.close()
            shutil.rmtree(self._marks, ignore_errors=True)
            raise
        self._slots = jobs  # all of them, though some may still be starting

    def _start(self, key: str, *task: Any) -> Any:
        self._tasks[key] = task
        return self._send(task, key, _marked, self._marks / key)

    def _killed(self, key: str, task: str) -> Failed | None:
        """Begin it anew, unless it ran on too many workers that died."""
        mark = self._marks / key
        ran = mark.exists()
        mark.unlink(missing_ok=True)
        (self._deaths if ran else self._strays)[key] += 1
        if self._deaths[key] >= DEATHS:
            seen = f", last seen with {self._memory[key] / 1e6:.0f} MB" if self._memory.get(key) else ""
            return Failed(_died(f"{DEATHS} worker processes died while they ran it{seen}"), "")
        if self._strays[key] >= INNOCENT:
            return Failed(_died(f"{INNOCENT} worker processes died before they began it"), "")
        self.submit(key, *self._tasks[key])
        return None

    def _result(self, key: str, future: Any) -> Outcome | Failed | None:
        outcome = super()._result(key, future)
        if outcome is not None:
            self._replaced = 0
        return outcome

    def _watch(self) -> None:
        self._replace_lost()
        for mark in self._marks.iterdir():
            with suppress(OSError, ValueError, psutil.Error):  # it ends as we look
                memory = int(psutil.Process(int(mark.read_text())).memory_info().rss)
                self._memory[mark.name] = max(memory, self._memory.get(mark.name, 0))

    def _replace_lost(self) -> None:
        now, lost = time.monotonic(), []
        for name in list(self._cluster.worker_spec):
            nanny = self._cluster.workers.get(name)
            process = nanny and nanny.process and nanny.process.process
            if process is not None and process.is_alive():
                self._alive[name] = now
            elif now - self._alive.setdefault(name, now + START) > LOST:
                lost.append(name)
        if lost:
            self._replaced += len(lost)
            if self._replaced > REPLACED:
                raise _died(f"{REPLACED} worker processes died as they started")
            for name in lost:
                del self._cluster.worker_spec[name]
            self._cluster.scale(self._slots)

    def close(self, kill: bool = False) -> None:
        """End the workers, at once if ``kill``; none is left behind."""
        nannies = list({*self._cluster.workers.values(), *self._cluster._created})
        processes = [n.process.process for n in nannies if n.process and n.process.process]
        if kill:
            self._cluster.shutdown_on_close = False  # nor wait for it at exit
            _kill(nannies, processes)
        for leave in (self._client.close, self._cluster.close):
            with suppress(Exception):
                leave(timeout=HURRY if kill else GRACE)
        _kill(nannies, processes)
        self._settings.close()
        shutil.rmtree(self._marks, ignore_errors=True)


def _marked(mark: Path, key: str, root: Location, spec: Spec, refs: Refs, force: bool) -> Outcome | Failed:
    """Run a task under a mark that outlives the process."""
    mark.write_text(str(os.getpid()))
    try:
        return _attempt(key, root, spec, refs, force)
    finally:
        mark.unlink(missing_ok=True)


def _died(what: str) -> WorkerDiedError:
    remedy = "give it more memory with fewer --jobs, or run it with --executor inline to see the crash"
    return WorkerDiedError(what, remedy=remedy)


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block; processes that its new threads begin never see it.

    Otherwise a cluster interrupted half-way could not be closed, and each worker would print a traceback of its own.
    """
    resource_tracker.ensure_running()  # it unblocks the signal in the thread that happens to start it
    came: list[int] = []
    main = threading.current_thread() is threading.main_thread()
    previous = signal.signal(signal.SIGINT, lambda number, _: came.append(number)) if main else None
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # threads and processes inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        if main:
            signal.signal(signal.SIGINT, previous)
    if came:
        raise KeyboardInterrupt


def _kill(nannies: list[Any], processes: list[Any]) -> None:
    for nanny in nannies:
        nanny.close_gracefully()  # that is, do not restart its worker
    for process in processes:
        with suppress(Exception):
            process._process.kill()


def _leave_unsaid() -> None:
    """Python would warn at exit of each read or write of zarr's that an interruption caught before it began."""
    warnings.filterwarnings("ignore", message="coroutine .* was never awaited", category=RuntimeWarning)


def _quiet() -> None:
    """Silence distributed's log: what matters comes back as an exception, the rest is noise at shutdown."""
    import dask

    dask.config.set({"distributed.logging": {"distributed": "critical"}})
    for name in ("distributed", "distributed.nanny", "distributed.worker", "distributed.scheduler", "tornado"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
