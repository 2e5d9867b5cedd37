"""Workers that run tasks: those of a dask cluster of this machine, of a scheduler that others have started, or inline.

A task is a future that depends on the futures of the tasks that make its inputs: dask's scheduler chains them without
asking this process, gives a task to another worker if its own dies, and ends a worker that takes too much memory. What
became of a task comes back as an event. A task that comes back because its workers died is named ``Died``; the run
tries it once more when nothing else runs, so that the culprit is known for certain (:mod:`rille.pipeline.engine.run`).
"""

from __future__ import annotations

import asyncio
import itertools
import pickle
import queue
import time
import traceback
import uuid
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, cast

from rille.pipeline.engine import foreign
from rille.pipeline.engine.cluster import HURRY_SECONDS, LEAVE_SECONDS, Cluster, leave, quiet
from rille.pipeline.engine.runtime.environment import ignore_settings, prepare_environment
from rille.pipeline.engine.runtime.interrupts import held
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.engine.task import Outcome, Refs, Spec, ensure, flatten_ports, map_ports
from rille.stages.core.errors import ConfigError, RilleError

WATCH_SECONDS = 0.2
"""Longest wait for the end of a task, and for workers, between two looks at lost calls and at the scheduler."""

CONNECT_SECONDS, ANSWER_SECONDS = 10.0, 20.0
"""Time within which a scheduler must have answered, at first and later."""

NO_WORKERS_SECONDS, START_SECONDS = 30.0, 120.0
"""Time without workers after which a run is given up: on another's scheduler, and on our own, where workers start
slowly if the machine is busy."""


@dataclass(frozen=True)
class Call:
    """A call of :func:`~rille.pipeline.engine.task.ensure`: an input is an artifact, or the number of the call in
    flight that makes it. ``key`` is empty while an input is still to come."""

    number: int
    root: Path
    spec: Spec
    refs: Mapping[str, Ref | int | list[Ref | int]]
    key: str = ""
    force: bool = False

    def upstream(self) -> list[int]:
        """Numbers of the calls in flight that it waits for, each once, in a fixed order."""
        return list(dict.fromkeys(g for g in flatten_ports(self.refs) if isinstance(g, int)))

    def run(self, made: Mapping[int, Ref]) -> Outcome | Failed | NotBegun:
        """Run it here, with the artifacts of the calls that it waited for, unless one did not come."""
        if not made.keys() >= {*self.upstream()}:
            return NotBegun()
        refs = cast(Refs, map_ports(lambda given: made[given] if isinstance(given, int) else given, self.refs))
        try:
            return ensure(self.root, self.spec, refs, key=self.key or None, force=self.force)
        except Exception as error:
            return Failed.of(error)


@dataclass(frozen=True)
class Failed:
    """An exception that travels as a value, with the text of its traceback."""

    error: BaseException
    traceback: str = ""

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
    """In the place of an outcome: an input did not come."""


@dataclass(frozen=True)
class Died:
    """In the place of an outcome: this many worker processes died while they had the task.

    Attributes
    ----------
    memory : memory [bytes, in words] at which dask ended the last of them; empty if something else ended it.
    """

    workers: int
    memory: str = ""


Ended = Outcome | Failed | NotBegun | Died


def make(kind: Any, jobs: int, cache: Path, memory: float) -> Workers:
    """``inline``, or workers of dask: ``dask`` (of this machine), the address of a scheduler, or a ``Client``.

    ``jobs`` and ``memory`` are for workers of our own: how many, and bytes beyond which one that takes so many by
    itself is ended, before the system ends others.

    Raises
    ------
    ConfigError
        The cluster does not answer, or a worker of it is unlike this process.
    """
    if kind == "inline":
        return Inline()
    if kind == "dask":
        own = Cluster(jobs, memory)
        return Dask(own.client, own=own)
    return _elsewhere(kind, cache)


class Inline:
    """One call after the other in this process: for debugging, and where one core is all there is."""

    def __init__(self) -> None:
        import zarr

        self._calls: list[Call] = []
        self._made: dict[int, Ref] = {}
        with held():  # zarr makes its event loop when it is first used
            zarr.create_group(zarr.storage.MemoryStore())

    def submit(self, calls: Sequence[Call]) -> None:
        """Remember calls; :meth:`wait` runs them."""
        self._calls = sorted([*self._calls, *calls], key=lambda call: call.number)

    def wait(self) -> list[tuple[int, Ended]]:
        """Run the next call."""
        call = self._calls.pop(0)
        ended = call.run(self._made)
        if isinstance(ended, Outcome):
            self._made[call.number] = without_facts(ended.ref)
        return [(call.number, ended)]

    def scale(self, jobs: int) -> None:
        """There is one worker."""

    def cancel(self) -> None:
        """Forget what was not run."""
        self._calls = []

    def close(self, *, kill: bool = False) -> None:
        """Nothing to leave."""
        if kill:  # Python would warn at exit of each read or write of zarr's that was interrupted before it began
            warnings.filterwarnings("ignore", message="coroutine .* was never awaited", category=RuntimeWarning)


