"""Tasks on workers of dask: those of a cluster of this machine, or of a scheduler that others have started.

A task is a future that depends on the futures of the tasks that make its inputs, so that the scheduler chains them
without asking this process. They are submitted many at a time, as one graph; what became of each comes back as an event
of dask, which costs a fraction of fetching a result. Measured with trivial tasks on two cores, all processes together:
1.6 ms of processor time a task, against 2.2 ms if tasks are submitted one by one and results are fetched.

If a worker dies, all tasks that it was given come back as not begun (it ran one at most), and each is then submitted
alone. A task fails when a worker has died for the third time while it ran this task alone; a death does not count if
idle workers died at the same time, because then somebody killed them all. (A scheduler of others reports a death only
after one death more than its ``distributed.scheduler.allowed-failures``.) On this machine workers are spawned, never
forked; they never see Ctrl-C, end with this process, and speak TLS on the loopback with keys of this run alone, because
whoever reaches a scheduler of dask can run code as its user. This process hosts that scheduler, and hands over to it
what it has to say without any socket.
"""

from __future__ import annotations

import logging
import math
import pickle
import queue
import time
import uuid
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import dask
import psutil
from dask._expr import LLGExpr
from dask._task_spec import Task as Node
from dask._task_spec import TaskRef
from dask.utils import key_split
from distributed import Client, KilledWorker, LocalCluster, WorkerPlugin, get_worker

from rille.datasets.text.warning import warning
from rille.pipeline.engine.executors import dask_cluster
from rille.pipeline.engine.executors.base import Failed, Landed, NotBegun, Task, light
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.runtime.apart import ignore_settings, leave_out, take_back
from rille.pipeline.engine.runtime.environment import prepare_environment, worker_environment
from rille.pipeline.engine.runtime.interrupts import held
from rille.pipeline.engine.runtime.private import private_folder
from rille.pipeline.engine.store.manifest import Ref
from rille.pipeline.engine.task import CodeChangedError, Outcome
from rille.stages.core.errors import ConfigError, RilleError

DEPTH = 16
"""Tasks in flight for each worker, so that it need not wait for this process."""

WATCH = 0.2
"""Seconds until something else than an end of a task is looked after."""

DEATHS, TRIES = 3, 10
"""Worker processes that one task may take along; times that it is tried at most, whoever kills them."""

BIRTH = 120.0
"""Seconds that workers of our own may take to start, on a machine that others use."""

CONNECT = 10.0
"""Seconds until a scheduler must have answered."""

LOOK = 2.0
"""Seconds between looks at the scheduler."""

GRACE, HURRY = 2.0, 0.5
"""Seconds to take leave of a scheduler at the end of a run, and of an interrupted one."""


class WorkerDiedError(RilleError):
    """A task took several worker processes along: out of memory, or a crash in native code."""


def here(jobs: int, cache: Path, memory: float) -> Dask:
    """Workers of this machine; they start while this process goes on."""
    _configure()
    interactive = leave_out()
    resource_tracker.ensure_running()  # it unblocks the signal in the thread that happens to start it
    with held(), warnings.catch_warnings():
        # A queue within this process is named by the machine's address, which it may not have.
        warnings.filterwarnings("ignore", "Couldn't detect a suitable IP address", RuntimeWarning)
        cluster = LocalCluster(
            # With workers LocalCluster would block until they run; scale() returns at once.
            n_workers=0,
            threads_per_worker=1,
            security=True,
            host="127.0.0.1",
            # For the workers, and for the client.
            scheduler_kwargs={"host": ["127.0.0.1", None], "protocol": ["tls://", "inproc://"]},
            # Port 0 is any free one: dask's own, 8787, may belong to another run.
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address=None,
            local_directory=str(private_folder() / "dask"),
            memory_limit=int(memory) if math.isfinite(memory) else 0,
            silence_logs=logging.CRITICAL,
        )
        _, within = cluster.scheduler.listeners
        # As the default client it would take over whatever else the calling program computes with dask.
        client = Client(within.contact_address, loop=cluster.loop, set_as_default=False)
        made = Dask(client, cache, jobs, cluster)
        made.interactive = interactive
        cluster.scale(jobs)
    return made


