"""Worker processes of this machine: spawned (never forked), one task at a time, told over a pipe each.

A crash takes one task with it, and who ran it is known; a task that has taken three workers along is given up
(:class:`WorkerDiedError`). Workers leave when this process does, however it ends, and never see Ctrl-C.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection, resource_tracker
from typing import Any

import psutil

from rille.pipeline.engine.code_digest import remember_in
from rille.pipeline.engine.runtime.environment import worker_environment
from rille.pipeline.engine.runtime.private import private_folder
from rille.stages.core.errors import RilleError

DEATHS = 3
"""Worker processes that one task may take along."""

UNREADY = 12
"""Workers that may die without a task, with none done in between, before the run is given up."""

WATCH = 0.2
"""Seconds between looks at the memory of the workers."""

GRACE = 2.0
"""Seconds that workers get to leave at the end of a run before they are killed."""

Task = tuple[Any, ...]


class WorkerDiedError(RilleError):
    """A task took several worker processes along: out of memory, or a crash in native code."""


REMEDY = "give it more memory with fewer --jobs, or run it with --executor inline to see the crash"


def given_up(seen: float) -> WorkerDiedError:
    """The error of a task that took too many; ``seen`` is the greatest memory of its worker, bytes, if known."""
    last = f", last seen with {seen / 1e6:.0f} MB" if seen else ""
    return WorkerDiedError("RIL-586", f"{DEATHS} worker processes died while they ran it{last}", remedy=REMEDY)


@dataclass(eq=False)
class _Worker:
    """A process, this end of its pipe, whether it listens yet, and the key of its task."""

    process: Any
    pipe: connection.Connection
    ready: bool = False
    key: str | None = None


class Workers:
    """So many processes that run ``attempt(*task)`` each; one that dies is replaced.

    ``attempt`` must be importable, tasks and answers picklable. A worker with more than ``memory`` bytes is ended.
    While a worker waits for a task it runs ``prepare`` on one of ``names`` after the other; what fails there is left to
    the task that needs it.
    """

    def __init__(
        self,
        count: int,
        attempt: Callable[..., Any],
        memory: float = math.inf,
        prepare: Callable[[str], Any] = str,
        names: Sequence[str] = (),
    ) -> None:
        self._attempt, self._memory = attempt, memory
        self._prepare, self._names = prepare, tuple(names)
        self._tasks: dict[str, Task] = {}
        self._deaths: Counter[str] = Counter()
        self._seen: dict[str, int] = {}
        """Greatest memory of a worker that ran a task, bytes, by the task's key."""
        self._unready, self._watched = 0, 0.0
        self._workers: list[_Worker] = []
        try:
            with _interrupts_deferred():
                for _ in range(count):
                    self._workers.append(self._start())
        except BaseException:
            self.close(kill=True)
            raise

    def _start(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        args = (there, self._attempt, self._prepare, self._names)
        process = context.Process(target=_serve, args=args, daemon=True)
        with _environment(worker_environment()):
            process.start()
        there.close()  # so that its death ends the pipe
        return _Worker(process, here)

    def idle(self) -> bool:
        """Whether a worker has nothing to do."""
        return any(worker.key is None for worker in self._workers)

    def give(self, key: str, task: Task) -> None:
        """Begin a task on a worker that has none, one that listens already if there is one."""
        self._tasks[key] = task
        self._send(max((w for w in self._workers if w.key is None), key=lambda w: w.ready), key)

    def _send(self, worker: _Worker, key: str) -> None:
        worker.key = key
        with suppress(BrokenPipeError, ConnectionResetError):  # it has just died, which is seen when waiting
            worker.pipe.send(self._tasks[key])

    def wait(self) -> list[tuple[str, Any]]:
        """Block until a task has ended; key and answer of all that have, a :class:`WorkerDiedError` in its place."""
        landed: list[tuple[str, Any]] = []
        while not landed:
            ends = {end: w for w in self._workers for end in (w.pipe, w.process.sentinel)}
            moved = {ends[end] for end in connection.wait(list(ends), timeout=WATCH)}
            for worker in [w for w in self._workers if w in moved]:
                landed += self._hear(worker)
            self._watch()
        return landed

    def _hear(self, worker: _Worker) -> list[tuple[str, Any]]:
        try:
            if worker.pipe.poll():
                answer = worker.pipe.recv()
            elif worker.process.is_alive():
                return []
            else:
                raise EOFError
        except (EOFError, OSError):  # it died, perhaps in the midst of its answer
            return self._bury(worker)
        if not worker.ready:
            worker.ready = True
            return []
        key, worker.key = worker.key, None
        assert key is not None
        self._unready = 0
        del self._tasks[key]
        return [(key, answer)]

    def _bury(self, worker: _Worker) -> list[tuple[str, Any]]:
        """Put another one in its place, which goes on with its task unless that has taken too many along."""
        key = worker.key
        self._end([worker])
        if not worker.ready or key is None:
            self._unready += 1
            if self._unready > UNREADY:
                raise WorkerDiedError("RIL-585", f"{UNREADY} worker processes died without a task", remedy=REMEDY)
        with _interrupts_deferred():
            self._workers[self._workers.index(worker)] = another = self._start()
        if key is None:
            return []
        self._deaths[key] += worker.ready
        if self._deaths[key] < DEATHS:
            self._send(another, key)
            return []
        del self._tasks[key]
        return [(key, given_up(self._seen.get(key, 0)))]

    def _watch(self) -> None:
        """Note what memory the workers have, now and then; end one that has too much before the system ends others."""
        if time.monotonic() - self._watched < WATCH:
            return
        self._watched = time.monotonic()
        for worker in self._workers:
            if worker.key is not None:
                with suppress(psutil.Error):  # it ends as we look
                    memory = int(psutil.Process(worker.process.pid).memory_info().rss)
                    self._seen[worker.key] = max(memory, self._seen.get(worker.key, 0))
                    if memory > self._memory:
                        worker.process.kill()

    def close(self, kill: bool = False) -> None:
        """End all, at once if ``kill``; none is left behind."""
        self._end(self._workers, 0.0 if kill else GRACE)
        self._workers = []

    @staticmethod
    def _end(workers: list[_Worker], grace: float = 0.0) -> None:
        for worker in workers:
            worker.pipe.close()
        until = time.monotonic() + grace
        for worker in workers:
            if grace:
                worker.process.join(max(0.0, until - time.monotonic()))
            worker.process.kill()
        for worker in workers:
            worker.process.join()


def _serve(
    pipe: connection.Connection,
    attempt: Callable[..., Any],
    prepare: Callable[[str], Any],
    names: Sequence[str],
) -> None:
    """What a worker does until its pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_leave_with, args=(parent.sentinel,), daemon=True).start()
    remember_in(private_folder() / "sources.json")
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        pipe.send(None)
        to_come = list(reversed(names))
        while True:
            while to_come and not pipe.poll():
                with suppress(Exception):
                    prepare(to_come.pop())
            pipe.send(attempt(*pipe.recv()))


def _leave_with(parent: int) -> None:
    """End when the process that started this one has, in the midst of a task too."""
    connection.wait([parent])
    os._exit(1)


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Processes started in the block have these variables: they must be there before NumPy and numba are."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block; processes begun in it never see it.

    Otherwise a worker interrupted as it starts would print a traceback of its own, or be lost from sight.
    """
    resource_tracker.ensure_running()  # it unblocks the signal in the thread that happens to start it
    came: list[int] = []
    main = threading.current_thread() is threading.main_thread()
    previous = signal.signal(signal.SIGINT, lambda number, _: came.append(number)) if main else None
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # processes inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        if main:
            signal.signal(signal.SIGINT, previous)
    if came:
        raise KeyboardInterrupt