def _elsewhere(where: Any, cache: Path) -> Dask:
    """Workers of the scheduler at an address, or behind a ``Client``, if they are like this process."""
    from distributed import Client

    client = where
    if isinstance(where, str):
        quiet()
        try:
            client = Client(where, set_as_default=False, timeout=CONNECT_SECONDS)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError("RIL-541", f"no dask scheduler answers at {where}", remedy="check the address") from error
    made = Dask(client, ours=client is not where)
    try:
        if not made.threads():
            asked = client.submit(bool, pure=False)  # an adaptive cluster starts workers where there is a task
            while not made.threads():
                time.sleep(WATCH_SECONDS)
            asked.release()
        foreign.examine(client, cache)
    except BaseException:
        made.close(kill=True)
        raise
    return made


class Dask:
    """Workers behind a client of dask, which is ``ours`` or another's; ``own`` is the cluster if we have started it."""

    def __init__(self, client: Any, *, own: Cluster | None = None, ours: bool = True) -> None:
        self._client, self._own, self._ours = client, own, ours
        self._address = client.scheduler.address
        self._run, self._unused = f"rille-{uuid.uuid4().hex}", itertools.count()
        self._looked = self._manned = time.monotonic()
        self._futures: dict[int, Any] = {}
        self._leaving: list[Any] = []
        self._events: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        client.subscribe_topic(self._run, self._hear)

    def submit(self, calls: Sequence[Call]) -> None:
        """Start calls after those in flight that they wait for.

        They leave as one graph: each alone would cost the client and the scheduler several times as much.
        """
        from dask.task_spec import Alias

        if not calls:
            return
        # Dask takes equal names for equal results: a call that is tried again needs a new one.
        names = {call.number: f"{call.spec.stage.name}-{self._run}-{next(self._unused)}" for call in calls}
        known = {number: future.key for number, future in self._futures.items()} | names
        futures = self._client.map(
            work,
            # Bytes: dask would unpickle a call, and import its stage, where a worker hears of others.
            [pickle.dumps((names[call.number], call)) for call in calls],
            [[Alias(known[number]) for number in call.upstream()] for call in calls],
            run=self._run,
            ours=self._own is not None,
            key=[*names.values()],
            priority=-calls[0].number,
        )
        self._futures |= zip(names, futures, strict=True)

    def _hear(self, event: tuple[float, bytes]) -> None:
        """Hand an event over, on the client's event loop; there it costs less to drop what ended before."""
        self._leaving.clear()
        self._events.put(event[1])

    def wait(self) -> list[tuple[int, Ended]]:
        """Block until at least one call has ended; all that have ended meanwhile are given."""
        ended: list[tuple[int, Ended]] = []
        while not ended:
            # Not for ever: a call whose worker died and a scheduler that is lost send no event.
            ended = self._events_of(WATCH_SECONDS)
            # The scheduler is looked at every two seconds.
            due = time.monotonic() - self._looked > 2.0
            if due:
                self._look()
            if due or not ended:
                ended += self._lost()
        return ended

    def _lost(self) -> list[tuple[int, Ended]]:
        """Calls that have ended without an event."""
        lost = [n for n, future in self._futures.items() if future.status not in ("pending", "finished")]
        # A call must not come back before the inputs that it had.
        ended = self._events_of(0) if lost else []
        return ended + [(n, self._why(self._futures.pop(n))) for n in lost if n in self._futures]

    def _events_of(self, timeout: float) -> list[tuple[int, Ended]]:
        """Calls whose end an event tells; wait for the first one."""
        ended: list[tuple[int, Ended]] = []
        with suppress(queue.Empty):
            while True:
                number, name, outcome = pickle.loads(self._events.get(timeout=0 if ended else timeout))
                # Another name is that of an earlier try, whose worker died after it had sent this.
                if number in self._futures and self._futures[number].key == name:
                    self._leaving.append(self._futures.pop(number))
                    ended.append((number, outcome))
        return ended

    def _why(self, future: Any) -> Ended:
        """Outcome of a call that ended without an event."""
        from distributed import KilledWorker

        if future.status != "error":  # distributed cancels all futures when the connection to the scheduler is lost
            raise self._gone()
        error = future.exception()
        if not isinstance(error, KilledWorker):  # it could not even be unpickled there
            return Failed.of(error)
        # The task that killed its workers may be one that this one waited for.
        return self._died(error) if str(error.task) == future.key else NotBegun()

    def _died(self, error: Any) -> Died:
        address, memory = getattr(error.last_worker, "address", ""), ""
        for _, event in self._client.get_events("worker-restart-memory"):
            if event.get("worker") == address:
                memory = f"{event['rss'] / 1e6:.0f} MB"
        return Died(error.allowed_failures + 1, memory)

    def threads(self) -> int:
        """Threads of all workers now.

        Raises
        ------
        RilleError
            The scheduler is gone, or had no workers for too long.
        """
        try:
            workers = self._client.sync(self._client.scheduler.ncores, callback_timeout=ANSWER_SECONDS)
        except Exception as error:
            raise self._gone() from error
        now, patience = time.monotonic(), NO_WORKERS_SECONDS if self._own is None else START_SECONDS
        if workers:
            self._manned = now
        elif now - self._manned > patience:
            text = f"the dask scheduler at {self._address} had no workers for {patience:.0f} s"
            remedy = "start workers, and run the same command: what is committed stays"
            if self._own is not None:  # Python's own file may be closed to this user, or memory be short
                remedy = "look why this user can start no processes, or run it with --executor inline, which needs none"
            raise RilleError("RIL-525", text, remedy=remedy)
        return sum(workers.values())

    def _gone(self) -> RilleError:
        """The error of a scheduler that is gone."""
        text = f"the dask scheduler at {self._address} is gone"
        remedy = "start it again with its workers, and run the same command: what is committed stays"
        return RilleError("RIL-526", text, remedy=remedy)

    def _look(self) -> None:
        """Look whether the scheduler is there and has workers, and which workers of our own are gone."""
        self.threads()
        if self._own is not None:
            self._own.revive()
        self._looked = time.monotonic()

    def scale(self, jobs: int) -> None:
        """Have so many workers, if they are our own."""
        if self._own is not None:
            self._own.scale(jobs)

    def cancel(self) -> None:
        """Begin nothing that was submitted, and forget what is running."""
        futures, self._futures = list(self._futures.values()), {}
        with suppress(Exception):
            self._client.cancel(futures, force=True)

    def close(self, *, kill: bool = False) -> None:
        """End workers of our own, at once if ``kill``; leave others as they are."""
        self.cancel()
        if self._own is not None:
            self._own.close(kill=kill)
            return
        with suppress(Exception):
            self._client.unsubscribe_topic(self._run)
        if self._ours:
            leave(self._client, HURRY_SECONDS if kill else LEAVE_SECONDS)