def elsewhere(where: Any, cache: Path) -> Dask:
    """Workers of the scheduler at an address, or behind a ``Client``, if they are like this process."""
    client = where
    if isinstance(where, str):
        _quiet()
        try:
            client = Client(where, set_as_default=False, timeout=CONNECT)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError("RIL-541", f"no dask scheduler answers at {where}", remedy="check the address") from error
    presence = dask_cluster.Presence(client, dask_cluster.NO_WORKERS)
    try:
        while not (threads := presence.threads()):
            time.sleep(WATCH)
        dask_cluster.examine(client, cache)
        return Dask(client, cache, threads, None, ours=client is not where)
    except BaseException:
        if client is not where:
            _leave(client, HURRY)
        raise


class Dask:
    """An executor on ``slots`` threads of workers; ``cluster`` is one of our own, ``ours`` whether the client is."""

    depth, interactive = DEPTH, False

    def __init__(self, client: Any, cache: Path, slots: int, cluster: Any, *, ours: bool = True) -> None:
        self._client, self.slots, self._cluster, self._ours = client, slots, cluster, ours
        self._run, self._submitted = f"rille-{uuid.uuid4().hex}", 0
        self._presence = dask_cluster.Presence(client, BIRTH if cluster else dask_cluster.NO_WORKERS)
        self._looked = time.monotonic()
        self._futures: dict[int, Any] = {}
        self._labels: dict[int, str] = {}
        self._told: set[str] = set()
        """Silent workers that the user was told of."""
        self._gone: set[Any] = set()
        self._events: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._held: dict[int, Task] = {}
        """Suspects, which are sent when they are alone."""
        self._refused: set[int] = set()
        """Tasks that were submitted together with a suspect that they wait for: they come back as not begun."""
        self._deaths: Counter[int] = Counter()
        self._tries: Counter[int] = Counter()
        self._beside: set[int] = set()
        """Processes of workers while a suspect runs alone."""
        self._seen: Counter[int] = Counter()
        """Greatest memory of a worker while a suspect ran alone, bytes."""
        # The handler runs on the client's event loop: it only hands over what came, :meth:`wait` reads it.
        client.subscribe_topic(self._run, lambda event: self._events.put(event[1]))
        # Named after the run: of two plugins of one name the later replaces the earlier, and runs may share a cluster.
        client.register_plugin(SetUp(self._run, {} if cluster else dask_cluster.identity()), self._run)

    @property
    def pages(self) -> str:
        """Sentence with the address of dask's dashboard, which exists if the scheduler's machine has bokeh."""
        if self._cluster is not None and find_spec("bokeh") is None:
            return "dask has pages to watch once bokeh is installed: pip install bokeh"
        try:
            return f"dask at work: {self._client.dashboard_link}"  # the address is asked of the scheduler
        except OSError:
            return ""  # it has gone; the first wait for a task says so

    def free(self) -> bool:
        """Not beside a suspect."""
        return not self._held and not any(number in self._deaths for number in self._futures)

    def submit(self, tasks: Sequence[Task]) -> None:
        """Start tasks as one graph, each after those in flight that it waits for."""
        chosen: list[Task] = []
        for task in tasks:
            if task.number in self._deaths:
                self._held[task.number] = task
            elif self._held.keys().isdisjoint(task.upstream()) and self._refused.isdisjoint(task.upstream()):
                chosen.append(task)
            else:
                self._refused.add(task.number)
        self._send(chosen)

    def _send(self, tasks: Sequence[Task]) -> None:
        names = {number: future.key for number, future in self._futures.items()}
        nodes = {}
        for task in tasks:
            self._submitted += 1
            # Dask takes equal names for equal results: a task that is tried again needs a new one.
            name = names[task.number] = f"{task.spec.stage.name}-{self._run}-{self._submitted}-{task.number}"
            upstream = [TaskRef(names[number]) for number in task.upstream()]
            nodes[name] = Node(name, _work, self._run, pickle.dumps(task), *upstream)
        if nodes:
            graph = LLGExpr(nodes, _determ_token=uuid.uuid4().hex)  # a token spares dask to make one of all it holds
            with dask.annotate(priority=_priority):
                futures = self._client.get(graph, list(nodes), sync=False)
            self._futures |= {task.number: future for task, future in zip(tasks, futures, strict=True)}
            self._labels |= {task.number: task.spec.label for task in tasks}

    def wait(self) -> Landed:
        """Block until a task has ended; all that have ended meanwhile are given."""
        landed: Landed = [(number, NotBegun()) for number in sorted(self._refused)]
        self._refused.clear()
        while not landed:
            if self._held and not self._futures:
                self._beside = {pid for pid in self._pids() if _resident(pid)}
                self._send([self._held.pop(min(self._held))])
            # Not for ever: a worker that dies and a scheduler that is lost send no event.
            landed = self._hear(WATCH) + self._watch()
        return landed

    def _hear(self, timeout: float) -> Landed:
        """All that has ended; the first of it is waited for."""
        landed: Landed = []
        with suppress(queue.Empty):
            while True:
                number, name, outcome = pickle.loads(self._events.get(timeout=0 if landed else timeout))
                # Of another name: it ran again because its worker died after it had said so.
                if (future := self._futures.get(number)) is not None and future.key == name:
                    del self._futures[number]
                    landed.append((number, outcome))
        return landed

    def _watch(self) -> Landed:
        """Look at what was lost; now and then at the memory of a suspect's worker, and whether there are workers."""
        if len(self._futures) == 1 and (number := next(iter(self._futures))) in self._deaths:
            pids = self._pids()
            self._beside |= set(pids)
            self._seen[number] = max(self._seen[number], *(_resident(pid) for pid in pids), 0)
        if time.monotonic() - self._looked > LOOK:
            threads = self._presence.threads()
            self._tell_silent(self._presence.silent())
            if self._cluster is None:
                self.slots = threads or self.slots
            else:
                self._revive()
            key_split.cache_clear()  # it holds the names of the last hundred thousand tasks
            self._looked = time.monotonic()
        # A finished future is no loss: the event with its outcome is on its way.
        lost = [n for n, future in self._futures.items() if future.status not in ("pending", "finished")]
        # A task must not come back before the inputs that it had: it would wait for what is no more in flight.
        landed = self._hear(0) if lost else []
        return landed + [(n, self._lost(n, self._futures.pop(n), len(lost) == 1)) for n in lost if n in self._futures]

    def _tell_silent(self, silent: set[str]) -> None:
        """Warn once of each worker that is silent (stopped, or its machine is gone) in the midst of a task of ours."""
        self._told &= silent
        labels = {future.key: self._labels[number] for number, future in self._futures.items()}
        nannies = getattr(self._cluster, "workers", {}).values()
        processes = {nanny.worker_address: f", process {nanny.pid}," for nanny in nannies}
        for address in silent - self._told:
            with suppress(Exception):  # it has left meanwhile
                given = [key for key in self._client.processing([address])[address] if key in labels]
                if given:
                    who = dask_cluster.worker_name(self._client, address) + processes.get(address, "")
                    began = labels[max(given, key=_priority)]
                    text = f"{who} has been silent for {dask_cluster.SILENCE:.0f} s at {began}"
                    warn(warning("RIL-710", f"{text}: let it go on if it was stopped (kill -CONT), or end it"))
                    self._told.add(address)

    def _revive(self) -> None:
        """Start a worker again that is gone for two looks: its nanny does not where it died just as it began."""
        gone = {nanny for nanny in self._cluster.workers.values() if not nanny.is_alive()}
        for nanny in gone & self._gone:
            # Nannies belong to the event loop of the client: their methods must run there.
            self._client.loop.add_callback(nanny.instantiate)
        self._gone = gone - self._gone

    def _lost(self, number: int, future: Any, alone: bool) -> Failed | NotBegun:
        # Neither pending nor failed: distributed cancels all futures when the connection to the scheduler is lost.
        if future.status != "error":
            raise self._presence.gone()
        error = future.exception()
        if not isinstance(error, KilledWorker):
            return Failed.of(error)
        if str(error.task) != future.key:  # one that it waited for
            return NotBegun()
        others = sum(not _resident(pid) for pid in self._beside) > 1
        # Several workers that die at once were killed from outside, so no task is to blame.
        self._deaths[number] += alone and not others  # else it is a suspect, and no more
        self._tries[number] += 1
        if self._deaths[number] < DEATHS and self._tries[number] < TRIES:
            return NotBegun()
        seen = f", last seen with {self._seen[number] / 1e6:.0f} MB" if self._seen[number] else ""
        remedy = "give it more memory with fewer --jobs, or run it with --executor inline to see the crash"
        # A scheduler of others begins it anew after so many deaths, before it gives it back.
        died = (DEATHS if self._deaths[number] >= DEATHS else TRIES) * (error.allowed_failures + 1)
        text = f"{died} worker processes died while they ran it{seen}"
        return Failed(WorkerDiedError("RIL-586", text, remedy=remedy), "")

    def _pids(self) -> list[int]:
        return [pid for nanny in getattr(self._cluster, "workers", {}).values() if (pid := getattr(nanny, "pid", None))]

    def halt(self) -> None:
        """Begin nothing more of this run on any worker."""
        with suppress(Exception):
            self._client.run(_halt, self._run, on_error="ignore")

    def close(self, kill: bool = False) -> None:
        """End workers of our own, at once if ``kill``; leave others as they are."""
        within = HURRY if kill else GRACE
        # Releases what the scheduler holds for this run; on a cluster of others it would stay.
        self._futures.clear()
        if self._cluster is None:
            with suppress(Exception):
                self.halt()
                self._client.unsubscribe_topic(self._run)
                self._client.unregister_worker_plugin(self._run)
            if self._ours:
                _leave(self._client, within)
            return
        if kill:
            for nanny in self._cluster.workers.values():
                # A nanny starts a worker again as soon as it is killed.
                nanny.auto_restart = False
            _end(self._pids())
        _leave(self._client, within)
        with suppress(Exception):
            self._cluster.close(timeout=within)
        self._cluster._instances.discard(self._cluster)  # else it is closed once more at exit, for up to ten seconds
        _end([child.pid for child in psutil.Process().children() if "multiprocessing.spawn" in _command(child)])
        take_back(self.interactive)


