"""Admission of tasks: running tasks together stay under a limit of memory, and begin in the order of creation.

The sum counts the memory of this process, of each worker between tasks, and of each running task as foreseen
(:mod:`rille.pipeline.engine.memory.cost_model`). A task begins if the sum stays under the limit; a later one may
pass one that has to wait, but not for ever. One that does not fit even alone is refused, with the parameter that makes
it smaller. On a cluster given by address the memory is the workers' own business, unless a limit is given for all of
it.

Executors get more tasks than they run at a time, so that workers need not wait. Nobody knows which of them
run together, so the sum takes the largest: as many as can run at a time, of all that the executor has.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any

from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.memory import limits
from rille.pipeline.engine.memory.cost_model import Costs, Foreseen, input_bytes
from rille.pipeline.engine.memory.limits import words
from rille.stages.core.errors import ConfigError

PATIENCE = 8
"""Tasks that may pass one that waits for memory."""


FRESH = 0.2
"""Seconds that a look at the machine's free memory holds."""


class MemoryRefusedError(ConfigError):
    """A task needs more memory than the limit, all others aside."""


@dataclass(frozen=True)
class Account:
    """Division of the memory limit, bytes: ``own`` is held by this process, ``rest`` by each of the ``workers``."""

    limit: float
    own: float
    rest: float
    workers: int

    @property
    def budget(self) -> float:
        """Memory for all running tasks together, bytes."""
        return max(0.0, self.limit - self.own - self.workers * self.rest)

    @property
    def alone(self) -> float:
        """Memory for a task that runs alone, on the only worker, bytes."""
        return max(0.0, self.limit - self.own - self.rest)