Workers = Inline | Dask
"""What runs calls: each is known by its number, and the least runs first."""


async def work(pickled: bytes, made: list[Ref | None], run: str, ours: bool) -> Ref | None:
    """Run a call on a worker, which is ``ours`` or another's; give its artifact to the calls that wait for it.

    Its outcome is sent to the client of ``run`` as an event of dask, at half the cost of fetching a result. It never
    raises: dask would state the exception as the failure of every call that waits for this one.
    """
    from distributed import get_worker

    worker, loop = get_worker(), asyncio.get_running_loop()
    default = worker.executors["default"]
    event, ref = await loop.run_in_executor(default, _run, pickled, made, str(worker.name), ours)
    # Not now, but when the loop hears that this has ended: so both leave as one message.
    loop.call_soon(worker.log_event, run, event)
    return ref


def _run(pickled: bytes, made: list[Ref | None], worker: str, ours: bool) -> tuple[bytes, Ref | None]:
    """Run a call on a thread of a worker; return its event, and its artifact, if there is one."""
    _prepare(ours=ours)
    name, call = pickle.loads(pickled)
    ended = call.run({number: ref for number, ref in zip(call.upstream(), made, strict=True) if ref is not None})
    if isinstance(ended, Outcome):
        ended = replace(ended, took=replace(ended.took, worker=worker))
    # Events travel as msgpack, which has no types of ours: bytes pass.
    return pickle.dumps((call.number, name, ended)), without_facts(ended.ref) if isinstance(ended, Outcome) else None


def without_facts(ref: Ref) -> Ref:
    """Return a reference without its facts: a task reads them from the store, and those of a trajectory are large."""
    return replace(ref, meta={})


@cache
def _prepare(*, ours: bool) -> None:
    """Set a worker process up, once."""
    prepare_environment()
    if ours:
        ignore_settings()