class SetUp(WorkerPlugin):  # type: ignore[misc]
    """Prepares each worker, also one that joins later, and tells the client of ``run`` what became of its tasks.

    ``ours`` is what the worker must be like, if others have started it. An event leaves together with the word of the
    worker to the scheduler that the task is done: one message, not two.
    """

    def __init__(self, run: str, ours: dict[str, str]) -> None:
        self.run, self.ours = run, ours

    def setup(self, worker: Any) -> None:
        """Set the process up, and remember in what it differs."""
        prepare_environment()
        if not self.ours:
            ignore_settings()
        # Nearly all stages import them: the seconds of a worker's first task are then its own.
        for name in ("cv2", "numba"):
            import_module(name)
        self._worker = worker
        differs = dask_cluster.unlike(dask_cluster.identity(), self.ours) if self.ours else ""
        _runs[self.run] = f"worker {worker.name} differs: {differs}" if differs else ""

    def teardown(self, worker: Any) -> None:
        """Forget the run."""
        _runs.pop(self.run, None)

    def transition(self, key: Any, start: str, finish: str, **more: Any) -> None:
        """Send what a task of the run has left; a task of another run is left to the plugin of that run."""
        if finish == "memory" and (event := _ended.pop((self.run, key), None)) is not None:
            self._worker.log_event(self.run, event)


