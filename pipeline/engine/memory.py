"""Memory: how much a run may take here, what its tasks are estimated to need, and how many workers that permits.

The limit is the free memory of the machine, or of the control group that this process is in. A task is estimated from
its stage's declaration (:class:`~rille.stages.core.declare.Memory`) and the decoded bytes of its inputs; an input still
to come counts as its stage declares, too. There are as many workers as the limit holds of the largest task; a task
that does not fit even alone is refused, with the parameter that makes it smaller.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import psutil

from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.runtime.environment import cores
from rille.pipeline.engine.task import map_ports
from rille.stages.core.errors import ConfigError

WORKER_BYTES = 250e6
"""Memory of a worker process between tasks: Python with NumPy, SciPy and numba."""


def parse(text: str) -> int:
    """Bytes of ``6GB``, ``800 MiB``, ``75%`` (of the machine or its control group).

    Raises
    ------
    ConfigError
        It is none of these.
    """
    from dask.utils import parse_bytes

    given = text.strip()
    share = given.endswith("%")
    with suppress(ValueError, OverflowError):
        amount = float(given[:-1]) / 100 * total() if share else parse_bytes(given)
        if given[:1].isdecimal() and 0 < amount <= (total() if share else math.inf):
            return int(amount)
    shown = f"--memory-limit {text!r} is no amount of memory"
    raise ConfigError("RIL-553", shown, remedy="give e.g. 6GB, 800MB or 75%")


def words(amount: float) -> str:
    """``412 MB``, ``1.2 GB``, ``35 kB``."""
    if amount >= 999.5e6:
        return f"{amount / 1e9:.1f} GB"
    if amount >= 99.5e3:
        return f"{amount / 1e6:.{1 if amount < 9.95e6 else 0}f} MB"
    return f"{amount / 1e3:.0f} kB"


def total() -> int:
    """Memory of the machine, or what its control groups and resource limits leave of it, bytes."""
    from distributed.system import MEMORY_LIMIT

    return int(MEMORY_LIMIT)


def free() -> int:
    """Memory that this process and its children may still take, bytes."""
    machine = psutil.virtual_memory()
    # The memory of other processes in the control group is unknown here: only that of this one is subtracted.
    return max(0, min(int(machine.available), total() - resident()))


def resident() -> int:
    """Resident memory of this process, bytes."""
    return int(psutil.Process().memory_info().rss)


@dataclass(frozen=True)
class Budget:
    """Bytes that a run may take, ``limit``, of which this process holds ``own``; with ``jobs`` workers at most."""

    limit: float
    own: float
    jobs: int = 1

    @property
    def alone(self) -> float:
        """Memory for a task on the only worker, bytes."""
        return max(0.0, self.limit - self.own - WORKER_BYTES)

    def workers(self, largest: float) -> int:
        """Number of workers each of which may run the ``largest`` task [bytes] at once."""
        return int(max(1, min(self.jobs, (self.limit - self.own) // (WORKER_BYTES + largest))))

    def refusal(self, handle: Handle, estimate: float) -> ConfigError | None:
        """Why a task cannot run here at all, if so."""
        if estimate <= self.alone:
            return None
        lower = handle.spec.stage.memory.lower
        change = f"change {' or '.join(lower)}, or " if lower else ""
        return ConfigError(
            "RIL-500",
            f"is estimated to need {words(estimate)}, and {words(self.alone)} are left for a task of the limit of "
            f"{words(self.limit)} (the program itself and a worker hold {words(self.own + WORKER_BYTES)})",
            remedy=f"{change}give more with --memory-limit",
        )


def budget(executor: Any, limit: float | None, jobs: int | None) -> Budget:
    """What a run may take.

    Parameters
    ----------
    limit : bytes; None: on a cluster of others as much as it likes, else what is free.
    jobs : workers; None: one a core. Within the program (``inline``) there is one.
    """
    own = float(resident())
    if limit is None:
        # The page cache of the run's files, and other programs that grow, need the rest of what is free.
        limit = own + 0.9 * free() if executor in ("dask", "inline") else math.inf
    return Budget(float(limit), own, 1 if executor == "inline" else jobs or cores())


class Estimates:
    """Estimates of the tasks of one graph, in the order of their creation.

    Attributes
    ----------
    _results : decoded bytes of results still to come, by number of the node.
    """

    def __init__(self) -> None:
        self._results: dict[int, float] = {}

    def task(self, handle: Handle) -> float:
        """Memory of a task beyond that of an idle worker, bytes."""
        stage = handle.spec.stage
        inputs = [float(h.ref.nbytes) if h.ref else self._results.get(h.index, 0.0) for h in handle.upstream()]
        more = handle.expect  # what it reads from outside, and what its stage adds
        with suppress(Exception):  # an estimate only, and facts may be still to come
            if stage.memory.size is not None:
                more += stage.memory.size(handle.spec.params, handle.spec.args, map_ports(_meta, handle.inputs))
        size = sum(inputs) + more
        # Guesses upon guesses would grow without end along a chain: no result is larger than the largest it came from.
        most = max(*inputs, more) if inputs else math.inf
        self._results[handle.index] = min(stage.memory.result * size, most)
        return stage.memory.fixed + stage.memory.factor * size

    def planned(self, graph: Graph) -> list[tuple[Handle, float]]:
        """Tasks of a dry run that are to be computed, each with its memory [bytes]."""
        return [(handle, self.task(handle)) for handle in graph.nodes if handle.status == "planned"]


def _meta(handle: Handle) -> Any:
    ref = handle.ref or handle.earlier
    return ref.meta if ref is not None else {}