def account(costs: Costs, limit: float | None, executor: Any, jobs: int, largest: float = 0.0) -> Account:
    """The shares; with fewer workers than ``jobs`` where the largest task needs their place."""
    own = limits.resident()
    if executor not in ("dask", "inline") and limit is None:
        return Account(math.inf, own, 0.0, jobs)
    limit = float(limit) if limit is not None else own + limits.SHARE * limits.free()
    if executor != "dask":
        return Account(limit, own, 0.0, 1 if executor == "inline" else jobs)
    rest = costs.rest
    # Workers hold memory between tasks too: fewer of them leave room for the one task that needs it.
    fit = int((limit - own - largest) // rest)
    return Account(limit, own, rest, max(1, min(jobs, fit)))


class Admission:
    """Keeps the sum of what runs under the budget of an account; ``automatic``: the limit was not given by the user."""

    def __init__(self, costs: Costs, shares: Account, *, automatic: bool) -> None:
        self.costs, self.shares, self.automatic = costs, shares, automatic
        self.together = shares.workers
        """Tasks that may run side by side."""
        self._running: dict[int, Foreseen] = {}
        self._foreseen: dict[tuple[int, bool], Foreseen] = {}
        self._free, self._asked = 0.0, -math.inf

    def foresee(self, handle: Handle) -> Foreseen:
        """Foresee the cost of a task; results of running tasks count as foreseen."""
        # No key while an input is still to come: with one it is foreseen anew, from the true sizes of its inputs.
        asked = handle.index, bool(handle.key)
        if asked not in self._foreseen:
            results = {h.index: f.result for h in handle.upstream() if (f := self._running.get(h.index)) is not None}
            self._foreseen[asked] = self.costs.foresee(handle.spec, input_bytes(handle, results))
        return self._foreseen[asked]

    def fits(self, handle: Handle) -> bool:
        """Whether a task may begin now; alone it always may."""
        # Alone it may begin whatever the look says: waiting would free nothing.
        if not self._running:
            return True
        most = self.foresee(handle).most
        together = heapq.nlargest(self.together, [most, *(f.most for f in self._running.values())])
        if sum(together) > self.shares.budget:
            return False
        # The automatic limit is a share of what was free at the start; others may have taken of it since.
        return not self.automatic or self._now() > most

    def _now(self) -> float:
        """What is free on the machine, by a look that is fresh enough."""
        if time.monotonic() - self._asked > FRESH:
            self._free, self._asked = limits.free(), time.monotonic()
        return self._free

    def begin(self, handle: Handle) -> None:
        """A task has begun."""
        self._running[handle.index] = self.foresee(handle)
        for known in (False, True):
            self._foreseen.pop((handle.index, known), None)

    def end(self, handle: Handle) -> None:
        """A task has ended."""
        self._running.pop(handle.index, None)

    def refusal(self, handle: Handle, foreseen: Foreseen | None = None) -> MemoryRefusedError | None:
        """Why a task cannot run here at all, if so."""
        foreseen = foreseen or self.foresee(handle)
        if foreseen.memory <= self.shares.alone:
            return None
        lower = handle.spec.stage.memory.lower
        change = f"change {' or '.join(lower)}, or " if lower else ""
        return MemoryRefusedError(
            "RIL-500",
            f"would need about {words(foreseen.memory)} ({foreseen.source}), and "
            f"{words(self.shares.alone)} are left for a task of the limit of {words(self.shares.limit)} "
            f"(the program itself and a worker hold {words(self.shares.own + self.shares.rest)})",
            remedy=f"{change}give more with --memory-limit",
        )

    def check(self, graph: Graph) -> None:
        """Raise where a planned task cannot run here at all."""
        for index, foreseen in forecast(graph, self.costs).items():
            error = self.refusal(graph.nodes[index], foreseen)
            if error is not None:
                raise error.at(graph.nodes[index].label)


def forecast(graph: Graph, costs: Costs) -> dict[int, Foreseen]:
    """Foresee the cost of each planned task of a dry run, by index; results still to come count as foreseen."""
    found: dict[int, Foreseen] = {}
    results: dict[int, float] = {}
    for handle in graph.nodes:  # inputs come before what they lead to
        if handle.status == "planned":
            size = input_bytes(handle, results)
            found[handle.index] = foreseen = costs.foresee(handle.spec, size)
            results[handle.index] = foreseen.result
            inputs = [float(h.ref.nbytes) if h.ref else results.get(h.index, 0.0) for h in handle.upstream()]
            if inputs and not foreseen.measured:  # guesses upon guesses would grow without end along a chain
                results[handle.index] = min(foreseen.result, max(*inputs, size - sum(inputs)))
    return found


def largest(graph: Graph, costs: Costs) -> float:
    """Memory of the greatest planned task, bytes."""
    return max((f.most for f in forecast(graph, costs).values()), default=0.0)


class Waiting:
    """Tasks that wait for a worker: by stage, in order of creation."""

    def __init__(self) -> None:
        self._heaps: dict[str, list[int]] = {}
        self._nodes: dict[int, Handle] = {}
        self._passed = 0

    def __len__(self) -> int:
        return len(self._nodes)

    def __iter__(self) -> Iterator[Handle]:
        return iter(self._nodes.values())

    def push(self, handle: Handle) -> None:
        """Add a task."""
        heapq.heappush(self._heaps.setdefault(handle.stage, []), handle.index)
        self._nodes[handle.index] = handle

    def discard(self, handle: Handle) -> None:
        """Take out what need not wait any more."""
        self._nodes.pop(handle.index, None)

    def clear(self) -> None:
        """Forget all."""
        self._heaps.clear()
        self._nodes.clear()

    def take(self, cold: Collection[str], fits: Callable[[Handle], bool], last: bool = True) -> Handle | None:
        """The first that fits into memory, if there is one; of ``cold`` stages only as the ``last`` resort.

        While a stage's first task compiles its kernels another worker would wait for the same ones.
        """
        for stage, heap in list(self._heaps.items()):
            # A heap gives up its least entry alone: discarded tasks stay in it until they come to the top.
            while heap and heap[0] not in self._nodes:
                heapq.heappop(heap)
            if not heap:
                del self._heaps[stage]
        first = sorted((stage in cold, heap[0], stage) for stage, heap in self._heaps.items())
        for place, (is_cold, index, stage) in enumerate(first):
            handle = self._nodes[index]
            if is_cold and not last:
                return None
            if fits(handle):
                self._passed = self._passed + 1 if place else 0
                heapq.heappop(self._heaps[stage])
                del self._nodes[index]
                return handle
            # From now on nothing passes: what runs ends, and makes room for the one that waits.
            if self._passed >= PATIENCE:
                return None
        return None