_runs: dict[str, str] = {}
"""Runs that this worker serves, and in what it differs from what they need."""

_ended: dict[tuple[str, str], bytes] = {}
"""What became of tasks that have just ended on this worker, by their runs and names."""


def _halt(run: str) -> None:
    _runs.pop(run, None)


def _priority(name: str) -> int:
    """What was laid out first comes first."""
    return -int(name.rpartition("-")[2])


def _work(run: str, pickled: bytes, *made: Ref | None) -> Ref | None:
    """Run a task on a worker, unless the run was stopped or an input did not come; give its artifact to others."""
    task: Task = pickle.loads(pickled)
    outcome: Outcome | Failed | NotBegun
    refs = {number: ref for number, ref in zip(task.upstream(), made, strict=True) if ref is not None}
    if run not in _runs or len(refs) < len(made):
        outcome = NotBegun()
    elif _runs[run]:
        outcome = Failed(CodeChangedError("RIL-524", _runs[run], remedy="install the same there"), "")
    else:
        outcome = task.run(refs)
    worker = get_worker()
    if isinstance(outcome, Outcome):
        outcome = replace(outcome, took=replace(outcome.took, worker=str(worker.name)))
    name = worker.get_current_task()
    # Events travel as msgpack, which has no types of ours: bytes pass.
    _ended[run, name] = pickle.dumps((task.number, name, outcome))
    # Never an exception: dask would state it as the failure of every task that waits for this one.
    return light(outcome.ref) if isinstance(outcome, Outcome) else None


