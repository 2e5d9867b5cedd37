"""A cluster of dask on this machine, for one run or several: worker processes, their scheduler, and a client.

Workers are spawned, never forked; they never see Ctrl-C, end with this process, and speak TLS on the loopback with
keys of this cluster alone, because whoever reaches a scheduler of dask can run code as its user.
"""

from __future__ import annotations

import logging
import math
import time
import warnings
from contextlib import suppress
from multiprocessing import resource_tracker
from typing import Any

import psutil

from rille.pipeline.engine.runtime.environment import leave_out, take_back, worker_environment
from rille.pipeline.engine.runtime.interrupts import held
from rille.pipeline.engine.runtime.private import private_folder

LEAVE_SECONDS, HURRY_SECONDS = 2.0, 0.5
"""Time to take leave of a scheduler at the end of a run, and of an interrupted one."""


class Cluster:
    """Workers of this machine; they start while this process goes on.

    Parameters
    ----------
    jobs : workers at first.
    memory : bytes beyond which a worker that takes so many by itself is ended.
    """

    def __init__(self, jobs: int, memory: float) -> None:
        leave_out()  # before anything else is imported
        from distributed import Client, LocalCluster, Nanny

        nannies = self._nannies = list[Any]()
        self._dead: set[Any] = set()

        class Known(Nanny):  # type: ignore[misc]  # dask's types are unknown
            """One that can be ended while its worker still starts: a cluster knows it only afterwards."""

            def __init__(self, *args: Any, **options: Any) -> None:
                super().__init__(*args, **options)
                nannies.append(self)

        _configure()
        resource_tracker.ensure_running()  # it unblocks the signal in the thread that happens to start it
        with held(), warnings.catch_warnings():
            # A queue within this process is named by the machine's address, which it may not have.
            warnings.filterwarnings("ignore", "Couldn't detect a suitable IP address", RuntimeWarning)
            self._cluster = LocalCluster(
                # With workers LocalCluster would block until they run; scale() returns at once.
                n_workers=0,
                worker_class=Known,
                threads_per_worker=1,
                security=True,
                host="127.0.0.1",
                # For the workers, and for the client: it shares the process, and needs no socket.
                scheduler_kwargs={"host": ["127.0.0.1", None], "protocol": ["tls://", "inproc://"]},
                # Port 0 is any free one: dask's own, 8787, may belong to another run.
                dashboard_address="127.0.0.1:0",
                worker_dashboard_address=None,
                local_directory=str(private_folder() / "dask"),
                memory_limit=int(memory) if math.isfinite(memory) else 0,
                silence_logs=logging.CRITICAL,
            )
            _, within = self._cluster.scheduler.listeners
            # As the default client it would take over whatever else the calling program computes with dask.
            self.client = Client(within.contact_address, loop=self._cluster.loop, set_as_default=False)
            self.scale(jobs)

    def scale(self, jobs: int) -> None:
        """Have so many workers; tasks of those that go are begun on others."""
        self._cluster.scale(jobs)

    def revive(self) -> None:
        """Start workers again that nobody else does.

        A nanny does not start one again that died just as it began: after two looks we do.
        """
        dead = {nanny for nanny in self._cluster.workers.values() if not nanny.is_alive()}
        for nanny in dead & self._dead:
            # Nannies belong to the event loop of the client: their methods must run there.
            self.client.loop.add_callback(nanny.instantiate)
        self._dead = dead - self._dead

    def close(self, *, kill: bool) -> None:
        """End the workers, at once if ``kill``, and the scheduler."""
        within = HURRY_SECONDS if kill else LEAVE_SECONDS
        until = time.monotonic() + LEAVE_SECONDS
        while kill and self._beginning() and time.monotonic() < until:
            time.sleep(0.01)
        processes = [nanny.pid for nanny in self._nannies if nanny.pid]
        if kill:
            for nanny in self._nannies:
                nanny.close_gracefully()  # else it starts a worker again as soon as that is killed
            _kill(processes)
        leave(self.client, within)
        with suppress(Exception):
            self._cluster.close(timeout=within)
        self._cluster.shutdown_on_close = False  # else it is closed once more at exit, for up to ten seconds
        _kill(processes)
        take_back()

    def _beginning(self) -> bool:
        """Whether a worker that is to start has no number yet by which it could be killed."""
        begun = [nanny for nanny in self._nannies if nanny.pid or nanny.status.name == "closed"]
        return len(begun) < max(len(self._nannies), len(self._cluster.worker_spec))


def _configure() -> None:
    """Set dask up for workers of our own: no word in its logs, nothing at regular times that nobody looks at; no
    spilling or pausing, because what travels is small."""
    import dask

    quiet()
    environment = worker_environment() | {
        "PYTHONSAFEPATH": "1",
        "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "critical",
        "MALLOC_ARENA_MAX": "1",  # tasks run on a second thread, whose own arena gives memory back and takes it anew
    }
    memory = {f"distributed.worker.memory.{what}": False for what in ("target", "spill", "pause")}
    dask.config.set(
        {
            # After one death of its worker dask begins a task once more; at the next it gives it back.
            "distributed.scheduler.allowed-failures": 1,
            # By default a cluster forgets a worker for good whose nanny has not started it again within 15 s, which on
            # a busy machine is usual.
            "distributed.deploy.lost-worker-timeout": "1h",
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


def quiet() -> None:
    """Silence distributed's log: what matters comes back as an exception, the rest is noise at shutdown."""
    import dask

    names = ("distributed", "distributed.client", "distributed.worker", "distributed.nanny", "distributed.scheduler")
    dask.config.set({"distributed.logging": dict.fromkeys(names, "critical")})
    for name in (*names, "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def leave(client: Any, within: float) -> None:
    """Close a client within so many seconds, whatever its scheduler says."""
    with suppress(Exception):
        client.close(timeout=within)


def _kill(processes: list[int]) -> None:
    """Kill processes, and wait until they are gone."""
    killed = []
    for process in processes:
        with suppress(psutil.Error):
            killed.append(psutil.Process(process))
            killed[-1].kill()
    psutil.wait_procs(killed, timeout=LEAVE_SECONDS)