def _configure() -> None:
    """Set dask up for workers of our own: no word in its logs, nothing at regular times that nobody looks at.

    One death gives a task back; no spilling or pausing, because what travels is small.
    """
    _quiet()
    memory = {f"distributed.worker.memory.{what}": False for what in ("target", "spill", "pause")}
    environment = worker_environment() | {
        "PYTHONSAFEPATH": "1",
        "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "critical",
        "MALLOC_ARENA_MAX": "1",  # tasks run on a second thread, whose own arena gives memory back and takes it anew
        # glibc keeps freed memory for the next task up to this, and takes arrays of 32 MiB (its limit) from it: fresh
        # pages took an eighth of a task's time.
        "MALLOC_TRIM_THRESHOLD_": str(128 << 20),
        "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    }
    dask.config.set(
        {
            # The first death ends the task for dask: this client decides which one is a suspect, and tries it alone.
            "distributed.scheduler.allowed-failures": 0,
            # A share of the limit: the bytes given are meant whole, by default dask ends a worker at 95 % of them.
            "distributed.worker.memory.terminate": 1.0,
            # Entries of each of dask's logs, which nobody reads; some keep whole messages, with all tasks in them.
            "distributed.admin.low-level-log-length": 10,
            "distributed.scheduler.active-memory-manager.start": False,
            "distributed.worker.profile.enabled": False,
            "distributed.worker.memory.monitor-interval": "500ms",
            "distributed.scheduler.work-stealing-interval": "1s",
            "distributed.admin.tick.interval": "5s",
            "distributed.admin.system-monitor.interval": "5s",
            "distributed.client.scheduler-info-interval": "10s",
            "distributed.nanny.pre-spawn-environ": environment,
            **memory,
        }
    )


def _quiet() -> None:
    """Silence distributed's log: what matters comes back as an exception, the rest is noise at shutdown."""
    names = ("distributed", "distributed.client", "distributed.worker", "distributed.nanny", "distributed.scheduler")
    dask.config.set({"distributed.logging": dict.fromkeys(names, "critical")})
    for name in (*names, "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _leave(client: Any, within: float) -> None:
    with suppress(Exception):
        client.close(timeout=within)


def _resident(pid: int) -> int:
    with suppress(psutil.Error):  # it ends as we look
        return int(psutil.Process(pid).memory_info().rss)
    return 0


def _command(process: psutil.Process) -> str:
    with suppress(psutil.Error):
        return " ".join(process.cmdline())
    return ""


def _end(pids: list[int]) -> None:
    """Kill processes, and wait until they are gone."""
    found = []
    for pid in pids:
        with suppress(psutil.Error):
            found.append(psutil.Process(pid))
            found[-1].kill()
    psutil.wait_procs(found, timeout=GRACE)
